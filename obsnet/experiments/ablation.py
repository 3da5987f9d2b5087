"""Every detector on every kind of simulated record: who is right how often, at what price.

A row is a choice of azimuth and range maps: of the analytic detectors, of a variant of theirs, of the learned ones, or of one
sensor each. Rows share the records, the segmentation and the tracker. Thresholds and the recalibration are chosen on
validation records, which have other seeds than the test records.
"""

from __future__ import annotations

import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.optimize import minimize

from obsnet.ais import ReferenceTrack, read, reference_tracks
from obsnet.config import build, to_dict
from obsnet.detectors.analytic import AzimuthDetectorConfig
from obsnet.detectors.maps import detections, presence
from obsnet.errors import ConfigError, ModelError
from obsnet.evaluation import evaluate
from obsnet.experiments.ablation_minutes import azimuth_nll, minute_table, range_nll, samples
from obsnet.experiments.ablation_records import KINDS
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.output import write_text
from obsnet.pipeline import RunConfig
from obsnet.run import Run, track
from obsnet.signals.cepstrogram import CepstrogramConfig
from obsnet.signals.station import Station
from obsnet.tracking import find_tracks

Maker = Callable[[str, int, float, Path], None]
"""Writes the record of (kind, seed, hours) into a folder: waveforms.mseed, station.xml, ais.csv, truth.csv."""
Progress = Callable[[float, float], None]


@dataclass(frozen=True)
class Row:
    """Where a row's maps come from: names of `BASES`; `recalibrated` by a slope and an offset for each sensor."""

    azimuth: str
    range: str
    recalibrated: bool = False


BASES: dict[str, RunConfig] = {
    "analytic": RunConfig(detector="analytic"),
    "mean_cepstrum": RunConfig(detector="analytic", cepstrogram=CepstrogramConfig(clutter="mean")),
    "uniform_null": RunConfig(detector="analytic", azimuth=AzimuthDetectorConfig(null="uniform")),
    "table_ii": RunConfig(detector="analytic"),
    "learned_azimuth": RunConfig(detector="learned-azimuth"),
    "learned_range": RunConfig(detector="learned-range"),
    "learned": RunConfig(detector="learned"),
}
ROWS: dict[str, Row] = {
    "analytic": Row("analytic", "analytic"),
    "analytic recalibrated": Row("analytic", "analytic", recalibrated=True),
    "mean cepstrum": Row("analytic", "mean_cepstrum"),
    "paper's null and amplitudes": Row("uniform_null", "table_ii"),
    "learned azimuth only": Row("learned_azimuth", "learned_azimuth"),
    "learned range only": Row("learned_range", "learned_range"),
    "learned both": Row("learned", "learned"),
}
VALIDATION_SEED = 1000
SAMPLES = "samples.npz"


def add_variant(name: str, sensor: str, model: str) -> None:
    """Add a row for a learned detector of `sensor` ('azimuth' or 'range') from a model file, the other sensor analytic."""
    if name in ROWS or sensor not in ("azimuth", "range"):
        raise ConfigError(
            f"a variant needs a new name and the sensor azimuth or range, found {name!r} and {sensor!r}"
        )
    detector = "learned-azimuth" if sensor == "azimuth" else "learned-range"
    BASES[name] = build(RunConfig, {"detector": detector, "models": {sensor: model}})
    ROWS[name] = Row(name, name)


@dataclass(frozen=True)
class Plan:
    """What to run: generators by name, kinds, numbers of test and validation seeds of each, hours of a record, rows.

    Validation is of `validation_kinds`, of the same kinds as the test where it is empty.
    """

    generators: Mapping[str, Maker]
    kinds: tuple[str, ...] = KINDS
    seeds: int = 2
    validation_seeds: int = 1
    hours: float = 4.0
    rows: tuple[str, ...] = tuple(ROWS)
    first_seed: int = 0
    validation_kinds: tuple[str, ...] = ()

    def cases(self, validation: bool) -> list[tuple[str, str, int]]:
        """Generator, kind and seed of every record."""
        first, count = (
            (VALIDATION_SEED, self.validation_seeds) if validation else (self.first_seed, self.seeds)
        )
        kinds = (self.validation_kinds or self.kinds) if validation else self.kinds
        return [(g, k, first + i) for g in self.generators for i in range(count) for k in kinds]


