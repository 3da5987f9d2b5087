"""A ship's course from the station's bearings alone, for when no range was heard.

The errors' covariance is in `bearing_errors`, the geometry and the Cramér-Rao bounds in `bearing_bounds`, the
maximum-likelihood fit in `bearing_fit` (Urazghildiiev & Hannay). A station's minutes also hold false ones.
The course is found under a mixture of independent Gaussian errors and a uniform share, their size annealed;
the rest is fitted with its full covariance, without what is more probably false given its neighbours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse, emission, wrap180
from obsnet.trackers.bearing_bounds import cpa_jacobian, cramer_rao, whitener
from obsnet.trackers.bearing_errors import BearingErrors
from obsnet.trackers.bearing_fit import Fit, centre, refine, start_grid, to_theta, turn
from obsnet.trackers.track import Track

Delay = Callable[[np.ndarray], np.ndarray]
MOST_PASSES = 40
FIXED_ODDS = 10.0
"""Log odds that a passing ship must have over a fixed direction; noise from one side is common."""


def track_bearings(
    times_s: np.ndarray,
    azimuth_deg: np.ndarray,
    std_deg: float | np.ndarray,
    *,
    correlation_s: float,
    speed_mps: float,
    speed_std_mps: float,
    delay: Delay | None = None,
    false_share: float = 0.1,
    white_share: float = 0.1,
    max_range_m: float = 100e3,
) -> Track | None:
    """Course of a ship from a station's bearings alone, when no range was heard.

    Parameters
    ----------
    times_s : array (K,), s since 1970
        When the bearings were heard, in any order, all different.
    azimuth_deg : array (K,), deg
        NaN where there is none.
    std_deg : float or array (K,), deg
        Standard deviation of true bearings.
    correlation_s : float
        Correlation interval of their errors (linear model) [s]; bearings from overlapping windows share at
        least the window's length.
    speed_mps, speed_std_mps : float
        Mean and standard deviation of the speed's prior, for example 7.5 and 2.
    delay : callable, optional
        Travel time of sound [s] at a range [m]; with it the track is where the ship was, not where it was
        heard.
    false_share : float
        Share of false bearings, uniform in azimuth, in (0, 1).
    white_share : float
        Share of the errors' variance that is not correlated, in [0, 1].
    max_range_m : float
        Prior of the signed CPA range: uniform to this on either side.

    Returns
    -------
    Track or None
        None where the bearings say no ship, or do not tell a passing one from a source at a fixed azimuth.
        `log_bayes_factor` is against no ship (uniform bearings), by Laplace's method with uniform priors of
        course, CPA range and CPA time (twice the span). `extra` holds `log_likelihood` of the bearings used,
        `log_bayes_factor_fixed`, against a fixed azimuth, and `used`, per bearing given.

    Raises
    ------
    LayoutError, ConfigError
        Bearings, times, errors or priors are not what they should be.
    """
    errors = BearingErrors(1.0, correlation_s, nugget=white_share)
    record = _record(times_s, azimuth_deg, std_deg, errors, false_share)
    _check_prior(speed_mps, speed_std_mps, max_range_m)
    if len(record.time) < 4:
        return None
    found = _locate(record, speed_mps, delay)
    if found is None:
        return None
    motion, emitted, used, log_ratio = found
    margin = (record.time[-1] - record.time[0]) / 2
    if abs(motion.cpa_range_m) > max_range_m or not -margin <= motion.cpa_time - emitted[0] <= 3 * margin:
        return None
    covariance = _motion_covariance(record, motion, emitted, used)
    if covariance is None:
        return None
    volume = 4 * margin * 2 * max_range_m * 360.0
    evidence = log_ratio + 0.5 * np.linalg.slogdet(2 * np.pi * covariance[:3, :3])[1] - np.log(volume)
    fixed = evidence - _fixed_evidence(record)
    if evidence <= 0 or fixed <= FIXED_ODDS:
        return None
    scale = np.array([0.0, motion.cpa_range_m / speed_mps, 0.0, 1.0])
    covariance += speed_std_mps**2 * np.outer(scale, scale)
    if delay is not None:
        covariance = _undo_delay(covariance, motion, delay)
    flags = np.zeros(np.size(times_s), bool)
    flags[record.kept[used]] = True
    extra = {"log_likelihood": log_ratio, "log_bayes_factor_fixed": fixed, "used": flags}
    method = f"bearings only, no range heard: speed taken as {speed_mps:g} ± {speed_std_mps:g} m/s"
    return Track(float(emitted[0]), float(emitted[-1]), motion, covariance, float(evidence), method, extra)


@dataclass(frozen=True)
class _Record:
    """A station's bearings in order of time [s, deg, deg], their places in what was given, their errors."""

    time: np.ndarray
    azimuth: np.ndarray
    std: np.ndarray
    kept: np.ndarray
    errors: BearingErrors
    false_share: float

    def true_share(self, residual: np.ndarray, widening: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Probability that a bearing of this residual [deg] is true; the mixture's log density [1/deg]."""
        std = self.std * widening
        true = (1 - self.false_share) * np.exp(-0.5 * (residual / std) ** 2) / (np.sqrt(2 * np.pi) * std)
        mixture = true + self.false_share / 360.0
        return true / mixture, np.log(mixture)


def _record(
    times_s: np.ndarray,
    azimuth_deg: np.ndarray,
    std_deg: float | np.ndarray,
    errors: BearingErrors,
    false_share: float,
) -> _Record:
    time, azimuth = np.asarray(times_s, float), np.asarray(azimuth_deg, float)
    if time.ndim != 1 or azimuth.shape != time.shape:
        raise LayoutError(
            f"one azimuth per time is needed, found {azimuth.shape} azimuths and {time.shape} times"
        )
    try:
        std = np.broadcast_to(np.asarray(std_deg, float), time.shape)
    except ValueError:
        raise LayoutError(
            f"std_deg must be one number or one per bearing, found {np.shape(std_deg)} for {time.shape}"
        ) from None
    kept = np.flatnonzero(np.isfinite(time) & np.isfinite(azimuth))
    kept = kept[np.argsort(time[kept], kind="stable")]
    if not (np.isfinite(std[kept]).all() and (std[kept] > 0).all()):
        raise ConfigError("std_deg must be positive and finite wherever there is a bearing")
    if (np.diff(time[kept]) <= 0).any():
        raise LayoutError("two bearings have the same time; keep one bearing for each time")
    if not 0 < false_share < 1:
        raise ConfigError(f"false_share must lie between 0 and 1, found {false_share}")
    return _Record(time[kept], azimuth[kept], std[kept], kept, errors, false_share)


def _check_prior(speed_mps: float, speed_std_mps: float, max_range_m: float) -> None:
    if not (np.isfinite(speed_mps) and speed_mps > 0):
        raise ConfigError(f"speed_mps must be positive, found {speed_mps}")
    if not (np.isfinite(speed_std_mps) and speed_std_mps >= 0):
        raise ConfigError(f"speed_std_mps must be zero or positive, found {speed_std_mps}")
    if not (np.isfinite(max_range_m) and max_range_m > 0):
        raise ConfigError(f"max_range_m must be positive, found {max_range_m}")


def _locate(
    record: _Record, speed_mps: float, delay: Delay | None
) -> tuple[StraightCourse, np.ndarray, np.ndarray, float] | None:
    """Motion, times of emission, bearings used and log likelihood ratio; travel times by fixed point."""
    emitted, polar = record.time, None
    for _ in range(1 if delay is None else 3):
        reference, half = centre(emitted)
        unit_time = (emitted - reference) / half
        starts = _candidates(record, unit_time) if polar is None else polar
        solved = _robust_fit(record, unit_time, starts, free=3)
        if solved is None:
            return None
        polar, used, log_ratio = solved
        speed = np.array([speed_mps])
        motion = Fit(to_theta(polar, half, speed), speed, reference, np.zeros(1), np.ones(1, bool)).course()
        if delay is not None:
            emitted = emission(motion, record.time, partial(_travel_time, delay))
    return motion, emitted, used, log_ratio


def _candidates(record: _Record, unit_time: np.ndarray, count: int = 3) -> np.ndarray:
    """Grid cells (2 count, 3), both sides, that do best under the mixture with widened errors."""
    cells = start_grid(unit_time)
    radians = np.deg2rad(record.azimuth)
    relative = radians - turn(cells, unit_time)
    offset = np.angle(np.exp(1j * relative) @ record.std**-2.0)
    residual = wrap180(np.rad2deg(relative - offset[:, None]))
    score = record.true_share(residual, 4.0)[1].sum(axis=1)
    chosen: list[int] = []
    for side in (-1, 1):
        own = np.flatnonzero(np.sign(cells[:, 0]) == side)
        chosen.extend(own[np.argsort(score[own])[-count:]])
    return np.concatenate([offset[chosen, None], cells[chosen]], axis=1)


def _robust_fit(
    record: _Record, unit_time: np.ndarray, starts: np.ndarray, free: int
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Best of `starts` under independent errors and false bearings; then the true ones, whitened."""
    annealed = [_anneal(record, unit_time, start[None], free) for start in starts]
    polar = annealed[int(np.argmax([score for _, score in annealed]))][0]
    radians = np.deg2rad(record.azimuth)[None]
    used = np.flatnonzero(record.true_share(_misfit(polar, radians, unit_time))[0] > 0.5)
    for _ in range(MOST_PASSES):
        if len(used) <= free:
            return None
        white = whitener(record.errors.covariance(record.time[used], record.std[used]))
        seen, when = radians[:, used], unit_time[used]
        polar, chi2, _ = refine(polar, seen, when, np.rad2deg(white), free)
        false = _false_in_context(white, _misfit(polar, seen, when), record, used)
        fitted, used = used, used[~false]
        if not false.any():
            break
    return polar, fitted, _log_ratio(white, float(chi2[0]), len(unit_time), record.false_share)


def _false_in_context(
    white: np.ndarray, residual: np.ndarray, record: _Record, used: np.ndarray
) -> np.ndarray:
    """Bearings that are more probably false, given all others; of neighbours only the worst.

    With Q the inverse covariance, residual r_k less its mean given all others is (Q r)_k / Q_kk, of variance
    1 / Q_kk. A false bearing near the course stands out against its correlated neighbours long before it does
    against the course; it also discredits them, which is why they are judged again without it.
    """
    inverse = white.T @ white
    precision = np.diag(inverse)
    score = 0.5 * (np.log(precision / (2 * np.pi)) - (inverse @ residual) ** 2 / precision)
    score += np.log((1 - record.false_share) * 360.0 / record.false_share)
    time, reach = record.time[used], 3.5 * record.errors.correlation_s
    false = np.zeros(len(used), bool)
    for worst in np.argsort(score)[: int(np.sum(score < 0))]:
        false[worst] = not (np.abs(time[false] - time[worst]) <= reach).any()
    return false


def _log_ratio(white: np.ndarray, chi2: float, count: int, false_share: float) -> float:
    """Log likelihood of true bearings, and of the false ones among `count`, against uniform azimuths."""
    true = len(white)
    density = np.log(np.diag(white)).sum() - true * np.log(2 * np.pi) / 2 - chi2 / 2
    return float(density + true * np.log(360.0 * (1 - false_share)) + (count - true) * np.log(false_share))


def _anneal(record: _Record, unit_time: np.ndarray, polar: np.ndarray, free: int) -> tuple[np.ndarray, float]:
    radians = np.deg2rad(record.azimuth)[None]
    for widening in (4.0, 2.0, 1.0, 1.0):
        true = record.true_share(_misfit(polar, radians, unit_time), widening)[0]
        white = np.sqrt(np.maximum(true, 1e-9)) / np.deg2rad(record.std * widening)
        polar = refine(polar, radians, unit_time, white, free)[0]
    return polar, float(record.true_share(_misfit(polar, radians, unit_time))[1].sum())


def _misfit(polar: np.ndarray, azimuth: np.ndarray, unit_time: np.ndarray) -> np.ndarray:
    """Residuals [deg] of one run, (K,)."""
    return wrap180(np.rad2deg(azimuth - polar[:, :1] - turn(polar[:, 1:], unit_time)))[0]


def _fixed_evidence(record: _Record) -> float:
    """Log evidence of a source at a fixed azimuth against no source."""
    grid = np.arange(0.0, 360.0, 2.0)
    score = record.true_share(wrap180(record.azimuth - grid[:, None]), 4.0)[1].sum(axis=1)
    start = np.array([[np.deg2rad(grid[np.argmax(score)]), 0.0, 0.0]])
    solved = _robust_fit(record, np.zeros_like(record.time), start, free=1)
    if solved is None:
        return -np.inf
    _, used, log_ratio = solved
    white = whitener(record.errors.covariance(record.time[used], record.std[used]))
    variance = 1.0 / np.sum(white.sum(axis=1) ** 2)
    return log_ratio + 0.5 * np.log(2 * np.pi * variance) - np.log(360.0)


def _motion_covariance(
    record: _Record, motion: StraightCourse, emitted: np.ndarray, used: np.ndarray
) -> np.ndarray | None:
    """Covariance (4, 4) of the motion for a known speed; None where the bearings do not determine it."""
    reference = centre(emitted)[0]
    east, north = motion.position(np.array(reference))
    theta = np.array([float(east), float(north), motion.course_deg])
    errors = record.errors.covariance(record.time[used], record.std[used])
    try:
        bounds = cramer_rao(theta, emitted[used] - reference, errors, motion.speed_mps)
    except LayoutError:
        return None
    jacobian = cpa_jacobian(theta, motion.speed_mps)
    return jacobian @ bounds.full @ jacobian.T


def _travel_time(delay: Delay, distance: np.ndarray) -> np.ndarray:
    """Delay at `distance`; beyond the table sound takes 1 s for 1500 m."""
    with np.errstate(all="ignore"):
        seconds = np.asarray(delay(distance), float)
    return np.where(np.isfinite(seconds), seconds, distance / 1500.0)


def _undo_delay(covariance: np.ndarray, motion: StraightCourse, delay: Delay) -> np.ndarray:
    """A wrong CPA range shifts the CPA time by its travel time: add that to the covariance."""
    distance = abs(motion.cpa_range_m)
    near, far = _travel_time(delay, np.array([0.98 * distance, 1.02 * distance]))
    shift = np.eye(4)
    shift[0, 1] = -np.sign(motion.cpa_range_m) * (far - near) / max(0.04 * distance, 1e-6)
    return shift @ covariance @ shift.T
