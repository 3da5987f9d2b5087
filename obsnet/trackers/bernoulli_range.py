"""Azimuth and range maps of a station, row by row, in; existence, position and velocity of one ship out, live.

Beyond the track-before-detect paper: its Bernoulli filter (see `bernoulli_filter`) over (east, north) [m]
and their rates [m/s]. A minute in which only one of the two maps speaks still counts. The sound's travel
time is not undone: a state is where the ship was when it emitted what is heard in that minute, about range
/ 1500 m/s earlier.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.azimuth_grid import AzimuthGrid
from obsnet.trackers.bernoulli import intervals, tempered
from obsnet.trackers.bernoulli_filter import BernoulliConfig, BernoulliFilter
from obsnet.trackers.particles import circular_mean, systematic_resampling


@dataclass(frozen=True)
class StationTrackerConfig:
    """A ship heard by one station, azimuth and range.

    Parameters
    ----------
    interval_s : float
        Time between the rows of the maps.
    acceleration_mps2 : float
        Standard deviation of each component of the ship's acceleration, constant within an interval.
    scale_drift : float
        While there is no range map, position and velocity are scaled together by a random factor of this
        relative size per interval: azimuths do not tell it, and a few particles would pretend to know it.
    turn_drift_deg : float
        Position and velocity are turned together about the station by a random angle of this size per interval: a
        sharp range map, which does not tell it, otherwise leaves a handful of azimuths to choose from.
    speed_std_mps : float
        Spread of each component of a newborn ship's velocity that the maps do not tell.
    max_range_m : float
        Ships are born up to here, uniformly over the area, and exist up to twice as far.
    azimuth_detection, range_detection : float
        P_d of either map, as in `AzimuthTrackerConfig`.
    weight : float
        Exponent of the maps' ratios.
    bernoulli : BernoulliConfig
    """

    interval_s: float = 60.0
    acceleration_mps2: float = 2e-3
    scale_drift: float = 0.03
    turn_drift_deg: float = 0.5
    speed_std_mps: float = 6.0
    max_range_m: float = 50e3
    azimuth_detection: float = 0.9
    range_detection: float = 0.6
    weight: float = 1.0 / 3.0
    bernoulli: BernoulliConfig = field(
        default_factory=lambda: BernoulliConfig(
            survival=0.99, birth=1 / 300, replacement=1e-4, particles=4000, births=2000
        )
    )

    def __post_init__(self) -> None:
        for name in ("interval_s", "speed_std_mps", "max_range_m", "weight"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)!r}")
        if not (
            0 < self.azimuth_detection <= 1
            and 0 < self.range_detection <= 1
            and min(self.acceleration_mps2, self.scale_drift, self.turn_drift_deg) >= 0
        ):
            raise ConfigError(
                "detection probabilities must lie in (0, 1], acceleration and drifts not be negative"
            )


class StationTracker:
    """Live Bernoulli filter on azimuth and range maps; restarts as `AzimuthTracker` does.

    Parameters
    ----------
    azimuth_deg : array, dims (azimuth,)
    range_m, range_rate_mps : arrays, dims (range,) and (range_rate,), each in equal steps
    config : StationTrackerConfig, optional
    seed : int
    """

    def __init__(
        self,
        azimuth_deg: np.ndarray,
        range_m: np.ndarray,
        range_rate_mps: np.ndarray,
        config: StationTrackerConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.config = config or StationTrackerConfig()
        self._azimuth = AzimuthGrid(azimuth_deg)
        self._range, self._rate = (np.asarray(axis, float) for axis in (range_m, range_rate_mps))
        for axis in (self._range, self._rate):
            if (
                axis.ndim != 1
                or len(axis) < 2
                or not np.allclose(np.diff(axis), axis[1] - axis[0], rtol=1e-3)
            ):
                raise LayoutError(
                    "ranges and range rates of a map must increase in equal steps, two at least"
                )
        self._seed, self._row = int(seed), 0
        self._previous: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
        first = self._births(np.random.default_rng([self._seed]))
        self._filter = BernoulliFilter(self.config.bernoulli, first)

    @property
    def existence(self) -> float:
        """Probability that a ship is there, after the last row."""
        return self._filter.existence

    @property
    def confirmed(self) -> bool:
        """Whether that probability exceeds the threshold."""
        return self._filter.confirmed

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (4,) and covariance (4, 4) of east, north [m] and their rates [m/s], if a ship is there."""
        return self._filter.states.mean(axis=1), np.cov(self._filter.states, ddof=0)

    @property
    def azimuth(self) -> tuple[float, float]:
        """Mean azimuth [0, 360) and its circular standard deviation, deg."""
        east, north = self._filter.states[:2]
        return circular_mean(np.rad2deg(np.arctan2(east, north)), np.zeros(len(east)))

    @property
    def range_m(self) -> tuple[float, float]:
        """Mean range and its standard deviation, m."""
        distance = np.hypot(*self._filter.states[:2])
        return float(distance.mean()), float(distance.std())

    def step(self, azimuth_llr: np.ndarray | None, range_llr: np.ndarray | None) -> float:
        """Existence probability after one more row of both maps.

        Parameters
        ----------
        azimuth_llr : array, dims (azimuth,), or None
        range_llr : array, dims (range, range_rate), or None
            Natural logs; None or all NaN where a map is missing.

        Raises
        ------
        LayoutError
            A map has not the shape of its axes, or holds plus infinity.
        FilterError
            Every particle is impossible.
        """
        config = self.config
        row = _measured(
            azimuth_llr, (len(self._azimuth.azimuth_deg),), config.weight, config.azimuth_detection
        )
        chart = _measured(
            range_llr, (len(self._range), len(self._rate)), config.weight, config.range_detection
        )
        self._row += 1
        rng = np.random.default_rng([self._seed, self._row])
        births = self._births(rng)
        likelihood = None if row is None and chart is None else lambda states: self._llr(states, row, chart)
        drift = config.scale_drift if chart is None else 0.0
        self._filter.step(lambda states: self._moved(states, drift, rng), births, likelihood, rng)
        self._previous = (row, chart)
        return self.existence

    def state_dict(self) -> dict[str, np.ndarray]:
        """All that a restart needs, as plain arrays."""
        row, chart = (np.empty(0) if previous is None else previous.copy() for previous in self._previous)
        return {
            "azimuth_deg": self._azimuth.azimuth_deg.copy(),
            "range_m": self._range.copy(),
            "range_rate_mps": self._rate.copy(),
            "states": self._filter.states.copy(),
            "existence": np.array(self.existence),
            "previous_azimuth": row,
            "previous_range": chart,
            "position": np.array([self._seed, self._row]),
        }

    @classmethod
    def from_state_dict(
        cls, state: Mapping[str, np.ndarray], config: StationTrackerConfig | None = None
    ) -> StationTracker:
        """Tracker that goes on where `state_dict` was taken, given the same configuration."""
        wanted = {"azimuth_deg", "range_m", "range_rate_mps", "states", "existence", "position"}
        missing = (wanted | {"previous_azimuth", "previous_range"}) - set(state)
        if missing:
            raise LayoutError(f"the state of a station tracker lacks {', '.join(sorted(missing))}")
        seed, row = (int(value) for value in state["position"])
        tracker = cls(state["azimuth_deg"], state["range_m"], state["range_rate_mps"], config, seed)
        tracker._filter = BernoulliFilter(
            tracker.config.bernoulli, state["states"], float(state["existence"])
        )
        tracker._row = row
        before = [np.asarray(state[name], float) for name in ("previous_azimuth", "previous_range")]
        tracker._previous = tuple(values if values.size else None for values in before)  # type: ignore[assignment]
        return tracker

    def _llr(self, states: np.ndarray, row: np.ndarray | None, chart: np.ndarray | None) -> np.ndarray:
        east, north, east_rate, north_rate = states
        distance = np.maximum(np.hypot(east, north), 1.0)
        total = np.where(distance > 2.0 * self.config.max_range_m, -np.inf, 0.0)
        if row is not None:
            total += self._azimuth(row, np.rad2deg(np.arctan2(east, north)))
        if chart is not None:
            rate = (east * east_rate + north * north_rate) / distance
            axes = (
                self._range[0],
                self._range[1] - self._range[0],
                self._rate[0],
                self._rate[1] - self._rate[0],
            )
            total += _bilinear(chart, distance, rate, *axes)
        return total

    def _births(self, rng: np.random.Generator) -> np.ndarray:
        """Draws from the previous row's maps times the prior: uniform in area, any direction."""
        config, count = self.config, self.config.bernoulli.births
        row, chart = self._previous
        grid = self._azimuth
        known = np.zeros(len(grid.azimuth_deg)) if row is None else row
        azimuth = grid.azimuth_deg[systematic_resampling(known, rng, count)]
        azimuth = np.deg2rad(azimuth + grid.step_deg * (rng.random(count) - 0.5))
        if chart is None:
            distance = config.max_range_m * np.sqrt(rng.random(count))
            rate = config.speed_std_mps * rng.standard_normal(count)
        else:
            distance, rate = self._ranges(chart, count, rng)
        # A systematic draw is sorted: unshuffled, azimuth and range of the births would rise together.
        order = rng.permutation(count)
        distance, rate = distance[order], rate[order]
        across = config.speed_std_mps * rng.standard_normal(count)
        east, north = np.sin(azimuth), np.cos(azimuth)
        return np.stack(
            [distance * east, distance * north, rate * east + across * north, rate * north - across * east]
        )

    def _ranges(
        self, chart: np.ndarray, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore"):
            area = np.log(np.where(self._range <= self.config.max_range_m, np.maximum(self._range, 0.0), 0.0))
        drift = -0.5 * (self._rate / self.config.speed_std_mps) ** 2
        cell = systematic_resampling((chart + area[:, None] + drift).ravel(), rng, count)
        i, j = np.unravel_index(cell, chart.shape)
        near, slow = self._range[1] - self._range[0], self._rate[1] - self._rate[0]
        distance = self._range[i] + near * (rng.random(count) - 0.5)
        return np.maximum(distance, 1.0), self._rate[j] + slow * (rng.random(count) - 0.5)

    def _moved(self, states: np.ndarray, drift: float, rng: np.random.Generator) -> np.ndarray:
        interval = self.config.interval_s
        kick = self.config.acceleration_mps2 * interval * rng.standard_normal((2, states.shape[1]))
        moved = np.concatenate([states[:2] + interval * (states[2:] + 0.5 * kick), states[2:] + kick])
        factor = np.exp(drift * rng.standard_normal(states.shape[1]))
        turn = np.deg2rad(self.config.turn_drift_deg) * rng.standard_normal(states.shape[1])
        cos, sin = factor * np.cos(turn), factor * np.sin(turn)
        east, north, east_rate, north_rate = moved
        return np.stack(
            [
                cos * east + sin * north,
                cos * north - sin * east,
                cos * east_rate + sin * north_rate,
                cos * north_rate - sin * east_rate,
            ]
        )


@dataclass(frozen=True)
class StationTrack:
    """Existence probability, and given existence the moments of the ship's state, row by row.

    Attributes
    ----------
    existence, azimuth_deg, azimuth_std_deg, range_m, range_std_m : arrays, dims (time,)
    state : array, dims (time, 4); mean east and north [m] and their rates [m/s]
    covariance : array, dims (time, 4, 4)
    """

    existence: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    azimuth_deg: np.ndarray
    azimuth_std_deg: np.ndarray
    range_m: np.ndarray
    range_std_m: np.ndarray


def track_station(
    times_s: np.ndarray,
    azimuth_llr: np.ndarray | None,
    azimuth_deg: np.ndarray,
    range_llr: np.ndarray | None,
    range_m: np.ndarray,
    range_rate_mps: np.ndarray,
    config: StationTrackerConfig | None = None,
    seed: int = 0,
) -> StationTrack:
    """Bernoulli filter over a station's azimuth and range maps, minute by minute, using no minute before it
    is heard.

    Parameters
    ----------
    times_s : array, dims (time,), s since 1970
        Increasing by whole intervals; missing rows count as gaps.
    azimuth_llr : array, dims (time, azimuth), or None
    azimuth_deg : array, dims (azimuth,)
    range_llr : array, dims (time, range, range_rate), or None
    range_m, range_rate_mps : arrays, dims (range,), (range_rate,)
    config : StationTrackerConfig, optional
    seed : int

    Raises
    ------
    LayoutError
        Shapes do not agree, there is no map, or times do not increase by whole intervals.
    FilterError
        As `StationTracker.step`.
    """
    maps = [values for values in (azimuth_llr, range_llr) if values is not None]
    if not maps:
        raise LayoutError("tracking a station needs an azimuth map, a range map or both; found neither")
    tracker = StationTracker(azimuth_deg, range_m, range_rate_mps, config, seed)
    rows = min(len(values) for values in maps)
    steps = intervals(times_s, rows, tracker.config.interval_s)
    if any(len(values) != rows for values in maps):
        raise LayoutError("azimuth and range map must have the same times; select their common minutes first")
    existence, state, covariance = np.empty(rows), np.empty((rows, 4)), np.empty((rows, 4, 4))
    azimuth, distance = np.empty((rows, 2)), np.empty((rows, 2))
    for row, step in enumerate(steps):
        for _ in range(step - 1):
            tracker.step(None, None)
        chart = None if range_llr is None else range_llr[row]
        existence[row] = tracker.step(None if azimuth_llr is None else azimuth_llr[row], chart)
        state[row], covariance[row] = tracker.state
        azimuth[row], distance[row] = tracker.azimuth, tracker.range_m
    return StationTrack(existence, state, covariance, *azimuth.T, *distance.T)


def _measured(
    llr: np.ndarray | None, shape: tuple[int, ...], weight: float, detection: float
) -> np.ndarray | None:
    if llr is None:
        return None
    values = np.asarray(llr, float)
    if values.shape != shape or np.isposinf(values).any():
        raise LayoutError(
            f"a row of a map must have shape {shape} and stay below infinity, found {values.shape}"
        )
    return None if np.isnan(values).all() else tempered(values, weight, detection)


def _bilinear(
    chart: np.ndarray,
    distance: np.ndarray,
    rate: np.ndarray,
    first_range: float,
    range_step: float,
    first_rate: float,
    rate_step: float,
) -> np.ndarray:
    """Values of `chart` (range, rate) between its nodes; 0 off it."""
    x, y = (distance - first_range) / range_step, (rate - first_rate) / rate_step
    last = np.array(chart.shape) - 1
    inside = (x >= 0.0) & (x <= last[0]) & (y >= 0.0) & (y <= last[1])
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    a, b = np.minimum(x.astype(np.int64), last[0] - 1), np.minimum(y.astype(np.int64), last[1] - 1)
    u, v = x - a, y - b
    low = (1.0 - v) * chart[a, b] + v * chart[a, b + 1]
    high = (1.0 - v) * chart[a + 1, b] + v * chart[a + 1, b + 1]
    return np.where(inside, (1.0 - u) * low + u * high, 0.0)