def run(plan: Plan, folder: str | Path, progress: Progress | None = None) -> None:
    """Run what is missing in `folder`; what is there already is kept, so that a study goes on where it stopped.

    Every record leaves ``<generator>/<kind>_<seed>/<row>.csv`` (a row a minute) and ``<row>.json`` (tracks). A row whose model is
    not there is left out. Delete a record's folder to run it anew.
    """
    folder = Path(folder)
    validation = plan.cases(validation=True)
    stages: list[tuple[tuple[str, str, int], bool | None]] = [(case, False) for case in validation]
    if any(ROWS[name].recalibrated for name in plan.rows):
        stages += [(case, True) for case in validation]
    stages += [(case, None) for case in plan.cases(validation=False)]
    for done, (case, recalibrated) in enumerate(stages):
        wanted = [n for n in plan.rows if recalibrated is None or ROWS[n].recalibrated == recalibrated]
        _case(plan, folder, case, wanted)
        if progress is not None:
            progress(done + 1, len(stages))


def _case(plan: Plan, folder: Path, case: tuple[str, str, int], wanted: list[str]) -> None:
    generator, kind, seed = case
    place = folder / generator / f"{kind}_{seed}"
    missing = [name for name in wanted if not (place / f"{_key(name)}.json").exists()]
    if not missing:
        return
    if not (place / "truth.csv").exists():
        plan.generators[generator](kind, seed, plan.hours, place)
    runs: dict[str, tuple[Run, float]] = {}
    for name in missing:
        try:
            made, seconds = _compose(ROWS[name], place, runs, folder)
        except ModelError:
            continue
        _keep(place, name, made, seconds)
    if "analytic" in runs and seed >= VALIDATION_SEED and not (place / SAMPLES).exists():
        truth = pd.read_csv(place / "truth.csv")
        held: dict[str, Any] = {**samples(runs["analytic"][0].maps, truth)}
        np.savez(place / SAMPLES, **held)


def _key(name: str) -> str:
    digest = hashlib.sha256(
        json.dumps([to_dict(BASES[b]) for b in (ROWS[name].azimuth, ROWS[name].range)]).encode()
    )
    return f"{name.replace(' ', '_').replace(chr(39), '')}-{digest.hexdigest()[:8]}"


def _base(name: str, place: Path, runs: dict[str, tuple[Run, float]]) -> tuple[Run, float]:
    if name not in runs:
        station = Station.from_stationxml(place / "station.xml")
        amplitudes = Amplitudes.default().scaled_to(station.depth_m) if name == "table_ii" else None
        begun = time.process_time()
        made = track(place / "waveforms.mseed", station, BASES[name], amplitudes=amplitudes, threads=1)
        runs[name] = made, time.process_time() - begun
    return runs[name]


def _compose(row: Row, place: Path, runs: dict[str, tuple[Run, float]], folder: Path) -> tuple[Run, float]:
    """The run of a row, and its CPU seconds (NaN where maps of two runs were put together)."""
    azimuth, seconds = _base(row.azimuth, place, runs)
    if row.azimuth == row.range and not row.recalibrated:
        return azimuth, seconds
    ranged, _ = _base(row.range, place, runs)
    maps = xr.merge(
        [
            azimuth.maps[[n for n in azimuth.maps if str(n).startswith("azimuth")]],
            ranged.maps[[n for n in ranged.maps if str(n).startswith(("range", "line"))]],
        ],
        combine_attrs="drop_conflicts",
    )
    if row.recalibrated:
        fitted = recalibration(folder)
        for sensor in ("azimuth", "range"):
            if f"{sensor}_llr" in maps:
                slope, offset = fitted[sensor]
                maps[f"{sensor}_llr"] = maps[f"{sensor}_llr"] * np.float32(slope) + np.float32(offset)
    ratios = presence(maps)
    made = replace(
        azimuth, maps=maps, presence=ratios, detections=detections(maps, ratios), segments=[], tracks=[]
    )
    made.segments, made.tracks = find_tracks(made, 1)
    return made, float("nan")


