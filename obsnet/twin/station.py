"""The whole twin: a scenario (ships on courses, sea, recorder, faults) becomes waveforms, StationXML, AIS and
the truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import xarray as xr
from obspy import Stream, Trace, UTCDateTime
from obspy.core.inventory import Inventory

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.ocean.rays import propagation_table
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.twin.course import Course
from obsnet.twin.faults import Faults
from obsnet.twin.instrument import Recorder
from obsnet.twin.noise import sample_index
from obsnet.twin.propagate import OVERSAMPLING, Field, Paths, add_moving_source
from obsnet.twin.sea import Ambient, add_ambient
from obsnet.twin.ship import Emission, Ship
from obsnet.twin.truth import Truth, ais_of, truth_of

BLOCK_S = 3600.0
CONTEXT_S = 150.0
MAX_RANGE_M = 130_000.0


@dataclass(frozen=True)
class Passage:
    """A ship and where it goes."""

    ship: Ship
    course: Course


@dataclass(frozen=True)
class Scenario:
    """Everything that makes a record.

    Parameters
    ----------
    start : float
        First sample not before this, s since 1970.
    hours : float
        Length of the record.
    passages : tuple of Passage
        Ships and courses; none is a record of the sea.
    recorder : Recorder
        The station.
    ambient : Ambient or None
        The background; None is silence.
    faults : Faults
        Gaps, dead or clipped channels.
    ocean : OceanConfig
        From which the propagation table is made.
    seed : int
        Of everything but the ships, which have their own.
    """

    start: float = 1369130400.0
    hours: float = 8.0
    passages: tuple[Passage, ...] = ()
    recorder: Recorder = field(default_factory=Recorder)
    ambient: Ambient | None = field(default_factory=Ambient)
    faults: Faults = field(default_factory=Faults)
    ocean: OceanConfig = field(default_factory=lambda: OceanConfig(max_range_m=MAX_RANGE_M))
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.hours > 0:
            raise ConfigError(f"hours must be positive, found {self.hours}")
        mmsi = [passage.ship.mmsi for passage in self.passages]
        if len(set(mmsi)) != len(mmsi):
            raise ConfigError(f"ships must have different mmsi, found {mmsi}")

    @property
    def end(self) -> float:
        """End of the record, s since 1970."""
        return self.start + 3600.0 * self.hours

    @classmethod
    def random(
        cls,
        seed: int,
        hours: float = 8.0,
        ships: int = 1,
        start: float = 1369130400.0,
        sampling_rate: float = 50.0,
        **fixed: object,
    ) -> Scenario:
        """Draw a record: ships, courses, recorder and sea; fields given in `fixed` are kept.

        CPA times are uniform over the middle of the record, CPA ranges over ±30 km, courses over all
        directions, speeds over 6–13 m/s.
        """
        generator = np.random.default_rng([seed, 0x0B5])
        passages = tuple(_draw_passage(generator, seed, i, start, hours) for i in range(ships))
        drawn: dict[str, object] = {
            "start": start,
            "hours": hours,
            "passages": passages,
            "recorder": Recorder.random(generator, sampling_rate),
            "ambient": Ambient.random(generator),
            "seed": seed,
        }
        return cls(**{**drawn, **fixed})  # type: ignore[arg-type]

    def replace(self, **changes: object) -> Scenario:
        """The same scenario with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


def _draw_passage(
    generator: np.random.Generator, seed: int, number: int, start: float, hours: float
) -> Passage:
    margin = min(0.25 * hours, 2.0)
    cpa_time = start + 3600.0 * float(generator.uniform(margin, hours - margin))
    course = StraightCourse(
        cpa_time,
        float(generator.uniform(-30e3, 30e3)),
        float(generator.uniform(0.0, 360.0)),
        float(generator.uniform(6.0, 13.0)),
    )
    return Passage(Ship.random(1000 * seed + number, 100000001 + number), course)


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


def simulate(
    scenario: Scenario,
    table: xr.Dataset | None = None,
    progress: Callable[[int, int], None] | None = None,
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
    table = propagation_table(scenario.ocean, scenario.recorder.depth_m) if table is None else table
    blocks = list(_counts(scenario, Paths(table), progress))
    parts = {
        part: np.concatenate([block[part] for _, block in blocks]) for part in scenario.recorder.channels
    }
    stream = _stream(scenario, blocks[0][0], parts)
    return Simulation(
        stream, scenario.recorder.inventory(), ais_of(scenario), truth_of(scenario, Paths(table)), scenario
    )


def simulate_blocks(
    scenario: Scenario, table: xr.Dataset | None = None, progress: Callable[[int, int], None] | None = None
) -> Iterator[Stream]:
    """Simulate the same record hour by hour in flat memory; the streams join without a seam."""
    table = propagation_table(scenario.ocean, scenario.recorder.depth_m) if table is None else table
    for first, block in _counts(scenario, Paths(table), progress):
        yield _stream(scenario, first, block)


def _counts(
    scenario: Scenario, paths: Paths, progress: Callable[[int, int], None] | None
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Counts of each component in the hours of the absolute grid that the record touches, with their first
    sample.
    """
    rate = scenario.recorder.sampling_rate
    first, last = sample_index(scenario.start, rate), sample_index(scenario.end, rate)
    size, context = round(BLOCK_S * rate), round(CONTEXT_S * rate)
    emissions = [Emission(passage.ship, OVERSAMPLING * rate, rate) for passage in scenario.passages]
    blocks = range(first // size, (last - 1) // size + 1)
    for done, block in enumerate(blocks):
        motion = Field.silence(size + 2 * context)
        begin = block * size - context
        for passage, emission in zip(scenario.passages, emissions, strict=True):
            add_moving_source(
                motion, begin, rate, passage.course, passage.ship.source_depth_m, emission, paths
            )
        if scenario.ambient is not None:
            add_ambient(motion, begin, rate, scenario.ambient, scenario.seed)
        counts = scenario.recorder.record(motion, context, size)
        low, high = max(first - block * size, 0), min(last - block * size, size)
        yield block * size + low, {part: values[low:high] for part, values in counts.items()}
        if progress is not None:
            progress(done + 1, len(blocks))


def _stream(scenario: Scenario, first: int, parts: dict[str, np.ndarray]) -> Stream:
    recorder = scenario.recorder
    network, station = recorder.code.split(".")
    stream = Stream()
    for part, code in recorder.channels.items():
        for offset, counts in scenario.faults.pieces(
            part, first, parts[part], recorder.sampling_rate, scenario.start
        ):
            trace = Trace(np.ascontiguousarray(counts))
            trace.stats.update(
                {
                    "network": network,
                    "station": station,
                    "location": "00",
                    "channel": code,
                    "sampling_rate": recorder.sampling_rate,
                }
            )
            trace.stats.starttime = UTCDateTime(ns=round((first + offset) * 1e9 / recorder.sampling_rate))
            stream.append(trace)
    return stream
