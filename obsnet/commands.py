"""What commands do once their arguments are read: files into parameters and a station, a whole run into a folder."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Generator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from obsnet import console
from obsnet.beside import Beside
from obsnet.errors import ConfigError

if TYPE_CHECKING:
    from obsnet.ocean.amplitudes import Amplitudes
    from obsnet.pipeline import RunConfig
    from obsnet.run import Run
    from obsnet.signals.station import Station

Settings = TypeVar("Settings", bound="RunConfig")


def track(
    waveforms: list[str],
    station_file: Path,
    out: Path,
    *,
    code: str | None = None,
    detector: str | None = None,
    tracker: str | None = None,
    config: Path | None = None,
    overrides: list[str] | None = None,
    start: str | None = None,
    end: str | None = None,
    ais: Path | None = None,
    calibration: Path | None = None,
    propagation: Path | None = None,
    orientation: float | None = None,
    hydrophone_polarity: int | None = None,
    depth: float | None = None,
    latitude: float | None = None,
    longitude: float | None = None,
    jobs: int | None = None,
    quiet: bool = False,
    tracking: bool = True,
) -> None:
    """Read waveforms, station and parameters; run; put the run's files into `out` and say what was found."""
    console.keep_memory()
    with console.loading():
        import obsnet.run as runs
        from obsnet.output import staged

    settings = run_config(config, overrides, detector, tracker, propagation)
    station, settings, amplitudes = _calibrated(
        station_file, code, calibration, settings, orientation_deg=orientation, hydrophone_polarity=hydrophone_polarity,
        depth_m=depth, latitude=latitude, longitude=longitude,
    )  # fmt: skip
    if ais:
        station = placed(station, waveforms, settings, start, end)
    reference = read_reference(ais, station, quiet=quiet) if ais else None
    task = runs.track if tracking else runs.detect
    leftovers = ("live.csv", runs.PROPAGATION_FILE, "figure-[35678].png")
    with staged(out, leftovers=leftovers) as folder, ExitStack() as stack:
        report = stack.enter_context(Beside(_drawing(folder / "report.png", reference), jobs))
        with console.progress("reading and detecting", quiet) as progress:
            run = task(
                waveforms, station, settings, starttime=start, endtime=end, folder=folder, threads=jobs,
                progress=progress, amplitudes=amplitudes, heard=report.tell,
            )  # fmt: skip
        report.tell((run.segments, run.tracks, run.info))
        runs.write_tables(run, folder)
        report.finish()
        console.heed()
    if not quiet:
        _summary(run, out)


def _drawing(path: Path, reference: list | None) -> Generator[None, Any, None]:
    """The report, for a process beside this one: matplotlib is loaded there, while this one reads."""
    with console.loading():
        from obsnet.plots.report import drawing

    yield from drawing(path, reference)


def watch(
    source: str,
    station_file: Path,
    out: Path,
    *,
    code: str | None = None,
    detector: str | None = None,
    config: Path | None = None,
    overrides: list[str] | None = None,
    latency: float | None = None,
    calibration: Path | None = None,
    propagation: Path | None = None,
    orientation: float | None = None,
    hydrophone_polarity: int | None = None,
    depth: float | None = None,
    latitude: float | None = None,
    longitude: float | None = None,
    once: bool = False,
    check: bool = False,
    quiet: bool = False,
) -> None:
    """Read station and parameters and keep `out` up to date with what comes from the source."""
    with console.loading():
        from obsnet.config import build
        from obsnet.live.config import WatchConfig
        from obsnet.live.watch import watch_source

    values = _values(config, overrides, propagation, detector=detector)
    if latency is not None:
        section = values.setdefault("live", {})
        if isinstance(section, dict):
            section["latency_s"] = latency
    settings = build(WatchConfig, values)
    station, settings, amplitudes = _calibrated(
        station_file, code, calibration, settings, orientation_deg=orientation, hydrophone_polarity=hydrophone_polarity,
        depth_m=depth, latitude=latitude, longitude=longitude,
    )  # fmt: skip
    watch_source(
        source, station, settings, out, once=once, check=check,
        amplitudes=amplitudes,
        say=(lambda line: None) if quiet else console.say,
    )  # fmt: skip


