"""Directional, coloured sea noise on an array: its cross-spectral density and its vector autoregression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.arrays.beamforming import HydrophoneArray
from obsnet.arrays.whitening import NoiseModel, from_autocovariance
from obsnet.errors import ConfigError


@dataclass(frozen=True)
class NoiseSector:
    """Plane waves from a sector: a coast, a harbour, a shipping lane, or, with a line, the machinery of a
    distant ship.

    Parameters
    ----------
    azimuth_deg, spread_deg : float
        Centre and standard deviation of the sector, Gaussian in azimuth.
    power : float
        At one hydrophone, mean over the band.
    slope_db_octave : float
        Of the spectrum.
    line_hz, line_width_hz : float
        Centre and half width of a Lorentzian line; a width of 0 is no line.
    """

    azimuth_deg: float
    spread_deg: float
    power: float
    slope_db_octave: float = -6.0
    line_hz: float = 0.0
    line_width_hz: float = 0.0


@dataclass(frozen=True)
class SeaNoise:
    """Sea noise as a sum, each part by its power at one hydrophone, mean over the band.

    Parameters
    ----------
    self_noise : float
        White, independent between hydrophones.
    diffuse, diffuse_slope_db_octave : float
        Isotropic in three dimensions: coherence sin(kd)/(kd).
    sectors : tuple of NoiseSector
    """

    self_noise: float
    diffuse: float
    diffuse_slope_db_octave: float = -5.0
    sectors: tuple[NoiseSector, ...] = ()

    def __post_init__(self) -> None:
        if not self.self_noise > 0 or self.diffuse < 0 or any(sector.power < 0 for sector in self.sectors):
            raise ConfigError("self noise must have a positive power, the other noise none that is negative")
        if any(not sector.spread_deg > 0 for sector in self.sectors):
            raise ConfigError("a noise sector needs a spread above 0 deg")

    def spectral_density(self, array: HydrophoneArray, frequency_hz: np.ndarray) -> np.ndarray:
        """Cross-spectral density, complex, dims (frequency, hydrophone, hydrophone); fields exp(+iωt).

        Scaled such that its mean over `frequency_hz` is the covariance of analytic samples of these powers.
        """
        frequency = np.asarray(frequency_hz, float)
        apart = np.linalg.norm(array.positions_m[:, None] - array.positions_m[None], axis=-1)
        coherence = np.sinc(2.0 * frequency[:, None, None] * apart / array.sound_speed_mps)
        level = self.diffuse * _spectrum(frequency, self.diffuse_slope_db_octave)
        density = self.self_noise * np.eye(array.count) + level[:, None, None] * coherence.astype(complex)
        for sector in self.sectors:
            away = np.linspace(-3.0, 3.0, 121)
            weight = np.exp(-0.5 * away**2)
            delay = array.delays_s(sector.azimuth_deg + away * sector.spread_deg)
            wave = np.exp(-2j * np.pi * frequency[:, None, None] * delay)
            level = sector.power * _spectrum(
                frequency, sector.slope_db_octave, sector.line_hz, sector.line_width_hz
            )
            weighted = wave * (weight / weight.sum())[:, None]
            density += level[:, None, None] * (np.swapaxes(weighted, 1, 2) @ wave.conj())
        return density

    def noise_model(
        self, array: HydrophoneArray, sampling_rate: float, carrier_hz: float, order: int, bins: int = 2048
    ) -> NoiseModel:
        """VAR(`order`) with the first `order` + 1 autocovariances of this noise after demodulation."""
        cycles = (np.arange(bins) + 0.5) / (2.0 * bins)
        density = self.spectral_density(array, carrier_hz + cycles * sampling_rate) / bins
        turns = np.exp(2j * np.pi * np.arange(order + 1)[:, None] * cycles)
        return from_autocovariance(np.einsum("kf,fij->kij", turns, density).real)


def _spectrum(frequency: np.ndarray, slope: float, line_hz: float = 0.0, width_hz: float = 0.0) -> np.ndarray:
    """Spectral shape with mean 1 over the band."""
    shape = 10.0 ** (slope / 10.0 * np.log2(frequency / frequency[0]))
    if width_hz > 0:
        shape = shape / (1.0 + ((frequency - line_hz) / width_hz) ** 2)
    return shape / shape.mean()
