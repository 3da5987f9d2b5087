"""A whole run: waveforms and station metadata in, maps, detections and tracks out; in memory or into a folder.

``obsnet.track(stream, station)`` in Python and ``obsnet track`` on the command line are this module.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
import xarray as xr
from threadpoolctl import threadpool_limits

from obsnet import netcdf, provenance
from obsnet.beside import usable_cores
from obsnet.config import build, to_dict
from obsnet.detectors.maps import LikelihoodMaps, two_sided
from obsnet.errors import ConfigError, LayoutError, StationError, WaveformError
from obsnet.layout import iso, to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import propagation_table, travel_time, write_propagation
from obsnet.output import prepare_folder, write_text
from obsnet.pipeline import Minutes, Pipeline, RunConfig
from obsnet.provenance import Clock
from obsnet.signals.spectra import iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.usable import mute_hydrophone, nothing_heard
from obsnet.signals.waveforms import WaveformSource, open_waveforms
from obsnet.sinks import FolderSink, MemorySink, read_minutes
from obsnet.tables import (
    DETECTION_COLUMNS,
    TRACK_COLUMNS,
    detections_csv,
    geojson,
    seconds,
    track_of_row,
    tracks_csv,
)
from obsnet.trackers.track import Segment, Track
from obsnet.tracking import ambiguity_deg, find_tracks

if TYPE_CHECKING:
    import obspy

Progress = Callable[[float, float], None]
"""Called with seconds of record done and in all."""

PROPAGATION_FILE = "propagation.nc"
"""Of a run's folder, where its table is not that of the configured ocean."""


@dataclass
class Run:
    """What a run found, and how.

    Attributes
    ----------
    station : Station
    maps : LikelihoodMaps (lazily read from disk after a run into a folder).
    features : Dataset of power, azigram and cepstrogram, one column a minute (read when it is first asked for).
    detections : DataFrame, one row a minute, the columns of detections.csv.
    presence : DataFrame of log presence ratios, indexed by s since 1970.
    segments : list of Segment. tracks : list of Track.
    table : propagation table. info : what run.json holds.
    live : what a live tracker (bernoulli, focalization) knew minute by minute or scan by scan; empty for the grid search.
    """

    station: Station
    config: RunConfig
    maps: LikelihoodMaps
    _features: xr.Dataset | Path
    detections: pd.DataFrame
    presence: pd.DataFrame
    segments: list[Segment]
    tracks: list[Track]
    table: xr.Dataset
    info: dict[str, Any] = field(default_factory=dict)
    live: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def features(self) -> xr.Dataset:
        """What the station heard, one column a minute."""
        if isinstance(self._features, Path):
            self._features = netcdf.join_complex(netcdf.read(self._features))
        return self._features

    @features.setter
    def features(self, made: xr.Dataset) -> None:
        self._features = made

    def delay(self, range_m: np.ndarray) -> np.ndarray:
        """Travel time [s] of the loudest path against range [m]."""
        return travel_time(self.table)(range_m)

    def write(self, folder: str | Path) -> None:
        """Write detections, tracks, maps, features, run.json and report.png into a folder, each file atomically."""
        folder = prepare_folder(folder)
        for name, dataset in (("maps", self.maps), ("features", self.features)):
            target = folder / f"{name}.nc"
            if target.exists() and dataset.encoding.get("source") == str(target):
                continue
            with netcdf.TimeWriter(target, {"station": self.station.code}) as writer:
                writer.append(dataset)
        write_tables(self, folder)
        self.plot(folder / "report.png")

    def plot(self, path: str | Path | None = None, reference: list | None = None) -> Any:
        """The report figure; saved to `path` if given."""
        from obsnet.plots.report import report

        return report(self, path, reference=reference)


def detect(
    stream: obspy.Stream | str | Path | list,
    station: Station,
    config: RunConfig = RunConfig(),
    **options: Any,
) -> Run:
    """Waveforms to likelihood maps and detections, without tracking; options as for `track`."""
    return _run(stream, station, config, tracking=False, **options)


def track(
    stream: obspy.Stream | str | Path | list,
    station: Station,
    config: RunConfig | None = None,
    *,
    detector: Literal["learned", "analytic", "learned-azimuth", "learned-range"] | None = None,
    **options: Any,
) -> Run:
    """Waveforms to tracks.

    Parameters
    ----------
    stream : obspy Stream, or path(s) of files, folders or an SDS archive.
    station : Station, for instance from `Station.from_stationxml`.
    config : RunConfig, defaults of the core paper.
    detector : overrides `config.detector`.
    starttime, endtime : ISO text, UTCDateTime or datetime64; part of the record to use.
    amplitudes : `Amplitudes` from a calibration. table : propagation table instead of the configured ocean's.
    folder : write maps and features there block by block, so that memory stays flat with record length.
    progress : called with seconds done and in all. threads : how many may work at a time, processes on the maps and threads on the search; all cores by default, and at most.
    heard : called with the run when all is heard, before tracks are looked for.

    Returns
    -------
    Run. No ship found is an empty `tracks`.

    Raises
    ------
    ObsnetError : the waveforms, the station or the configuration cannot serve.
    """
    return _run(stream, station, config or RunConfig(), tracking=True, detector=detector, **options)


