"""Ambient noise of the deep sea floor: isotropic and partly directional sea noise, microseism, sensors' own
noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError
from obsnet.twin.noise import Wander, below_nyquist, gaussian_noise, named
from obsnet.twin.propagate import Field

IMPEDANCE = 1030.0 * 1520.0
REFERENCE_HZ = 15.0
LEVEL_KNOT_S = 4.0


@dataclass(frozen=True)
class Ambient:
    """Levels and directions of the background.

    Parameters
    ----------
    level_db : float
        PSD of the sea noise's pressure at 15 Hz, dB re 1 µPa²/Hz.
    slope_db : float
        Its fall, dB per decade.
    level_spread_db : float
        Standard deviation of its slow changes.
    microseism_db : float
        PSD of the microseism's peak, dB re 1 µPa²/Hz (140–155 on deep sea floors); −inf is none.
    microseism_hz : float
        Frequency of the peak.
    directional_fraction : float
        Share of the sea noise's pressure power that comes from one side.
    directional_azimuth_deg : float
        Azimuth from the station to where that comes from.
    directional_width_deg : float
        Standard deviation of the azimuths that it comes from; 0 is one point, as of a single distant source.
    directional_elevation_deg : float
        Grazing angle at which it arrives.
    horizontal_share : float
        PSD of either horizontal velocity of the isotropic part over that of a plane wave of the same
        pressure: 1/3 in a three-dimensionally isotropic field.
    vertical_coherence : float
        Coherence of pressure and downward velocity: noise comes from the surface.
    hydrophone_noise_db : float
        Own noise of the hydrophone at 10 Hz, dB re 1 µPa²/Hz, growing as 1/f below.
    seismometer_noise_db : float
        Own noise of the seismometer, dB re 1 (m/s²)²/Hz.
    chorus_db : float
        PSD of distant whales together at 26 Hz (blue) and 6 dB less at 20 Hz (fin), dB re 1 µPa²/Hz; −inf is
        none.
    tilt_noise_db : float
        Noise of currents on the horizontals at 0.1 Hz, dB re 1 (m/s²)²/Hz, falling 30 dB per decade.
    """

    level_db: float = 78.0
    slope_db: float = 18.0
    level_spread_db: float = 1.0
    microseism_db: float = 146.0
    microseism_hz: float = 0.22
    directional_fraction: float = 0.15
    directional_azimuth_deg: float = 90.0
    directional_elevation_deg: float = 20.0
    horizontal_share: float = 1 / 3
    vertical_coherence: float = 0.4
    hydrophone_noise_db: float = 48.0
    seismometer_noise_db: float = -165.0
    tilt_noise_db: float = -125.0
    chorus_db: float = -np.inf
    directional_width_deg: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.directional_fraction <= 1:
            raise ConfigError(
                f"directional_fraction must lie between 0 and 1, found {self.directional_fraction}"
            )
        if not 0 <= self.vertical_coherence <= 1:
            raise ConfigError(f"vertical_coherence must lie between 0 and 1, found {self.vertical_coherence}")
        if not self.microseism_hz > 0:
            raise ConfigError(f"microseism_hz must be positive, found {self.microseism_hz}")

    @classmethod
    def isotropic(cls, level_db: float = 78.0, slope_db: float = 0.0) -> Ambient:
        """Stationary isotropic sea noise alone: every other component switched off."""
        off = -np.inf
        return cls(
            level_db, slope_db, 0.0, off, 0.22, 0.0, 90.0, 20.0, 1 / 3, 0.0, off, off, off
        )  # fmt: skip

    @classmethod
    def random(cls, generator: np.random.Generator, quiet: bool = False) -> Ambient:
        """Draw a background: 74–86 dB at 15 Hz, up to 70 % of it directional, any microseism."""
        fraction = float(generator.beta(1.0, 3.0)) * 0.9
        return cls(
            level_db=float(generator.uniform(74.0, 78.0 if quiet else 86.0)),
            slope_db=float(generator.uniform(10.0, 28.0)),
            level_spread_db=float(generator.uniform(0.3, 2.0)),
            microseism_db=float(generator.uniform(138.0, 154.0)),
            microseism_hz=float(generator.uniform(0.14, 0.35)),
            directional_fraction=fraction,
            directional_azimuth_deg=float(generator.uniform(0.0, 360.0)),
            directional_elevation_deg=float(generator.uniform(5.0, 40.0)),
            vertical_coherence=float(generator.uniform(0.1, 0.6)),
            seismometer_noise_db=float(generator.uniform(-172.0, -150.0)),
            tilt_noise_db=float(generator.uniform(-140.0, -110.0)),
            chorus_db=float(generator.choice([-np.inf, generator.uniform(75.0, 95.0)], p=[0.6, 0.4])),
        )

    def sea_psd(self, frequency: np.ndarray) -> np.ndarray:
        """One-sided PSD of the sea noise's pressure [Pa²/Hz], levelling off below 2 Hz."""
        hertz = np.maximum(frequency, 2.0)
        blue, fin = np.exp(-0.5 * ((hertz - 25.8) / 0.6) ** 2), np.exp(-0.5 * ((hertz - 20.0) / 1.6) ** 2)
        chorus = _power(self.chorus_db - 120.0) * (blue + 0.25 * fin)
        return _power(self.level_db - 120.0) * (hertz / REFERENCE_HZ) ** (-self.slope_db / 10) + chorus

    def microseism_psd(self, frequency: np.ndarray) -> np.ndarray:
        """One-sided PSD of the microseism's pressure [Pa²/Hz]: f⁸ below its peak, f⁻⁵ above."""
        x = np.maximum(frequency, 1e-3) / self.microseism_hz
        return _power(self.microseism_db - 120.0) * 1.6 / (x**-8 * 0.6 + x**5)

    def pressure_psd(self, frequency: np.ndarray) -> np.ndarray:
        """One-sided PSD of the whole background's pressure [Pa²/Hz], the hydrophone's own noise included."""
        own = _power(self.hydrophone_noise_db - 120.0) * np.maximum(1.0, 10.0 / np.maximum(frequency, 1e-2))
        return self.sea_psd(frequency) + self.microseism_psd(frequency) + own


