"""The posterior of a straight course and a score in, what is known of the ship at CPA out if its course may bend or turn.

Ships wander: a merchant ship's velocity departs from that at CPA by some 2.4 % of its speed in an hour, across as much as along,
and by ten times as much now and then. The bends are nuisance parameters with that prior, and so is a turn where one speaks
up; the course at CPA is marginalised over them. Straight is what is reported unless the evidence prefers otherwise, with a
covariance that knows how rare straight is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsnet.trackers.posterior import FLOOR, Posterior, difference, student, widened

WANDER = 0.024
"""Departure of the velocity over the speed an hour from CPA: scale of a Student t that grows with the square root of time."""

WANDER_DOF = 2.3
"""Degrees of freedom of that Student t. Both are fitted to 457 departures after 1 h and 1.5 h of 61 ships' AIS around 21° S 54° E,
October to December 2012 (package `obsea`): both times agree, and so do across and along."""

STRAIGHT_ODDS = 1.0 / 62.0
"""Prior odds of a straight course: none of those 61 ships held one (rule of succession)."""

ASKED = 1.0
"""Log evidence ratio to the straight course from which another is reported: positive evidence (Kass and Raftery 1995)."""

TURN_ODDS = 0.1
MOST_TURN_DEG = 100.0
"""Prior odds of a turn within the hours of a passage, and its largest angle; when and by how much are uniform."""

WORTH = 20.0
"""A turn is looked into where it alone gains so many nats on the straight course."""

TERMS = 2
BENDS = slice(4, 4 + 4 * TERMS)
TURN = slice(BENDS.stop, BENDS.stop + 2)
LARGEST = 0.7
"""A velocity that departs further is another course, not a bend."""

MARGIN_S = 1800.0
"""Bends are given this much beyond the stretch over which the straight course is heard."""

ENOUGH = 70.0
"""Effective samples from which a covariance is taken."""

UNTRUSTED = 30.0
"""Effective samples below which a model is not reported, only feared."""

LogLikelihood = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (n, 14): course at CPA, per term the bends across before and after and along before and after, time [s] and angle
[deg] of the turn (`kinematics.BentCourse`); to their log-likelihood (n) and each tile's share of it (n_tiles, n)."""


@dataclass(frozen=True)
class Bends:
    """What is known of the course at CPA.

    Attributes
    ----------
    mean : array (14), as `LogLikelihood` takes it; zeros for bends and turn of a straight course.
    covariance : (4, 4) of the course at CPA about `mean`.
    bent : whether the data ask for bends or a turn. log_evidence : of the model that is reported.
    """

    mean: np.ndarray
    covariance: np.ndarray
    bent: bool
    log_evidence: float


def bends(
    straight: Posterior,
    log_likelihood: LogLikelihood,
    allowed: Callable[[np.ndarray], np.ndarray],
    reach_s: np.ndarray,
    *,
    least_of_turn: float,
    samples: int = 3000,
    seed: int = 0,
) -> Bends:
    """Marginalise the course at CPA over bends and, where one speaks up, over a turn.

    Parameters
    ----------
    straight : posterior of the straight course.
    allowed : points to whether the prior of the course at CPA, uniform, allows them (n).
    reach_s : (2), s before and after CPA over which the velocity departs.
    least_of_turn : nats that a turn must gain to be believed.
    """
    start = np.concatenate([straight.mean, np.zeros(TURN.stop - 4)])
    models = [(Posterior(start, straight.covariance, straight.log_evidence), np.log(STRAIGHT_ODDS), np.inf)]
    known, effective = _sampled(start, straight.covariance, log_likelihood, allowed, reach_s, samples, seed)
    models.append((known, 0.0, effective))
    turned, gain = _turned(start, log_likelihood, reach_s)
    if gain > WORTH:
        known, effective = _sampled(
            turned, straight.covariance, log_likelihood, allowed, reach_s, samples, seed
        )
        if known.log_evidence - straight.log_evidence > least_of_turn:
            models.append((known, np.log(TURN_ODDS), effective))
    trusted = [model.log_evidence if count >= UNTRUSTED else -np.inf for model, _, count in models]
    trusted[0] += ASKED
    best = int(np.argmax(trusted))
    mean = models[best][0].mean
    log_share = np.array([model.log_evidence + odds for model, odds, _ in models])
    covariance = np.zeros((4, 4))
    for share, (model, _, _) in zip(np.exp(log_share - np.logaddexp.reduce(log_share)), models, strict=True):
        apart = difference(model.mean[None, :4].copy(), mean[:4])[0]
        covariance += share * (model.covariance[:4, :4] + np.outer(apart, apart))
    return Bends(mean, covariance, best > 0, models[best][0].log_evidence)


