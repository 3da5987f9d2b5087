"""The whole twin: a scenario becomes the waveforms, StationXML, AIS and truth of a simulated
ocean-bottom station.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from obspy import Stream, Trace, UTCDateTime
from obspy.core.inventory import Inventory

from obsnet import ais as positions
from obsnet.errors import AISError, ConfigError
from obsnet.layout import iso, parse_utc
from obsnet.ocean.rays import propagation_table
from obsnet.signals.station import Station
from obsnet.twin.course import Course
from obsnet.twin.files import WAVEFORMS, append_stream, whole_file, write_tables, writing
from obsnet.twin.instrument import Recorder
from obsnet.twin.noise import sample_index
from obsnet.twin.propagate import OVERSAMPLING, Field, Paths, add_moving_source
from obsnet.twin.scenario import DEFAULT_START, Passage, Scenario
from obsnet.twin.sea import add_ambient, add_lobe
from obsnet.twin.seafloor import add_earthquakes, add_tremor
from obsnet.twin.ship import Emission
from obsnet.twin.truth import Truth, ais_of, truth_of
from obsnet.twin.whales import add_whale

__all__ = [
    "Passage",
    "Scenario",
    "Simulation",
    "simulate",
    "simulate_blocks",
    "simulate_folder",
    "write_simulation",
]

BLOCK_S = 3600.0
CONTEXT_S = 150.0
LONGEST_H = 100_000.0
Progress = Callable[[float, float], None]


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
        with writing(Path(folder)) as target:
            with whole_file(target / WAVEFORMS) as file:
                append_stream(file, self.stream)
            return [
                target / WAVEFORMS,
                *write_tables(target, self.inventory, self.ais, self.truth, self.scenario),
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
    with writing(Path(folder)) as target:
        with whole_file(target / WAVEFORMS) as file:
            for first, block in _counts(scenario, paths, progress):
                append_stream(file, _stream(scenario, first, block))
        tables = write_tables(
            target, scenario.recorder.inventory(), ais_of(scenario), truth_of(scenario, paths), scenario
        )
        return [target / WAVEFORMS, *tables]


def simulate_folder(
    out: str | Path,
    hours: float = 8.0,
    seed: int = 0,
    ships: int = 1,
    ais: str | Path | None = None,
    station: str | Path | None = None,
    code: str | None = None,
    start: str | None = None,
    progress: Progress | None = None,
) -> str:
    """Simulate a record into a folder: ships drawn from `seed`, or those of an AIS file on their courses.

    Parameters
    ----------
    out : path
        Folder of `write_simulation`'s files.
    hours, seed, ships : length of the record, seed of all that is drawn, ships drawn where no AIS is given.
    ais : path, optional
        AIS file in any dialect.
    station : path, optional
        StationXML whose code, position, depth and orientation to take; station RR03's position by default.
    code : text, optional
        NET.STA, where the StationXML holds several stations.
    start : text, optional
        ISO 8601 UTC; by default the record is centred on the first closest approach of the AIS.

    Returns
    -------
    str
        What was simulated, for the reader.

    Raises
    ------
    ConfigError, AISError, StationError, OutputError
        A time that cannot be read, AIS without a ship near the station, bad metadata, a folder that cannot be
        written.
    """
    if not (np.isfinite(hours) and 0 < hours <= LONGEST_H):
        raise ConfigError(f"hours must lie between 0 and {LONGEST_H:g}, found {hours:g}")
    if seed < 0 or ships < 0:
        name, value = ("seed", seed) if seed < 0 else ("number of ships", ships)
        raise ConfigError(f"the {name} must be a whole number of at least 0, found {value}")
    generator = np.random.default_rng([seed, 0x57A])
    recorder = Recorder.random(generator, **_described(station, code))  # type: ignore[arg-type]
    begin = _seconds(start) if start else None
    if ais is None:
        begin = DEFAULT_START if begin is None else begin
        scenario = Scenario.random(seed, hours, ships, begin, recorder=recorder)
    else:
        scenario = _after_ais(ais, seed, hours, begin, recorder)
    written = write_simulation(scenario, out, progress=progress)
    count = len(scenario.passages)
    return (
        f"simulated {hours:g} h of {recorder.code} from {iso(scenario.start)} with {count} "
        f"ship{'' if count == 1 else 's'}: {', '.join(path.name for path in written)} in {out}"
    )


def _described(station: str | Path | None, code: str | None) -> dict[str, object]:
    if station is None:
        return {"depth_m": Recorder.depth_m}
    known = Station.from_stationxml(station, code)
    angle = known.orientation_deg
    place: dict[str, object] = {
        "code": known.code,
        "latitude": known.latitude,
        "longitude": known.longitude,
        "depth_m": known.depth_m,
    }
    return place if angle is None else place | {"orientation_deg": angle}


def _seconds(text: str) -> float:
    try:
        return parse_utc(text) / 1e9
    except ValueError:
        raise ConfigError(
            f"cannot read the start {text!r}; give ISO 8601, e.g. 2013-05-21T10:00:00Z"
        ) from None


def _after_ais(
    path: str | Path, seed: int, hours: float, start: float | None, recorder: Recorder
) -> Scenario:
    place = (recorder.latitude, recorder.longitude)
    reports = positions.read(path, near=place)
    if start is None:
        tracks = positions.reference_tracks(reports, place, max_cpa_m=None)
        if not tracks:
            raise AISError(
                f"no ship of {path} comes within 100 km of {place[0]:g}, {place[1]:g}; give --station"
            )
        start = float(np.round(tracks[0].cpa().time / 60.0) * 60.0 - 1800.0 * hours)
    sea = Scenario.random(seed, hours, 0, start, recorder=recorder)
    return sea.replace(passages=Scenario.from_ais(reports, start, hours, recorder, seed).passages)


def _paths(scenario: Scenario, table: xr.Dataset | None) -> Paths:
    table = propagation_table(scenario.ocean, scenario.recorder.depth_m) if table is None else table
    return Paths(table, scenario.sediment, scenario.bottom_loss_db)


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
        yield block * size + low, {part: _whole_counts(values[low:high]) for part, values in counts.items()}
        if progress is not None:
            progress(done + 1, len(blocks))


def _whole_counts(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), -(2.0**31), 2.0**31 - 1).astype(np.int32)


def _fill(motion: Field, first: int, scenario: Scenario, emissions: list[Emission], paths: Paths) -> None:
    rate = scenario.recorder.sampling_rate
    for passage, emission in zip(scenario.passages, emissions, strict=True):
        add_moving_source(motion, first, rate, passage.course, passage.ship.source_depth_m, emission, paths)
    if scenario.ambient is not None:
        add_ambient(motion, first, rate, scenario.ambient, scenario.seed)
    for lobe in scenario.lobes:
        add_lobe(motion, first, rate, lobe)
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
