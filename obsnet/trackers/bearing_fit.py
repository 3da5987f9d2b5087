"""Maximum-likelihood position and course from bearings with correlated errors, for many records at once.

The speed is given. Bearings fix the course, the CPA time and the side on which the ship passes, but range
only in units of the speed: x0, y0 and v may all be multiplied by one number (Urazghildiiev & Hannay, eq. 6).
So the best estimate of the speed is its prior mean, its posterior is its prior, and a relative error of
the speed is the same relative error of every range.

The likelihood is maximised in modified polar coordinates at mid-observation: azimuth α0, turn rate ω and
relative opening rate ρ = ṙ/r, in which α(t) = α0 + atan2(ω t, 1 + ρ t). Bearings are nearly linear in them
whatever the range, also for a ship so far that it hardly moves, where (x0, y0) run off to infinity; the speed
enters only afterwards, r0 = v / √(ω² + ρ²), so that one fit serves all speeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse
from obsnet.trackers.bearing_bounds import Bounds, cramer_rao, whitener


@dataclass(frozen=True)
class Fit:
    """Maximum-likelihood fits to R records of bearings.

    `theta` (R, 3): east, north [m] and course [deg] at `reference_time` [s, on the clock of the bearings];
    `speed_mps` (R,); `chi2` (R,): whitened squared misfit; `converged` (R,).
    """

    theta: np.ndarray
    speed_mps: np.ndarray
    reference_time: float
    chi2: np.ndarray
    converged: np.ndarray

    @property
    def cpa_time(self) -> np.ndarray:
        """Time of CPA [s], (R,)."""
        sin, cos = np.sin(np.deg2rad(self.theta[:, 2])), np.cos(np.deg2rad(self.theta[:, 2]))
        return self.reference_time - (self.theta[:, 0] * sin + self.theta[:, 1] * cos) / self.speed_mps

    @property
    def cpa_range_m(self) -> np.ndarray:
        """Signed range at CPA [m], (R,); positive where the ship is then at azimuth course + 90°."""
        sin, cos = np.sin(np.deg2rad(self.theta[:, 2])), np.cos(np.deg2rad(self.theta[:, 2]))
        return self.theta[:, 0] * cos - self.theta[:, 1] * sin

    def course(self, run: int = 0) -> StraightCourse:
        """One run's estimate as a `StraightCourse`."""
        values = (self.cpa_time[run], self.cpa_range_m[run], self.theta[run, 2], self.speed_mps[run])
        return StraightCourse(*(float(value) for value in values))

    def bounds(
        self, time: np.ndarray, covariance: np.ndarray, speed_std_mps: float = 0.0, run: int = 0
    ) -> Bounds:
        """Cramér-Rao bounds at one run's estimate, as its covariance; arguments as in `fit`."""
        since = np.asarray(time, float) - self.reference_time
        return cramer_rao(self.theta[run], since, covariance, float(self.speed_mps[run]), speed_std_mps)


def fit(
    azimuth_deg: np.ndarray, time: np.ndarray, covariance: np.ndarray, speed_mps: float | np.ndarray
) -> Fit:
    """Maximum-likelihood position and course of many records at once (eqs 9, 10).

    A grid over CPA time, CPA range in units of speed and side, with the course in closed form, starts
    Levenberg-Marquardt on the whitened and wrapped residuals from the best cell of either side; the smaller
    misfit wins.

    Parameters
    ----------
    azimuth_deg : array (R, K) or (K,), deg
    time : array (K,), s, increasing; shared by the records
    covariance : array (K, K), deg²
    speed_mps : float or array (R,)

    Raises
    ------
    LayoutError
        Shapes do not match, a value is not finite, or there are fewer than four bearings.
    ConfigError
        A speed that is not positive.
    """
    azimuth = np.atleast_2d(np.asarray(azimuth_deg, float))
    time, covariance = np.asarray(time, float), np.asarray(covariance, float)
    _check_bearings(azimuth, time, covariance)
    speed = np.broadcast_to(np.asarray(speed_mps, float), (len(azimuth),))
    if not (np.isfinite(speed).all() and (speed > 0).all()):
        raise ConfigError(f"speed_mps must be positive, found {speed_mps}")
    reference, half = centre(time)
    unit_time = (time - reference) / half
    radians = np.deg2rad(azimuth)
    starts = _starts(radians, unit_time, np.diag(covariance))
    white = np.rad2deg(whitener(covariance))
    solved = [refine(start, radians, unit_time, white) for start in starts]
    best = np.argmin([cost for _, cost, _ in solved], axis=0)
    rows = np.arange(len(azimuth))
    polar, chi2, done = (np.stack(part)[best, rows] for part in zip(*solved, strict=True))
    return Fit(to_theta(polar, half, speed), speed, reference, chi2, done)


def _check_bearings(azimuth: np.ndarray, time: np.ndarray, covariance: np.ndarray) -> None:
    count = azimuth.shape[-1]
    if azimuth.ndim != 2 or time.shape != (count,) or covariance.shape != (count, count):
        found = f"found {time.shape} and {covariance.shape}"
        raise LayoutError(f"{count} bearings need as many times and a square covariance, {found}")
    if count < 4:
        raise LayoutError(f"position and course need four bearings or more, found {count}")
    if not (np.isfinite(azimuth).all() and np.isfinite(time).all() and np.isfinite(covariance).all()):
        raise LayoutError(
            "bearings, times and covariance must be finite; leave out the minutes without a bearing"
        )
    if not (np.diff(time) > 0).all():
        raise LayoutError("times of bearings must increase; sort them and keep one bearing for each time")


def centre(time: np.ndarray) -> tuple[float, float]:
    """Mid-observation and half of its length [s]."""
    return float((time[0] + time[-1]) / 2), float((time[-1] - time[0]) / 2)