def _sampled(
    start: np.ndarray,
    covariance: np.ndarray,
    log_likelihood: LogLikelihood,
    allowed: Callable[[np.ndarray], np.ndarray],
    reach_s: np.ndarray,
    samples: int,
    seed: int,
    rounds: int = 24,
) -> tuple[Posterior, float]:
    """Posterior of the course at CPA with its bends (and turn, if `start` has one), by adaptive importance sampling.

    The rounds flatten the posterior so far that `ENOUGH` samples count, until it needs no flattening; the last takes twice as
    many samples, and is no last one if it finds what the others missed. Returned beside it is how many independent samples it stands on.
    """
    rng = np.random.default_rng(seed)
    turns = start[TURN][1] != 0.0
    scale = wander(reach_s)
    # The straight course nearest to one that turns may be neither of its legs.
    mean, spread = start, np.diag(np.array([30.0, 200.0, 1.0, 0.1]) * (5.0 if turns else 1.0)) ** 2
    seen = np.arange(len(start)) < (TURN.stop if turns else BENDS.stop)
    cov = np.diag(np.concatenate([np.zeros(4), scale**2, [300.0**2, 5.0**2]]))
    cov[:4, :4] = covariance + spread
    floor = np.diag(np.concatenate([FLOOR, np.full(scale.size, 1e-3), [10.0, 0.1]])) ** 2
    last = False
    for step in range(rounds):
        last = last or step == rounds - 1
        points, log_proposal = student(rng, mean, cov, samples // 2 if last else samples // 4, seen)
        total, per_tile = log_likelihood(points)
        log_prior = np.where(allowed(points), _log_prior(points, scale), -np.inf)
        if turns:
            log_prior += _log_prior_of_turn(points, start[TURN][0], reach_s)
        log_weight = total + log_prior - log_proposal
        top = log_weight.max()
        log_weight = np.maximum(log_weight - top, -1e6)
        power = _power(log_weight)
        last = last and (power == 1.0 or step == rounds - 1)
        weight = np.exp((1.0 if last else power) * log_weight)
        log_evidence = float(top + np.log(weight.mean()))
        weight /= weight.sum()
        mean = start + weight @ difference(points, start)
        deviation = difference(points, mean)
        cov = (weight * deviation.T) @ deviation + floor
        if last:
            break
        last = power == 1.0
    chosen = np.ix_(seen, seen)
    cov[chosen] = widened(cov[chosen], deviation[:, seen], weight, per_tile, block=5)
    return Posterior(mean, cov, log_evidence), float(1.0 / (weight @ weight))


def wander(reach_s: np.ndarray) -> np.ndarray:
    """Prior scales of the bends, (4·TERMS): the terms of a random walk of the velocity go as 1/(k − ½)."""
    first = WANDER * np.sqrt(np.asarray(reach_s) / 3600.0)
    return np.concatenate([np.tile(first, 2) / (2 * term + 1) for term in range(TERMS)])


def _log_prior(points: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log density of the bends of points, Student's t each."""
    dof, values = WANDER_DOF, points[:, BENDS]
    constant = math.lgamma((dof + 1) / 2) - math.lgamma(dof / 2) - 0.5 * np.log(dof * np.pi)
    density = constant - np.log(scale) - 0.5 * (dof + 1) * np.log1p((values / scale) ** 2 / dof)
    return np.where((abs(values) < LARGEST).all(axis=1), density.sum(axis=1), -np.inf)


def _log_prior_of_turn(points: np.ndarray, side: float, reach_s: np.ndarray) -> np.ndarray:
    """Log density of the turns of points: uniform over time and angle, on the same side of CPA, which is the closest of both legs."""
    time, angle = points[:, TURN].T
    possible = (time * side >= 0) & (abs(angle) <= MOST_TURN_DEG)
    possible &= (time >= -reach_s[0]) & (time <= reach_s[1])
    foot, cpa = _other_leg(points)
    possible &= (np.sign(time) * (foot - time) <= 0) | (abs(cpa) >= abs(points[:, 1]))
    return np.where(possible, -np.log(reach_s.sum() * 2 * MOST_TURN_DEG), -np.inf)


def _other_leg(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """When the leg beyond the turn comes closest [s after CPA] and how close, signed [m]; bends left out."""
    cpa, speed, (time, angle) = points[:, 1], points[:, 3], points[:, TURN].T
    sine, cosine = np.sin(np.deg2rad(angle)), np.cos(np.deg2rad(angle))
    foot = time - (cpa * sine + speed * time * cosine) / speed
    return foot, cpa * cosine - speed * time * sine


def _turned(
    start: np.ndarray, log_likelihood: LogLikelihood, reach_s: np.ndarray
) -> tuple[np.ndarray, float]:
    """The likeliest turn of a straight course, seen from the leg that comes closest, and what it gains in nats."""
    turned, gain = start, 0.0
    steps_and_halves = (((480.0, 15.0), (reach_s.max(), 90.0)), ((120.0, 3.0), (480.0, 12.0)))
    for steps, halves in steps_and_halves:
        axes = [m + np.arange(-h, h + 1.0, s) for m, s, h in zip(turned[TURN], steps, halves, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        grid = grid[(grid[:, 0] >= -reach_s[0]) & (grid[:, 0] <= reach_s[1]) & (grid[:, 1] != 0.0)]
        points = np.tile(start, (len(grid) + 1, 1))
        points[1:, TURN] = grid
        total, _ = log_likelihood(points)
        best = 1 + int(np.argmax(total[1:]))
        turned, gain = points[best], float(total[best] - total[0])
    (foot,), (cpa,) = _other_leg(turned[None])
    when, by = turned[TURN]
    if np.sign(when) * (foot - when) > 0 and abs(cpa) < abs(turned[1]):
        turned = turned + 0.0
        turned[:4] = turned[0] + foot, cpa, (turned[2] + by) % 360.0, turned[3]
        turned[TURN] = when - foot, -by
    return turned, gain


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
