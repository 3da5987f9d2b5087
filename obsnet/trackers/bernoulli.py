"""Azimuth maps of a station, row by row, in; existence and azimuth of one ship out, live.

What the grid search can only do once a passage is over. One ship at a time: of two, the filter follows the
one that the map tells it more of. Bernoulli filter of Bossér et al. (see `bernoulli_filter`) with a
circular state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.azimuth_grid import AzimuthGrid
from obsnet.trackers.bernoulli_filter import BernoulliConfig, BernoulliFilter, move
from obsnet.trackers.particles import circular_mean


@dataclass(frozen=True)
class AzimuthTrackerConfig:
    """A ship heard by one station, azimuth alone; numbers per minute or per second as named.

    Parameters
    ----------
    interval_s : float
        Time between the rows of the map.
    acceleration_deg_s2 : float
        Standard deviation of the azimuth's acceleration, constant within an interval. A ship that passes
        3 km away at 7 m/s reaches 2e-4 deg/s².
    rate_std_deg_s : float
        Spread of a newborn ship's azimuth rate; 0.03 deg/s is 7 m/s across at 13 km.
    detection_probability : float
        P_d: in the other minutes the map says nothing of the ship. L becomes 1 − P_d + P_d L, so that one
        minute cannot end a track.
    weight : float
        Exponent of the map's ratios: windows of three minutes every minute count everything three times.
    bernoulli : BernoulliConfig
        By default a ship stays for 100 min, and one comes every 5 h.
    """

    interval_s: float = 60.0
    acceleration_deg_s2: float = 2e-4
    rate_std_deg_s: float = 0.03
    detection_probability: float = 0.9
    weight: float = 1.0 / 3.0
    bernoulli: BernoulliConfig = field(
        default_factory=lambda: BernoulliConfig(
            survival=0.99, birth=1 / 300, replacement=1e-3, particles=2000, births=500
        )
    )

    def __post_init__(self) -> None:
        if not (self.interval_s > 0 and self.acceleration_deg_s2 >= 0 and self.rate_std_deg_s >= 0):
            raise ConfigError("an azimuth tracker needs a positive interval and process noises of 0 or more")
        if not (0 < self.detection_probability <= 1 and self.weight > 0):
            raise ConfigError(
                "detection_probability must lie in (0, 1] and weight be positive, "
                f"found {self.detection_probability!r} and {self.weight!r}"
            )


def tempered(llr: np.ndarray, weight: float, detection_probability: float) -> np.ndarray:
    """ln(1 − P_d + P_d e^(weight · llr)); NaN cells, of which nothing is known, become 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mixed = np.logaddexp(np.log1p(-detection_probability), np.log(detection_probability) + weight * llr)
    return np.where(np.isnan(llr), 0.0, mixed)


