"""Bearings-only motion analysis, figures 1-3 of Urazghildiiev & Hannay, on simulated bearings.

A ship at 7 m/s on course 45° passes at 500 to 2000 m; bearings with σ = 2° are correlated over 0 to 150 s.
The paper does not say where the observation lies nor how often bearings come: here it is centred on CPA, as
in the paper's own tests at sea, with one bearing a second. Errors are drawn from the linear covariance that
the estimator assumes; figure 1 has a second set from the paper's sixth-order lowpass, which no linear
covariance describes.

Speed errors are drawn in both readings of the paper: a ship at 7 m/s whose assumed speed is wrong (its
simulation), and ships whose own speeds scatter about the assumed one (its eq. 22).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from obsnet.experiments import montecarlo
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.trackers.bearing_bounds import Bounds, cramer_rao, mismatched_covariance, speed_scale_variance
from obsnet.trackers.bearing_errors import BearingErrors, estimate_correlation
from obsnet.trackers.bearing_fit import Fit, fit

SPEED_MPS, COURSE_DEG, STD_DEG, INTERVAL_S = 7.0, 45.0, 2.0, 1.0
DISTANCES_M = tuple(range(500, 2001, 250))
CORRELATIONS_S = (0.0, 50.0, 100.0, 150.0)
OBSERVATIONS_S = (100.0, 200.0, 300.0, 400.0)
SPEED_STDS_MPS = (0.0, 0.5, 1.0, 2.0)
EFFICIENT = 1.05
"""An estimate of range counts as efficient where its curvature adds no more than 5 % to the bound."""


@dataclass(frozen=True)
class Setting:
    """One simulation point, and the figures in which it appears."""

    cpa_distance_m: float
    correlation_s: float
    observation_s: float = 200.0
    speed_std_mps: float = 0.0
    figures: tuple[int, ...] = (1,)

    @property
    def time(self) -> np.ndarray:
        """Times of bearings [s] after CPA."""
        half = self.observation_s / 2
        return np.arange(-half, half + INTERVAL_S / 2, INTERVAL_S)


def settings() -> list[Setting]:
    """The points of figures 1 (correlation), 2 (observation time) and 3 (speed errors), each once."""
    points = []
    for distance in DISTANCES_M:
        points += [Setting(distance, tau) for tau in CORRELATIONS_S[:-1]]
        points += [Setting(distance, CORRELATIONS_S[-1], figures=(1, 2, 3))]
        points += [
            Setting(distance, 150.0, length, 0.0, (2,)) for length in OBSERVATIONS_S if length != 200.0
        ]
        points += [Setting(distance, 150.0, 200.0, std, (3,)) for std in SPEED_STDS_MPS[1:]]
    return points


def reproduce(
    runs: int = 1000,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    jobs: int = 1,
    points: list[Setting] | None = None,
) -> Result:
    """Errors of range at CPA and course over `runs` simulated passages at each point of figures 1-3.

    Every point has its own seed, so the result does not depend on `jobs`. `points` are those of `settings()`
    unless others are given.

    Raises
    ------
    ConfigError
        `runs`, `seed` or `jobs` is out of range.
    """
    montecarlo.seeds(runs, seed)
    points = settings() if points is None else points
    rows = montecarlo.run(
        partial(_point, points=points, runs=runs), len(points), seed, jobs=jobs, progress=progress
    )
    return Result(rows, runs, seed, _recover_correlation(np.random.default_rng([seed, 1])))


def _point(rng: np.random.Generator, points: list[Setting], runs: int) -> dict[str, Any]:
    setting = points[rng.bit_generator.seed_seq.spawn_key[-1]]  # type: ignore[attr-defined]
    time, distance = setting.time, setting.cpa_distance_m
    errors = BearingErrors(STD_DEG, setting.correlation_s)
    covariance = errors.covariance(time)
    independent = np.diag(np.diag(covariance))
    noise = errors.sample(time, runs, rng)
    truth = StraightCourse(0.0, distance, COURSE_DEG, SPEED_MPS)
    bearings = truth.observables(time)[0] + noise
    assumed = _speeds(rng, setting.speed_std_mps, SPEED_MPS / 10, runs)
    found = fit(bearings, time, covariance, assumed)
    ignoring = found if setting.correlation_s == 0 else fit(bearings, time, independent, assumed)
    theta = _theta(truth, 0.0)
    bounds = cramer_rao(theta, time, covariance, SPEED_MPS, setting.speed_std_mps)
    cost = mismatched_covariance(theta, time, independent, covariance, SPEED_MPS, setting.speed_std_mps)
    row = _common(setting, bounds, found, runs)
    row |= {
        "rmse_range_ignoring_m": _rms(np.abs(ignoring.cpa_range_m) - distance),
        "theory_range_ignoring_m": cost.cpa_range_std_m,
        "expected_range_ignoring_m": cost.curved_cpa_range_rmse_m,
        "rmse_course_ignoring_deg": _rms(wrap180(ignoring.theta[:, 2] - COURSE_DEG)),
        "theory_course_ignoring_deg": cost.course_std_deg,
    }
    row |= _positions(setting, truth, covariance, found)
    row |= _ships(setting, noise, covariance, bounds, rng)
    return row | _lowpass(setting, truth, covariance, runs, rng)


def _common(setting: Setting, bounds: Bounds, found: Fit, runs: int) -> dict[str, Any]:
    expected = bounds.curved_cpa_range_rmse_m
    scatter = setting.cpa_distance_m * setting.speed_std_mps / SPEED_MPS
    return {
        "cpa_distance_m": float(setting.cpa_distance_m),
        "correlation_s": setting.correlation_s,
        "bearing_std_deg": STD_DEG,
        "observation_s": setting.observation_s,
        "speed_std_mps": setting.speed_std_mps,
        "rmse_range_m": _rms(np.abs(found.cpa_range_m) - setting.cpa_distance_m),
        "crb_range_m": bounds.cpa_range_std_m,
        "rmse_course_deg": _rms(wrap180(found.theta[:, 2] - COURSE_DEG)),
        "crb_course_deg": bounds.course_std_deg,
        "interval_s": INTERVAL_S,
        "runs": runs,
        "figures": list(setting.figures),
        "expected_range_m": expected,
        "efficient": bool(expected <= EFFICIENT * bounds.cpa_range_std_m),
        "block_range_m": float(np.hypot(bounds.block_cpa_range_std_m, scatter)),
        "right_side": float(np.mean(found.cpa_range_m > 0)),
        "converged": float(np.mean(found.converged)),
    }


def _positions(
    setting: Setting, truth: StraightCourse, covariance: np.ndarray, found: Fit
) -> dict[str, float]:
    """Error and bounds of the position at the start of the observation, the paper's (x0, y0)."""
    time = setting.time
    start = cramer_rao(_theta(truth, time[0]), time - time[0], covariance, SPEED_MPS, setting.speed_std_mps)
    course = np.deg2rad(found.theta[:, 2])
    along = found.speed_mps * (time[0] - found.reference_time)
    east, north = found.theta[:, 0] + along * np.sin(course), found.theta[:, 1] + along * np.cos(course)
    return {
        "rmse_start_position_m": _rms(np.hypot(east - start.theta[0], north - start.theta[1])),
        "crb_start_position_m": start.position_std_m,
        "block_start_position_m": start.block_position_std_m,
    }


