"""Waveforms, StationXML and AIS in, prepared records out; the same way for a real archive and for the twin."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.ais import read as read_ais
from obsnet.config import to_dict
from obsnet.detectors.azimuth_features import AzimuthFeatures, Cells, FeatureConfig
from obsnet.errors import ConfigError, WaveformError
from obsnet.layout import iso, parse_utc, to_posix
from obsnet.learn.dataset import PreparedSet, Record, packed_cells, packed_table
from obsnet.learn.labels import labels
from obsnet.learn.scenes import NEVER_TRAINED, SceneConfig, draw_scene, read_courses, split_of
from obsnet.ocean.rays import propagation_table, travel_time
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.signals.cepstrogram import CepstrogramConfig, ClutterFilter, cepstrogram, noise_std
from obsnet.signals.spectra import SpectraConfig, iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms
from obsnet.twin.station import simulate

Job = tuple[str, Callable[[], Record]]

QUIET_SEEDS = 50_000
"""Where the seeds of the records without ships begin."""


@dataclass(frozen=True)
class FrontEnd:
    """The analytic path's own front end, as the records are prepared with it."""

    spectra: SpectraConfig = field(default_factory=SpectraConfig)
    cepstrogram: CepstrogramConfig = field(default_factory=CepstrogramConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)


@dataclass(frozen=True)
class TwinData:
    """Simulated records: how many of each split, how many more of the first two without ships, what scenes, and AIS to take
    courses from (`obsea`: that package's 2012).
    """

    train: int = 180
    validation: int = 36
    test: int = 28
    quiet_train: int = 50
    quiet_validation: int = 12
    first_seed: int = 0
    courses: str | None = "obsea"
    scene: SceneConfig = field(default_factory=SceneConfig)
    front_end: FrontEnd = field(default_factory=FrontEnd)


@dataclass(frozen=True)
class ArchiveData:
    """Records of a real station.

    Parameters
    ----------
    waveforms : files, folder or SDS archive. stationxml : its metadata. ais : AIS file(s), any dialect.
    start, end : ISO 8601, the span to cut into records of `hours`, each with `lead_s` before it to warm up.
    code : NET.STA where the metadata hold several stations.
    orientation_deg, hydrophone_polarity : over the metadata's.
    absence_known : whether a minute without AIS is a minute without a ship. Rarely so: small vessels carry none.
    max_interpolation_s : AIS positions farther from a report are unknown.
    """

    waveforms: str = ""
    stationxml: str = ""
    ais: tuple[str, ...] = ()
    start: str = ""
    end: str = ""
    hours: float = 6.0
    lead_s: float = 10800.0
    code: str | None = None
    orientation_deg: float | None = None
    hydrophone_polarity: int | None = None
    absence_known: bool = False
    max_interpolation_s: float = 1800.0
    ocean: OceanConfig = field(default_factory=OceanConfig)
    front_end: FrontEnd = field(default_factory=FrontEnd)


def prepare(folder: str | Path, data: TwinData | ArchiveData, progress: Any = None) -> PreparedSet:
    """Make the records that are not there yet, and write provenance.

    Parameters
    ----------
    folder : of the set; a folder prepared with another configuration is refused.
    progress : called with (done, total).
    """
    partial = functools.partial
    jobs: list[Job]
    if isinstance(data, TwinData):
        courses, seeds = _courses(data.courses), _twin_jobs(data)
        jobs = [(name, partial(twin_record, name, split, seed, data, courses)) for name, split, seed in seeds]
    else:
        spans = _archive_jobs(data)
        jobs = [(name, partial(archive_record, name, split, span, data)) for name, split, span in spans]
    return fill(folder, data, jobs, progress)


def fill(folder: str | Path, data: Any, jobs: Sequence[Job], progress: Any = None) -> PreparedSet:
    """Make those of the records that are not there yet, and write provenance.

    Parameters
    ----------
    data : the configuration; a folder prepared with another is refused, but for more records.
    jobs : name of each record, and what makes it; one that raises `WaveformError` is passed over.

    Raises
    ------
    WaveformError : there are waveforms for none of the records.
    """
    prepared = PreparedSet(folder)
    _check_same(prepared, data)
    prepared.folder.mkdir(parents=True, exist_ok=True)
    prepared.write_provenance(provenance(data))
    missing: WaveformError | None = None
    for done, (name, make) in enumerate(jobs, 1):
        try:
            if not prepared.has(name):
                prepared.write(make())
        except WaveformError as error:
            missing = missing or error
        if progress is not None:
            progress(done, len(jobs))
    if missing is not None and prepared.empty():
        raise missing
    prepared.write_provenance(
        provenance(data) | {"digest": prepared.digest(), "records": len(prepared.names())}
    )
    return prepared


