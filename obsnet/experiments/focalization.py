"""Probabilistic focalization, figures 2 and 3 of Watkins et al., on simulated passages.

Two passages like the paper's: a boat within 500 m in 65 m of water, a cargo ship within 3 km in 73 m, with one
moving receiver. The paper filters a recording of each with three parameter sets, whose probabilities of detection
and false alarms are set by hand, and says that its sections are those where most is heard. `kraken` and `marfret`
do the same with simulated sound: every 3 s, delays are detected in its cepstrogram; every run has its own sound.

The paper's filter knows three paths, all heard everywhere, and its own error grows in the cargo ship's passage after
250 s. Over silt, which reflects flat paths whole, pairs of a second bounce are then heard scan after scan while those
of the direct path are lost, and three paths take the ones for the others. The filter here therefore knows two bounces
and from where each pair can be heard (`ImageModel`), and takes the number of false alarms from the scans; the paper's
three paths and its listed false alarms filter the same delays beside it. Bottom and source depth it is told.

`kraken_listed` and `marfret_listed` take the parameter sets at their word: unlabelled delays are drawn with just
these probabilities. Such scans tell so little (`information_nats`) that even a filter told which delay belongs to
which pair (`ToldFilter`) waits for the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.stats import norm

from obsnet.errors import ConfigError
from obsnet.experiments import montecarlo, passage_sound
from obsnet.experiments.passage_sound import Heard, Sound
from obsnet.kinematics import StraightCourse
from obsnet.trackers.false_alarms import LOWEST_COUNT
from obsnet.trackers.focalization import DEPTH, RANGE, FocalizationConfig, FocalizationFilter
from obsnet.trackers.waveguide import Hearing, ImageModel

SCAN_S = 3.0
SOUND_SPEED_MPS = 1508.0
MAX_RANGE_M = 5000.0
MAX_TDOA_S = 0.1
MIN_DETECTED_S = 0.001
"""Delays below are not looked for in a cepstrogram: the source's own spectrum lies there."""

PATHS = ("direct", "bottom", "bottom-surface", "bottom-surface-bottom", "bottom-surface-bottom-surface")
"""Over a bottom that reflects all of a flat path, a second bounce is as loud as the first, and where the source's
image in the surface takes the direct sound away, its pairs are all that is left."""

SECOND_BOUNCE = 0.5
"""The boat's set (i) falls by as much from its first pair to its third. Chosen on trial records: with 1 the boat
settles 10 s later, and the ship is held as well."""

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
    sound : what is recorded, to detect delays in; where None, delays are drawn at each setting's rates.
    """

    water_depth_m: float
    cpa_m: float
    speed_mps: float
    along_m: tuple[float, float]
    receiver_depth_m: tuple[float, float]
    settings: dict[str, Setting]
    sound: Sound | None = None

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

    def model(self, heard: Heard | None = None) -> ImageModel:
        """The paper's three paths; with what was heard, those of a second bounce and how loud each pair is."""
        if heard is None or self.sound is None:
            return ImageModel(self.water_depth_m, SOUND_SPEED_MPS)
        hearing = Hearing(
            self.sound.bottom,
            self.sound.source_depth_m,
            self.sound.sampling_rate / 2,
            heard.quefrency_s,
            heard.floor,
        )
        return ImageModel(self.water_depth_m, SOUND_SPEED_MPS, PATHS, bounces_apart=1, hearing=hearing)

    def delays(self) -> np.ndarray:
        """True delays of the paper's three pairs [s], dims (scan, pair)."""
        model = self.model()
        at = zip(self.range_m, self.receiver_m, strict=True)
        return np.concatenate([model.tdoas(np.array([r]), np.zeros(1), h) for r, h in at])

    def heard(self, setting: Setting, rng: np.random.Generator) -> np.ndarray:
        """Simulated delays [s] of one run at the setting's rates, dims (scan, pair), NaN where missed."""
        delays = self.delays()
        noisy = delays + TDOA_STD_S * rng.standard_normal(delays.shape)
        return np.where(rng.random(delays.shape) < setting.detection_probability, noisy, np.nan)

    def recorded(self, seed: int) -> Heard:
        """Delays detected in the simulated sound of one run."""
        if self.sound is None:
            raise ConfigError("this passage has no sound to detect delays in; draw them with `heard`")
        pressure = passage_sound.record(
            self.time_s,
            self.range_m,
            self.receiver_m,
            self.water_depth_m,
            SOUND_SPEED_MPS,
            self.sound,
            (seed,),
        )
        return passage_sound.detect(pressure, self.time_s, self.sound, (MIN_DETECTED_S, MAX_TDOA_S))