def evaluate(folder: Path, ais: Path, quiet: bool = False, as_json: bool = False, **limits: Any) -> None:
    """Say Table I of a run against AIS; `limits` as `evaluate_folder` takes them."""
    from obsnet.evaluation import evaluate_folder

    evaluation = evaluate_folder(folder, ais, **limits)
    if as_json:
        console.say(json.dumps(evaluation.to_json()))
    elif not quiet:
        console.say(evaluation.table())


def archive(
    waveforms: Path,
    stations: list[Path],
    start: str,
    end: str,
    out: Path,
    *,
    select: str | None,
    detector: str | None,
    config: Path | None,
    overrides: list[str] | None,
    jobs: int | None,
    scheduler: str | None,
    quiet: bool,
) -> int:
    """Work through an archive and say what became of it; 3 if a station-day failed, else 0."""
    require_extra("archive", "distributed", "pyarrow", "zarr")
    from obsnet.archive import archive as work_through

    settings = run_config(config, overrides, detector, None)
    with console.progress("station-days", quiet) as progress:
        report = work_through(
            waveforms, list(stations), start, end, out, settings, select=select.split(",") if select else None, jobs=jobs,
            scheduler=scheduler, progress=progress,
        )  # fmt: skip
    if not quiet:
        for line in report.lines():
            console.say(line)
    return 3 if len(report.failed) else 0


def serve(folder: Path, host: str, port: int, ais: Path | None) -> None:
    """Serve a folder's page until it is stopped."""
    require_extra("serve", "starlette", "uvicorn", "plotly")
    from obsnet.ais import read, reference_tracks
    from obsnet.serve.server import is_loopback
    from obsnet.serve.server import serve as listen

    def ready(address: str) -> None:
        console.say(f"{folder} at {address} (Ctrl-C ends it)")
        if not is_loopback(host):
            console.say("note: other machines can reach this page; it has no password")

    listen(
        folder,
        host,
        port,
        None if ais is None else (lambda at: reference_tracks(read(ais, near=at), at)),
        ready,
    )


