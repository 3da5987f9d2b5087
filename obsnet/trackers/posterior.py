"""Best hypothesis and a score in, what is known about the course out: mean, covariance, evidence.

Importance sampling adapts a multivariate t to the posterior. Its covariance takes the tiles' word for independent draws of
the model; a ship that turns a little or delays that are a little wrong make neighbouring tiles err together. How far blocks of
tiles disagree about the course shows it, and widens the covariance (the sandwich of misspecified likelihoods, Huber 1967).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsnet.kinematics import wrap180

FLOOR = np.array([1.0, 10.0, 0.05, 0.005])
"""Standard deviations that no segment goes below: s, m, deg, m/s; finer than the maps' cells."""


@dataclass(frozen=True)
class Posterior:
    """Mean (CPA time [s], signed CPA range [m], course [deg], speed [m/s]), 4×4 covariance and log evidence."""

    mean: np.ndarray
    covariance: np.ndarray
    log_evidence: float


def posterior(
    best: np.ndarray,
    log_likelihood: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    inside: Callable[[np.ndarray], np.ndarray],
    seen: np.ndarray,
    *,
    block: int = 5,
    samples: int = 3000,
    seed: int = 0,
    rounds: int = 5,
) -> Posterior:
    """Mean, covariance and evidence of a course, by adaptive importance sampling around the best hypothesis.

    Parameters
    ----------
    best : array (4), CPA time, signed CPA range, course, speed.
    log_likelihood : points (n, 4) to their log-likelihood (n) and each tile's share of it (n_tiles, n).
    inside : points (n, 4) to whether the prior allows them (n).
    seen : bool array (4), parameters that the maps observe; the others stay where `best` has them.
    block : consecutive tiles whose errors may be one.
    """
    rng = np.random.default_rng(seed)
    mean, cov = best.copy(), np.diag([60.0, 500.0, 3.0, 0.3]) ** 2
    log_evidence = -np.inf
    for _ in range(rounds):
        points, log_proposal = student(rng, mean, cov, samples, seen)
        total, per_tile = log_likelihood(points)
        log_weight = np.where(inside(points), total, -np.inf) - log_proposal
        top = log_weight.max()
        weight = np.exp(log_weight - top)
        log_evidence = float(top + np.log(weight.mean()))
        weight /= weight.sum()
        mean = best + weight @ difference(points, best)
        deviation = difference(points, mean)
        cov = (weight * deviation.T) @ deviation + np.diag(FLOOR) ** 2
    chosen = np.ix_(seen, seen)
    cov[chosen] = widened(cov[chosen], deviation[:, seen], weight, per_tile, block)
    return Posterior(mean, cov, log_evidence)


def widened(
    cov: np.ndarray, deviation: np.ndarray, weight: np.ndarray, per_tile: np.ndarray, block: int
) -> np.ndarray:
    """The covariance, widened along the directions in which blocks of tiles disagree more than it allows.

    The gradient of a tile's score is its regression on the deviation of the samples, C⁻¹ cov(θ, s).
    """
    heard = np.flatnonzero(np.abs(per_tile).sum(axis=1) > 0)
    if len(heard) < 3 * block:
        return cov
    share = per_tile[heard[0] : heard[-1] + 1]
    slope = (weight * (share - (share @ weight)[:, None])) @ deviation
    edges = np.arange(0, len(share), block)
    slope = np.add.reduceat(slope, edges, axis=0)
    slope -= slope.mean(axis=0)
    # cov(θ, s) = C·gradient, so that its scatter over the blocks is the sandwich C J C itself.
    spare = max(len(edges) - len(cov), 1)
    sandwich = slope.T @ slope * len(edges) / spare
    root = np.linalg.cholesky(cov)
    inverse = np.linalg.inv(root)
    values, turn = np.linalg.eigh(inverse @ sandwich @ inverse.T)
    wide = root @ turn
    return (wide * np.maximum(values, 1.0)) @ wide.T


def difference(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Points minus centre, courses the short way round."""
    difference = points - centre
    difference[:, 2] = wrap180(difference[:, 2])
    return difference


def student(
    rng: np.random.Generator,
    mean: np.ndarray,
    cov: np.ndarray,
    count: int,
    seen: np.ndarray,
    dof: float = 5.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws from a multivariate t over the parameters that are seen, and the log density of each."""
    d = int(seen.sum())
    root = np.linalg.cholesky(cov[np.ix_(seen, seen)] * 1.5)
    z = rng.standard_normal((count, d)) / np.sqrt(rng.chisquare(dof, (count, 1)) / dof)
    points = np.tile(mean, (count, 1))
    points[:, seen] += z @ root.T
    points[:, 2] %= 360.0
    constant = (
        math.lgamma((dof + d) / 2)
        - math.lgamma(dof / 2)
        - 0.5 * d * np.log(dof * np.pi)
        - np.log(np.diag(root)).sum()
    )
    return points, constant - 0.5 * (dof + d) * np.log1p((z**2).sum(axis=1) / dof)