def mixed(heard: np.ndarray, false_alarms: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Scans of unlabelled delays [s] in random order: those heard, dims (scan, pair), and false ones."""
    scans = []
    for values in heard:
        false = rng.uniform(0.0, MAX_TDOA_S, rng.poisson(false_alarms))
        scans.append(rng.permutation(np.concatenate([values[np.isfinite(values)], false])))
    return scans


def _settings(false_alarms: float, *probabilities: tuple[float, ...]) -> dict[str, Setting]:
    return {
        name: Setting(values, false_alarms)
        for name, values in zip(("i", "ii", "iii"), probabilities, strict=True)
    }


KRAKEN = _settings(4.0, (0.12, 0.08, 0.06), (0.15, 0.15, 0.15), (0.1, 0.1, 0.1))
MARFRET = _settings(1.0, (0.42, 0.35, 0.3), (0.35, 0.35, 0.35), (0.25, 0.25, 0.25))
KRAKEN_SOUND = Sound(source_level_db=115.0, source_depth_m=1.0)
MARFRET_SOUND = Sound(source_level_db=131.0, source_depth_m=4.0)
"""Level of the mean merchant ship at 1 kHz, Wales and Heitmeyer 2002, doi:10.1121/1.1427355."""

_KRAKEN = Scenario(65.0, 100.0, 2.85, (-490.0, 490.0), (40.0, 7.0), KRAKEN)
_MARFRET = Scenario(73.0, 500.0, 6.4, (-866.0, 2958.0), (30.0, 7.0), MARFRET)
SCENARIOS = {
    "kraken": replace(_KRAKEN, sound=KRAKEN_SOUND),
    "marfret": replace(_MARFRET, sound=MARFRET_SOUND),
    "kraken_listed": _KRAKEN,
    "marfret_listed": _MARFRET,
}


def fitted(setting: Setting, pairs: int, scans: Sequence[np.ndarray | None]) -> Setting:
    """The setting for so many pairs, those of a second bounce detected `SECOND_BOUNCE` times as often as the last
    that is listed, with the false alarms that section III-A of the paper counts: measurements in a mean scan,
    less the expected true ones.
    """
    chances = setting.detection_probability
    chances += (SECOND_BOUNCE * chances[-1],) * (pairs - len(chances))
    count = float(np.mean([len(scan) for scan in scans if scan is not None]))
    return Setting(chances, max(count - sum(chances), LOWEST_COUNT))


def filter_config(setting: Setting, particles: int, seed: int, min_tdoa_s: float = 0.0) -> FocalizationConfig:
    """The paper's filter: no births, no existence; driving noise of variance 0.05 m²/s⁴ in range."""
    return FocalizationConfig(
        detection_probability=setting.detection_probability,
        tdoa_std_s=(TDOA_STD_S,),
        false_alarms=setting.false_alarms,
        false_alarm_memory_s=np.inf,
        false_alarm_resolution_s=0.0,
        min_tdoa_s=min_tdoa_s,
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
            label: Tracks(*(np.array(column) for column in zip(*rows, strict=True)))
            for label in SCENARIOS[name].settings
            for rows in [[outcome[name][label] for outcome in outcomes]]
        }
        for name in scenarios
    }
    scans = {name: [outcome[name]["scans"] for outcome in outcomes] for name in scenarios}
    return Result(tracks, scans, runs, seed, particles)


