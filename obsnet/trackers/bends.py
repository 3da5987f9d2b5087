"""The posterior of a straight course and a score in, what is known of the ship at CPA out if its course may bend.

Ships wander: a merchant ship's velocity departs from that at CPA by some 2.4 % of its speed in an hour, across as much as along,
and by ten times as much now and then. The bends are nuisance parameters with that prior; the course at CPA is marginalised
over them. Straight is what is reported unless the evidence prefers bends, with a covariance that knows how rare straight is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, gammaln

from obsnet.trackers.posterior import FLOOR, Posterior, difference, student, widened

WANDER = 0.024
"""Departure of the velocity over the speed an hour from CPA: scale of a Student t that grows with the square root of time."""

WANDER_DOF = 2.3
"""Degrees of freedom of that Student t. Both are fitted to 457 departures after 1 h and 1.5 h of 61 ships' AIS around 21° S 54° E,
October to December 2012 (package `obsea`): both times agree, and so do across and along."""

STRAIGHT_ODDS = 1.0 / 62.0
"""Prior odds of a straight course: none of those 61 ships held one (rule of succession)."""

TERMS = 2
LARGEST = 0.7
"""A velocity that departs further is another course, not a bend."""

MARGIN_S = 1800.0
"""Bends are given this much beyond the stretch over which the straight course is heard."""

ENOUGH = 100.0
"""Effective samples from which a covariance is taken."""

UNTRUSTED = 30.0
"""Effective samples below which bends are not reported, only feared."""


@dataclass(frozen=True)
class Bends:
    """What is known of the course at CPA.

    Attributes
    ----------
    mean : array (4 + 4·TERMS), the course at CPA, then per term the bends across before and after and along before and after.
    covariance : (4, 4) of the course at CPA, about `mean` if `bent`, else about the straight course's.
    bent : whether the data ask for bends. log_evidence : of the model that is reported.
    """

    mean: np.ndarray
    covariance: np.ndarray
    bent: bool
    log_evidence: float


def bends(
    straight: Posterior,
    log_likelihood: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    allowed: Callable[[np.ndarray], np.ndarray],
    reach_s: np.ndarray,
    *,
    samples: int = 3000,
    seed: int = 0,
) -> Bends:
    """Marginalise the course at CPA over bends, by adaptive importance sampling.

    Parameters
    ----------
    straight : posterior of the straight course.
    log_likelihood : points (n, 4 + 4·TERMS) to their log-likelihood (n) and each tile's share of it (n_tiles, n).
    allowed : points to whether the prior of the course at CPA, uniform, allows them (n).
    reach_s : (2), s before and after CPA over which the velocity departs (`kinematics.BentCourse`).
    """
    known, effective = _sampled(straight, log_likelihood, allowed, reach_s, samples, seed)
    log_ratio = known.log_evidence - straight.log_evidence
    share = float(expit(log_ratio - np.log(STRAIGHT_ODDS)))
    bent = log_ratio > 0 and effective >= UNTRUSTED
    apart = difference(known.mean[None, :4].copy(), straight.mean)[0]
    covariance = (1.0 - share) * straight.covariance + share * known.covariance[:4, :4]
    covariance += ((1.0 - share) if bent else share) * np.outer(apart, apart)
    return Bends(known.mean, covariance, bent, straight.log_evidence + (log_ratio if bent else 0.0))


def _sampled(
    straight: Posterior,
    log_likelihood: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    allowed: Callable[[np.ndarray], np.ndarray],
    reach_s: np.ndarray,
    samples: int,
    seed: int,
    rounds: int = 12,
) -> tuple[Posterior, float]:
    """Posterior of the course at CPA and its bends, and how many independent samples it stands on.

    The rounds flatten the posterior so far that `ENOUGH` samples count, until it needs no flattening; the last takes all samples.
    """
    rng = np.random.default_rng(seed)
    scale = wander(reach_s)
    best = np.concatenate([straight.mean, np.zeros(scale.size)])
    mean, spread = best, np.diag([30.0, 200.0, 1.0, 0.1]) ** 2
    cov = np.diag(np.concatenate([np.zeros(4), scale**2]))
    cov[:4, :4] = straight.covariance + spread
    floor = np.diag(np.concatenate([FLOOR, np.full(scale.size, 1e-3)])) ** 2
    every = np.ones(len(best), bool)
    last = False
    for step in range(rounds):
        last = last or step == rounds - 1
        points, log_proposal = student(rng, mean, cov, samples if last else samples // 2, every)
        total, per_tile = log_likelihood(points)
        inside = allowed(points) & (abs(points[:, 4:]) < LARGEST).all(axis=1)
        log_weight = np.where(inside, total + _log_prior(points[:, 4:], scale), -np.inf) - log_proposal
        top = log_weight.max()
        log_weight = np.maximum(log_weight - top, -1e6)
        power = 1.0 if last else _power(log_weight)
        weight = np.exp(power * log_weight)
        log_evidence = float(top + np.log(weight.mean()))
        weight /= weight.sum()
        mean = best + weight @ difference(points, best)
        deviation = difference(points, mean)
        cov = (weight * deviation.T) @ deviation + floor
        if last:
            break
        last = power == 1.0
    cov = widened(cov, deviation, weight, per_tile, block=5)
    return Posterior(mean, cov, log_evidence), float(1.0 / (weight @ weight))


def wander(reach_s: np.ndarray) -> np.ndarray:
    """Prior scales of the bends, (4·TERMS): the terms of a random walk of the velocity go as 1/(k − ½)."""
    first = WANDER * np.sqrt(np.asarray(reach_s) / 3600.0)
    return np.concatenate([np.tile(first, 2) / (2 * term + 1) for term in range(TERMS)])


def _log_prior(values: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log density of bends (n, 4·TERMS), Student's t each."""
    dof = WANDER_DOF
    constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
    density = constant - np.log(scale) - 0.5 * (dof + 1) * np.log1p((values / scale) ** 2 / dof)
    return density.sum(axis=1)


def _power(log_weight: np.ndarray) -> float:
    """Greatest power of the weights, up to 1, by which `ENOUGH` samples count."""

    def enough(power: float) -> bool:
        weight = np.exp(power * log_weight)
        return bool(weight.sum() ** 2 >= ENOUGH * (weight @ weight))

    low, high = 0.0, 1.0
    if enough(high):
        return high
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return low