def start_grid(unit_time: np.ndarray) -> np.ndarray:
    """Cells (G, 2) of (ω, ρ) over CPA time, CPA range and side.

    Ranges run from a fiftieth to sixty times the ship's way in half the observation, CPA times beyond both
    ends of it; their steps follow the range, because within it the azimuth turns.
    """
    cells = []
    for passing in np.geomspace(0.02, 60.0, 20):
        inside = np.linspace(-1, 1, max(int(np.ceil(2 / (0.7 * passing))), 2) + 1)
        outside = 1 + passing * np.array([0.5, 1.0, 2.0, 4.0])
        cpa = np.concatenate([-outside[::-1], inside, outside])
        for side in (-1.0, 1.0):
            squared = passing**2 + cpa**2
            cells.append(np.stack([-side * passing / squared, -cpa / squared], axis=1))
    return np.concatenate(cells)


def _starts(azimuth: np.ndarray, unit_time: np.ndarray, variance: np.ndarray) -> list[np.ndarray]:
    """Best grid cell of either side by the score |Σ e^{i(α - model)} / σ²|, whose argument is α0."""
    cells = start_grid(unit_time)
    weight = variance.min() / variance
    seen = (np.exp(1j * azimuth) * weight).astype(np.complex64)
    place = np.complex64(1) + (cells[:, 1:] + 1j * cells[:, :1]).astype(np.complex64) * unit_time.astype(
        np.float32
    )
    scores = seen @ (place / np.maximum(np.abs(place), 1e-9)).conj().T
    starts = []
    for side in (-1, 1):
        chosen = np.flatnonzero(np.sign(cells[:, 0]) == side)
        best = chosen[np.argmax(np.abs(scores[:, chosen]), axis=1)]
        offset = np.angle(scores[np.arange(len(azimuth)), best])
        starts.append(np.concatenate([offset[:, None], cells[best]], axis=1))
    return starts


def turn(rates: np.ndarray, unit_time: np.ndarray) -> np.ndarray:
    """Azimuth relative to the reference [rad], (R, K), for (ω, ρ) of shape (R, 2)."""
    return np.arctan2(rates[:, :1] * unit_time, 1.0 + rates[:, 1:] * unit_time)


def refine(
    polar: np.ndarray, azimuth: np.ndarray, unit_time: np.ndarray, white: np.ndarray, free: int = 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levenberg-Marquardt over the first `free` of (α0, ω, ρ), all runs together.

    Parameters
    ----------
    polar : array (R, 3)
        Starts; rad and per unit of `unit_time`.
    azimuth : array (R, K), rad
    unit_time : array (K,)
    white : array (K, K) or (K,)
        Whitens residuals in rad; one row for independent errors.

    Returns
    -------
    polar (R, 3), squared misfit (R,), converged (R,)
    """
    polar = polar.copy()
    damping = np.full(len(polar), 1e-3)
    residuals = _residual(polar, azimuth, unit_time, white)
    active = np.ones(len(polar), bool)
    for _ in range(60):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        here, residual = polar[rows], residuals[rows]
        slopes = _slopes(here, unit_time, white)[:free]
        normal = np.einsum("irk,jrk->rij", slopes, slopes)
        gradient = np.einsum("irk,rk->ri", slopes, residual)
        diagonal = np.einsum("rii->ri", normal).copy()
        normal[:, range(free), range(free)] += (
            damping[rows, None] * diagonal + 1e-9 * diagonal.max(axis=1)[:, None]
        )
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        trial = here.copy()
        trial[:, :free] += step
        trial_residual = _residual(trial, azimuth[rows], unit_time, white)
        better = np.sum(trial_residual**2, axis=1) <= np.sum(residual**2, axis=1)
        finished = np.sum(step * gradient, axis=1) < 1e-7
        polar[rows[better]], residuals[rows[better]] = trial[better], trial_residual[better]
        damping[rows] = np.clip(np.where(better, damping[rows] * 0.2, damping[rows] * 5), 1e-9, 1e9)
        active[rows[finished]] = False
    return polar, np.sum(residuals**2, axis=1), ~active


def _residual(polar: np.ndarray, azimuth: np.ndarray, unit_time: np.ndarray, white: np.ndarray) -> np.ndarray:
    difference = azimuth - polar[:, :1] - turn(polar[:, 1:], unit_time)
    return _whiten(np.mod(difference + np.pi, 2 * np.pi) - np.pi, white)


def _slopes(polar: np.ndarray, unit_time: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Whitened derivatives of the azimuth with respect to α0, ω, ρ: (3, R, K)."""
    across, along = polar[:, 1:2] * unit_time, 1.0 + polar[:, 2:] * unit_time
    squared = np.maximum(across**2 + along**2, 1e-12)
    slopes = np.stack([np.ones_like(along), unit_time * along / squared, -unit_time * across / squared])
    return _whiten(slopes, white)


def _whiten(values: np.ndarray, white: np.ndarray) -> np.ndarray:
    return values * white if white.ndim == 1 else values @ white.T


def to_theta(polar: np.ndarray, half_s: float, speed: np.ndarray) -> np.ndarray:
    """(x0, y0, course) [m, m, deg], (R, 3), of polar coordinates in units of `half_s` at a speed [m/s]."""
    rates = polar[:, 1:] / half_s
    distance = speed / np.maximum(np.hypot(*rates.T), 1e-12)
    course = np.rad2deg(polar[:, 0] + np.arctan2(rates[:, 0], rates[:, 1])) % 360.0
    return np.stack([distance * np.sin(polar[:, 0]), distance * np.cos(polar[:, 0]), course], axis=1)