@dataclass(frozen=True)
class Lobe:
    """Noise from one side that turns and swells: distant shipping together, a storm that moves, surf on a coast.

    Parameters
    ----------
    level_db : float
        PSD of its pressure at 15 Hz, dB re 1 µPa²/Hz.
    slope_db : float
        Its fall, dB per decade.
    azimuth_deg : float
        Azimuth from the station to its middle at `since`.
    width_deg : float
        Standard deviation of the azimuths that it comes from.
    elevation_deg : float
        Grazing angle at which it arrives.
    turning_deg_per_h : float
        How fast its middle turns.
    wander_deg : float
        Standard deviation of its middle about that.
    swell_db : float
        Standard deviation of its level's changes, within minutes to hours.
    since : float
        s since 1970.
    seed : int
        Names the realisation.
    """

    level_db: float = 74.0
    slope_db: float = 18.0
    azimuth_deg: float = 90.0
    width_deg: float = 20.0
    elevation_deg: float = 15.0
    turning_deg_per_h: float = 0.0
    wander_deg: float = 0.0
    swell_db: float = 0.0
    since: float = 0.0
    seed: int = 0

    def azimuth(self, time: np.ndarray) -> np.ndarray:
        """Azimuth to its middle [deg] at `time` [s since 1970], not wrapped."""
        wander = Wander(np.random.default_rng(named(self.seed, 14)), self.wander_deg, 900.0, 6 * 3600.0)
        turned = self.turning_deg_per_h * (np.asarray(time, float) - self.since) / 3600.0
        return self.azimuth_deg + turned + wander(time)