def provenance(config: Any) -> dict[str, Any]:
    """Configuration, versions and git commit, for whoever asks later how something was made."""
    names = ("obsnet", "numpy", "scipy", "obspy", "xarray", "zarr", "torch", "onnxruntime", "obsea")
    versions = {"python": sys.version.split()[0]}
    for name in names:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "kind": type(config).__name__,
        "config": to_dict(config),
        "versions": versions,
        "commit": git_commit(),
    }


def git_commit() -> str:
    """Commit of the checkout, marked where files differ from it; empty outside a checkout."""
    try:
        text = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return ""
    return text.stdout.strip()


def _check_same(prepared: PreparedSet, data: Any) -> None:
    import json

    path = prepared.folder / "provenance.json"
    if not path.is_file():
        return
    before = json.loads(path.read_text())["config"]
    now = json.loads(json.dumps(to_dict(data), default=str))
    grown = ("train", "validation", "test", "quiet_train", "quiet_validation", "end")
    changed = [key for key in now if key not in grown and before.get(key) != now[key]]
    if changed:
        raise ConfigError(
            f"{prepared.folder} was prepared with another {', '.join(changed)}; name another folder"
        )


def _twin_jobs(data: TwinData) -> Iterator[tuple[str, str, int]]:
    """Records of the splits by turns, so that a set cut short holds all of them."""
    places = [
        ((i + 0.5) / count, split, kind, i)
        for split, kind, count in (
            ("train", "", data.train), ("validation", "", data.validation), ("test", "", data.test),
            ("train", "quiet-", data.quiet_train), ("validation", "quiet-", data.quiet_validation),
        )
        for i in range(count)
    ]  # fmt: skip
    for _, split, kind, i in sorted(places):
        seed = data.first_seed + i
        yield (
            f"{split}-{kind}{i if kind else seed:05d}",
            split,
            seed + QUIET_SEEDS if kind else seed,
        )


def _courses(name: str | None) -> pd.DataFrame | None:
    if name is None:
        return None
    if name != "obsea":
        return read_courses(name)
    if find_spec("obsea") is None:
        raise ConfigError("courses 'obsea' need that package; install obsnet[bench] or set courses=null")
    folder = Path(str(find_spec("obsea").origin)).parent / "data"  # type: ignore[union-attr]
    tables = [read_courses(folder / name) for name in ("ais_marine_traffic.csv", "ais_cls.csv")]
    return pd.concat(tables, ignore_index=True).drop_duplicates(["mmsi", "time"])


def twin_record(
    name: str, split: str, seed: int, data: TwinData, courses: pd.DataFrame | None = None
) -> Record:
    """Simulate and prepare one record."""
    quiet = seed >= data.first_seed + QUIET_SEEDS
    scene = draw_scene(seed, split, replace(data.scene, ship_shares=(1.0,)) if quiet else data.scene, courses)
    recorder = scene.scenario.recorder
    simulation = simulate(scene.scenario, scene.ocean.truth)
    horizontals = "1" in recorder.components
    station = Station.from_stationxml(
        simulation.inventory,
        orientation_deg=recorder.orientation_deg + scene.orientation_error_deg if horizontals else None,
    )
    facts = {
        "seed": seed,
        "ships": len(scene.scenario.passages),
        "real_courses": any(hasattr(p.course, "span") for p in scene.scenario.passages),
        "sampling_rate": recorder.sampling_rate,
        "components": recorder.components,
        "directional_fraction": scene.scenario.ambient.directional_fraction
        if scene.scenario.ambient
        else 0.0,
        "lobes": len(scene.scenario.lobes),
        "whales": len(scene.scenario.whales),
        "earthquakes_per_day": scene.scenario.earthquakes.per_day if scene.scenario.earthquakes else 0.0,
        "tremor": scene.scenario.tremor is not None,
        "gaps": len(scene.scenario.faults.gaps),
        "source_levels_db": [p.ship.source_level_db for p in scene.scenario.passages],
        "orientation_error_deg": scene.orientation_error_deg,
    }
    attributes = {"id": name, "split": split, "source": "twin", "absence_known": True, "scene": facts}
    arrays = front_end(simulation.stream, station, data.front_end)
    minutes = _minutes(scene.scenario.start, scene.scenario.end)
    place = (recorder.latitude, recorder.longitude)
    seen = labels(simulation.ais, place, minutes, travel_time(scene.ocean.believed))
    return _record(attributes, station, arrays, minutes, seen, scene.ocean.believed)


