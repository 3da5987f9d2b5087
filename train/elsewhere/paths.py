"""A ship's waveform and its course in, what the station hears in: closed-form rays, fractional delays at retarded times.

Image method in water whose sound speed is constant or grows linearly with depth, where rays are arcs of circles and everything
about them is written down in closed form. The sea floor is a lossy fluid, with one reflector below it if wanted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numba
import numpy as np
from scipy.interpolate import CubicSpline

WATER_DENSITY = 1030.0
NODE_S = 5.0
TAPS, FRACTIONS = 16, 512


@dataclass(frozen=True)
class Sea:
    """Water and bottom: depth [m], surface sound speed [m/s] and its growth with depth [1/s].

    The bottom is a fluid of `speed_ratio` and `density_ratio` to the water, `loss` the loss tangent of its speed, `loss_db_per_bounce`
    what roughness takes at 20 Hz (growing with frequency), `layer_m` the depth of a reflector below it (0: none).
    `scatter` is the share of a surface bounce that comes and goes.
    """

    depth_m: float = 4300.0
    surface_mps: float = 1500.0
    gradient: float = 0.0
    speed_ratio: float = 1.12
    density_ratio: float = 1.7
    loss: float = 0.02
    loss_db_per_bounce: float = 1.0
    layer_m: float = 0.0
    layer_reflection: float = 0.35
    scatter: float = 0.1

    @property
    def bottom_mps(self) -> float:
        """Sound speed at the sea floor."""
        return self.surface_mps + self.gradient * self.depth_m

    def delay(self, crossings: int, range_m: np.ndarray) -> np.ndarray:
        """Travel time [s] of the path that crosses the water so many times.

        One crossing is an arc of a circle: τ = arcosh(1 + g²(r² + D²)/(2 c₁c₂))/g, and √(r² + D²)/c where g = 0.
        """
        r = np.asarray(range_m, float) / crossings
        square = r**2 + self.depth_m**2
        if abs(self.gradient) < 1e-6:
            return crossings * np.sqrt(square) / self.surface_mps
        g = self.gradient
        half = np.sqrt(g**2 * square / (4.0 * self.surface_mps * self.bottom_mps))
        return crossings * 2.0 * np.arcsinh(half) / g

    def slowness(self, crossings: int, range_m: np.ndarray) -> np.ndarray:
        """Horizontal slowness [s/m] of a path: the delay's derivative with respect to range."""
        r = np.asarray(range_m, float) / crossings
        square = r**2 + self.depth_m**2
        product = self.surface_mps * self.bottom_mps
        return r / np.sqrt(square * (product + self.gradient**2 * square / 4.0))

    def reach(self, crossings: int) -> float:
        """Range [m] at which a path grazes the bottom and ends; infinite where sound speed does not grow."""
        if self.gradient < 1e-6:
            return np.inf
        radius = self.bottom_mps / self.gradient
        return crossings * np.sqrt(2.0 * radius * self.depth_m - self.depth_m**2)

    def sines(self, crossings: int, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sines of the grazing angles at the surface and at the sea floor."""
        p = self.slowness(crossings, range_m)
        return tuple(
            np.sqrt(np.maximum(1.0 - (p * c) ** 2, 1e-8)) for c in (self.surface_mps, self.bottom_mps)
        )

    def reflection(self, sine: np.ndarray) -> np.ndarray:
        """Rayleigh's reflection coefficient of a lossy fluid at a grazing angle, fields exp(+iωt); |R| ≤ 1."""
        ratio = self.speed_ratio / (1.0 - 1j * self.loss)
        cosine = np.sqrt(1.0 - sine**2)
        below = np.sqrt(1.0 / ratio**2 - cosine**2 + 0j)
        below = np.where(below.imag > 0, -below, below)
        return (self.density_ratio * sine - below) / (self.density_ratio * sine + below)


@dataclass(frozen=True)
class Arrival:
    """One way from the ship to the station at nodes of time: when it left, how strong, from where.

    `emitted` and its `rate` of change; `gain` (pressure) and `vertical` (upward velocity, per Pa) complex; `east` and
    `north` horizontal velocity per Pa; `image` the half delay of the surface's mirror image; `bounces` off the bottom.
    """

    emitted: np.ndarray
    rate: np.ndarray
    gain: np.ndarray
    vertical: np.ndarray
    east: np.ndarray
    north: np.ndarray
    image: np.ndarray
    bounces: int


Course = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Source:
    """A source: its course (time → east, north [m]), depth [m], and whether it is louder abeam and astern than ahead."""

    course: Course
    depth_m: float = 5.0
    bow_shadow: float = 0.0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


def arrivals(
    sea: Sea, source: Source, nodes: np.ndarray, paths: tuple[int, ...] = (1, 3, 5, 7, 9, 11)
) -> list[Arrival]:
    """Every path's arrival at `nodes` [s, spaced by NODE_S]."""
    spare = np.arange(nodes[0] - 150.0, nodes[-1] + NODE_S, NODE_S)
    east, north = source.course(spare)
    found = []
    for crossings in paths:
        delay = sea.delay(crossings, np.hypot(east, north))
        emitted = CubicSpline(spare + delay, spare)(nodes)
        found += _path(sea, source, crossings, emitted, nodes)
    return found


def _path(sea: Sea, source: Source, crossings: int, emitted: np.ndarray, nodes: np.ndarray) -> list[Arrival]:
    east, north = source.course(emitted)
    range_m = np.hypot(east, north)
    slowness = sea.slowness(crossings, range_m)
    top, bottom = sea.sines(crossings, range_m)
    bounces = (crossings - 1) // 2
    reflection = sea.reflection(bottom)
    length = sea.delay(crossings, range_m) * np.sqrt(sea.surface_mps * sea.bottom_mps)
    fading = np.exp(-((np.maximum(range_m - sea.reach(crossings), 0.0) / (150.0 * crossings)) ** 2))
    sound = (
        fading / length * (-reflection) ** bounces * _flicker(source.rng, len(nodes), bounces * sea.scatter)
    )
    sound = sound * _aspect(source, emitted, east, north)
    away = slowness / (WATER_DENSITY * np.maximum(range_m, 1.0))

    def arrival(gain: np.ndarray, vertical: np.ndarray, extra: np.ndarray | float) -> Arrival:
        times = emitted - extra
        return Arrival(
            times, np.gradient(times, nodes), gain, vertical, -away * east, -away * north,
            source.depth_m * top / sea.surface_mps, bounces,
        )  # fmt: skip

    upward = -bottom / (WATER_DENSITY * sea.bottom_mps)
    made = [arrival(sound * (1.0 + reflection), sound * (1.0 - reflection) * upward, 0.0)]
    if sea.layer_m > 0:
        inside = np.sqrt(np.maximum(1.0 - (slowness * sea.bottom_mps * sea.speed_ratio) ** 2, 0.0))
        lag = 2.0 * sea.layer_m * inside / (sea.bottom_mps * sea.speed_ratio)
        share = (1.0 - np.abs(reflection) ** 2) * sea.layer_reflection * (inside > 0)
        per_bounce = bounces * (1.0 + reflection) / np.where(abs(reflection) > 0.05, reflection, 0.05) + 1.0
        made.append(arrival(sound * share * per_bounce, -sound * share * upward, lag))
    return made


def _flicker(rng: np.random.Generator, count: int, share: float) -> np.ndarray:
    """Complex gain of mean power 1, a share of which wanders with a memory of 40 s."""
    share = min(share, 0.8)
    kernel = np.exp(-0.5 * (np.arange(-24, 25) * NODE_S / 40.0) ** 2)
    noise = (rng.standard_normal((2, count + 48))).T @ np.array([1.0, 1j])
    smooth = np.convolve(noise, kernel, "valid") / np.sqrt(2.0 * np.sum(kernel**2))
    return np.sqrt(1.0 - share**2) + share * smooth


def _aspect(source: Source, emitted: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    if source.bow_shadow == 0:
        return np.ones(len(emitted))
    ahead = np.subtract(source.course(emitted + 30.0), source.course(emitted - 30.0))
    cosine = -(ahead[0] * east + ahead[1] * north) / np.maximum(
        np.hypot(*ahead) * np.hypot(east, north), 1e-9
    )
    return 1.0 - source.bow_shadow * np.maximum(cosine, 0.0) ** 2


def lossy(waveform: np.ndarray, rate_hz: float, bounces: int, db_per_bounce: float) -> np.ndarray:
    """Analytic signals (n_bounces + 1, n) of a source after 0, 1, … bounces whose loss [dB at 20 Hz] grows with frequency."""
    import scipy.fft

    n = scipy.fft.next_fast_len(len(waveform), real=True)
    spectrum = scipy.fft.rfft(waveform, n)
    frequency = scipy.fft.rfftfreq(n, 1.0 / rate_hz)
    both = np.zeros(n, np.complex64)
    signals = np.empty((bounces + 1, len(waveform)), np.complex64)
    for number in range(bounces + 1):
        loss = 10.0 ** (-number * db_per_bounce * frequency / 20.0 / 20.0)
        both[: len(spectrum)] = 2.0 * spectrum * loss
        signals[number] = scipy.fft.ifft(both)[: len(waveform)]
    return signals


def receive(
    waveform: np.ndarray,
    rate_hz: float,
    begin: float,
    sea: Sea,
    source: Source,
    start: float,
    count: int,
    out_rate_hz: float,
) -> np.ndarray:
    """Pressure [Pa], and velocity of the ground [m/s] to the east, north and upwards.

    Parameters
    ----------
    waveform : array, Pa at 1 m, from the time `begin` [s] on at `rate_hz`; it should hold nothing near its Nyquist frequency.
    start, count, out_rate_hz : the samples wanted.

    Returns
    -------
    array (4, count) float32. Compression is positive; velocity is positive away from the source where pressure is.
    """
    nodes = start + NODE_S * np.arange(int(count / out_rate_hz / NODE_S) + 3)
    found = arrivals(sea, source, nodes)
    signals = lossy(waveform, rate_hz, max(a.bounces for a in found), sea.loss_db_per_bounce)
    out = np.zeros((4, count), np.float32)
    table = sinc_table()
    for a in found:
        if np.max(np.abs(a.gain)) > 0:
            _add(
                signals[a.bounces], rate_hz, begin, out_rate_hz, table, a.emitted - begin, a.rate, a.gain, a.vertical, a.east,
                a.north, a.image, out,
            )  # fmt: skip
    return out


def sinc_table() -> np.ndarray:
    """Kaiser-windowed sinc (fraction, tap) for reading between samples."""
    fraction = np.arange(FRACTIONS + 1)[:, None] / FRACTIONS
    x = np.arange(TAPS)[None, :] - (TAPS // 2 - 1) - fraction
    window = np.i0(7.0 * np.sqrt(np.maximum(1.0 - (x / (TAPS / 2)) ** 2, 0.0))) / np.i0(7.0)
    return (np.sinc(x) * window).astype(np.float32)


@numba.njit(cache=True, inline="always")
def _read(signal: np.ndarray, at: float, table: np.ndarray) -> complex:
    """The signal between its samples; 0 beyond its ends."""
    whole = int(np.floor(at))
    first = whole - (table.shape[1] // 2 - 1)
    if first < 0 or first + table.shape[1] > signal.size:
        return 0j
    fine = (at - whole) * (table.shape[0] - 1)
    row = int(fine)
    share = fine - row
    total = 0j
    for tap in range(table.shape[1]):
        total += signal[first + tap] * (
            table[row, tap] * (1.0 - share) + table[min(row + 1, table.shape[0] - 1), tap] * share
        )
    return total


@numba.njit(cache=True)
def _add(signal, rate, begin, out_rate, table, emitted, slope, gain, vertical, east, north, image, out):
    for i in range(out.shape[1]):
        position = i / out_rate / NODE_S
        k = int(position)
        x = position - k
        y = 1.0 - x
        rise = emitted[k + 1] - emitted[k]
        bend = x * y * (y * (slope[k] * NODE_S - rise) + x * (rise - slope[k + 1] * NODE_S))
        at = (emitted[k] + x * rise + bend) * rate
        half = (y * image[k] + x * image[k + 1]) * rate
        heard = _read(signal, at + half, table) - _read(signal, at - half, table)
        p = (heard * (y * gain[k] + x * gain[k + 1])).real
        out[0, i] += p
        out[1, i] += p * (y * east[k] + x * east[k + 1])
        out[2, i] += p * (y * north[k] + x * north[k + 1])
        out[3, i] += (heard * (y * vertical[k] + x * vertical[k + 1])).real