def add_lobe(field: Field, first: int, sampling_rate: float, lobe: Lobe) -> None:
    """Add a lobe to `field`, whose samples begin at `first` since 1970: made towards north, and turned sample by sample."""

    def colour(frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
        hertz = np.maximum(frequency, 2.0)
        psd = _power(lobe.level_db - 120.0) * (hertz / REFERENCE_HZ) ** (-lobe.slope_db / 10)
        return _amplitude(psd, below_nyquist(frequency, sampling_rate)) * np.tensordot(parts, z, 1)

    parts = _directions(0.0, lobe.elevation_deg, lobe.width_deg)
    count = field.pressure.size
    noise = gaussian_noise((lobe.seed, 13), first, count, sampling_rate, colour, draws=parts.shape[1])
    swell = Wander(np.random.default_rng(named(lobe.seed, 15)), lobe.swell_db, 300.0, 3 * 3600.0)
    samples, knots = _knots(first, count, sampling_rate)
    time = knots / sampling_rate
    noise *= np.interp(samples, knots, 10 ** (swell(time) / 20)).astype(np.float32)
    turned = np.deg2rad(np.interp(samples, knots, lobe.azimuth(time)))
    sine, cosine = np.sin(turned), np.cos(turned)
    pressure, across, along, down = noise
    field.pressure[:] += pressure
    field.east[:] += along * sine + across * cosine
    field.north[:] += along * cosine - across * sine
    field.down[:] += down


def add_ambient(field: Field, first: int, sampling_rate: float, ambient: Ambient, seed: int) -> None:
    """Add the background to `field`, whose samples begin at `first` since 1970."""

    def colour(frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
        gains = _Gains(ambient, frequency, sampling_rate)
        pressure, east, north, down = gains.directional * np.tensordot(directions, z[np.r_[4, 6 : len(z)]], 1)
        isotropic = gains.isotropic * z[0]
        return np.stack(
            (
                isotropic + gains.hydrophone * z[5] + pressure,
                gains.horizontal * z[1] + east,
                gains.horizontal * z[2] + north,
                gains.vertical * z[3] + gains.coupled * z[0] + down,
            )
        )

    directions = _directions(
        ambient.directional_azimuth_deg, ambient.directional_elevation_deg, ambient.directional_width_deg
    )
    draws = 5 + directions.shape[1]
    noise = gaussian_noise((seed, 11), first, field.pressure.size, sampling_rate, colour, draws=draws)
    gain = _level(ambient, seed, first, field.pressure.size, sampling_rate)
    for values, row in zip((field.pressure, field.east, field.north, field.down), noise, strict=True):
        values += row * gain


class _Gains:
    """Spectral amplitudes [unit/√Hz], float32, of each part of the background."""

    def __init__(self, ambient: Ambient, frequency: np.ndarray, sampling_rate: float) -> None:
        edge = below_nyquist(frequency, sampling_rate)
        sea = ambient.sea_psd(frequency)
        directional = ambient.directional_fraction * sea
        isotropic = sea - directional + ambient.microseism_psd(frequency)
        velocity = isotropic / IMPEDANCE**2
        hertz = np.maximum(frequency, 1e-2)
        own = _power(ambient.seismometer_noise_db) / (2 * np.pi * hertz) ** 2
        tilt = _power(ambient.tilt_noise_db) * (hertz / 0.1) ** -3.0 / (2 * np.pi * hertz) ** 2
        hydrophone = _power(ambient.hydrophone_noise_db - 120.0) * np.maximum(1.0, 10.0 / hertz)
        coherence = ambient.vertical_coherence
        self.isotropic = _amplitude(isotropic, edge)
        self.hydrophone = _amplitude(hydrophone, edge)
        self.horizontal = _amplitude(ambient.horizontal_share * velocity + own + tilt, edge)
        self.vertical = _amplitude((1 - coherence**2) * velocity / 3 + own, edge)
        self.coupled = _amplitude(coherence**2 * velocity / 3, edge)
        self.directional = _amplitude(directional, edge)


def _directions(azimuth_deg: float, elevation_deg: float, width_deg: float) -> np.ndarray:
    """Pressure, and velocity east, north, down over it, of independent parts of directional noise (4, part), float32.

    From one point it is a single plane wave. From a sector it is a sum of countless ones, Gaussian as they are: all that is left
    of them is the covariance of the four channels, of which these columns are a root.
    """
    azimuth, elevation, width = np.deg2rad([azimuth_deg, elevation_deg, width_deg])
    horizontal, down = -np.cos(elevation) / IMPEDANCE, np.sin(elevation) / IMPEDANCE
    nodes = np.linspace(-3.0, 3.0, 61) if width else np.zeros(1)
    weight = np.exp(-0.5 * nodes**2)
    angle = azimuth + width * nodes
    waves = np.stack(
        [
            np.ones_like(angle),
            horizontal * np.sin(angle),
            horizontal * np.cos(angle),
            np.full_like(angle, down),
        ]
    ) * np.sqrt(weight / weight.sum())
    if not width:
        return waves.astype(np.float32)
    scale = np.array([1.0, IMPEDANCE, IMPEDANCE, IMPEDANCE])[:, None]
    vectors, values, _ = np.linalg.svd(scale * waves, full_matrices=False)
    return (vectors * values / scale)[:, values > 1e-6].astype(np.float32)


def _level(ambient: Ambient, seed: int, first: int, count: int, sampling_rate: float) -> np.ndarray:
    wander = Wander(np.random.default_rng([seed, 12]), ambient.level_spread_db, 1800.0, 24 * 3600.0)
    samples, knots = _knots(first, count, sampling_rate)
    return np.interp(samples, knots, 10 ** (wander(knots / sampling_rate) / 20))


def _knots(first: int, count: int, sampling_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the samples, and those between which what changes slowly is interpolated, the same however a record is split."""
    step = max(round(LEVEL_KNOT_S * sampling_rate), 1)
    return np.arange(first, first + count), np.arange(first // step, (first + count) // step + 2) * step


def _power(level_db: float) -> float:
    return float(10 ** (level_db / 10))


def _amplitude(psd: np.ndarray, edge: np.ndarray) -> np.ndarray:
    return (np.sqrt(psd) * edge).astype(np.float32)