def _ships(
    setting: Setting, noise: np.ndarray, covariance: np.ndarray, bounds: Bounds, rng: np.random.Generator
) -> dict[str, float | None]:
    """Ships whose speeds scatter about the assumed 7 m/s, against σ² = d² σ_k² + CRB (eq. 20)."""
    if setting.speed_std_mps == 0:
        return {"rmse_range_ships_m": None, "theory_range_ships_m": None}
    time, distance = setting.time, setting.cpa_distance_m
    speed = _speeds(rng, setting.speed_std_mps, SPEED_MPS / 4, len(noise))
    bearings = COURSE_DEG + np.rad2deg(np.arctan2(distance, speed[:, None] * time)) + noise
    found = fit(bearings, time, covariance, SPEED_MPS)
    scale = speed_scale_variance(SPEED_MPS, setting.speed_std_mps, SPEED_MPS / 4)
    known = bounds.cpa_range_std_m**2 - (distance * setting.speed_std_mps / SPEED_MPS) ** 2
    return {
        "rmse_range_ships_m": _rms(np.abs(found.cpa_range_m) - distance),
        "theory_range_ships_m": float(np.sqrt(distance**2 * scale + known)),
    }


def _lowpass(
    setting: Setting, truth: StraightCourse, covariance: np.ndarray, runs: int, rng: np.random.Generator
) -> dict[str, float | None]:
    """The paper's filtered errors, met with the linear covariance."""
    if 1 not in setting.figures or setting.correlation_s == 0:
        return {"rmse_range_lowpass_m": None, "expected_range_lowpass_m": None}
    time = setting.time
    errors = BearingErrors(STD_DEG, setting.correlation_s, "butterworth")
    found = fit(truth.observables(time)[0] + errors.sample(time, runs, rng), time, covariance, SPEED_MPS)
    theory = mismatched_covariance(_theta(truth, 0.0), time, covariance, errors.covariance(time), SPEED_MPS)
    return {
        "rmse_range_lowpass_m": _rms(np.abs(found.cpa_range_m) - setting.cpa_distance_m),
        "expected_range_lowpass_m": theory.curved_cpa_range_rmse_m,
    }


