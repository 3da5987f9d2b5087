"""The whole twin: a scenario becomes the waveforms, StationXML, AIS and truth of a simulated
ocean-bottom station.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd
import xarray as xr
from obspy import Stream, Trace, UTCDateTime
from obspy.core.inventory import Inventory

from obsnet.errors import OutputError
from obsnet.layout import iso
from obsnet.ocean.rays import propagation_table
from obsnet.twin.course import Course
from obsnet.twin.noise import sample_index
from obsnet.twin.propagate import OVERSAMPLING, Field, Paths, add_moving_source
from obsnet.twin.scenario import Passage, Scenario
from obsnet.twin.sea import add_ambient
from obsnet.twin.seafloor import add_earthquakes, add_tremor
from obsnet.twin.ship import Emission
from obsnet.twin.truth import Truth, ais_of, truth_of
from obsnet.twin.whales import add_whale

__all__ = ["Passage", "Scenario", "Simulation", "simulate", "simulate_blocks", "write_simulation"]

BLOCK_S = 3600.0
CONTEXT_S = 150.0
WAVEFORMS, METADATA, AIS, MINUTES, PASSAGES = (
    "waveforms.mseed",
    "station.xml",
    "ais.csv",
    "truth.csv",
    "truth.json",
)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Simulation:
    """A simulated record and what it is a record of.

    Attributes
    ----------
    stream : obspy Stream, counts (int32); gaps leave several traces per channel.
    inventory : obspy Inventory, what the metadata say.
    ais : DataFrame mmsi, time, lon, lat, sog [knots], cog [deg].
    truth : Truth, what was heard each minute, and every passage's CPA.
    scenario : Scenario
    """

    stream: Stream
    inventory: Inventory
    ais: pd.DataFrame
    truth: Truth
    scenario: Scenario

    @property
    def courses(self) -> tuple[Course, ...]:
        """Courses of the ships."""
        return tuple(passage.course for passage in self.scenario.passages)

    def write(self, folder: str | Path) -> list[Path]:
        """Write waveforms.mseed (STEIM2), station.xml, ais.csv, truth.csv (minutes) and truth.json
        (passages).

        Each file appears whole or not at all.

        Raises
        ------
        OutputError
            The folder cannot be made or written to.
        """
        with _writing(Path(folder)) as target:
            with _whole(target / WAVEFORMS) as file:
                _append(file, self.stream)
            return [
                target / WAVEFORMS,
                *_write_tables(target, self.inventory, self.ais, self.truth, self.scenario),
            ]


def simulate(
    scenario: Scenario, table: xr.Dataset | None = None, progress: Progress | None = None
) -> Simulation:
    """Simulate a record.

    Parameters
    ----------
    scenario : Scenario
        What to simulate.
    table : Dataset, optional
        Propagation table to use instead of the one of `scenario.ocean`.
    progress : callable, optional
        Called with (blocks done, blocks in all).

    Notes
    -----
    The samples depend on absolute time, on the seeds and on the sampling rate only: a longer or a later
    record of the same scenario has the same samples where they overlap.
    """
    paths = _paths(scenario, table)
    blocks = list(_counts(scenario, paths, progress))
    parts = {
        part: np.concatenate([block[part] for _, block in blocks]) for part in scenario.recorder.channels
    }
    stream = _stream(scenario, blocks[0][0], parts)
    return Simulation(
        stream, scenario.recorder.inventory(), ais_of(scenario), truth_of(scenario, paths), scenario
    )


def simulate_blocks(
    scenario: Scenario, table: xr.Dataset | None = None, progress: Progress | None = None
) -> Iterator[Stream]:
    """Simulate the same record hour by hour in flat memory; the streams join without a seam."""
    for first, block in _counts(scenario, _paths(scenario, table), progress):
        yield _stream(scenario, first, block)


def write_simulation(
    scenario: Scenario, folder: str | Path, table: xr.Dataset | None = None, progress: Progress | None = None
) -> list[Path]:
    """Simulate a record of any length straight into the files of `Simulation.write`, in flat memory.

    Raises
    ------
    OutputError
        The folder cannot be made or written to.
    """
    paths = _paths(scenario, table)
    with _writing(Path(folder)) as target:
        with _whole(target / WAVEFORMS) as file:
            for first, block in _counts(scenario, paths, progress):
                _append(file, _stream(scenario, first, block))
        tables = _write_tables(
            target, scenario.recorder.inventory(), ais_of(scenario), truth_of(scenario, paths), scenario
        )
        return [target / WAVEFORMS, *tables]


def _paths(scenario: Scenario, table: xr.Dataset | None) -> Paths:
    table = propagation_table(scenario.ocean, scenario.recorder.depth_m) if table is None else table
    return Paths(table, scenario.sediment)


def _counts(
    scenario: Scenario, paths: Paths, progress: Progress | None
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Counts of each component in the hours of the absolute grid that the record touches, with their
    first sample.
    """
    rate = scenario.recorder.sampling_rate
    first, last = sample_index(scenario.start, rate), sample_index(scenario.end, rate)
    size, context = round(BLOCK_S * rate), round(CONTEXT_S * rate)
    emissions = [Emission(passage.ship, OVERSAMPLING * rate, rate) for passage in scenario.passages]
    blocks = range(first // size, (last - 1) // size + 1)
    for done, block in enumerate(blocks):
        motion = Field.silence(size + 2 * context)
        _fill(motion, block * size - context, scenario, emissions, paths)
        counts = scenario.recorder.record(motion, context, size)
        low, high = max(first - block * size, 0), min(last - block * size, size)
        yield block * size + low, {part: values[low:high] for part, values in counts.items()}
        if progress is not None:
            progress(done + 1, len(blocks))


def _fill(motion: Field, first: int, scenario: Scenario, emissions: list[Emission], paths: Paths) -> None:
    rate = scenario.recorder.sampling_rate
    for passage, emission in zip(scenario.passages, emissions, strict=True):
        add_moving_source(motion, first, rate, passage.course, passage.ship.source_depth_m, emission, paths)
    if scenario.ambient is not None:
        add_ambient(motion, first, rate, scenario.ambient, scenario.seed)
    for whale in scenario.whales:
        add_whale(motion, first, rate, whale, paths)
    if scenario.earthquakes is not None:
        add_earthquakes(motion, first, rate, scenario.earthquakes)
    if scenario.tremor is not None:
        add_tremor(motion, first, rate, scenario.tremor)


def _stream(scenario: Scenario, first: int, parts: dict[str, np.ndarray]) -> Stream:
    recorder = scenario.recorder
    network, station = recorder.code.split(".")
    rate = recorder.sampling_rate
    stream = Stream()
    for part, code in recorder.channels.items():
        for offset, counts in scenario.faults.pieces(part, first, parts[part], rate, scenario.start):
            header = {
                "network": network,
                "station": station,
                "location": "00",
                "channel": code,
                "sampling_rate": rate,
                "starttime": UTCDateTime(ns=round((first + offset) * 1e9 / rate)),
            }
            stream.append(Trace(counts.copy(), header))
    return stream


def _append(file: BinaryIO, stream: Stream) -> None:
    for trace in stream:
        buffer = BytesIO()
        trace.write(buffer, format="MSEED", encoding="STEIM2", reclen=4096)
        file.write(buffer.getvalue())


def _write_tables(
    target: Path, inventory: Inventory, ais: pd.DataFrame, truth: Truth, scenario: Scenario
) -> list[Path]:
    stamps = dict.fromkeys(("time", "emitted"), "%Y-%m-%dT%H:%M:%S.%fZ")
    with _whole(target / METADATA) as file:
        inventory.write(file, format="STATIONXML")
    for name, frame in ((AIS, ais), (MINUTES, truth.minutes)):
        text = frame.copy()
        for column in stamps.keys() & set(text.columns):
            text[column] = text[column].dt.strftime(stamps[column]).str.replace(".000000Z", "Z", regex=False)
        with _whole(target / name) as file:
            file.write(text.to_csv(index=False, float_format="%.9g").encode())
    rows = truth.passages.assign(
        cpa_time=[iso(time) for time in truth.passages["cpa_time"].to_numpy("datetime64[ns]")]
    )
    known = {
        "simulated": True,
        "station": scenario.recorder.code,
        "start": iso(scenario.start),
        "end": iso(scenario.end),
        "seed": scenario.seed,
        "orientation_deg": scenario.recorder.orientation_deg,
        "hydrophone_polarity": scenario.recorder.hydrophone_polarity,
        "passages": rows.to_dict("records"),
    }
    with _whole(target / PASSAGES) as file:
        file.write(json.dumps(known, indent=2).encode())
    return [target / name for name in (METADATA, AIS, MINUTES, PASSAGES)]


@contextmanager
def _writing(folder: Path) -> Iterator[Path]:
    """Make the output folder; what the system refuses is an `OutputError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except (FileExistsError, NotADirectoryError):
        raise OutputError(f"cannot write the simulation to {folder}: it is a file, name a folder") from None
    except OSError as error:
        raise OutputError(f"cannot write the simulation to {folder}: {error.strerror or error}") from None


@contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """A file that takes its name only when it is complete."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(partial, "wb") as file:
            yield file
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
