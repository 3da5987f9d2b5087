"""Distance between a set of true targets and a set of estimates: OSPA and GOSPA."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from obsnet.errors import ConfigError
from obsnet.kinematics import wrap180


@dataclass(frozen=True)
class Gospa:
    """GOSPA distance and, with α = 2, what it is made of (each already raised to the power of the order)."""

    distance: float
    localisation: float
    missed: float
    false: float


def angular_distances(truth_deg: np.ndarray, estimates_deg: np.ndarray) -> np.ndarray:
    """Absolute angle differences [deg], dims (truth, estimate), across the 360° seam.

    >>> angular_distances([359.0], [2.0, 180.0]).tolist()
    [[3.0, 179.0]]
    """
    truth, estimates = (
        np.atleast_1d(np.asarray(truth_deg, float)),
        np.atleast_1d(np.asarray(estimates_deg, float)),
    )
    return np.abs(wrap180(truth[:, None] - estimates[None, :]))


def euclidean_distances(truth: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    """Euclidean distances, dims (truth, estimate), of points with dims (point, coordinate)."""
    truth, estimates = np.asarray(truth, float), np.asarray(estimates, float)
    if truth.size == 0 or estimates.size == 0:
        return np.empty((len(truth), len(estimates)))
    return np.linalg.norm(truth[:, None, :] - estimates[None, :, :], axis=-1)


def ospa(distances: np.ndarray, cutoff: float, order: float = 1.0) -> float:
    """Optimal subpattern assignment distance per target, 0 to `cutoff`.

    With m ≤ n the sizes of the two sets: ((min over assignments Σ min(d, c)^p + c^p (n − m)) / n)^(1/p); zero
    where both are empty. Eq. 37 of the track-before-detect paper leaves out the division, which is the same
    where there is one target and at most one estimate.

    Parameters
    ----------
    distances : array, dims (truth, estimate)
        Base distances, as of `angular_distances` or `euclidean_distances`; one of the sizes may be 0.
    cutoff : float
        c, in the unit of the distances; a missing or a false target costs this much.
    order : float
        p ≥ 1.

    Raises
    ------
    ConfigError
        `distances` is not a matrix, holds a NaN or a negative value, or cut-off and order are out of range.

    Source: Schuhmacher, Vo & Vo 2008, IEEE Trans. Signal Process. 56(8).

    >>> ospa([[3.0, 100.0]], cutoff=30.0)
    16.5
    """
    capped = _capped(distances, cutoff, order)
    smaller, larger = min(capped.shape), max(capped.shape)
    if larger == 0:
        return 0.0
    total = _assigned(capped**order).sum() + cutoff**order * (larger - smaller)
    return float((total / larger) ** (1.0 / order))


def gospa(distances: np.ndarray, cutoff: float, order: float = 1.0) -> Gospa:
    """Generalised OSPA with α = 2: errors of the assigned pairs plus c^p/2 per missed and per false target.

    Not divided by the number of targets; a pair further apart than the cut-off counts as one missed and one
    false.

    Parameters and errors as of `ospa`.

    Source: Rahmathullah, García-Fernández & Svensson 2017, FUSION, eq. (4).

    >>> gospa([[3.0, 100.0]], cutoff=30.0)
    Gospa(distance=18.0, localisation=3.0, missed=0.0, false=15.0)
    """
    capped = _capped(distances, cutoff, order)
    pairs = _assigned(capped**order)
    assigned = pairs[pairs < cutoff**order]
    half = cutoff**order / 2.0
    missed = half * (capped.shape[0] - len(assigned))
    false = half * (capped.shape[1] - len(assigned))
    localisation = float(assigned.sum())
    return Gospa(float((localisation + missed + false) ** (1.0 / order)), localisation, missed, false)


def _assigned(costs: np.ndarray) -> np.ndarray:
    rows, columns = linear_sum_assignment(costs)
    return costs[rows, columns]


def _capped(distances: np.ndarray, cutoff: float, order: float) -> np.ndarray:
    distances = np.asarray(distances, float)
    if distances.ndim != 2:
        raise ConfigError(f"distances must have dims (truth, estimate), found {distances.ndim} dimension(s)")
    if not (distances >= 0).all():
        raise ConfigError(
            "distances must be numbers of at least 0; drop missing targets before comparing sets"
        )
    if not (np.isfinite(cutoff) and cutoff > 0 and order >= 1):
        raise ConfigError(
            f"the cut-off must be positive and the order at least 1, found {cutoff!r} and {order!r}"
        )
    return np.minimum(distances, cutoff)