def _keep(place: Path, name: str, made: Run, seconds: float) -> None:
    truth = pd.read_csv(place / "truth.csv")
    write_text(
        place / f"{_key(name)}.csv", minute_table(made.maps, truth).to_csv(index=False, float_format="%.6g")
    )
    reference = _reference(place, made, truth)
    scored = evaluate(made.detections, made.tracks, reference, made.delay)
    ships = [s.__dict__ for s in scored.ships if s.expected and s.number]
    summary = {
        "seconds": seconds,
        "found": sum(s["track"] is not None for s in ships),
        "missed": len(scored.missed),
        "false": len(scored.false_tracks),
        "coverage": scored.coverage,
        "ships": [
            {k: v for k, v in s.items() if k.endswith(("_error_s", "_error_m", "_error_deg"))} for s in ships
        ],
    }
    write_text(place / f"{_key(name)}.json", json.dumps(summary, default=float))


def _reference(place: Path, made: Run, truth: pd.DataFrame) -> list[ReferenceTrack]:
    if not len(truth):
        return []
    station = made.station
    return reference_tracks(
        read(place / "ais.csv"), (station.latitude, station.longitude), max_range_m=100e3, max_cpa_m=50e3
    )


def recalibration(folder: str | Path) -> dict[str, tuple[float, float]]:
    """Slope and offset for each sensor: those of least negative log posterior on the validation records.

    Returns
    -------
    dict of (slope, offset): the recalibrated ratio is slope·llr + offset.
    """
    return _recalibration(
        tuple((path, path.stat().st_mtime_ns) for path in sorted(Path(folder).glob(f"*/*/{SAMPLES}")))
    )


@functools.lru_cache(maxsize=1)
def _recalibration(samples: tuple[tuple[Path, int], ...]) -> dict[str, tuple[float, float]]:
    losses: dict[str, list[Callable[[float, float], np.ndarray]]] = {"azimuth": [], "range": []}
    for path, _ in samples:
        with np.load(path) as held:
            if "azimuth_llr" in held.files:
                losses["azimuth"].append(_azimuth_loss(held["azimuth_llr"], held["azimuth_holds"]))
            if "range_llr" in held.files:
                losses["range"].append(
                    _range_loss(held["range_llr"], held["range"], held["range_holds"], held["range_near"])
                )
    return {sensor: _fit(parts) for sensor, parts in losses.items() if parts}


def _azimuth_loss(llr: np.ndarray, holds: np.ndarray) -> Callable[[float, float], np.ndarray]:
    return lambda slope, offset: azimuth_nll(slope * llr + offset, holds)


def _range_loss(
    llr: np.ndarray, grid: np.ndarray, holds: np.ndarray, near: np.ndarray
) -> Callable[[float, float], np.ndarray]:
    return lambda slope, offset: range_nll(slope * llr.astype(np.float32) + offset, grid, holds, near)


def _fit(parts: list[Callable[[float, float], np.ndarray]]) -> tuple[float, float]:
    def loss(parameters: np.ndarray) -> float:
        slope, offset = float(np.exp(parameters[0])), float(parameters[1])
        return float(np.concatenate([part(slope, offset) for part in parts]).mean())

    best = minimize(loss, np.array([-1.0, 0.0]), method="Nelder-Mead", options={"fatol": 1e-5}).x
    return float(np.exp(best[0])), float(best[1])


Outcome = tuple[str, str, pd.DataFrame, dict[str, Any]]


def results(plan: Plan, folder: str | Path, validation: bool) -> dict[str, list[Outcome]]:
    """What is in `folder`: for each row a list of (generator, kind, minutes, summary)."""
    found: dict[str, list[Outcome]] = {}
    for name in plan.rows:
        for generator, kind, seed in plan.cases(validation):
            path = Path(folder) / generator / f"{kind}_{seed}" / f"{_key(name)}.json"
            if path.exists():
                minutes = pd.read_csv(path.with_suffix(".csv"))
                found.setdefault(name, []).append((generator, kind, minutes, json.loads(path.read_text())))
    return found