# The matrices are small: a pool of BLAS threads takes longer to wake than to multiply.
@threadpool_limits.wrap(limits=1, user_api="blas")
def _run(
    waveforms: Any,
    station: Station,
    config: RunConfig,
    *,
    tracking: bool,
    detector: Any = None,
    starttime: Any = None,
    endtime: Any = None,
    amplitudes: Amplitudes | None = None,
    table: xr.Dataset | None = None,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    heard: Callable[[Run], None] | None = None,
) -> Run:
    _require_kinds(waveforms, station, config)
    if detector is not None:
        config = replace(config, detector=detector)
    clock = Clock()
    threads = usable_cores(threads)

    def listen(
        station: Station,
    ) -> tuple[WaveformSource, Pipeline, MemorySink, xr.Dataset, xr.Dataset | Path]:
        source = open_waveforms(
            waveforms,
            station,
            starttime=starttime,
            endtime=endtime,
            min_rate_hz=config.spectra.analysis_rate_hz,
        )
        clock.lap("open")
        sink = FolderSink(folder, station) if folder is not None else MemorySink()
        with Pipeline(source.station, config, amplitudes, table, threads) as pipeline, sink:
            clock.lap("model")
            for minutes in _stream(source, config, pipeline, progress, clock):
                sink.append(minutes)
                clock.lap("write")
            _require_minutes(sink.detections(), source, config)
            return source, pipeline, sink, *sink.close()

    mute: list[str] = []
    while True:
        try:
            source, pipeline, sink, maps, features = listen(station)
            break
        except _MuteHydrophone as found_mute:
            mute.append(found_mute.seed_id)
            station = station.without(mute[-1])
    for seed_id in mute:
        source.report.left_aside[seed_id] = "never works: gone on as if there were no hydrophone"
    found = sink.detections(), sink.presence()
    run = Run(source.station, config, maps, features, *found, [], [], pipeline.table)
    if heard is not None:
        heard(run)
    if tracking and len(run.presence):
        run.live = pipeline.followed() if config.tracker == "focalization" else run.live
        run.segments, run.tracks = find_tracks(run, threads)
        clock.lap("track")
    run.info = _describe(run, source, clock) | {"models": pipeline.models}
    if table is not None or config.ocean.propagation_file:
        run.info["propagation_table"] = PROPAGATION_FILE
    if amplitudes is not None:
        run.info["amplitudes"] = amplitudes.to_dict()
    return run


def _require_kinds(waveforms: Any, station: Any, config: Any) -> None:
    """An `ObsnetError` where what is given is of another kind than is taken; of paths their reader says it."""
    if not isinstance(station, Station):
        raise StationError(
            f"obsnet takes a Station, as of Station.from_stationxml, found a {type(station).__name__}"
        )
    if not isinstance(config, RunConfig):
        raise ConfigError(
            f"obsnet takes a RunConfig, found a {type(config).__name__}; give RunConfig(…), or none for the defaults"
        )
    if getattr(waveforms, "traces", None) == []:
        raise WaveformError(f"the Stream is empty; give one that holds waveforms of {station.code}")


class _MuteHydrophone(Exception):
    """The hydrophone never worked, and nothing else keeps the horizontals from being heard."""

    def __init__(self, seed_id: str) -> None:
        self.seed_id = seed_id


def _require_minutes(detections: pd.DataFrame, source: WaveformSource, config: RunConfig) -> None:
    """Raise `WaveformError` where no minute has data: a record in which nothing was heard is no sea without ships.

    `_MuteHydrophone` where it is for the hydrophone alone.
    """
    if mute := mute_hydrophone(source):
        raise _MuteHydrophone(mute)
    if not (detections["coverage"] > 0).any():
        # whatever the second at which it begins, this holds a minute between the centres of two frames
        least_s = config.azimuth.step_s + config.spectra.window_s + 2 * config.spectra.hop_s
        raise WaveformError(nothing_heard(source, len(detections), math.ceil(least_s)))


def _stream(
    source: Any,
    config: RunConfig,
    pipeline: Pipeline,
    progress: Progress | None,
    clock: Clock,
) -> Iterator[Minutes]:
    for spectra in iter_spectra(source, config.spectra):
        clock.lap("spectra")
        finished = pipeline.push(spectra)
        clock.lap("detect")
        if progress is not None and spectra.sizes["time"]:
            done = float(to_posix(spectra["time"].values[-1])) - source.begin_ns / 1e9
            progress(done, (source.end_ns - source.begin_ns) / 1e9)
        yield from finished
    finished = pipeline.flush()
    clock.lap("detect")
    yield from finished