def _trial(rng: np.random.Generator, scenarios: tuple[str, ...], particles: int) -> dict[str, Any]:
    root = int(rng.integers(2**62))
    return {
        name: (_recorded if SCENARIOS[name].sound else _listed)(SCENARIOS[name], particles, root, place)
        for place, name in enumerate(SCENARIOS)
        if name in scenarios
    }


def _recorded(scenario: Scenario, particles: int, root: int, place: int) -> dict[str, Any]:
    """One recording, filtered with every setting; beside it with the paper's three paths."""
    heard = scenario.recorded(root + place)
    model, scans, seed = scenario.model(heard), heard.scans, root % 2**31
    outcome: dict[str, Any] = {"scans": scans}
    for label, setting in scenario.settings.items():
        listed = filter_config(setting, particles, seed, MIN_DETECTED_S)
        config = filter_config(fitted(setting, len(model.pairs), scans), particles, seed, MIN_DETECTED_S)
        three, _ = follow(scenario, scans, listed)
        outcome[label] = (*follow(scenario, scans, config, model=model), three)
    return outcome


def _listed(scenario: Scenario, particles: int, root: int, place: int) -> dict[str, Any]:
    """Delays drawn at each setting's own rates, filtered without and with their labels."""
    outcome: dict[str, Any] = {}
    for number, (label, setting) in enumerate(scenario.settings.items()):
        rng = np.random.default_rng([root, place, number])
        heard = scenario.heard(setting, rng)
        scans = mixed(heard, setting.false_alarms, rng)
        config = filter_config(setting, particles, root % 2**31)
        told, _ = follow(scenario, list(heard), config, ToldFilter)
        outcome[label] = (*follow(scenario, scans, config), told)
        outcome.setdefault("scans", scans)
    return outcome


