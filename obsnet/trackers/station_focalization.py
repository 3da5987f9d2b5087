"""A deep station's cepstrogram in, the ship's range scan by scan out: focalization on its path pairs.

The delays are unlabelled (which ridge belongs to which pair?), and one ridge alone fits as many ranges as
there are pairs. The filter carries all of them and lets the ship's motion and further ridges decide.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter1d

from obsnet.errors import ConfigError, LayoutError
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.trackers.focalization import RANGE, FocalizationConfig, FocalizationFilter, Scan
from obsnet.trackers.tdoa_association import TableModel
from obsnet.trackers.tdoa_detections import TdoaDetectionConfig, detect_tdoas

MODE_HALF_WIDTH_M = 1000.0
DENSITY_FLOOR = 1e-12


@dataclass(frozen=True)
class StationFocalizationConfig:
    """Path pairs, detection, filter, and the range grid of the maps.

    Parameters
    ----------
    pairs : path pairs whose delays are looked for; where there is none, every two successive paths of the
    table.
    half_amplitude : cepstral amplitude at which a pair is seen half as often as at best (see `TableModel`).
    range_step_m : spacing of the maps' ranges, m.
    map_smoothing_m : standard deviation of the kernel that makes a density of the particles, m.
    detection, filter : of the delays, and of the particle filter.
    """

    pairs: tuple[str, ...] | None = None
    half_amplitude: float = 0.02
    range_step_m: float = 70.0
    map_smoothing_m: float = 100.0
    detection: TdoaDetectionConfig = field(default_factory=TdoaDetectionConfig)
    filter: FocalizationConfig = field(default_factory=FocalizationConfig)

    def __post_init__(self) -> None:
        for name in ("half_amplitude", "range_step_m", "map_smoothing_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        looked = (self.detection.min_tdoa_s, self.detection.max_tdoa_s)
        if looked != (self.filter.min_tdoa_s, self.filter.max_tdoa_s):
            raise ConfigError(
                f"detection and filter must look at the same delays, found {looked} and "
                f"{(self.filter.min_tdoa_s, self.filter.max_tdoa_s)} s"
            )

    @property
    def range_m(self) -> np.ndarray:
        """Range grid of the maps [m], from 0."""
        return np.arange(int(self.filter.max_range_m / self.range_step_m) + 1) * self.range_step_m


@dataclass(frozen=True)
class StationScans:
    """What a deep station's filter knows after each scan; times are those at which the sound is heard.

    Parameters
    ----------
    time_s : dims (scan,), s since 1970.
    valid : dims (scan,), False in gaps, over which the filter only predicts.
    detections : dims (scan,), number of delays detected.
    range_mean_m, range_std_m : dims (scan,), of the posterior, given that there is a ship; m.
    range_mode_m, mode_probability : the densest range [m] and the share of the posterior within 1 km of it.
        Where several branches are open the mean lies between them and the mode on one.
    range_rate_mps, range_rate_std_mps : dims (scan,), m/s.
    log_evidence : dims (scan,), log-likelihood ratio of the scan's delays, a ship as predicted against none.
    existence_llr : dims (scan,), log posterior odds of a ship.
    travel_time_s : dims (scan,), s: what is heard at `time_s` left the ship so long before, were it at the
        mode.
    range_m : dims (range,), m.
    log_density : dims (scan, range), log posterior density of range, per metre, of all scans so far.
    scan_llr : dims (scan, range), log-likelihood ratio of this scan's delays alone: a detector's map, which
        another tracker may sum over scans; NaN in gaps.
    """

    time_s: np.ndarray
    valid: np.ndarray
    detections: np.ndarray
    range_mean_m: np.ndarray
    range_std_m: np.ndarray
    range_mode_m: np.ndarray
    mode_probability: np.ndarray
    range_rate_mps: np.ndarray
    range_rate_std_mps: np.ndarray
    log_evidence: np.ndarray
    existence_llr: np.ndarray
    travel_time_s: np.ndarray
    range_m: np.ndarray
    log_density: np.ndarray
    scan_llr: np.ndarray


class StationFocalization:
    """Follows one ship's range from a stream of cepstra, or scan by scan from delays that were detected
    elsewhere.

    Parameters
    ----------
    table : propagation table, dims (path, range).
    config : StationFocalizationConfig
    amplitudes : cepstral amplitude of each pair against range: it tells where a pair cannot be seen. By
        default the analytic range detector's, scaled to the table's `depth_m`; none where it has no depth.
    """

    def __init__(
        self,
        table: xr.Dataset,
        config: StationFocalizationConfig = StationFocalizationConfig(),
        amplitudes: Amplitudes | None = None,
    ) -> None:
        self.config = config
        pairs = config.pairs or tuple(f"{a}-{b}" for a, b in pairwise(table["path"].values.tolist()))
        if amplitudes is None and "depth_m" in table.attrs:
            standard = Amplitudes.default().scaled_to(float(table.attrs["depth_m"]))
            amplitudes = standard if set(pairs) <= set(standard.pairs) else None
        self.model = TableModel(table, pairs, amplitudes, config.half_amplitude)
        self.filter = FocalizationFilter(self.model, config.filter)
        self._time = -np.inf
        self._quefrency = np.empty(0)
        self._times = np.empty(0)
        self._values = np.empty((0, 0))

    def step(self, time_s: float, measured_s: np.ndarray | None) -> Scan:
        """One scan: delays [s] heard at `time_s`, None in a gap; times must increase."""
        elapsed = time_s - self._time if np.isfinite(self._time) else 0.0
        if not elapsed > 0 and np.isfinite(self._time):
            raise LayoutError(
                f"scans must come in time order, found one {-elapsed:.6g} s before the scan before"
            )
        scan = self.filter.step(measured_s, elapsed)
        self._time = float(time_s)
        return scan

    def push(self, values: np.ndarray, quefrency_s: np.ndarray, times_s: np.ndarray) -> StationScans:
        """The next cepstra, dims (quefrency, time), NaN in gaps; returns the scans whose surroundings are
        complete.

        A record pushed in pieces gives the scans of the whole. They come `config.detection.context_s` late.
        """
        values, times = np.asarray(values, float), np.asarray(times_s, float)
        if len(self._times) and (len(values) != len(self._values) or not np.all(times > self._times[-1])):
            raise LayoutError("the next cepstra must follow those before, on the same quefrencies")
        self._quefrency = np.asarray(quefrency_s, float)
        self._values = values if not len(self._times) else np.concatenate([self._values, values], axis=1)
        self._times = np.concatenate([self._times, times])
        return (
            self._advance(self._times[-1] - self.config.detection.context_s)
            if len(times)
            else self._collect([])
        )

    def flush(self) -> StationScans:
        """The scans that still wait for later cepstra, without them."""
        return self._advance(np.inf) if len(self._times) else self._collect([])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything that goes on: filter and buffered cepstra, as plain arrays."""
        own = {"time": self._time, "quefrency": self._quefrency, "times": self._times, "values": self._values}
        return {**self.filter.state_dict(), **{name: np.array(value) for name, value in own.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict` of the same configuration."""
        self.filter.load_state_dict(state)
        self._time = float(state["time"])
        self._quefrency, self._times, self._values = (
            np.array(state[name], float) for name in ("quefrency", "times", "values")
        )

    def _advance(self, until_s: float) -> StationScans:
        detected = detect_tdoas(self._values, self._quefrency, self._times, self.config.detection)
        rows = []
        for index, time in enumerate(detected.times_s):
            if self._time < time <= until_s:
                rows.append(self._row(float(time), detected.scan(index)))
        keep = self._times >= self._time - self.config.detection.context_s - 1e-6
        self._times, self._values = self._times[keep], self._values[:, keep]
        return self._collect(rows)

    def _row(self, time_s: float, measured: np.ndarray | None) -> dict[str, Any]:
        scan = self.step(time_s, measured)
        density = self._density()
        ranges = self.config.range_m
        mode = ranges[np.argmax(density)]
        near = np.abs(ranges - mode) <= MODE_HALF_WIDTH_M
        if measured is None:
            scan_llr = np.full(len(ranges), np.nan)
        else:
            scan_llr = self.filter.log_likelihood(ranges, measured)
        return {
            "time_s": time_s,
            "valid": measured is not None,
            "detections": 0 if measured is None else len(measured),
            "range_mean_m": scan.range_m,
            "range_std_m": scan.range_std_m,
            "range_mode_m": mode,
            "mode_probability": density[near].sum() / density.sum(),
            "range_rate_mps": scan.range_rate_mps,
            "range_rate_std_mps": scan.range_rate_std_mps,
            "log_evidence": scan.log_evidence,
            "existence_llr": scan.existence_llr,
            "travel_time_s": float(self.model.travel_time(np.array([mode]))[0]),
            "log_density": np.log(density + DENSITY_FLOOR).astype(np.float32),
            "scan_llr": scan_llr.astype(np.float32),
        }

    def _density(self) -> np.ndarray:
        config = self.config
        bins = np.rint(self.filter.particles[:, RANGE] / config.range_step_m).astype(int)
        bins = np.minimum(bins, len(config.range_m) - 1)
        mass = np.bincount(bins, np.exp(self.filter.log_weights), len(config.range_m))
        return gaussian_filter1d(mass, config.map_smoothing_m / config.range_step_m) / config.range_step_m

    def _collect(self, rows: list[dict[str, Any]]) -> StationScans:
        columns: dict[str, np.ndarray] = {"range_m": self.config.range_m}
        for entry in fields(StationScans):
            if entry.name in ("log_density", "scan_llr"):
                width = len(self.config.range_m)
                columns[entry.name] = np.array([row[entry.name] for row in rows], np.float32).reshape(
                    -1, width
                )
            elif entry.name != "range_m":
                kind = {"valid": bool, "detections": int}.get(entry.name, float)
                columns[entry.name] = np.array([row[entry.name] for row in rows], kind)
        return StationScans(**columns)


def focalize_station(
    values: np.ndarray,
    quefrency_s: np.ndarray,
    times_s: np.ndarray,
    table: xr.Dataset,
    config: StationFocalizationConfig = StationFocalizationConfig(),
    amplitudes: Amplitudes | None = None,
) -> StationScans:
    """Follow a ship's range through a whole record.

    Parameters
    ----------
    values : array, dims (quefrency, time), cepstrogram without the source's clutter; NaN in gaps.
    quefrency_s : array, dims (quefrency,), s, uniform, from 0.
    times_s : array, dims (time,), s since 1970, increasing.
    table : propagation table of the station, dims (path, range).
    config : StationFocalizationConfig
    amplitudes : as for `StationFocalization`.

    Returns
    -------
    StationScans

    Raises
    ------
    LayoutError, ConfigError
        The arrays do not fit, or the table lacks a path.

    Source: Watkins et al., applied to the path pairs of Trabattoni et al. 2023.
    """
    station = StationFocalization(table, config, amplitudes)
    state = station.push(values, quefrency_s, times_s)
    rest = station.flush()
    joined = {
        entry.name: np.concatenate([getattr(state, entry.name), getattr(rest, entry.name)])
        for entry in fields(StationScans)
        if entry.name != "range_m"
    }
    return StationScans(range_m=state.range_m, **joined)