def require_extra(extra: str, *packages: str) -> None:
    """`ConfigError` where packages of an optional extra are not installed."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"this needs {', '.join(missing)}; install obsnet with its extra: pip install 'obsnet[{extra}]'"
        )


def run_config(
    path: Path | None,
    overrides: list[str] | None,
    detector: str | None,
    tracker: str | None,
    propagation: Path | None = None,
) -> RunConfig:
    """`RunConfig` of a YAML file, overrides of single parameters, and the choices made by options."""
    from obsnet.config import build
    from obsnet.pipeline import RunConfig

    return build(RunConfig, _values(path, overrides, propagation, detector=detector, tracker=tracker))


def _values(
    path: Path | None, overrides: list[str] | None, propagation: Path | None = None, **chosen: str | None
) -> dict[str, Any]:
    from obsnet.config import merge_overrides, read_yaml

    values = merge_overrides(read_yaml(path) if path else {}, overrides or [])
    if propagation is not None:
        ocean = values.setdefault("ocean", {})
        if isinstance(ocean, dict):
            ocean["propagation_file"] = str(propagation.resolve())
    return values | {key: value for key, value in chosen.items() if value is not None}


def read_station(path: Path, code: str | None, **overrides: Any) -> Station:
    """The station of a StationXML; `overrides` as `Station.from_stationxml` takes them, None where not given."""
    from obsnet.signals.station import Station

    given = {key: value for key, value in overrides.items() if value is not None}
    return Station.from_stationxml(path, code, **given)


def placed(
    station: Station, waveforms: list[str], settings: RunConfig, start: str | None, end: str | None
) -> Station:
    """The station where it lay when a record begins; the record is looked into where it lay in several places."""
    if not station.moved:
        return station
    from obsnet.signals.waveforms import open_waveforms

    rate_hz = settings.spectra.analysis_rate_hz
    return open_waveforms(waveforms, station, starttime=start, endtime=end, min_rate_hz=rate_hz).station


def _calibrated(
    path: Path,
    code: str | None,
    calibration: Path | None,
    config: Settings,
    **overrides: Any,
) -> tuple[Station, Settings, Amplitudes | None]:
    """Station, parameters and amplitudes of the pairs, after the file of ``obsnet calibrate`` if one was given.

    What the user gives counts before what the calibration found, and that before the StationXML.
    """
    station = read_station(path, code, **overrides)
    if calibration is None:
        return station, config, None
    from obsnet.calibration import Calibration

    fitted = Calibration.read(calibration)
    config = replace(config, ocean=fitted.ocean(config.ocean))
    return fitted.apply(station).calibrated(**overrides), config, fitted.amplitudes


def read_reference(path: Path, station: Station, max_cpa_m: float | None = 25e3, quiet: bool = False) -> list:
    """Reference tracks of an AIS file, around the station; says which rows were dropped, unless quiet."""
    from obsnet.ais import read, reference_tracks

    positions = read(path, near=(station.latitude, station.longitude))
    for complaint in positions.attrs["report"].complaint():
        if not quiet:
            console.say(f"note: {complaint}")
    return reference_tracks(positions, station, max_cpa_m=max_cpa_m)


def _summary(run: Run, out: Path) -> None:
    found = run.detections
    azimuths, ranges = int(found["azimuth_deg"].notna().sum()), int(found["range_m"].notna().sum())
    console.say(
        f"{run.station.code}: {console.counted(len(found), 'minute')}, {azimuths} with an azimuth, {ranges} with a range"
    )
    for note in run.info.get("notes", []):
        console.say(f"note: {note}")
    for note in _waveform_notes(run.info["waveforms"]):
        console.say(f"note: {note}")
    for number, found_track in enumerate(run.tracks, 1):
        row = found_track.row(number)
        seen = row["course_deg"] == row["course_deg"]
        course = f"azimuth {row['cpa_azimuth_deg']:.0f}°, course {row['course_deg']:.1f} ± {row['course_std_deg']:.1f}°, "
        console.say(
            f"track {number}: CPA {row['cpa_time']} ± {row['cpa_time_std_s']:.0f} s at "
            f"{row['cpa_distance_m'] / 1000:.2f} ± {row['cpa_distance_std_m'] / 1000:.2f} km, {course if seen else ''}"
            f"{row['speed_mps']:.2f} ± {row['speed_std_mps']:.2f} m/s, "
            f"log Bayes factor {row['log_bayes_factor']:.0f} ({found_track.method})"
        )
    if not run.tracks:
        console.say("no ship found" if "track" in run.info["seconds"] else "detections only")
    console.say(f"written to {out}")


def _waveform_notes(report: dict[str, Any]) -> list[str]:
    """What a reader of the tracks must know of the waveforms: what was mended, what could not be used."""
    notes = list(report["notes"])
    for left, kind in ((report["ignored"], "files"), (report["left_aside"], "channels")):
        named = [
            f"{Path(name).name}{':' if kind == 'files' else ''} {reason}" for name, reason in left.items()
        ]
        more = [f"{len(named) - 4} more {kind} left aside (all in run.json)"] if len(named) > 5 else []
        notes += named[: 4 if more else 5] + more
    for seed_id, channel in report["channels"].items():
        counts = {name: channel[name] for name in ("conflicting_overlaps", "dead_frames", "clipped_frames")}
        found = [f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count]
        notes += [f"{seed_id}: {', '.join(found)}"] if found else []
    return notes


def model_info(file: Path, as_json: bool = False) -> None:
    """Say what a model's card says."""
    from obsnet.detectors.model_card import ModelFile

    found = ModelFile.read(file)
    card = vars(found.card) | {"sha256": found.digest, "bytes": len(found.content)}
    if as_json:
        console.say(json.dumps(card, default=str))
        return
    for name, value in card.items():
        if not isinstance(value, dict):
            console.say(f"{name}: {value}")
            continue
        console.say(f"{name}:")
        for key, inner in value.items():
            console.say(f"  {key}: {f'{inner:.6g}' if isinstance(inner, float) else inner}")


def model_verify(file: Path) -> None:
    """Load a model as the detectors do and run it on noise."""
    import numpy as np

    from obsnet.detectors.model_card import ModelFile, run
    from obsnet.errors import ModelError

    found = ModelFile.read(file)
    if found.card.task == "azimuth":
        from obsnet.detectors.learned import LearnedAzimuthDetector

        LearnedAzimuthDetector(model=file)
    session = found.session()
    noise = np.random.default_rng(0)
    feeds = {
        item.name: noise.standard_normal([n if isinstance(n, int) else 2 for n in item.shape]).astype(
            np.float32
        )
        for item in session.get_inputs()
    }
    said = run(session, feeds)
    if not np.isfinite(said).all():
        raise ModelError(f"{file} gives values that are no numbers; export it again")
    console.say(
        f"{file}: {found.card.task} model, {len(found.content)} bytes, SHA-256 {found.digest}, can be used"
    )
