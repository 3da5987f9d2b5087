"""Everything that makes a simulated record: ships on courses, sea, sea floor, recorder and faults;
drawn, or after AIS.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.layout import to_posix
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.twin.course import Course, WaypointCourse
from obsnet.twin.faults import Faults
from obsnet.twin.instrument import Recorder
from obsnet.twin.propagate import Sediment
from obsnet.twin.sea import Ambient, Lobe
from obsnet.twin.seafloor import Earthquakes, Tremor
from obsnet.twin.ship import Ship
from obsnet.twin.whales import Whale

MAX_RANGE_M = 130_000.0
DEFAULT_START = 1369130400.0


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
        First sample not before this, s since 1970 (default 2013-05-21T10:00:00Z).
    hours : float
        Length of the record.
    passages : tuple of Passage
        Ships and courses; none is a record of the sea.
    recorder : Recorder
        The station.
    ambient : Ambient or None
        The background; None is silence.
    lobes : tuple of Lobe
        Noise from one side that turns and swells.
    whales : tuple of Whale
    earthquakes : Earthquakes or None
    tremor : Tremor or None
    sediment : Sediment or None
        A reflector below the sea floor.
    bottom_loss_db : float
        What each reflection at the sea floor loses to attenuation and scattering, which a propagation table
        of ideal half-spaces leaves out.
    faults : Faults
        Gaps, dead or clipped channels.
    ocean : OceanConfig
        From which the propagation table is made.
    seed : int
        Of the background; ships, whales, earthquakes and tremor have their own.
    """

    start: float = DEFAULT_START
    hours: float = 8.0
    passages: tuple[Passage, ...] = ()
    recorder: Recorder = field(default_factory=Recorder)
    ambient: Ambient | None = field(default_factory=Ambient)
    lobes: tuple[Lobe, ...] = ()
    whales: tuple[Whale, ...] = ()
    earthquakes: Earthquakes | None = None
    tremor: Tremor | None = None
    sediment: Sediment | None = None
    bottom_loss_db: float = 1.0
    faults: Faults = field(default_factory=Faults)
    ocean: OceanConfig = field(default_factory=lambda: OceanConfig(max_range_m=MAX_RANGE_M))
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.hours) and self.hours > 0):
            raise ConfigError(f"hours must be positive, found {self.hours}")
        if not np.isfinite(self.start):
            raise ConfigError(f"start must be seconds since 1970, found {self.start}")
        mmsi = [passage.ship.mmsi for passage in self.passages]
        if len(set(mmsi)) != len(mmsi):
            raise ConfigError(f"ships of a scenario must have different mmsi, found {mmsi}")

    @property
    def end(self) -> float:
        """End of the record, s since 1970."""
        return self.start + 3600.0 * self.hours

    def replace(self, **changes: object) -> Scenario:
        """The same scenario with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    @classmethod
    def random(
        cls,
        seed: int,
        hours: float = 8.0,
        ships: int = 1,
        start: float = DEFAULT_START,
        sampling_rate: float = 50.0,
        nuisances: bool = True,
        **fixed: object,
    ) -> Scenario:
        """Draw a record; fields given in `fixed` are kept.

        CPA times are uniform over the record but for its first and last quarter (two hours at most), CPA
        ranges over ±30 km, courses over all directions, speeds over 6–13 m/s. Every record has its own
        orientation, polarity, depth, sensors and background; with `nuisances` also whales, earthquakes,
        tremor, a sediment and gaps, each in a part of the records.
        """
        generator = np.random.default_rng([seed, 0x0B5])
        passages = tuple(
            Passage(Ship.random(1000 * seed + i, 100000001 + i), _draw_course(generator, start, hours))
            for i in range(ships)
        )
        drawn: dict[str, object] = {
            "start": start,
            "hours": hours,
            "passages": passages,
            "recorder": Recorder.random(generator, sampling_rate),
            "ambient": Ambient.random(generator),
            "seed": seed,
        }
        if nuisances:
            drawn |= _draw_nuisances(generator, start, hours)
        return cls(**{**drawn, **fixed})  # type: ignore[arg-type]

    @classmethod
    def from_ais(
        cls,
        ais: pd.DataFrame,
        start: float,
        hours: float,
        recorder: Recorder | None = None,
        seed: int = 0,
        radius_m: float = 120_000.0,
        max_gap_s: float = 24 * 3600.0,
        smooth: bool = False,
        **fixed: object,
    ) -> Scenario:
        """The ships of AIS messages on their courses, with sounds drawn from `seed` and the ship's mmsi.

        Parameters
        ----------
        ais : DataFrame
            Columns mmsi, time (datetime64), lon, lat; cut at gaps longer than `max_gap_s`.
        start, hours : float
            The record.
        radius_m : float
            Ships that do not come this near during the record are left out.
        smooth : bool
            Interpolate positions smoothly instead of at constant velocity.

        Raises
        ------
        ConfigError
            A column is missing.
        """
        absent = {"mmsi", "time", "lon", "lat"} - set(ais.columns)
        if absent:
            raise ConfigError(
                f"AIS lacks {', '.join(sorted(absent))}; its columns are {', '.join(ais.columns)}"
            )
        recorder = recorder or Recorder()
        end = start + 3600.0 * hours
        passages = []
        for mmsi, course in _courses(ais, (recorder.latitude, recorder.longitude), max_gap_s, smooth):
            time = np.arange(max(start, course.span[0]), min(end, course.span[1]) + 60.0, 60.0)
            if time.size and np.min(np.hypot(*course.position(time))) < radius_m:
                passages.append((mmsi, course))
        ships = _sounds([mmsi for mmsi, _ in passages], seed)
        return cls(
            start=start,
            hours=hours,
            passages=tuple(Passage(ship, course) for ship, (_, course) in zip(ships, passages, strict=True)),
            recorder=recorder,
            seed=seed,
            **fixed,  # type: ignore[arg-type]
        )


def _courses(
    ais: pd.DataFrame, station: tuple[float, float], max_gap_s: float, smooth: bool
) -> list[tuple[int, WaypointCourse]]:
    found = []
    for mmsi, rows in ais.groupby("mmsi"):
        rows = rows.sort_values("time")
        seconds = to_posix(rows["time"].to_numpy("datetime64[ns]"))
        parts = np.split(np.arange(seconds.size), np.flatnonzero(np.diff(seconds) > max_gap_s) + 1)
        for part in parts:
            if np.unique(seconds[part]).size >= 2:
                lon, lat = rows["lon"].to_numpy(float)[part], rows["lat"].to_numpy(float)[part]
                found.append(
                    (int(str(mmsi)), WaypointCourse.from_ais(seconds[part], lon, lat, station, smooth))
                )
    return found


def _sounds(mmsi: list[int], seed: int) -> list[Ship]:
    """One ship for each course; a second course of the same ship sounds the same under a mmsi of its own."""
    ships, used = [], set()
    for number in mmsi:
        ship = Ship.random(seed * 1_000_003 + number, number)
        while number in used:
            number += 900_000_000
        used.add(number)
        ships.append(dataclasses.replace(ship, mmsi=number))
    return ships


def _draw_course(generator: np.random.Generator, start: float, hours: float) -> StraightCourse:
    margin = min(0.25 * hours, 2.0)
    return StraightCourse(
        start + 3600.0 * float(generator.uniform(margin, hours - margin)),
        float(generator.uniform(-30e3, 30e3)),
        float(generator.uniform(0.0, 360.0)),
        float(generator.uniform(6.0, 13.0)),
    )


def _draw_nuisances(generator: np.random.Generator, start: float, hours: float) -> dict[str, object]:
    end = start + 3600.0 * hours
    whales = tuple(
        Whale.random(generator, start, end)
        for _ in range(generator.poisson(1.2) if generator.random() < 0.6 else 0)
    )
    earthquakes = Earthquakes(float(generator.gamma(1.5, 6.0)), seed=int(generator.integers(2**31)))
    tremor, sediment = (
        Tremor.random(generator),
        Sediment(
            float(generator.uniform(20.0, 150.0)),
            1650.0,
            float(np.clip(generator.normal(0.0, 0.12), -0.3, 0.3)),
        ),
    )
    return {
        "whales": whales,
        "earthquakes": earthquakes,
        "tremor": tremor if generator.random() < 0.35 else None,
        "sediment": sediment if generator.random() < 0.6 else None,
        "bottom_loss_db": float(generator.uniform(0.5, 3.0)),
        "faults": Faults.random(generator, hours),
    }
