"""What a ship emits: broadband machinery and cavitation noise, wandering shaft and auxiliary lines, drawn
from a seed.

Levels are monopole source levels, dB re 1 µPa at 1 m: the source alone, without its image in the sea surface.
In the band of an ocean-bottom station the surface takes some 10 dB off, so that a radiated noise level of
165–190 dB, as measured below merchant ships, corresponds to a monopole level of 180–200 dB here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from obsnet.errors import ConfigError
from obsnet.twin.noise import Wander, below_nyquist, gaussian_noise

MICROPASCAL = 1e-6
BAND_HZ = (5.0, 100.0)
PHASE_KNOT_S = 0.25
LEVEL_KNOT_S = 4.0


@dataclass(frozen=True)
class LineSeries:
    """Harmonics of one rotating machine.

    Parameters
    ----------
    rate_hz : float
        Its rate of rotation.
    harmonics : tuple of int
        Which multiples sound.
    levels_db : tuple of float
        Their monopole source levels, dB re 1 µPa (rms) at 1 m.
    rate_spread : float
        Standard deviation of the wandering rate, relative.
    """

    rate_hz: float
    harmonics: tuple[int, ...]
    levels_db: tuple[float, ...]
    rate_spread: float = 2e-4

    def __post_init__(self) -> None:
        if len(self.harmonics) != len(self.levels_db):
            raise ConfigError(
                f"lines need a level per harmonic, found {len(self.levels_db)} for {len(self.harmonics)}"
            )
        if not self.rate_hz > 0 or any(k < 1 for k in self.harmonics):
            raise ConfigError(
                f"line rate and harmonics must be positive, found {self.rate_hz=} {self.harmonics=}"
            )


@dataclass(frozen=True)
class Ship:
    """A ship as a source of sound.

    Parameters
    ----------
    mmsi : int
        Its identity in AIS and truth.
    source_level_db : float
        Broadband monopole level over 5–100 Hz, dB re 1 µPa at 1 m, lines not counted.
    source_depth_m : float
        Depth of the propeller, where the noise is made.
    peak_hz, slope_db : float
        The spectrum is level up to about `peak_hz` and falls by `slope_db` per decade above (Wales and
        Heitmeyer 2002, doi:10.1121/1.1427355: 36 dB).
    ripple_db : float
        Standard deviation of the spectrum's broad humps and hollows.
    level_spread_db : float
        Standard deviation of the level's random walk.
    modulation : float
        Depth of the cavitation noise's modulation at the blade rate, 0–1.
    blades : int
        Blades of the propeller: the harmonic of the first series at which the noise is modulated.
    lines : tuple of LineSeries
        The shaft first, then auxiliary machines.
    seed : int
        Names the realisation.
    """

    mmsi: int = 100000001
    source_level_db: float = 194.0
    source_depth_m: float = 5.0
    peak_hz: float = 14.0
    slope_db: float = 33.0
    ripple_db: float = 1.5
    level_spread_db: float = 1.5
    modulation: float = 0.25
    blades: int = 5
    lines: tuple[LineSeries, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.source_depth_m < 100:
            raise ConfigError(f"source_depth_m must lie between 0 and 100 m, found {self.source_depth_m}")
        if not 0 <= self.modulation <= 1:
            raise ConfigError(f"modulation must lie between 0 and 1, found {self.modulation}")

    @classmethod
    def random(cls, seed: int, mmsi: int = 100000001, source_level_db: float | None = None) -> Ship:
        """Draw a merchant ship: a direct-drive shaft of 1.1–2.2 Hz with blade and cylinder lines, and an
        auxiliary diesel.

        `source_level_db` is 194 ± 3.5 dB where it is not given.
        """
        generator = np.random.default_rng([seed, 0x5417])
        level = float(generator.normal(194.0, 3.5)) if source_level_db is None else source_level_db
        ship = cls(
            mmsi=mmsi,
            source_level_db=level,
            source_depth_m=float(generator.uniform(3.5, 7.5)),
            peak_hz=float(generator.uniform(10.0, 20.0)),
            slope_db=float(generator.uniform(27.0, 37.0)),
            ripple_db=float(generator.uniform(0.5, 2.0)),
            level_spread_db=float(generator.uniform(0.5, 2.5)),
            modulation=float(generator.uniform(0.0, 0.5)),
            blades=int(generator.choice([4, 5, 6])),
            seed=int(seed),
        )
        return ship.with_lines(_draw_lines(ship, generator))

    def with_lines(self, lines: tuple[LineSeries, ...]) -> Ship:
        """The same ship with other lines."""
        return Ship(**{**self.__dict__, "lines": lines})

    def spectrum_level_db(self, frequency: np.ndarray) -> np.ndarray:
        """One-sided PSD of the broadband noise at `frequency` [Hz], dB re 1 µPa²/Hz at 1 m (monopole)."""
        grid = np.linspace(*BAND_HZ, 2000)
        inside = 10 * np.log10(np.mean(10 ** (self._shape_db(grid) / 10)) * (BAND_HZ[1] - BAND_HZ[0]))
        return self.source_level_db - inside + self._shape_db(np.asarray(frequency, float))

    def _shape_db(self, frequency: np.ndarray) -> np.ndarray:
        hertz = np.maximum(frequency, 1e-3)
        ripple = Wander(np.random.default_rng([self.seed, 1]), self.ripple_db, 0.6, 4.0, 6)(np.log2(hertz))
        fall = -0.5 * self.slope_db * np.log10(1 + (hertz / self.peak_hz) ** 2)
        return fall + ripple - 10 * np.log10(1 + (4.0 / hertz) ** 6)


def _draw_lines(ship: Ship, generator: np.random.Generator) -> tuple[LineSeries, ...]:
    """Lines 5–30 dB above the noise in a 20 s spectrum (73 mHz wide): blade and cylinder rates strong, the
    rest weak.
    """
    shaft, cylinders = float(generator.uniform(1.1, 2.2)), int(generator.choice([6, 7, 8, 9, 10]))
    harmonics = tuple(range(2, int(120 / shaft)))
    excess = generator.normal(4.0, 5.0, len(harmonics))
    for i, k in enumerate(harmonics):
        strong = (k % ship.blades == 0) or (k % cylinders == 0)
        excess[i] += generator.uniform(6.0, 20.0) if strong else 0.0
    kept = [(k, e) for k, e in zip(harmonics, excess, strict=True) if e > 4.0]
    auxiliary = float(generator.uniform(5.0, 7.5))
    multiples = tuple(range(1, int(120 / auxiliary)))
    extra = generator.normal(8.0, 6.0, len(multiples))
    return (
        _series(ship, shaft, tuple(k for k, _ in kept), np.array([e for _, e in kept]), generator, 4e-4),
        _series(ship, auxiliary, multiples, extra, generator, 1.5e-4),
    )


def _series(
    ship: Ship,
    rate: float,
    harmonics: tuple[int, ...],
    excess: np.ndarray,
    generator: np.random.Generator,
    spread: float,
) -> LineSeries:
    levels = ship.spectrum_level_db(rate * np.array(harmonics)) + 10 * np.log10(0.073) + excess
    return LineSeries(rate, harmonics, tuple(map(float, levels)), spread * float(generator.uniform(0.5, 2.0)))


class Emission:
    """A ship's sound pressure at 1 m as a function of absolute time: analytic signal, Pa, on the grid of
    `sampling_rate`.
    """

    def __init__(self, ship: Ship, sampling_rate: float, passband_rate: float) -> None:
        """`passband_rate` is the recorder's sampling rate, to whose Nyquist frequency the sound is
        limited.
        """
        self.ship, self.sampling_rate, self.passband_rate = ship, sampling_rate, passband_rate
        generator = np.random.default_rng([ship.seed, 2])
        self._level = Wander(generator, ship.level_spread_db, 150.0, 4 * 3600.0)
        self._trains = [LineTrain(series, generator, passband_rate) for series in ship.lines]

    def _colour(self, frequency: np.ndarray, variates: np.ndarray) -> np.ndarray:
        amplitude = MICROPASCAL * 10 ** (self.ship.spectrum_level_db(frequency) / 20)
        amplitude *= below_nyquist(frequency, self.passband_rate)
        return variates * amplitude.astype(np.float32)

    def samples(self, first: int, count: int) -> np.ndarray:
        """Samples first … first + count − 1 since 1970, complex64."""
        noise = gaussian_noise(
            (self.ship.seed, 3), first, count, self.sampling_rate, self._colour, analytic=True
        )[0]
        step = max(round(LEVEL_KNOT_S * self.sampling_rate), 1)
        gain = 10 ** (self._level(_knots(first, count, step, self.sampling_rate)) / 20)
        _scale(noise, gain, first % step, step)
        for i, train in enumerate(self._trains):
            train.add(
                noise, first, self.sampling_rate, self.ship.blades, self.ship.modulation if i == 0 else 0.0
            )
        return noise


class LineTrain:
    """A line series as a function of absolute time: its rate wanders, and each line has its own slow
    level.
    """

    def __init__(self, series: LineSeries, generator: np.random.Generator, passband_rate: float) -> None:
        self.rate = series.rate_hz
        self.wander = Wander(generator, series.rate_hz * series.rate_spread, 60.0, 2 * 3600.0)
        self.fades = [Wander(generator, 2.0, 60.0, 3600.0, 8) for _ in series.harmonics]
        phases = generator.uniform(0, 2 * np.pi, len(series.harmonics))
        rms = MICROPASCAL * 10 ** (np.array(series.levels_db, float) / 20)
        frequency = self.rate * np.array(series.harmonics, float)
        rms *= below_nyquist(frequency * 1.01, passband_rate)
        self.amplitude = np.sqrt(2.0) * rms * np.exp(1j * phases)
        self.harmonics = np.array(series.harmonics, np.int64)

    def add(
        self, signal: np.ndarray, first: int, sampling_rate: float, blades: int, modulation: float
    ) -> None:
        """Add the lines to an analytic `signal` that begins at sample `first`; modulate it at `blades`
        times the rate.
        """
        count = signal.size
        step = max(round(PHASE_KNOT_S * sampling_rate), 1)
        wander = self.wander.integral(_knots(first, count, step, sampling_rate))
        coarse = max(round(LEVEL_KNOT_S * sampling_rate), 1)
        times = _knots(first, count, coarse, sampling_rate)
        highest = int(max([*self.harmonics[np.abs(self.amplitude) > 0], blades if modulation else 0, 0]))
        level = np.zeros((times.size, highest + 1), np.complex128)
        for k, amplitude, fade in zip(self.harmonics, self.amplitude, self.fades, strict=True):
            if abs(amplitude) > 0:
                level[:, k] += amplitude * 10 ** (fade(times) / 20)
        turns = float(np.fmod(np.longdouble(self.rate) * first / np.longdouble(sampling_rate), 1.0))
        rate = self.rate / sampling_rate
        _add_lines(
            signal, turns, rate, wander, first % step, step, level, first % coarse, coarse, blades, modulation
        )


def _knots(first: int, count: int, step: int, sampling_rate: float) -> np.ndarray:
    """Times of every `step`-th absolute sample around first … first + count − 1 [s since 1970]."""
    return np.arange(first // step, (first + count - 1) // step + 2) * (step / sampling_rate)


@numba.njit(cache=True, nogil=True)
def _scale(signal, gain, offset, step):  # type: ignore[no-untyped-def]
    for n in range(signal.size):
        m, rest = divmod(n + offset, step)
        signal[n] *= np.float32(gain[m] + (gain[m + 1] - gain[m]) * rest / step)


@numba.njit(cache=True, nogil=True)
def _add_lines(signal, turns, rate, wander, offset, step, level, coarse_offset, coarse, blades, modulation):
    # type: ignore[no-untyped-def]
    highest = level.shape[1] - 1
    norm = 1.0 / np.sqrt(1.0 + 0.5 * modulation * modulation)
    for n in range(signal.size):
        m, rest = divmod(n + offset, step)
        phase = turns + rate * n + wander[m] + (wander[m + 1] - wander[m]) * rest / step
        angle = 2.0 * np.pi * (phase - np.floor(phase))
        shaft = complex(np.cos(angle), np.sin(angle))
        j, remainder = divmod(n + coarse_offset, coarse)
        weight = remainder / coarse
        power = complex(1.0, 0.0)
        lines = complex(0.0, 0.0)
        blade = 0.0
        for k in range(1, highest + 1):
            power *= shaft
            lines += (level[j, k] + (level[j + 1, k] - level[j, k]) * weight) * power
            if k == blades:
                blade = power.real
        signal[n] = np.complex64(signal[n] * norm * (1.0 + modulation * blade) + lines)
