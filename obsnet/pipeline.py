"""Spectra in, likelihood maps out, block by block: the stages between waveforms and trackers, with their memory.

The same pipeline serves a batch run and a live station. Its output depends on the frames it was given, not on how they
were cut into blocks, and its memory does not grow with the record.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.beside import Crew
from obsnet.detectors.analytic import (
    AnalyticAzimuthDetector,
    AnalyticRangeDetector,
    AzimuthDetectorConfig,
    RangeDetectorConfig,
)
from obsnet.detectors.azimuth_features import LOOK_AHEAD_S, FeatureConfig
from obsnet.detectors.azimuths import HORIZONTALS, Azimuths, horizontals, unheard
from obsnet.detectors.lines import line_level, line_power
from obsnet.detectors.maps import (
    MARGINAL,
    LikelihoodMaps,
    detections,
    filled_up,
    joined,
    presence,
    window_bounds,
)
from obsnet.errors import ConfigError
from obsnet.layout import from_posix, to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import propagation_table
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.signals.azigram import AzigramConfig
from obsnet.signals.cepstrogram import CepstrogramConfig, ClutterFilter, cepstrogram
from obsnet.signals.held import followed_by, laid_out, per_minute, taken_up, thinned_power, under
from obsnet.signals.spectra import SpectraConfig
from obsnet.signals.station import Station
from obsnet.trackers.search_config import GridSearchConfig
from obsnet.trackers.segmentation import SegmentationConfig

if TYPE_CHECKING:
    from obsnet.detectors.learned import LearnedAzimuthDetector
    from obsnet.detectors.learned_range import LearnedRangeDetector
    from obsnet.trackers.station_focalization import StationFocalization, StationScans

NEEDS_FULL_AZIMUTHS = "the bernoulli tracker follows full azimuths, which need two horizontals and a hydrophone; use --tracker grid"

_AXES = "polarisation"
"""Name in a state of what azimuths by polarisation depend on."""

_MARGINAL = {
    "long_name": "log-likelihood ratio against no ship, range rate marginalised over an even prior",
    "units": "1",
}

_STRETCH = 30
"""Minutes whose maps are made at a time."""

LONG_SILENCE_S = 86400.0
"""A silence longer than this has no rows; the record goes on after it as if it began there."""


@dataclass(frozen=True)
class ModelsConfig:
    """ONNX files of the learned detectors, for those that are not the shipped ones."""

    azimuth: str | None = None
    range: str | None = None


@dataclass(frozen=True)
class RunConfig:
    """Parameters of a whole run, one section per stage; the YAML of ``--config`` mirrors it.

    `detector` may also be learned in azimuth or in range alone, for comparisons.
    """

    detector: Literal["learned", "analytic", "learned-azimuth", "learned-range"] = "learned"
    tracker: Literal["grid", "bernoulli", "focalization"] = "grid"
    spectra: SpectraConfig = field(default_factory=SpectraConfig)
    azigram: AzigramConfig = field(default_factory=AzigramConfig)
    cepstrogram: CepstrogramConfig = field(default_factory=CepstrogramConfig)
    azimuth: AzimuthDetectorConfig = field(default_factory=AzimuthDetectorConfig)
    range: RangeDetectorConfig = field(default_factory=RangeDetectorConfig)
    models: ModelsConfig = field(default_factory=ModelsConfig)
    ocean: OceanConfig = field(default_factory=OceanConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    grid_search: GridSearchConfig = field(default_factory=GridSearchConfig)

    def __post_init__(self) -> None:
        if self.azimuth.step_s != self.range.step_s or self.azimuth.window_s != self.range.window_s:
            raise ConfigError("azimuth and range detectors must share window_s and step_s")
        if (frames := self.azigram.average_frames) != 1:  # means over frames would depend on cuts
            raise ConfigError(f"a run takes single frames: azigram.average_frames must be 1, found {frames}")
        tile, step, window = self.grid_search.tile_s, self.azimuth.step_s, self.azimuth.window_s
        if abs(tile / step - round(tile / step)) > 1e-9 or tile < window:
            raise ConfigError(
                f"grid_search.tile_s must be a multiple of step_s and no shorter than window_s, "
                f"found {tile:g} s for {step:g} and {window:g} s"
            )
        hints = get_type_hints(RunConfig)
        for name in ("detector", "tracker"):
            if getattr(self, name) not in get_args(hints[name]):
                choices = ", ".join(get_args(hints[name]))
                raise ConfigError(f"{name} must be one of {choices}, found {getattr(self, name)!r}")

    def unused(self) -> list[str]:
        """A note where parameters are given that the detector asked for does not take."""
        if self.detector not in ("learned", "learned-azimuth"):
            return []
        from obsnet.detectors.learned import UNUSED

        default, given = RunConfig(), []
        for section, names in UNUSED.items():
            one, other = getattr(self, section), getattr(default, section)
            given += [f"{section}.{name}" for name in names if getattr(one, name) != getattr(other, name)]
        said = f"{', '.join(given)}: of the analytic azimuth detector, the learned one takes none"
        return [said] if given else []

    @property
    def memory_s(self) -> float:
        """How far back a minute's maps depend on the record: what the filters that learn from the past keep, s."""
        windows = [self.azimuth.window_s]
        if self.cepstrogram.clutter != "none":
            windows.append(self.cepstrogram.clutter_window_s + self.cepstrogram.clutter_step_s)
        if self.azimuth.null == "directional":
            windows.append(self.azimuth.background_window_s + self.azimuth.background_step_s)
        if self.detector in ("learned", "learned-azimuth"):
            windows.append(FeatureConfig.memory_s + FeatureConfig.memory_step_s)
        return max(windows) + self.azimuth.window_s