class AzimuthTracker:
    """Live Bernoulli filter on azimuth maps: state azimuth [deg] and its rate [deg/s], row by row.

    The random numbers of a row come from (seed, number of the row): a tracker restored from `state_dict`
    goes on as if it had never stopped.

    Parameters
    ----------
    azimuth_deg : array, dims (azimuth,)
        Equal steps, a whole circle or a sector.
    config : AzimuthTrackerConfig, optional
    seed : int
    """

    def __init__(
        self, azimuth_deg: np.ndarray, config: AzimuthTrackerConfig | None = None, seed: int = 0
    ) -> None:
        self.config = config or AzimuthTrackerConfig()
        self._grid = AzimuthGrid(azimuth_deg)
        self._seed, self._row = int(seed), 0
        self._previous: np.ndarray | None = None
        self._filter = BernoulliFilter(
            self.config.bernoulli, self._births(np.random.default_rng([self._seed]))
        )

    @property
    def existence(self) -> float:
        """Probability that a ship is there, after the last row."""
        return self._filter.existence

    @property
    def confirmed(self) -> bool:
        """Whether that probability exceeds the threshold."""
        return self._filter.confirmed

    @property
    def azimuth(self) -> tuple[float, float]:
        """Mean azimuth [0, 360) and its circular standard deviation, deg, if a ship is there."""
        return circular_mean(self._filter.states[0], np.zeros(self._filter.states.shape[1]))

    def step(self, llr_row: np.ndarray) -> float:
        """Existence probability after one more row, dims (azimuth,), natural logs; all NaN is a gap.

        Raises
        ------
        LayoutError
            The row is not as long as the grid, or holds plus infinity.
        FilterError
            Every particle is impossible.
        """
        row = np.asarray(llr_row, float)
        if row.shape != self._grid.azimuth_deg.shape or np.isposinf(row).any():
            raise LayoutError(
                f"a row must hold {len(self._grid.azimuth_deg)} log-likelihood ratios below infinity, "
                f"found shape {row.shape}"
            )
        config = self.config
        measured = None if np.isnan(row).all() else tempered(row, config.weight, config.detection_probability)
        self._row += 1
        rng = np.random.default_rng([self._seed, self._row])
        births = self._births(rng)
        weights = None if self._previous is None else self._grid(self._previous, births[0])
        likelihood = None if measured is None else lambda states: self._grid(measured, states[0])
        self._filter.step(lambda states: self._moved(states, rng), births, likelihood, rng, weights)
        self._previous = measured
        return self.existence

    def state_dict(self) -> dict[str, np.ndarray]:
        """All that a restart needs, as plain arrays."""
        previous = np.empty(0) if self._previous is None else self._previous
        return {
            "azimuth_deg": self._grid.azimuth_deg.copy(),
            "states": self._filter.states.copy(),
            "existence": np.array(self.existence),
            "previous": previous.copy(),
            "position": np.array([self._seed, self._row]),
        }

    @classmethod
    def from_state_dict(
        cls, state: Mapping[str, np.ndarray], config: AzimuthTrackerConfig | None = None
    ) -> AzimuthTracker:
        """Tracker that goes on where `state_dict` was taken, given the same configuration."""
        missing = {"azimuth_deg", "states", "existence", "previous", "position"} - set(state)
        if missing:
            raise LayoutError(f"the state of an azimuth tracker lacks {', '.join(sorted(missing))}")
        seed, row = (int(value) for value in state["position"])
        tracker = cls(state["azimuth_deg"], config, seed)
        tracker._filter = BernoulliFilter(
            tracker.config.bernoulli, state["states"], float(state["existence"])
        )
        tracker._row = row
        tracker._previous = np.asarray(state["previous"], float) if len(state["previous"]) else None
        return tracker

    def _births(self, rng: np.random.Generator) -> np.ndarray:
        count = self.config.bernoulli.births
        span = self._grid.step_deg * (len(self._grid.azimuth_deg) - (not self._grid.circular))
        azimuth = self._grid.first_deg + span * (np.arange(count) + rng.random(count)) / count
        return np.stack([azimuth, self.config.rate_std_deg_s * rng.standard_normal(count)])

    def _moved(self, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        moved = move(states, self.config.interval_s, self.config.acceleration_deg_s2, rng)
        if self._grid.circular:
            moved[0] %= 360.0
        return moved


@dataclass(frozen=True)
class AzimuthTrack:
    """Probability that a ship is there; its azimuth and standard deviation if it is, deg; dims (time,)."""

    existence: np.ndarray
    azimuth_deg: np.ndarray
    azimuth_std_deg: np.ndarray


def track_azimuth(
    times_s: np.ndarray,
    azimuth_llr: np.ndarray,
    azimuth_deg: np.ndarray,
    config: AzimuthTrackerConfig | None = None,
    seed: int = 0,
) -> AzimuthTrack:
    """Bernoulli filter over a station's azimuth map, minute by minute, using no minute before it is heard.

    Parameters
    ----------
    times_s : array, dims (time,), s since 1970
        Increasing by whole intervals; missing rows count as gaps.
    azimuth_llr : array, dims (time, azimuth), natural logs; NaN where there are no data
    azimuth_deg : array, dims (azimuth,)
    config : AzimuthTrackerConfig, optional
    seed : int

    Raises
    ------
    LayoutError
        Shapes do not agree, or times do not increase by whole intervals.
    FilterError
        As `AzimuthTracker.step`.
    """
    tracker = AzimuthTracker(azimuth_deg, config, seed)
    steps = intervals(times_s, len(azimuth_llr), tracker.config.interval_s)
    gap = np.full(len(tracker.state_dict()["azimuth_deg"]), np.nan)
    output = np.empty((3, len(steps)))
    for row, (llr, step) in enumerate(zip(azimuth_llr, steps, strict=True)):
        for _ in range(step - 1):
            tracker.step(gap)
        output[0, row] = tracker.step(llr)
        output[1:, row] = tracker.azimuth
    return AzimuthTrack(*output)


def intervals(times_s: np.ndarray, rows: int, interval_s: float) -> np.ndarray:
    """Intervals from each row to the one before, at most a day; 1 for the first row."""
    times = np.asarray(times_s, float)
    if times.shape != (rows,):
        raise LayoutError(f"{rows} rows of a map need as many times, found {times.shape}")
    steps = np.diff(times) / interval_s
    whole = np.round(steps)
    if (whole < 1).any() or (np.abs(steps - whole) > 0.01).any():
        raise LayoutError(
            f"times of a map must increase by whole intervals of {interval_s:g} s; resample the map"
        )
    return np.concatenate([[1], np.minimum(whole, np.ceil(86400.0 / interval_s))]).astype(int)[:rows]
