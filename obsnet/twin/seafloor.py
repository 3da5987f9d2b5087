"""What the sea floor itself adds: earthquakes on every component, and the harmonic tremor of currents on
the seismometer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from obsnet.errors import ConfigError
from obsnet.twin.noise import Wander, below_nyquist, named
from obsnet.twin.propagate import Field
from obsnet.twin.sea import IMPEDANCE
from obsnet.twin.ship import LineSeries, LineTrain

DRAW_S = 6 * 3600.0
EVENT_S = 400.0


@dataclass(frozen=True)
class Earthquakes:
    """Local and regional earthquakes: P, S and a water-borne T phase, at random times.

    Parameters
    ----------
    per_day : float
        Mean number.
    level_db : float
        Median of the P wave's peak pressure, dB re 1 µPa (rms).
    level_spread_db : float
        Standard deviation of that.
    seed : int
        Names the sequence.
    t_gain, t_stretch : float
        Strength and length of the T phases over the usual: those of distant earthquakes come without P and S that are heard.
    """

    per_day: float = 6.0
    level_db: float = 112.0
    level_spread_db: float = 10.0
    seed: int = 0
    t_gain: float = 1.0
    t_stretch: float = 1.0

    def __post_init__(self) -> None:
        if not self.per_day >= 0:
            raise ConfigError(f"per_day must be 0 or more, found {self.per_day}")
        if not (self.t_gain >= 0 and 0 < self.t_stretch <= 4):
            raise ConfigError(
                f"t_gain must be 0 or more and t_stretch lie between 0 and 4, found {self.t_gain} and {self.t_stretch}"
            )

    def events(self, start: float, end: float) -> list[tuple[float, int]]:
        """Times [s since 1970] and seeds of the events between `start` and `end`."""
        found = []
        for block in range(int(start // DRAW_S), int(end // DRAW_S) + 1):
            generator = np.random.default_rng(named(self.seed, 31, block))
            times = (block + generator.random(generator.poisson(self.per_day * DRAW_S / 86400.0))) * DRAW_S
            found += [(float(time), 1000 * block + i) for i, time in enumerate(times) if start <= time < end]
        return found


def add_earthquakes(field: Field, first: int, sampling_rate: float, earthquakes: Earthquakes) -> None:
    """Add earthquakes to `field`, whose samples begin at `first` since 1970."""
    start, count = first / sampling_rate, field.pressure.size
    for time, number in earthquakes.events(start - EVENT_S, start + count / sampling_rate):
        event = _event(np.random.default_rng(named(earthquakes.seed, 32, number)), earthquakes, sampling_rate)
        begin = round((time - start) * sampling_rate)
        low, high = max(begin, 0), min(begin + event.shape[1], count)
        for values, row in zip((field.pressure, field.east, field.north, field.down), event, strict=True):
            values[low:high] += row[low - begin : high - begin]


def _event(generator: np.random.Generator, earthquakes: Earthquakes, sampling_rate: float) -> np.ndarray:
    """Pressure, east, north, down of one event, (4, samples); lowest frequencies are drawn first at any rate.

    P comes from below: compression goes with upward motion. S moves the horizontals and hardly the water. T
    comes through the water, emergent, along the azimuth of its source.
    """
    level = 1e-6 * 10 ** (generator.normal(earthquakes.level_db, earthquakes.level_spread_db) / 20)
    azimuth, s_minus_p = generator.uniform(0, 2 * np.pi), generator.uniform(3.0, 60.0)
    corner, t_level, incidence = (
        generator.uniform(4.0, 14.0),
        generator.uniform(0.0, 1.0),
        generator.uniform(0.1, 0.5),
    )
    size = round(EVENT_S * sampling_rate)
    frequency = np.arange(size // 2 + 1) * (sampling_rate / size)
    variates = generator.standard_normal((frequency.size, 5, 2)).view(complex)[..., 0].T
    grid = np.linspace(0.0, 100.0, 4001)
    power = np.sum(_event_shape(grid, corner) ** 2) * grid[1] / frequency[1]
    shape = _event_shape(frequency, corner) * below_nyquist(frequency, sampling_rate)
    noise = fft.irfft(variates * shape * (size / 2 / np.sqrt(power)), size, axis=1)
    elapsed = np.arange(size) / sampling_rate
    p = noise[0] * _envelope(elapsed, 0.0, 0.3, 3.0 + 0.15 * s_minus_p)
    s = noise[1:3] * _envelope(elapsed, s_minus_p, 0.6, 5.0 + 0.25 * s_minus_p)
    stretch = earthquakes.t_stretch
    t = noise[3] * _envelope(elapsed, 2.0 * s_minus_p + 10.0, 15.0 * stretch, 25.0 * stretch)
    t *= t_level * earthquakes.t_gain
    down = noise[4] * _envelope(elapsed, s_minus_p, 0.6, 5.0 + 0.25 * s_minus_p)
    radial = (incidence * p + 0.8 * t) / IMPEDANCE
    return level * np.stack(
        (
            p + t + 0.15 * down,
            -np.sin(azimuth) * radial + 2.5 * s[0] / IMPEDANCE,
            -np.cos(azimuth) * radial + 2.5 * s[1] / IMPEDANCE,
            (-p + 0.3 * t + 0.8 * down) / IMPEDANCE,
        )
    )


def _event_shape(frequency: np.ndarray, corner: float) -> np.ndarray:
    return (frequency / 1.5) ** 2 / (1 + (frequency / 1.5) ** 2) / (1 + (frequency / corner) ** 3)


def _envelope(elapsed: np.ndarray, onset: float, rise: float, decay: float) -> np.ndarray:
    x = np.maximum(elapsed - onset, 0.0)
    end = np.clip((elapsed[-1] - elapsed) / 20.0, 0.0, 1.0)
    return (1 - np.exp(-x / rise)) * np.exp(-x / decay) * end


@dataclass(frozen=True)
class Tremor:
    """Harmonic tremor of a current shaking the station: gliding lines on the seismometer alone, in bursts of
    hours.

    Parameters
    ----------
    rate_hz : float
        Fundamental.
    level_db : float
        Level of the fundamental's velocity at its strongest, dB re 1 nm/s (rms).
    azimuth_deg : float
        Axis along which it shakes.
    spread : float
        Relative standard deviation of the gliding fundamental.
    duty : float
        Share of the time in which it sounds.
    seed : int
        Names the realisation.

    Source: Essing et al. 2021, doi:10.1785/0220210155.
    """

    rate_hz: float = 1.1
    level_db: float = 45.0
    azimuth_deg: float = 30.0
    spread: float = 0.06
    duty: float = 0.4
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0 or not 0 <= self.duty <= 1:
            raise ConfigError(
                f"a tremor needs rate_hz > 0 and a duty of 0–1, found {self.rate_hz=} {self.duty=}"
            )

    @classmethod
    def random(cls, generator: np.random.Generator) -> Tremor:
        """Draw a tremor."""
        return cls(
            rate_hz=float(generator.uniform(0.6, 3.0)),
            level_db=float(generator.uniform(30.0, 60.0)),
            azimuth_deg=float(generator.uniform(0.0, 180.0)),
            duty=float(generator.uniform(0.1, 0.6)),
            seed=int(generator.integers(2**31)),
        )


def add_tremor(field: Field, first: int, sampling_rate: float, tremor: Tremor) -> None:
    """Add a tremor to `field`, whose samples begin at `first` since 1970."""
    generator = np.random.default_rng([tremor.seed, 41])
    tide = Wander(generator, 1.0, 3 * 3600.0, 12.4 * 3600.0, 6)
    threshold = np.quantile(tide(np.linspace(0.0, 30 * 86400.0, 4000)), 1 - tremor.duty)
    count = field.pressure.size
    step = max(round(10.0 * sampling_rate), 1)
    knots = np.arange(first // step, (first + count) // step + 2) * step
    strength = np.clip(tide(knots / sampling_rate) - threshold, 0.0, 1.0)
    if not np.any(strength):
        return
    harmonics = tuple(range(1, 9))
    levels = tuple(
        tremor.level_db - 180.0 + 120.0 - 5.0 * (k - 1) + generator.normal(0.0, 3.0) for k in harmonics
    )
    series = LineSeries(tremor.rate_hz, harmonics, levels, tremor.spread)
    motion = np.zeros(count, np.complex64)
    LineTrain(series, generator, sampling_rate).add(motion, first, sampling_rate, 0, 0.0)
    motion *= np.interp(np.arange(first, first + count), knots, strength)
    axis = np.deg2rad(tremor.azimuth_deg)
    field.east[:] += motion.real * np.sin(axis)
    field.north[:] += motion.real * np.cos(axis)
    field.down[:] += 0.3 * motion.imag
