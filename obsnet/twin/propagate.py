"""From what a source emits to pressure and particle velocity at the sea floor: every path with the delay,
amplitude, phase, dipole and direction that belong to where the source was when it emitted what is heard now.

Fields go as exp(+iωt). What arrives at time t along path k left the source at t_e, t_e + τ_k(r(t_e)) = t:

    p_k(t) = Re{A_k(r(t_e)) [s(t_e + δ_k) − s(t_e − δ_k)]},   δ_k = z_s √(1/c² − p_k²),

with s the analytic signal of the source, A_k the table's pressure and the two terms the source at depth z_s
and its image in the surface. Horizontal velocity is pressure times slowness over density, away from the
source: incident and reflected wave have the same horizontal slowness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import xarray as xr
from scipy.interpolate import CubicHermiteSpline

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import PROPAGATION, require
from obsnet.ocean.bottom import Bottom
from obsnet.twin.course import Course, presence

OVERSAMPLING = 2
TAPS = 12
PHASES = 512


@dataclass(frozen=True)
class Sediment:
    """A reflector below the sea floor: every meeting of a path with the bottom adds a weak echo.

    Parameters
    ----------
    thickness_m : float
        Depth of the reflector below the sea floor.
    speed_mps : float
        Sound speed above it.
    reflection : float
        Amplitude of the echo of one meeting over that of the path; the (k + 1)/2 meetings of path k add up.
    """

    thickness_m: float = 60.0
    speed_mps: float = 1650.0
    reflection: float = 0.15

    def __post_init__(self) -> None:
        if not (self.thickness_m > 0 and self.speed_mps > 0 and abs(self.reflection) < 1):
            raise ConfigError(
                f"a sediment needs thickness and speed > 0 and a reflection within ±1, found {self}"
            )

    def delay(self, slowness: np.ndarray) -> np.ndarray:
        """Two-way vertical delay 2h √(1/c² − p²) [s]."""
        return 2 * self.thickness_m * np.sqrt(np.maximum(self.speed_mps**-2.0 - slowness**2, 0.0))


@dataclass(frozen=True)
class Arrival:
    """One path at given ranges (arrays like these): delay [s], complex pressure [1/m], horizontal slowness
    [s/m], and downward velocity over pressure at the sea floor [m/s/Pa], complex.
    """

    delay: np.ndarray
    pressure: np.ndarray
    slowness: np.ndarray
    admittance: np.ndarray


@dataclass(frozen=True)
class _Column:
    delay: CubicHermiteSpline
    pressure: np.ndarray
    slowness: np.ndarray
    admittance: np.ndarray


class Paths:
    """A propagation table as functions of range; a path has zero pressure where it does not exist."""

    def __init__(
        self, table: xr.Dataset, sediment: Sediment | None = None, bottom_loss_db: float = 0.0
    ) -> None:
        """`bottom_loss_db` is what each reflection at the sea floor loses beyond the table's coefficient."""
        self.sediment, self.bottom_loss_db = sediment, bottom_loss_db
        require(table, PROPAGATION)
        table = table.transpose("path", "range", ...)
        self.range_m = table["range"].values.astype(float)
        self.numbers = [int(k) for k in table["path"].values]
        self.surface_speed = float(table.attrs.get("surface_speed_mps", 1530.0))
        self.seafloor_speed = float(table.attrs.get("seafloor_speed_mps", 1520.0))
        self.water_density = float(table.attrs.get("water_density_kgm3", 1030.0))
        self._columns = [self._column(table.isel(path=k)) for k in range(len(self.numbers))]
        if all(column is None for column in self._columns):
            raise LayoutError("the propagation table holds no path at any range; compute it for other ranges")
        self.longest_delay_s = float(np.nanmax(table["delay"].values)) + 5.0

    def __len__(self) -> int:
        return len(self._columns)

    def _column(self, path: xr.Dataset) -> _Column | None:
        delay, pressure, slowness = (path[name].values for name in ("delay", "pressure", "slowness"))
        there = np.isfinite(delay) & np.isfinite(pressure) & np.isfinite(slowness)
        if there.sum() < 2:
            return None
        ranges = self.range_m[there]
        filled = np.interp(self.range_m, ranges, slowness[there])
        strength = np.where(there, pressure, 0.0).astype(np.complex128)
        strength *= 10 ** (-self.bottom_loss_db / 20 * ((int(path["path"]) - 1) // 2))
        spline = CubicHermiteSpline(ranges, delay[there], slowness[there])
        return _Column(spline, strength, filled, self._admittance(path, filled))

    def _admittance(self, path: xr.Dataset, slowness: np.ndarray) -> np.ndarray:
        """(1 − R)/(1 + R) √(1/c² − p²)/ρ; R of the table, or of the default bottom where it holds none."""
        slowness = np.minimum(slowness, 0.9999 / self.seafloor_speed)
        reflection = Bottom().reflection(slowness, self.seafloor_speed)
        if "reflection" in path:
            reflection = np.where(
                np.isfinite(path["reflection"].values), path["reflection"].values, reflection
            )
        total = 1 + reflection
        total = np.where(np.abs(total) < 0.05, 0.05, total)
        return (
            (1 - reflection) / total * np.sqrt(self.seafloor_speed**-2.0 - slowness**2) / self.water_density
        )

    def arrival(self, path: int, range_m: np.ndarray) -> Arrival | None:
        """Path number `path` (from 0) at ranges [m], its delay going on straight where it ends; None where it
        never exists.
        """
        column = self._columns[path]
        if column is None:
            return None
        known = column.delay.x
        inside = np.clip(range_m, known[0], known[-1])
        slowness = np.interp(inside, self.range_m, column.slowness)
        return Arrival(
            column.delay(inside) + (range_m - inside) * slowness,
            np.interp(range_m, self.range_m, column.pressure, right=0.0),
            slowness,
            np.interp(inside, self.range_m, column.admittance),
        )

    def strongest_delay(self, range_m: np.ndarray) -> np.ndarray:
        """Travel time [s] of the path with the greatest pressure at each range; NaN where none exists."""
        range_m = np.asarray(range_m, float)
        best, delay = np.zeros(range_m.shape), np.full(range_m.shape, np.nan)
        for path in range(len(self)):
            arrival = self.arrival(path, range_m)
            if arrival is not None:
                stronger = np.abs(arrival.pressure) > best
                best = np.where(stronger, np.abs(arrival.pressure), best)
                delay = np.where(stronger, arrival.delay, delay)
        return delay

    def dipole_delay(self, source_depth_m: float, slowness: np.ndarray) -> np.ndarray:
        """Half the time by which the surface image is later than the source, z_s √(1/c² − p²) [s]."""
        return source_depth_m * np.sqrt(np.maximum(self.surface_speed**-2.0 - slowness**2, 0.0))


@dataclass(frozen=True)
class Field:
    """Pressure [Pa] and particle velocity east, north and down [m/s] at the sea floor, float64 arrays of one
    length.
    """

    pressure: np.ndarray
    east: np.ndarray
    north: np.ndarray
    down: np.ndarray

    @classmethod
    def silence(cls, count: int) -> Field:
        """`count` samples of nothing."""
        return cls(*(np.zeros(count) for _ in range(4)))


def add_moving_source(
    field: Field,
    first: int,
    sampling_rate: float,
    course: Course,
    source_depth_m: float,
    emission: object,
    paths: Paths,
) -> None:
    """Add to `field` (samples `first` … since 1970 at `sampling_rate`) what arrives from a source along
    `course`.

    `emission.samples(first, count)` gives the source's analytic signal on a grid `OVERSAMPLING` times as
    fine, limited to `sampling_rate`/2.
    """
    count, rate = field.pressure.size, OVERSAMPLING * sampling_rate
    start = first / sampling_rate
    step = max(round(sampling_rate), 1)
    knots = np.arange((count - 1) // step + 2) * (step / sampling_rate)
    margin = paths.longest_delay_s + 2.0
    grid = np.arange(-margin, knots[-1] + 2.0, 1.0)
    if not np.any(presence(course, start + grid)):
        return
    heard = [
        track
        for k in range(len(paths))
        for track in _tracks(paths, k, course, source_depth_m, start, knots, grid)
    ]
    if not heard:
        return
    low = min(track.emitted.min() for track in heard)
    high = max(track.emitted.max() for track in heard)
    # The source and its image are read up to δ beside the emission time.
    beside = max(2 * TAPS, TAPS + int(np.ceil(max(track.dipole.max() for track in heard) * rate)))
    begin = int(np.floor((start + low) * rate)) - beside
    length = int(np.ceil((high - low) * rate)) + 2 * beside
    signal = emission.samples(begin, length)  # type: ignore[attr-defined]
    for track in heard:
        position = track.emitted * rate + (OVERSAMPLING * first - begin)
        _add_path(
            field.pressure, field.east, field.north, field.down, signal, position, track.dipole * rate,
            track.pressure, track.east, track.north, track.down, step, INTERPOLATOR,
        )  # fmt: skip


@dataclass(frozen=True)
class _Track:
    """One path against heard time, at knots: emission time [s from the start], δ [s], complex pressure,
    v/p.
    """

    emitted: np.ndarray
    dipole: np.ndarray
    pressure: np.ndarray
    east: np.ndarray
    north: np.ndarray
    down: np.ndarray

    def echo(self, later: np.ndarray, weight: float) -> _Track:
        """The same arrival `later` [s] and weaker."""
        return replace(
            self, emitted=self.emitted - later, pressure=self.pressure * weight, down=self.down * weight
        )


def _tracks(
    paths: Paths, path: int, course: Course, depth: float, start: float, knots: np.ndarray, grid: np.ndarray
) -> list[_Track]:
    arrival = paths.arrival(path, np.hypot(*course.position(start + grid)))
    if arrival is None:
        return []
    emitted = np.interp(knots, grid + arrival.delay, grid)
    for _ in range(2):  # a contraction by speed over sound speed
        east, north = course.position(start + emitted)
        distance = np.hypot(east, north)
        arrival = paths.arrival(path, distance) or arrival
        emitted = knots - arrival.delay
    pressure = arrival.pressure * presence(course, start + emitted)
    if not np.any(np.abs(pressure) > 0):
        return []
    towards = -arrival.slowness / paths.water_density / np.maximum(distance, 1e-3)
    track = _Track(
        emitted,
        paths.dipole_delay(depth, arrival.slowness),
        pressure,
        towards * east,
        towards * north,
        pressure * arrival.admittance,
    )
    if paths.sediment is None:
        return [track]
    weight = paths.sediment.reflection * (paths.numbers[path] + 1) / 2
    return [track, track.echo(paths.sediment.delay(arrival.slowness), weight)]


def _interpolator() -> np.ndarray:
    """Kaiser-windowed sinc at `PHASES` + 1 fractions of a sample: (fraction, tap), float32.

    The signal is oversampled twice, so that the transition band is half the sampling rate wide: −80 dB with
    12 taps.
    """
    fraction = np.arange(PHASES + 1)[:, None] / PHASES
    offset = np.arange(TAPS)[None, :] - (TAPS // 2 - 1) - fraction
    inside = np.maximum(1 - (2 * offset / TAPS) ** 2, 0.0)
    window = np.i0(8.0 * np.sqrt(inside)) / np.i0(8.0)
    taps = np.sinc(offset) * window
    return (taps / taps.sum(axis=1, keepdims=True)).astype(np.float32)


INTERPOLATOR = _interpolator()


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def sample_at(signal, position, table):  # type: ignore[no-untyped-def]
    """Real and imaginary part of a complex signal at a fractional sample, by the taps of `INTERPOLATOR`."""
    whole = int(np.floor(position))
    scaled = (position - whole) * PHASES
    row = int(scaled)
    blend = np.float32(scaled - row)
    base = whole - (TAPS // 2 - 1)
    real, imag = np.float32(0.0), np.float32(0.0)
    for j in range(TAPS):
        tap = table[row, j] + (table[row + 1, j] - table[row, j]) * blend
        real += tap * signal[base + j].real
        imag += tap * signal[base + j].imag
    return real, imag


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_path(  # type: ignore[no-untyped-def]
    pressure, east, north, down, signal, position, dipole, strength, to_east, to_north, to_down, step, table
):
    for m in range(position.size - 1):
        if strength[m] == 0 and strength[m + 1] == 0:
            continue
        for i in range(m * step, min((m + 1) * step, pressure.size)):
            w = (i - m * step) / step
            x = position[m] + (position[m + 1] - position[m]) * w
            d = dipole[m] + (dipole[m + 1] - dipole[m]) * w
            direct_re, direct_im = sample_at(signal, x + d, table)
            image_re, image_im = sample_at(signal, x - d, table)
            s = complex(direct_re - image_re, direct_im - image_im)
            p = ((strength[m] + (strength[m + 1] - strength[m]) * w) * s).real
            pressure[i] += p
            east[i] += p * (to_east[m] + (to_east[m + 1] - to_east[m]) * w)
            north[i] += p * (to_north[m] + (to_north[m + 1] - to_north[m]) * w)
            down[i] += ((to_down[m] + (to_down[m + 1] - to_down[m]) * w) * s).real