@dataclass(frozen=True)
class Minutes:
    """What the pipeline has finished: maps, presence ratios for the segmentation, and thinned representations to look at."""

    maps: LikelihoodMaps
    detections: pd.DataFrame
    presence: pd.DataFrame
    features: xr.Dataset


@dataclass(frozen=True)
class _Coming:
    """Minutes of which some maps are still being made."""

    minutes: np.ndarray
    maps: list[list[Future]]
    lines: xr.DataArray
    features: xr.Dataset


class Pipeline:
    """Turns consecutive blocks of spectra into likelihood maps at UTC multiples of the detectors' step.

    Parameters
    ----------
    station : Station; its depth and the ocean's profile make the propagation table.
    config : RunConfig
    amplitudes : strength of each path pair against range; by default weak, broad curves
        scaled to the depth (`Amplitudes.broad`).
    workers : how many make maps beside this process; with one a minute is finished as soon as its frames are there.
    table : propagation table, if it is not to be made from `config.ocean`.
    begin : s since 1970; earlier frames are heard, so that the filters have learned by then, but have no minutes.
    """

    def __init__(
        self,
        station: Station,
        config: RunConfig = RunConfig(),
        amplitudes: Amplitudes | None = None,
        table: xr.Dataset | None = None,
        workers: int = 1,
        begin: float = -np.inf,
    ) -> None:
        self.station, self.config, self.begin = station, config, begin
        self.table = table if table is not None else propagation_table(config.ocean, station.depth_m)
        expected = amplitudes or Amplitudes.broad().scaled_to(station.depth_m)
        self._azimuth = AnalyticAzimuthDetector(config.azimuth)
        self._range = _range_detector(config, self.table, expected)
        self._clutter = ClutterFilter(config.cepstrogram)
        self._azimuths = self._by(config.azigram)
        self._axes: Azimuths | None = None
        self._cepstrogram: xr.DataArray | None = None
        self._spectrogram: xr.DataArray | None = None
        self._lines: xr.DataArray | None = None
        self._follower = _follower(self.table, amplitudes) if config.tracker == "focalization" else None
        self._followed: list[StationScans] = []
        self._next: float | None = None
        self._last: float | None = None
        self._coming: deque[_Coming] = deque()
        self._most = 2 * workers if workers > 1 else 0
        self._crew = Crew(self._detect, workers)

    def push(self, spectra: xr.Dataset) -> list[Minutes]:
        """Take the next block of spectra; return the minutes that it finishes, if any."""
        if not spectra.sizes["time"]:
            return []
        times = to_posix(spectra["time"].values)
        finished: list[Minutes] = []
        if self._last is not None and times[0] - self._last > LONG_SILENCE_S:
            finished += self.flush()
            self._cepstrogram = self._spectrogram = self._lines = None
            self._next = None
            for azimuths in self._by_each():
                azimuths.restart()
        if self.config.tracker == "bernoulli" and not set(spectra) >= {*HORIZONTALS, "p"}:
            raise ConfigError(NEEDS_FULL_AZIMUTHS)
        if self._next is None:
            first = max(times[0], self.begin)
            self._next = float(np.ceil(first / self.config.azimuth.step_s) * self.config.azimuth.step_s)
        self._last = float(times[-1])
        ready = times[-1] - self.config.azimuth.window_s / 2
        learned = self._azimuths.learned is not None
        looks = learned and (self._azimuths.azigram is not None or set(spectra) >= HORIZONTALS)
        self._begin(ready - LOOK_AHEAD_S if looks else ready + self.config.spectra.hop_s, spectra)
        return finished + self._done(self._most)

    def flush(self) -> list[Minutes]:
        """Finish all minutes of a record, with the last ones, whose windows reach beyond its end."""
        held = self._spectrogram
        if held is not None and held.sizes["time"]:
            for azimuths in self._by_each():
                azimuths.finish()
            self._begin(float(to_posix(held["time"].values[-1])))
        return self._done(0)

    def close(self) -> None:
        """Part from the workers; what they have not finished is lost."""
        self._crew.close()

    def __enter__(self) -> Pipeline:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def followed(self) -> pd.DataFrame:
        """What the focalization tracker knew after each scan: time, range, its spread, range rate and existence."""
        if self._follower is None:
            return pd.DataFrame()
        scans = [*self._followed, self._follower.flush()]

        def column(name: str) -> np.ndarray:
            return np.concatenate([getattr(scan, name) for scan in scans])

        table = {"time": from_posix(column("time_s")), "existence_llr": column("existence_llr")}
        names = ("range_mode_m", "mode_probability", "range_mean_m", "range_std_m", "range_rate_mps")
        return pd.DataFrame(table | {name: column(name) for name in (*names, "range_rate_std_mps")})

    @property
    def models(self) -> dict[str, str]:
        """SHA-256 of the learned models in use, by task."""
        files = {
            "azimuth": getattr(self._azimuths.learned, "file", None),
            "range": getattr(self._range, "file", None),
        }
        return {task: file.digest for task, file in files.items() if file is not None}

    @property
    def next_minute(self) -> float | None:
        """The next minute to be finished, s since 1970; None before the first frame."""
        return self._next

    def state(self) -> dict[str, np.ndarray]:
        """All that the next minute depends on, for a station that must survive; arrays by name, none changed in place.

        A stage with a memory offers its own under its name. An array that is the same object as in an earlier state
        is the same value.

        Raises
        ------
        ConfigError : the focalization tracker is part of the run; its memory is not offered.
        """
        if self._follower is not None:
            raise ConfigError(
                "the focalization tracker cannot be stopped and continued; use --tracker grid for a live station"
            )
        arrays = {"next": np.array(self._next, float), "last": np.array(self._last, float)}
        arrays |= self._azimuths.state()
        for name, stage in {"clutter": self._clutter, _AXES: self._axes}.items():
            if stage is not None:
                arrays |= {f"{name}/{key}": value for key, value in stage.state().items()}
        for name, held in self._held().items():
            if held is not None:
                arrays |= {f"{name}/{key}": value for key, value in laid_out(held).items()}
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken, by a pipeline of the same station and configuration."""
        self._next, self._last = (
            None if np.isnan(state[name]) else float(state[name]) for name in ("next", "last")
        )
        self._clutter.restore(under(state, "clutter"))
        self._azimuths.restore(state)
        if axes := under(state, _AXES):
            self._axes = self._by_polarisation()
            self._axes.restore(axes)
        self._cepstrogram, self._spectrogram, self._lines = (
            taken_up(under(state, name)) for name in self._held()
        )

    def _held(self) -> dict[str, xr.DataArray | None]:
        return {
            "cepstrogram": self._cepstrogram,
            "spectrogram": self._spectrogram,
            "lines": self._lines,
        }

    def _begin(self, ready: float, spectra: xr.Dataset | None = None) -> None:
        """Take the next spectra, if any, and begin the minutes up to `ready`."""
        step = self.config.azimuth.step_s
        count = int(np.floor((ready - self._next) / step + 1e-6)) + 1 if self._next is not None else 0
        minutes = (self._next or 0.0) + step * np.arange(max(count, 0))
        if spectra is not None:
            self._spectrogram = followed_by(self._spectrogram, thinned_power(spectra))
            self._lines = followed_by(self._lines, line_power(spectra))
        ranges = self._range_maps(minutes, spectra)
        azimuths, axes = self._azimuth_maps(minutes, spectra)
        if not len(minutes):
            return
        if not azimuths and not ranges:
            raise ConfigError(
                f"{self.station.code} offers neither two horizontals nor a hydrophone; nothing to detect with"
            )
        assert self._lines is not None
        lines = line_level(self._lines, minutes, self.config.azimuth.window_s)
        self._coming.append(_Coming(minutes, [azimuths, axes, ranges], lines, self._features(minutes)))
        self._next = float(minutes[-1] + step)
        self._forget(self._next - self.config.azimuth.window_s / 2)

    def _done(self, most: int) -> list[Minutes]:
        """The minutes that are done, in order, waiting where more than so many parts are still to come."""
        done = []
        while self._coming:
            coming = sum(not part.done() for one in self._coming for maps in one.maps for part in maps)
            if coming > most or all(part.done() for maps in self._coming[0].maps for part in maps):
                done.append(self._finished(self._coming.popleft()))
            else:
                break
        return done

    def _finished(self, coming: _Coming) -> Minutes:
        azimuths, axes, ranges = (
            joined([Crew.result_of(part) for part in maps]) if maps else None for maps in coming.maps
        )
        if azimuths is not None and axes is not None:
            azimuths = filled_up(azimuths, axes)
        parts = [part for part in (azimuths, ranges) if part is not None]
        maps = xr.merge(parts, combine_attrs="drop_conflicts", join="exact", compat="equals")
        maps["line_level"] = coming.lines
        maps.attrs.update({"station": self.station.code, "detector": self.config.detector})
        features, marginal = coming.features, None
        if "range_llr" in maps:
            marginal = np.empty(maps["range_llr"].shape[:2], np.float32)
            features = features.assign_coords(range=maps["range"])
            features[MARGINAL] = ("time", "range"), marginal, _MARGINAL
        ratios = presence(maps, marginal)
        for name in ("approaching", "leaving"):
            if name in ratios:
                features[f"{name}_llr"] = ("time", ratios[name].to_numpy(np.float32), {"units": "1"})
        return Minutes(maps, detections(maps, ratios), ratios, features)

    def _detect(
        self,
        sensor: Literal["azimuth", "range"],
        frames: xr.DataArray,
        minutes: np.ndarray,
        *null: np.ndarray | None,
    ) -> xr.Dataset:
        """Maps of some minutes by a detector that has no memory; the crew's task."""
        return (
            self._azimuth.maps(frames, minutes, *null)
            if sensor == "azimuth"
            else self._range.maps(frames, minutes)
        )

    def _ordered(
        self,
        sensor: Literal["azimuth", "range"],
        held: xr.DataArray,
        minutes: np.ndarray,
        null: np.ndarray | None = None,
    ) -> list[Future]:
        """Have maps made of some minutes, a stretch at a time, from the frames that each needs."""
        start, stop = window_bounds(to_posix(held["time"].values), minutes, self.config.azimuth.window_s)
        ordered = []
        for lo in range(0, len(minutes), _STRETCH):
            part = slice(lo, lo + _STRETCH)
            frames = slice(max(start[part].min() - 2, 0), stop[part].max() + 2)
            more = () if null is None else (null[:, frames],)
            ordered.append(self._crew.submit(sensor, held[:, frames], minutes[part], *more))
        return ordered

    def _by(self, estimator: AzigramConfig) -> Azimuths:
        """The azimuth detector's stage with an estimator; several may be at work beside each other."""
        config = self.config
        learned = _learned_azimuth(config) if config.detector in ("learned", "learned-azimuth") else None

        def order(held: xr.DataArray, minutes: np.ndarray, null: np.ndarray | None) -> list[Future]:
            return self._ordered("azimuth", held, minutes, null)

        return Azimuths(estimator, config.azimuth, learned, order)

    def _by_polarisation(self) -> Azimuths:
        return self._by(replace(self.config.azigram, method="polarisation"))

    def _by_each(self) -> list[Azimuths]:
        return [self._azimuths] if self._axes is None else [self._azimuths, self._axes]

    def _azimuth_maps(
        self, minutes: np.ndarray, spectra: xr.Dataset | None
    ) -> tuple[list[Future], list[Future]]:
        """Take what the next spectra say of azimuth, and begin some minutes; none without horizontals.

        The second are azimuths by polarisation, of what was heard while the hydrophone of the record was silent.
        """
        if spectra is not None:
            self._azimuths.take(spectra)
            alone = unheard(spectra)
            if self._axes is None and alone.any() and self.config.azigram.method == "auto":
                self._axes = self._by_polarisation()
            if self._axes is not None:
                self._axes.take(horizontals(spectra, alone))
        return self._azimuths.maps(minutes), [] if self._axes is None else self._axes.maps(minutes)

    def _range_maps(self, minutes: np.ndarray, spectra: xr.Dataset | None) -> list[Future]:
        """Take what the next spectra say of range, and begin some minutes; none without a hydrophone."""
        if spectra is not None and "p" in spectra:
            cepstra = self._clutter(cepstrogram(spectra))
            self._cepstrogram = followed_by(self._cepstrogram, cepstra)
            if self._follower is not None:
                times = to_posix(cepstra["time"].values)
                self._followed.append(self._follower.push(cepstra.values, cepstra["quefrency"].values, times))
        if self._cepstrogram is None or not len(minutes):
            return []
        return self._ordered("range", self._cepstrogram, minutes)

    def _features(self, minutes: np.ndarray) -> xr.Dataset:
        """Spectrogram, azigram and cepstrogram thinned to one column a minute, for the eye."""
        features = {}
        step = self.config.azimuth.step_s
        for name, held in (
            ("power", self._spectrogram),
            ("azigram", self._azimuths.azigram),
            ("cepstrogram", self._cepstrogram),
        ):
            if held is not None:
                features[name] = per_minute(held, minutes, step)
        return xr.Dataset(features).assign_coords(time=from_posix(minutes))

    def _forget(self, before: float) -> None:
        for azimuths in self._by_each():
            azimuths.forget(before)
        if self._cepstrogram is not None:
            self._cepstrogram = self._cepstrogram[:, to_posix(self._cepstrogram["time"].values) >= before]
        if self._spectrogram is not None and self._lines is not None:
            keep = to_posix(self._spectrogram["time"].values) >= before
            self._spectrogram, self._lines = self._spectrogram[:, keep], self._lines[:, keep]


def _learned_azimuth(config: RunConfig) -> LearnedAzimuthDetector:
    from obsnet.detectors.learned import LearnedAzimuthDetector

    return LearnedAzimuthDetector(config.azimuth, config.spectra, config.models.azimuth)


def _range_detector(
    config: RunConfig, table: xr.Dataset, amplitudes: Amplitudes
) -> AnalyticRangeDetector | LearnedRangeDetector:
    analytic = AnalyticRangeDetector(table, amplitudes, config.range)
    if config.detector in ("learned", "learned-range"):
        from obsnet.detectors.learned_range import LearnedRangeDetector

        return LearnedRangeDetector.from_model(
            table, config.models.range, config.range, config.spectra, analytic
        )
    return analytic


def _follower(table: xr.Dataset, amplitudes: Amplitudes | None) -> StationFocalization:
    from obsnet.trackers.station_focalization import StationFocalization

    return StationFocalization(table, amplitudes=amplitudes)
