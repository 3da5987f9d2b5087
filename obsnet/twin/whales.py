"""Whale calls: stereotyped pulses and tones between 15 and 60 Hz, each along all paths from where the
whale is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numba
import numpy as np

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.twin.course import Course
from obsnet.twin.noise import below_nyquist, named
from obsnet.twin.propagate import Field, Paths

Species = Literal["fin", "blue_z", "pygmy_blue", "blue_d"]
CALLS_PER_DRAW = 64


@dataclass(frozen=True)
class Unit:
    """Part of a call: from `start_s` for `duration_s`, sweeping evenly between two frequencies [Hz]."""

    start_s: float
    duration_s: float
    from_hz: float
    to_hz: float


@dataclass(frozen=True)
class Song:
    """Units of one call, seconds from call to call, their relative jitter, and calls in a bout of `bout`
    + `rest`.
    """

    units: tuple[Unit, ...]
    interval_s: float
    jitter: float
    bout: int
    rest: int


SONGS: dict[str, Song] = {
    "fin": Song((Unit(0.0, 1.0, 23.5, 17.5),), 13.0, 0.06, 60, 10),
    "blue_z": Song(
        (Unit(0.0, 9.0, 26.2, 26.0), Unit(9.0, 1.5, 26.0, 19.6), Unit(10.5, 8.0, 19.5, 18.7)),
        64.0,
        0.03,
        12,
        4,
    ),
    "pygmy_blue": Song((Unit(0.0, 15.0, 35.0, 34.5), Unit(23.0, 17.0, 24.2, 22.4)), 96.0, 0.03, 15, 5),
    "blue_d": Song((Unit(0.0, 3.0, 60.0, 19.0),), 75.0, 0.6, 20, 20),
}


@dataclass(frozen=True)
class Whale:
    """A calling whale.

    Parameters
    ----------
    species : {"fin", "blue_z", "pygmy_blue", "blue_d"}
        Fin 20 Hz pulses, Antarctic blue Z calls, south-western Indian Ocean pygmy blue songs, blue D calls.
    course : Course
        Where it swims.
    source_level_db : float
        dB re 1 µPa (rms) at 1 m; 185–190 is usual.
    depth_m : float
        Where it calls.
    span : tuple of float
        It calls between these times, s since 1970.
    seed : int
        Names its sequence.
    pitch, pace : float
        Frequencies, and seconds from call to call, over those of the species' song: songs differ among oceans and years.
    length : float
        Duration of a call over that of the song.
    level_spread_db : float
        Standard deviation of the calls' levels.
    """

    species: Species = "fin"
    course: Course = field(default_factory=lambda: StraightCourse(0.0, 8000.0, 0.0, 0.0))
    source_level_db: float = 188.0
    depth_m: float = 20.0
    span: tuple[float, float] = (-np.inf, np.inf)
    seed: int = 0
    pitch: float = 1.0
    pace: float = 1.0
    length: float = 1.0
    level_spread_db: float = 0.0

    def __post_init__(self) -> None:
        if self.species not in SONGS:
            raise ConfigError(f"species must be one of {', '.join(SONGS)}, found {self.species!r}")
        if not self.depth_m > 0:
            raise ConfigError(f"a whale's depth must be positive, found {self.depth_m}")
        if not (self.pitch > 0 and self.pace > 0 and self.length > 0):
            raise ConfigError(
                f"a whale's pitch, pace and length must be positive, found {self.pitch}, {self.pace}, {self.length}"
            )

    @property
    def song(self) -> Song:
        """What it sings: its species' song at its own pitch, pace and length."""
        song = SONGS[self.species]
        units = tuple(
            Unit(
                u.start_s * self.length,
                u.duration_s * self.length,
                u.from_hz * self.pitch,
                u.to_hz * self.pitch,
            )
            for u in song.units
        )
        return replace(song, units=units, interval_s=song.interval_s * self.pace)

    @classmethod
    def random(cls, generator: np.random.Generator, start: float, end: float) -> Whale:
        """Draw a whale somewhere within 40 km, swimming at up to 2 m/s and calling for a part of the
        record.
        """
        centre = float(generator.uniform(start, end))
        half = 3600.0 * float(generator.uniform(0.5, 4.0))
        course = StraightCourse(
            centre,
            float(np.sqrt(generator.uniform(1.0, 1600.0)) * 1000.0),
            float(generator.uniform(0.0, 360.0)),
            float(generator.uniform(0.2, 2.0)),
        )
        return cls(
            species=str(generator.choice(list(SONGS), p=[0.45, 0.25, 0.15, 0.15])),  # type: ignore[arg-type]
            course=course,
            source_level_db=float(generator.normal(187.0, 3.0)),
            depth_m=float(generator.uniform(10.0, 40.0)),
            span=(centre - half, centre + half),
            seed=int(generator.integers(2**31)),
        )

    def calls(self, start: float, end: float) -> np.ndarray:
        """Times at which its calls begin between `start` and `end` [s since 1970]."""
        return self._calls(start, end)[0]

    def _calls(self, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Times and numbers of the calls."""
        song = self.song
        start, end = max(start, self.span[0]), min(end, self.span[1])
        if not end > start:
            return np.empty(0), np.empty(0, np.int64)
        first, last = int(start // song.interval_s) - 2, int(end // song.interval_s) + 3
        blocks = range(first // CALLS_PER_DRAW, last // CALLS_PER_DRAW + 1)
        shifts = np.concatenate(
            [
                np.random.default_rng(named(self.seed, 21, block)).uniform(-1, 1, CALLS_PER_DRAW)
                for block in blocks
            ]
        )
        number = np.arange(blocks.start * CALLS_PER_DRAW, blocks.stop * CALLS_PER_DRAW)
        times = (number + song.jitter * shifts) * song.interval_s
        singing = (number + self.seed) % (song.bout + song.rest) < song.bout
        chosen = singing & (times >= start) & (times < end)
        return times[chosen], number[chosen]

    def _levels(self, numbers: np.ndarray) -> np.ndarray:
        """Amplitude of each call [Pa at 1 m]."""
        spread = np.array([np.random.default_rng(named(self.seed, 22, int(n))).normal() for n in numbers])
        return np.sqrt(2.0) * 1e-6 * 10 ** ((self.source_level_db + self.level_spread_db * spread) / 20)


def add_whale(field: Field, first: int, sampling_rate: float, whale: Whale, paths: Paths) -> None:
    """Add a whale's calls to `field`, whose samples begin at `first` since 1970."""
    start, count = first / sampling_rate, field.pressure.size
    song = whale.song
    longest = max(unit.start_s + unit.duration_s for unit in song.units)
    calls, numbers = whale._calls(start - paths.longest_delay_s - longest, start + count / sampling_rate)
    amplitude = whale._levels(numbers)
    units = np.array([[u.start_s, u.duration_s, u.from_hz, u.to_hz] for u in song.units])
    hertz = np.linspace(0.0, 100.0, 2001)
    edge = below_nyquist(hertz, sampling_rate)
    east, north = whale.course.position(calls)
    distance = np.maximum(np.hypot(east, north), 1.0)
    for path in range(len(paths)):
        arrival = paths.arrival(path, distance)
        if arrival is None:
            continue
        towards = -arrival.slowness / paths.water_density / distance
        late = paths.dipole_delay(whale.depth_m, arrival.slowness)
        pressure = arrival.pressure * amplitude
        heard = calls - start + arrival.delay
        for i in np.flatnonzero(np.abs(pressure) > 0):
            _add_call(
                field.pressure, field.east, field.north, field.down, heard[i], late[i], sampling_rate, units,
                pressure[i], towards[i] * east[i], towards[i] * north[i], arrival.admittance[i], edge,
                hertz[1],
            )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _sound(time, units, edge, step):  # type: ignore[no-untyped-def]
    """Analytic signal of a call `time` seconds after its beginning: phase-continuous, tapered sweeps."""
    phase = 0.0
    for j in range(units.shape[0]):
        begin, duration, low, high = units[j]
        x = time - begin
        if x >= 0.0 and x < duration:
            hertz = low + (high - low) * x / duration
            taper = min(0.2 * duration, 1.0)
            window = 1.0
            if x < taper:
                window = 0.5 - 0.5 * np.cos(np.pi * x / taper)
            elif x > duration - taper:
                window = 0.5 - 0.5 * np.cos(np.pi * (duration - x) / taper)
            turns = phase + low * x + 0.5 * (high - low) * x * x / duration
            angle = 2.0 * np.pi * (turns - np.floor(turns))
            return (
                complex(np.cos(angle), np.sin(angle)) * window * edge[min(int(hertz / step), edge.size - 1)]
            )
        phase += 0.5 * (low + high) * duration
    return complex(0.0, 0.0)


@numba.njit(cache=True, nogil=True)
def _add_call(  # type: ignore[no-untyped-def]
    pressure, east, north, down, heard, late, rate, units, strength, to_east, to_north, to_down, edge, step
):
    longest = 0.0
    for j in range(units.shape[0]):
        longest = max(longest, units[j, 0] + units[j, 1])
    low = max(int(np.floor((heard - late) * rate)), 0)
    high = min(int(np.ceil((heard + late + longest) * rate)) + 1, pressure.size)
    for i in range(low, high):
        time = i / rate - heard
        s = _sound(time + late, units, edge, step) - _sound(time - late, units, edge, step)
        p = (strength * s).real
        pressure[i] += p
        east[i] += p * to_east
        north[i] += p * to_north
        down[i] += (strength * to_down * s).real
