"""Weights of particles, always as natural logs: normalisation, systematic resampling, moments."""

from __future__ import annotations

import numpy as np

from obsnet.errors import FilterError


def normalise(log_weights: np.ndarray, what: str = "particle") -> tuple[np.ndarray, float]:
    """Log weights that sum to one, and the log of what they summed to before.

    Parameters
    ----------
    log_weights : array, dims (particle,)
        Natural logs; minus infinity is a dead particle.
    what : str
        Name of the hypotheses, for the message.

    Returns
    -------
    normalised : array, dims (particle,)
        `log_weights - log_total`.
    log_total : float
        ln Σ exp(log_weights): the log evidence where the weights were prior times likelihood.

    Raises
    ------
    FilterError
        There is no particle, every one is dead, or a weight is NaN or plus infinity: the data contradict
        every hypothesis or the likelihood is broken, and no estimate is better than a wrong one.

    >>> round(normalise(np.log([1.0, 3.0]))[1], 6)
    1.386294
    """
    log_weights = np.asarray(log_weights, float)
    if log_weights.size == 0:
        raise FilterError(f"asked to normalise the weights of no {what} at all; give the filter at least one")
    total = _log_total(log_weights.ravel())
    if not np.isfinite(total):
        raise FilterError(_death(log_weights, total, what))
    return log_weights - total, total


def effective_sample_size(log_weights: np.ndarray) -> float:
    """Number of equally weighted particles worth as much: (Σ w)² / Σ w²; the weights need not be normalised.

    >>> round(effective_sample_size(np.zeros(8)), 6)
    8.0
    """
    normalised, _ = normalise(log_weights)
    return float(1.0 / np.exp(2.0 * normalised).sum())


def systematic_resampling(
    log_weights: np.ndarray, rng: np.random.Generator, count: int | None = None
) -> np.ndarray:
    """Indices of the surviving particles: one uniform draw, equidistant pointers into the cumulated weights.

    Particle i is drawn ⌊count·w_i⌋ or ⌈count·w_i⌉ times. The indices are sorted; survivors weigh 1/`count`.

    Parameters
    ----------
    log_weights : array, dims (particle,)
        Natural logs, not necessarily normalised.
    rng : Generator
    count : int, optional
        Number of survivors; by default as many as there are particles.

    Raises
    ------
    FilterError
        As `normalise`.

    Source: Kitagawa 1996, J. Comp. Graph. Stat. 5(1).
    """
    log_weights = np.asarray(log_weights, float)
    normalised, _ = normalise(log_weights)
    return _systematic(np.exp(normalised), rng.random(), len(log_weights) if count is None else int(count))


def weighted_mean(values: np.ndarray, log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum mean-square-error estimate and its covariance.

    Parameters
    ----------
    values : array, dims (particle, state)
    log_weights : array, dims (particle,)
        Not necessarily normalised.

    Returns
    -------
    mean : array, dims (state,)
    covariance : array, dims (state, state)
    """
    values = np.asarray(values, float)
    weights = np.exp(normalise(log_weights)[0])
    mean = weights @ values
    spread = values - mean
    return mean, (spread * weights[:, None]).T @ spread


def circular_mean(angles_deg: np.ndarray, log_weights: np.ndarray) -> tuple[float, float]:
    """Mean direction [0, 360) and circular standard deviation √(−2 ln R) of weighted angles, degrees.

    >>> [round(value, 6) for value in circular_mean(np.array([350.0, 10.0]), np.zeros(2))]
    [0.0, 10.02556]
    """
    weights = np.exp(normalise(log_weights)[0])
    resultant = weights @ np.exp(1j * np.deg2rad(np.asarray(angles_deg, float)))
    length = min(abs(resultant), 1.0)
    spread = np.rad2deg(np.sqrt(-2.0 * np.log(max(length, np.finfo(float).tiny))))
    mean = float(np.round(np.rad2deg(np.angle(resultant)), 12) % 360.0)
    return mean, float(spread)


def _death(log_weights: np.ndarray, total: float, what: str) -> str:
    count = log_weights.size
    if np.isnan(log_weights).any():
        broken = int(np.isnan(log_weights).sum())
        return f"{broken} of {count} {what} weights are NaN; check the measurement for gaps"
    if total > 0:
        return f"a {what} weight is infinite; give the measurement noise a positive spread"
    return (
        f"all {count} {what} weights are zero: the measurement contradicts every {what}; "
        "widen the prior or the measurement noise, or check the measurement"
    )


def _log_total(log_weights: np.ndarray) -> float:
    """NaN where a weight is, infinite where one is infinite or all are zero."""
    peak = float(log_weights.max())
    if not np.isfinite(peak):
        return peak
    return peak + float(np.log(np.exp(log_weights - peak).sum()))


def _systematic(weights: np.ndarray, offset: float, count: int) -> np.ndarray:
    """The particle whose stretch of the cumulated weights each pointer falls into; never one of no weight at their end."""
    last = int(np.flatnonzero(weights)[-1])
    pointers = (np.arange(count) + offset) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), pointers, side="right"), last)