def write_tables(run: Run, folder: Path) -> None:
    """Write detections.csv, tracks.csv, tracks.geojson and run.json, and a propagation table that was given."""
    write_text(folder / "detections.csv", detections_csv(run.detections))
    rows = pd.DataFrame([found.row(i) for i, found in enumerate(run.tracks, 1)], columns=TRACK_COLUMNS)
    write_text(folder / "tracks.csv", tracks_csv(rows))
    write_text(folder / "tracks.geojson", json.dumps(geojson(run.tracks, run.station)))
    if len(run.live):
        stamps = np.datetime_as_string(run.live["time"].to_numpy("datetime64[s]"))
        live = run.live.assign(time=np.char.add(stamps, "Z"))
        write_text(folder / "live.csv", live.to_csv(index=False, float_format="%.6g"))
    if "propagation_table" in run.info:
        write_propagation(run.table, folder / PROPAGATION_FILE)
    write_text(folder / "run.json", json.dumps(run.info, indent=1, default=str))


def _describe(run: Run, source: Any, clock: Clock) -> dict[str, Any]:
    return {
        **provenance.versions(),
        "station": {
            "code": run.station.code,
            "latitude": run.station.latitude,
            "longitude": run.station.longitude,
            "depth_m": run.station.depth_m,
        },
        "waveforms": source.report.to_dict(),
        "start": iso(source.begin_ns / 1e9),
        "end": iso(source.end_ns / 1e9),
        "config": to_dict(run.config),
        "segments": [
            {"start": iso(s.start), "end": iso(s.end), "cpa": None if s.cpa is None else iso(s.cpa)}
            for s in run.segments
        ],
        "tracks": len(run.tracks),
        "azimuth_ambiguity_deg": ambiguity_deg(run),
        "ambiguous_tracks": [n for n, found in enumerate(run.tracks, 1) if found.ambiguity_deg == 180],
        "notes": _notes(run),
        "seconds": {stage: round(value, 3) for stage, value in clock.stages.items()},
        "peak_memory_mb": provenance.peak_memory_mb(),
    }


def _notes(run: Run) -> list[str]:
    notes = run.config.unused() if "azimuth_llr" in run.maps else []
    if len(run.presence) and "azimuth" not in run.presence:
        notes.append("no two horizontals: range only, courses are not observed")
    if len(run.presence) and "range" not in run.presence:
        notes.append("no hydrophone: azimuth from polarisation, ambiguous by 180°, no range")
    elif ambiguity_deg(run) == 180:
        notes.append("azimuth from polarisation, ambiguous by 180°")
    elif "azimuth_llr" in run.maps and (alone := two_sided(run.maps["azimuth_llr"].values).sum()):
        notes.append(
            f"the hydrophone is silent in {alone} minutes: their azimuths are from polarisation, known on which axis but not to which side"
        )
    return notes


def read_run(folder: str | Path) -> Run:
    """The run in a folder of ``obsnet track``; maps stay on disk until they are looked at.

    The station comes back without channels, tracks with variances only: infinite where tracks.csv is empty.

    Raises
    ------
    LayoutError : the folder is not one of a run, or a file of it is missing or damaged.
    """
    folder = Path(folder)
    try:
        found = pd.read_csv(folder / "detections.csv", dtype={"time": str}).reindex(columns=DETECTION_COLUMNS)
        found["time"] = found["time"].str.removesuffix("Z").to_numpy("datetime64[ns]")
        found = found.astype(dict.fromkeys(DETECTION_COLUMNS[1:], float))
        rows = pd.read_csv(folder / "tracks.csv").reindex(columns=TRACK_COLUMNS)
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        code, *place = (info["station"][key] for key in ("code", "latitude", "longitude", "depth_m"))
        station, config = Station(code, *place), build(RunConfig, info["config"])
        maps, features = (read_minutes(folder / f"{name}.nc", len(found)) for name in ("maps", "features"))
        spans = [
            Segment(seconds(s["start"]), seconds(s["end"]), s["cpa"] and seconds(s["cpa"]))
            for s in info["segments"]
        ]
        tracks = [track_of_row(row) for _, row in rows.iterrows()]
        kept = folder / PROPAGATION_FILE if "propagation_table" in info else None
    except FileNotFoundError as error:
        missing = Path(error.filename).name if folder.is_dir() else "the folder"
        raise LayoutError(f"{folder} is not a folder of `obsnet track`: {missing} is missing") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise LayoutError(
            f"{folder} does not hold a run of this obsnet ({reason}); run obsnet track again"
        ) from None
    names = {"azimuth_llr": "azimuth", "range_llr": "range"}
    ratios = found.set_index(to_posix(found["time"].to_numpy()))[list(names)].rename(columns=names)
    for name in ("approaching", "leaving"):
        if f"{name}_llr" in features:
            ratios[name] = features[f"{name}_llr"].values
    table = propagation_table(config.ocean, station.depth_m, kept)
    return Run(
        station, config, maps, features, found, ratios.dropna(axis=1, how="all"), spans, tracks, table, info
    )
