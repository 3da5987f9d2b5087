"""Simulated records for the range detector: every nuisance drawn anew in every record, the hydrophone alone analysed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.kinematics import StraightCourse
from obsnet.layout import to_posix
from obsnet.learn.dataset import PreparedSet, Record, packed_table
from obsnet.learn.oceans import Ocean, OceanSpread, draw_ocean
from obsnet.learn.prepare import Job, fill
from obsnet.signals.cepstrogram import ClutterFilter, cepstrogram, noise_std
from obsnet.signals.spectra import spectra
from obsnet.signals.station import Station
from obsnet.twin.course import Course, TurningCourse
from obsnet.twin.scenario import DEFAULT_START, Passage, Scenario
from obsnet.twin.ship import Ship
from obsnet.twin.station import simulate


@dataclass(frozen=True)
class HydrophoneData:
    """Simulated records of the hydrophone alone: how many of each split, and their length. Labels are the twin's truth.

    With `depth_m` every station stands at that depth; by default each draws its own.
    """

    train: int = 160
    validation: int = 50
    hours: float = 5.0
    depth_m: float | None = None


FIRST_SEEDS = {"train": 0, "validation": 10_000}


@dataclass(frozen=True)
class RangeRecord:
    """A simulated record as the range detector meets it.

    Attributes
    ----------
    cepstrogram : DataArray float32 (quefrency, time), clutter removed.
    minutes : DataFrame of the twin's truth: time, mmsi, range_m, range_rate_mps.
    ocean : Ocean
    scenario : Scenario
    """

    cepstrogram: xr.DataArray
    minutes: pd.DataFrame
    ocean: Ocean
    scenario: Scenario


def draw_record(
    seed: int,
    hours: float = 5.0,
    ships: int | None = None,
    depth_m: float | None = None,
    level_db: tuple[float, float] = (192.0, 5.0),
    nuisances: bool = True,
    spread: OceanSpread = OceanSpread(),
) -> RangeRecord:
    """Draw and simulate a record.

    Parameters
    ----------
    seed : names the record.
    ships : how many; 0 to 3 where not given.
    level_db : mean and standard deviation of the ships' source level.
    """
    generator = np.random.default_rng([seed, 0x4A6E])
    ocean = draw_ocean(generator, depth_m, spread)
    count = int(generator.choice(4, p=[0.12, 0.5, 0.28, 0.1])) if ships is None else ships
    rate = float(generator.choice([50.0, 62.5, 100.0], p=[0.9, 0.05, 0.05]))
    passages = tuple(
        Passage(
            replace(
                Ship.random(1000 * seed + i, 100000001 + i, float(generator.normal(*level_db))),
                peak_hz=float(generator.uniform(8.0, 30.0)),
                slope_db=float(generator.uniform(20.0, 40.0)),
                ripple_db=float(generator.uniform(0.5, 3.5)),
            ),
            _draw_course(generator, hours),
        )
        for i in range(count)
    )
    scenario = Scenario.random(seed, hours, 0, sampling_rate=rate, nuisances=nuisances, passages=passages)
    scenario = scenario.replace(
        recorder=replace(scenario.recorder, depth_m=ocean.depth_m, components="H"), tremor=None
    )
    simulation = simulate(scenario, ocean.truth)
    station = Station.from_stationxml(simulation.inventory)
    cepstra = ClutterFilter()(cepstrogram(spectra(simulation.stream, station)))
    return RangeRecord(cepstra, simulation.truth.minutes, ocean, scenario)


def _draw_course(generator: np.random.Generator, hours: float) -> Course:
    margin = min(0.25 * hours, 2.0)
    straight = StraightCourse(
        DEFAULT_START + 3600.0 * float(generator.uniform(margin, hours - margin)),
        float(generator.uniform(-35e3, 35e3)),
        float(generator.uniform(0.0, 360.0)),
        float(generator.uniform(3.0, 12.5)),
    )
    if generator.random() > 0.15:
        return straight
    when = DEFAULT_START + 3600.0 * float(generator.uniform(0.2, 0.8)) * hours
    return TurningCourse(straight, when, float(generator.choice([-1, 1]) * generator.uniform(15.0, 90.0)))


def prepare_hydrophone(folder: str | Path, data: HydrophoneData, progress: Any = None) -> PreparedSet:
    """Make the records that are not there yet, and write provenance.

    Parameters
    ----------
    folder : of the set; a folder prepared with another configuration is refused.
    progress : called with (done, total).
    """

    def job(split: str, seed: int) -> Job:
        name = f"range-{split}-{seed:05d}"
        return name, lambda: hydrophone_record(
            name, split, draw_record(seed, data.hours, depth_m=data.depth_m)
        )

    jobs = [
        job(split, first + k) for split, first in FIRST_SEEDS.items() for k in range(getattr(data, split))
    ]
    return fill(folder, data, jobs, progress)


def hydrophone_record(name: str, split: str, made: RangeRecord) -> Record:
    """A simulated record as a prepared set holds it, without what the horizontals hear."""
    cepstra, truth = made.cepstrogram, made.minutes
    quefrency, times = cepstra["quefrency"].values, to_posix(cepstra["time"].values)
    sigma = noise_std(quefrency, int(cepstra.attrs["nfft"])).astype(np.float32)
    minute = np.arange(np.ceil(times[0] / 60.0), times[-1] // 60.0 + 1) * 60.0
    ships = np.unique(truth["mmsi"])
    place = np.full((2, len(minute), len(ships)), np.nan, np.float32)
    for column, ship in enumerate(ships):
        rows = truth[truth["mmsi"] == ship]
        at = np.rint((to_posix(rows["time"].to_numpy("datetime64[ns]")) - minute[0]) / 60.0).astype(int)
        inside = (at >= 0) & (at < len(minute))
        place[:, at[inside], column] = rows[["range_m", "range_rate_mps"]].to_numpy()[inside].T
    arrays = {
        "frame_time": times,
        "cepstra": np.clip(cepstra.values.T / sigma, -1e4, 1e4).astype(np.float16),
        "quefrency": quefrency,
        "minute": minute,
        "azimuth_deg": np.full(place.shape[1:], np.nan, np.float32),
        "range_m": place[0],
        "range_rate_mps": place[1],
        "known": np.ones(place.shape[1:], bool),
    }
    facts = {"source_levels_db": [passage.ship.source_level_db for passage in made.scenario.passages]}
    attributes = {
        "id": name,
        "split": split,
        "source": "twin",
        "station": made.scenario.recorder.code,
        "depth_m": float(made.ocean.believed.attrs["depth_m"]),
        "ambiguity_deg": 360,
        "absence_known": True,
        "scene": facts,
    }
    return Record(attributes, arrays | packed_table(made.ocean.believed))
