"""Probabilistic focalization, figures 2 and 3 of Watkins et al., on simulated delays.

Two passages like the paper's: a boat within 500 m in 65 m of water, a cargo ship within 3 km in 73 m. Every
3 s a scan of unlabelled delays comes from one moving receiver; each of the paper's three parameter sets
filters delays that were simulated with its own rates of detection and false alarms. The paper filters one
recording with all three sets; it gives no courses and no numbers but its figures.

What the listed rates of the boat's passage tell about its range is so little that no filter can settle
within seconds (`information_nats`), which the paper's recording evidently allowed. A third passage,
`kraken_clear`, is the boat's with each pair detected every other scan, filtered with the listed sets as they
are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from obsnet.errors import ConfigError
from obsnet.experiments import montecarlo
from obsnet.kinematics import StraightCourse
from obsnet.trackers.focalization import FocalizationConfig, FocalizationFilter
from obsnet.trackers.tdoa_association import ImageModel

SCAN_S = 3.0
SOUND_SPEED_MPS = 1508.0
MAX_RANGE_M = 5000.0
MAX_TDOA_S = 0.1
TDOA_STD_S = 5e-4
WARM_UP_S = 30.0
SETTLED_SHARE = 0.1
"""Settled: the RMSE is at most this share of the prior's, the error of the mid-range that it begins with."""


@dataclass(frozen=True)
class Setting:
    """One of the paper's parameter sets: probability of detection of the three pairs, mean false alarms."""

    detection_probability: tuple[float, ...]
    false_alarms: float


@dataclass(frozen=True)
class Scenario:
    """A passage: water, motion of the source relative to the receiver, the receiver's depth, settings.

    Parameters
    ----------
    water_depth_m : m.
    cpa_m, speed_mps : m, m/s; straight course at the surface.
    along_m : m, place along the course where the passage begins and ends, 0 at CPA.
    receiver_depth_m : m, at the beginning and at the end, linear between.
    settings : the paper's parameter sets.
    detected : probability with which each pair is detected in truth; each setting's own where it is None.
    """

    water_depth_m: float
    cpa_m: float
    speed_mps: float
    along_m: tuple[float, float]
    receiver_depth_m: tuple[float, float]
    settings: dict[str, Setting]
    detected: float | None = None

    @property
    def time_s(self) -> np.ndarray:
        """Times of the scans since the first [s]."""
        duration = (self.along_m[1] - self.along_m[0]) / self.speed_mps
        return np.arange(0.0, duration + 1e-6, SCAN_S)

    @property
    def range_m(self) -> np.ndarray:
        """Range of the source at each scan [m]."""
        course = StraightCourse(-self.along_m[0] / self.speed_mps, self.cpa_m, 0.0, self.speed_mps)
        return course.observables(self.time_s)[1]

    @property
    def receiver_m(self) -> np.ndarray:
        """Depth of the receiver at each scan [m]."""
        begin, end = self.receiver_depth_m
        return begin + (end - begin) * self.time_s / self.time_s[-1]

    def delays(self) -> np.ndarray:
        """True delays [s], dims (scan, pair)."""
        model = ImageModel(self.water_depth_m, SOUND_SPEED_MPS)
        at = zip(self.range_m, self.receiver_m, strict=True)
        return np.concatenate([model.tdoas(np.array([r]), np.zeros(1), h) for r, h in at])

    def measurements(self, setting: Setting, rng: np.random.Generator) -> list[np.ndarray]:
        """Simulated scans of one run, delays [s] in random order."""
        delays = self.delays()
        heard = delays + TDOA_STD_S * rng.standard_normal(delays.shape)
        odds = setting.detection_probability if self.detected is None else self.detected
        detected = rng.random(delays.shape) < np.broadcast_to(odds, delays.shape)
        scans = []
        for values, keep in zip(heard, detected, strict=True):
            false = rng.uniform(0.0, MAX_TDOA_S, rng.poisson(setting.false_alarms))
            scans.append(rng.permutation(np.concatenate([values[keep], false])))
        return scans


def _settings(false_alarms: float, *probabilities: tuple[float, ...]) -> dict[str, Setting]:
    return {
        name: Setting(values, false_alarms)
        for name, values in zip(("i", "ii", "iii"), probabilities, strict=True)
    }