def _recover_correlation(rng: np.random.Generator, passages: int = 60) -> dict[str, float]:
    """σ and τ_α estimated from the errors of simulated passages with known positions."""
    time = np.arange(0.0, 600.0, 5.0)
    true = BearingErrors(STD_DEG, 150.0)
    found = estimate_correlation(list(true.sample(time, passages, rng)), [time] * passages)
    return {
        "passages": passages,
        "passage_s": 600.0,
        "true_std_deg": true.std_deg,
        "std_deg": found.std_deg,
        "std_uncertainty_deg": found.std_uncertainty_deg,
        "true_correlation_s": true.correlation_s,
        "correlation_s": found.correlation_s,
        "correlation_uncertainty_s": found.correlation_uncertainty_s,
    }


def _theta(course: StraightCourse, time: float) -> np.ndarray:
    east, north = course.position(np.array(time))
    return np.array([float(east), float(north), course.course_deg])


def _speeds(rng: np.random.Generator, std_mps: float, minimum_mps: float, runs: int) -> np.ndarray:
    """Speeds about 7 m/s, drawn anew below the minimum; eq. 22 has no finite value without one."""
    speed = SPEED_MPS + std_mps * rng.standard_normal(runs)
    while (low := speed < minimum_mps).any():
        speed[low] = SPEED_MPS + std_mps * rng.standard_normal(int(low.sum()))
    return speed


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class Result:
    """Rows of figures 1-3, one per simulation point, and the correlation recovered from known passages."""

    rows: list[dict[str, Any]]
    runs: int
    seed: int
    recovered: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Everything, ready for JSON; what does not apply to a row is null."""
        return {
            "experiment": "bearings",
            "simulated": True,
            "runs": self.runs,
            "seed": self.seed,
            "speed_mps": SPEED_MPS,
            "course_deg": COURSE_DEG,
            "efficient_below": EFFICIENT,
            "estimated_correlation": self.recovered,
            "rows": self.rows,
        }

    def select(self, figure: int, **values: float) -> list[dict[str, Any]]:
        """Rows of one figure with the given values, in order of distance."""
        chosen = [row for row in self.rows if figure in row["figures"]]
        chosen = [row for row in chosen if all(row[key] == value for key, value in values.items())]
        return sorted(chosen, key=lambda row: row["cpa_distance_m"])

    def table(self) -> list[str]:
        """Lines of text: the figures' numbers, then the paper's statements beside obsnet's."""
        from obsnet.experiments.bearings_report import lines

        return lines(self)

    def plot(self, path: str | Path) -> None:
        """Write a figure like the paper's figures 1-3."""
        from obsnet.experiments.bearings_report import draw

        draw(self, path)