def _archive_jobs(data: ArchiveData) -> Iterator[tuple[str, str, tuple[float, float]]]:
    if not (data.waveforms and data.stationxml and data.ais and data.start and data.end):
        raise ConfigError("an archive needs waveforms, stationxml, ais, start and end; see docs/training.md")
    begin, end = (parse_utc(text) / 1e9 for text in (data.start, data.end))
    for number in range(int((end - begin) / (3600.0 * data.hours))):
        start = begin + 3600.0 * data.hours * number
        stop = start + 3600.0 * data.hours
        if start < NEVER_TRAINED[1] and stop > NEVER_TRAINED[0]:
            split = "test"
        else:
            split = split_of(f"day {int(start // 86400)}")
        stamp = str(np.datetime64(int(start), "s")).replace(":", "")
        yield f"archive-{stamp}", split, (start, stop)


def archive_record(name: str, split: str, span: tuple[float, float], data: ArchiveData) -> Record:
    """Prepare one stretch of a real archive; `WaveformError` where it holds no waveforms."""
    station = Station.from_stationxml(
        data.stationxml,
        data.code,
        orientation_deg=data.orientation_deg,
        hydrophone_polarity=data.hydrophone_polarity,
    )
    lead = max(span[0] - data.lead_s, parse_utc(data.start) / 1e9)
    source = open_waveforms(
        data.waveforms, station, starttime=lead, endtime=span[1] + 180.0,
        min_rate_hz=data.front_end.spectra.analysis_rate_hz,
    )  # fmt: skip
    begin, end = (round(1e9 * time) for time in span)
    if not any(first < end and last > begin for first, last in source.covered(0)):
        raise WaveformError(f"{station.code} has no waveforms from {iso(span[0])} to {iso(span[1])}")
    arrays = front_end(source, station, data.front_end)
    place = (station.latitude, station.longitude)
    ais = read_ais(list(data.ais), near=place)
    seconds = to_posix(ais["time"].to_numpy())
    ais = ais[(seconds > span[0] - 86400.0) & (seconds < span[1] + 86400.0)]
    table = propagation_table(data.ocean, station.depth_m)
    minutes = _minutes(*span)
    seen = labels(
        ais, place, minutes, travel_time(table), max_interpolation_s=data.max_interpolation_s,
        ours=lambda mmsi: split != "train" or split_of(mmsi) == "train",
    )  # fmt: skip
    attributes = {
        "id": name, "split": split, "source": "archive", "absence_known": data.absence_known, "scene": {},
    }  # fmt: skip
    return _record(attributes, station, arrays, minutes, seen, table)


def front_end(source: Any, station: Station, config: FrontEnd = FrontEnd()) -> dict[str, Any]:
    """Cells of the azimuth detector and the filtered cepstrogram of a record, those that its channels allow.

    Returns
    -------
    dict of `cells` (Cells), `cepstra` (frame, quefrency) in units of the noise, `frame_time`, `quefrency`.
    """
    opened = open_waveforms(source, station, min_rate_hz=config.spectra.analysis_rate_hz)
    features, clutter = AzimuthFeatures(config.features), ClutterFilter(config.cepstrogram)
    cells: list[Cells] = []
    cepstra: list[xr.DataArray] = []
    for block in iter_spectra(opened, config.spectra):
        if "east" in block and "north" in block:
            cells.append(features.push(block))
        if "p" in block:
            cepstra.append(clutter(cepstrogram(block)))
    if cells:
        cells.append(features.flush())
    made: dict[str, Any] = {"cells": _joined(cells) if cells else None}
    if cepstra:
        quefrency = cepstra[0]["quefrency"].values
        sigma = noise_std(quefrency, int(cepstra[0].attrs["nfft"]))
        made["quefrency"] = quefrency
        made["cepstra"] = np.concatenate([c.values.T for c in cepstra]) / sigma.astype(np.float32)
        made["frame_time"] = np.concatenate([to_posix(c["time"].values) for c in cepstra])
    return made


def _joined(parts: list[Cells]) -> Cells:
    parts = [part for part in parts if len(part.index)] or parts[:1]
    return functools.reduce(Cells.joined, parts)


def _minutes(start: float, end: float) -> np.ndarray:
    return np.arange(np.ceil(start / 60.0) * 60.0, end, 60.0)


def _record(
    attributes: dict[str, Any],
    station: Station,
    made: dict[str, Any],
    minutes: np.ndarray,
    seen: dict[str, np.ndarray],
    table: xr.Dataset,
) -> Record:
    cells = made["cells"]
    if cells is None:
        cells = Cells(np.empty(0, np.int64), np.empty((0, 0, 0), np.float32), np.empty((0, 0), np.complex64))
    cepstral = {
        "frame_time": made.get("frame_time", np.empty(0)),
        "cepstra": np.clip(made.get("cepstra", np.empty((0, 0))), -1e4, 1e4).astype(np.float16),
        "quefrency": made.get("quefrency", np.empty(0)),
    }
    attributes |= {"station": station.code, "depth_m": station.depth_m, "ambiguity_deg": cells.ambiguity_deg}
    arrays = packed_cells(cells) | cepstral | {"minute": minutes} | seen | packed_table(table)
    return Record(attributes, arrays)