KRAKEN = _settings(4.0, (0.12, 0.08, 0.06), (0.15, 0.15, 0.15), (0.1, 0.1, 0.1))
MARFRET = _settings(1.0, (0.42, 0.35, 0.3), (0.35, 0.35, 0.35), (0.25, 0.25, 0.25))
SCENARIOS = {
    "kraken": Scenario(65.0, 100.0, 2.85, (-490.0, 490.0), (40.0, 7.0), KRAKEN),
    "marfret": Scenario(73.0, 500.0, 6.4, (-866.0, 2958.0), (30.0, 7.0), MARFRET),
    "kraken_clear": Scenario(65.0, 100.0, 2.85, (-490.0, 490.0), (40.0, 7.0), KRAKEN, detected=0.5),
}


def filter_config(setting: Setting, particles: int, seed: int) -> FocalizationConfig:
    """The paper's filter: no births, no existence; driving noise of variance 0.05 m²/s⁴ in range."""
    return FocalizationConfig(
        detection_probability=setting.detection_probability,
        tdoa_std_s=(TDOA_STD_S,),
        false_alarms=setting.false_alarms,
        false_alarm_memory_s=np.inf,
        false_alarm_resolution_s=0.0,
        min_tdoa_s=0.0,
        max_tdoa_s=MAX_TDOA_S,
        max_range_m=MAX_RANGE_M,
        range_prior="uniform",
        rate_prior="normal",
        rate_scale_mps=5.0,
        acceleration_std_mps2=float(np.sqrt(0.05)),
        range_diffusion_m=0.0,
        particles=particles,
        survival_s=np.inf,
        birth_s=np.inf,
        jump_s=np.inf,
        seed=seed,
    )


def reproduce(
    runs: int = 50,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    jobs: int = 1,
    particles: int = 10_000,
    scenarios: tuple[str, ...] = tuple(SCENARIOS),
) -> Result:
    """Filter `runs` simulated passages of each scenario with each of its settings.

    Raises
    ------
    ConfigError
        `runs`, `seed` or `jobs` is out of range, or a scenario is unknown.
    """
    unknown = [name for name in scenarios if name not in SCENARIOS]
    if unknown:
        raise ConfigError(f"no scenario '{unknown[0]}'; there are {', '.join(SCENARIOS)}")
    trial = partial(_trial, scenarios=scenarios, particles=particles)
    outcomes = montecarlo.run(trial, runs, seed, jobs=jobs, progress=progress)
    tracks = {
        name: {
            setting: Tracks(
                np.array([outcome[name][setting][0] for outcome in outcomes]),
                np.array([outcome[name][setting][1] for outcome in outcomes]),
            )
            for setting in SCENARIOS[name].settings
        }
        for name in scenarios
    }
    return Result(tracks, runs, seed, particles)


def _trial(rng: np.random.Generator, scenarios: tuple[str, ...], particles: int) -> dict[str, Any]:
    outcome: dict[str, Any] = {}
    root = int(rng.integers(2**62))
    for name in scenarios:
        scenario, outcome[name] = SCENARIOS[name], {}
        for number, (label, setting) in enumerate(scenario.settings.items()):
            own = 0 if scenario.detected is not None else number
            place = list(SCENARIOS).index(name)
            scans = scenario.measurements(setting, np.random.default_rng([root, place, own]))
            config = filter_config(setting, particles, root % 2**31)
            outcome[name][label] = follow(scenario, scans, config)
    return outcome