class ToldFilter(FocalizationFilter):
    """The same filter told which pair each delay belongs to and which are false: no other can do better.

    A scan is one delay for each pair [s], NaN where it was missed.
    """

    def _observable(self, measured_s: np.ndarray) -> np.ndarray:
        return np.asarray(measured_s, float)

    def _likelihood(
        self, states: np.ndarray, measured: np.ndarray, receiver_depth_m: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        predicted = self.model.tdoas(states[:, RANGE], states[:, DEPTH], receiver_depth_m)
        there = np.isfinite(measured)
        off = (predicted - measured)[:, there] / self._std[there]
        return -0.5 * (off**2).sum(axis=1), np.full(len(states), float(there.sum()))


def follow(
    scenario: Scenario,
    scans: Sequence[np.ndarray | None],
    config: FocalizationConfig,
    kind: type[FocalizationFilter] = FocalizationFilter,
    model: ImageModel | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and standard deviation of range [m] at each scan; without a model, of the paper's paths."""
    tracker = kind(model or scenario.model(), config)
    found = [
        tracker.step(measured, SCAN_S if i else 0.0, float(depth))
        for i, (measured, depth) in enumerate(zip(scans, scenario.receiver_m, strict=True))
    ]
    return np.array([scan.range_m for scan in found]), np.array([scan.range_std_m for scan in found])


@dataclass(frozen=True)
class Tracks:
    """Range estimates of all runs of one setting, the filter's own standard deviations, and the estimates of the
    filter beside it [m], dims (run, scan): told the labels where delays are drawn, else with the paper's paths.
    """

    range_m: np.ndarray
    std_m: np.ndarray
    beside_m: np.ndarray

    def rmse(self, truth_m: np.ndarray) -> np.ndarray:
        """Root mean square error over the runs at each scan [m]."""
        return _rmse(self.range_m, truth_m)

    def spread(self) -> np.ndarray:
        """Root mean square of the filter's own standard deviation at each scan [m]."""
        return np.sqrt(np.mean(self.std_m**2, axis=0))


def _rmse(range_m: np.ndarray, truth_m: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((range_m - truth_m) ** 2, axis=0))


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


def information_nats(setting: Setting) -> float:
    """Mean log-likelihood ratio by which a scan favours the true range over a place where no pair fits.

    The delays near pair l are a Poisson process of density λ + d N(·; g, σ²) against λ: Σ_l ∫ (λ + d N)
    ln(1 + d N/λ) − d. Telling n places apart takes ln n of these, whatever the filter.
    """
    density = setting.false_alarms / MAX_TDOA_S
    total = 0.0
    for chance in setting.detection_probability:

        def gain(x: float, chance: float = chance) -> float:
            pulse = chance * norm.pdf(x) / TDOA_STD_S
            return (density + pulse) * np.log1p(pulse / density) * TDOA_STD_S

        total += quad(gain, -8.0, 8.0)[0] - chance
    return total


@dataclass(frozen=True)
class Result:
    """Tracks of all runs, `tracks[scenario][setting]`, and what they were made from, `scans[scenario][run]`."""

    tracks: dict[str, dict[str, Tracks]]
    scans: dict[str, list[list[np.ndarray | None]]]
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
        square over the runs); `final_rmse_m`: over the last 30 s; `worst_rmse_m`: the largest after the first
        30 s. Where delays are detected, `three_paths_rmse_m`, `three_paths_settled_s` and
        `three_paths_worst_rmse_m`: the same of the paper's paths and false alarms. Where they are drawn at the
        listed rates, `told_rmse_m` and `told_settled_s` of a filter told the labels; `information_nats`.
        """
        scenario, tracks = SCENARIOS[name], self.tracks[name][label]
        time, truth = scenario.time_s, scenario.range_m
        rmse, late = tracks.rmse(truth), time >= WARM_UP_S
        error = np.median(np.abs(tracks.range_m - truth), axis=0)
        limit = SETTLED_SHARE * abs(MAX_RANGE_M / 2 - truth[0])
        row = {
            "range_rmse_m": float(np.median(rmse[late])),
            "settled_s": settled(time, rmse, limit),
            "settled_limit_m": float(limit),
            "median_error_m": float(np.median(error[late])),
            "filter_std_m": float(np.median(tracks.spread()[late])),
            "final_rmse_m": float(np.median(rmse[time > time[-1] - WARM_UP_S])),
            "worst_rmse_m": float(rmse[late].max()),
            "simulated": True,
            "runs": self.runs,
        }
        beside, kind = _rmse(tracks.beside_m, truth), "three_paths" if scenario.sound else "told"
        row[f"{kind}_rmse_m"] = float(np.median(beside[late]))
        row[f"{kind}_settled_s"] = settled(time, beside, limit)
        if scenario.sound:
            row["three_paths_worst_rmse_m"] = float(beside[late].max())
        else:
            row["information_nats"] = information_nats(scenario.settings[label])
        return row

    def heard(self, name: str) -> tuple[np.ndarray, float]:
        """Share of the scans in which each pair is heard (within 2 σ), dims (pair,), and delays per scan."""
        delays = SCENARIOS[name].delays()
        near, counts = np.zeros(delays.shape[1]), 0
        for scans in self.scans[name]:
            for true, measured in zip(delays, scans, strict=True):
                values = np.empty(0) if measured is None else measured
                counts += len(values)
                near += (np.abs(values[:, None] - true) < 2 * TDOA_STD_S).any(axis=0)
        total = len(self.scans[name]) * len(delays)
        return near / total, counts / total

    def table(self) -> str:
        """The numbers beside what the paper says, as plain text."""
        from obsnet.experiments.focalization_report import lines

        return "\n".join(lines(self))

    def plot(self, path: str | Path) -> None:
        """Figures 2 and 3: delays of one run, mean range estimate, and RMSE against time."""
        from obsnet.experiments.focalization_report import draw

        draw(self, path)