def follow(
    scenario: Scenario, scans: list[np.ndarray], config: FocalizationConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and standard deviation of range [m] at each scan."""
    tracker = FocalizationFilter(ImageModel(scenario.water_depth_m, SOUND_SPEED_MPS), config)
    found = [
        tracker.step(measured, SCAN_S if i else 0.0, float(depth))
        for i, (measured, depth) in enumerate(zip(scans, scenario.receiver_m, strict=True))
    ]
    return np.array([scan.range_m for scan in found]), np.array([scan.range_std_m for scan in found])


@dataclass(frozen=True)
class Tracks:
    """Range estimates of all runs of one setting and the filter's own standard deviations [m], (run, scan)."""

    range_m: np.ndarray
    std_m: np.ndarray

    def rmse(self, truth_m: np.ndarray) -> np.ndarray:
        """Root mean square error over the runs at each scan [m]."""
        return np.sqrt(np.mean((self.range_m - truth_m) ** 2, axis=0))

    def spread(self) -> np.ndarray:
        """Root mean square of the filter's own standard deviation at each scan [m]."""
        return np.sqrt(np.mean(self.std_m**2, axis=0))


def settled(time_s: np.ndarray, rmse_m: np.ndarray, limit_m: float) -> float | None:
    """First time from which the RMSE stays within the limit for `WARM_UP_S` [s]; None if there is none.

    >>> settled(np.arange(0.0, 60.0, 10.0), np.array([9.0, 1.0, 9.0, 1.0, 1.0, 1.0]), 2.0)
    30.0
    """
    hold = round(WARM_UP_S / float(time_s[1] - time_s[0]))
    for i in range(len(time_s) - hold + 1):
        if (rmse_m[i : i + hold] <= limit_m).all():
            return float(time_s[i])
    return None


def information_nats(setting: Setting, detected: float | None = None) -> float:
    """Mean log-likelihood ratio by which a scan favours the true range over a place where no pair fits.

    The delays near pair l are a Poisson process of density λ + d N(·; g, σ²) against λ: Σ_l ∫ (λ + d' N)
    ln(1 + d N/λ) − d, with d the filter's probability of detection and d' the true one. Telling n places
    apart takes ln n of these, whatever the filter.
    """
    density = setting.false_alarms / MAX_TDOA_S
    total = 0.0
    for assumed in setting.detection_probability:
        true = assumed if detected is None else detected

        def gain(x: float, assumed: float = assumed, true: float = true) -> float:
            pulse = norm.pdf(x) / TDOA_STD_S
            return (density + true * pulse) * np.log1p(assumed * pulse / density) * TDOA_STD_S

        total += quad(gain, -8.0, 8.0)[0] - assumed
    return total


@dataclass(frozen=True)
class Result:
    """Tracks of all runs: `tracks[scenario][setting]`."""

    tracks: dict[str, dict[str, Tracks]]
    runs: int
    seed: int
    particles: int

    def to_json(self) -> dict[str, Any]:
        """`{scenario: {setting: {range_rmse_m, settled_s, …}}}`: see `summary`."""
        return {
            name: {label: self.summary(name, label) for label in settings}
            for name, settings in self.tracks.items()
        }

    def summary(self, name: str, label: str) -> dict[str, Any]:
        """Numbers of one setting.

        Returns
        -------
        `range_rmse_m` : median over time, after the first 30 s, of the RMSE over the runs; `settled_s`: time
        from which it is within a tenth of the prior's for 30 s, null if never; `median_error_m`: the same
        medians of the absolute error; `filter_std_m`: of the filter's own standard deviation (root mean
        square over the runs); `final_rmse_m`: over the last 30 s; `information_nats`.
        """
        scenario, tracks = SCENARIOS[name], self.tracks[name][label]
        time, truth = scenario.time_s, scenario.range_m
        rmse, late = tracks.rmse(truth), time >= WARM_UP_S
        error = np.median(np.abs(tracks.range_m - truth), axis=0)
        limit = SETTLED_SHARE * abs(MAX_RANGE_M / 2 - truth[0])
        return {
            "range_rmse_m": float(np.median(rmse[late])),
            "settled_s": settled(time, rmse, limit),
            "settled_limit_m": float(limit),
            "median_error_m": float(np.median(error[late])),
            "filter_std_m": float(np.median(tracks.spread()[late])),
            "final_rmse_m": float(np.median(rmse[time > time[-1] - WARM_UP_S])),
            "information_nats": information_nats(scenario.settings[label], scenario.detected),
            "simulated": True,
            "runs": self.runs,
        }

    def table(self) -> str:
        """The numbers beside what the paper says, as plain text."""
        from obsnet.experiments.focalization_report import lines

        return "\n".join(lines(self))

    def plot(self, path: str | Path) -> None:
        """Figures 2 and 3: delays of one run, mean range estimate, and RMSE against time."""
        from obsnet.experiments.focalization_report import draw

        draw(self, path)
