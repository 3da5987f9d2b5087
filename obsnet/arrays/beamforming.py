"""Hydrophone array and batches of its samples in; delay-and-sum power against azimuth out.

A batch holds N samples of M hydrophones. Its fractional delays are phases on the N/2 *odd* frequency bins
(n + 1/2) fs/N rather than on the n fs/N of eq. 10: the latter hold two bins, 0 and fs/2, where a real
signal cannot carry a phase, so that the paper's cosine there breaks HᵀH = M I. With odd bins (the batch
continued antiperiodically) every bin has a conjugate, H is real, HᵀH = M I holds to rounding, and power is
a smooth function of azimuth.

Where the samples were demodulated by a carrier f0, a delay τ turns bin f by exp(−2πi (f0 + f) τ): the
aperture counts in wavelengths at sea, not in those of the demodulated signal.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import fft

from obsnet.arrays.whitening import NoiseModel
from obsnet.errors import ConfigError, WaveformError

BLOCK = 256


@dataclass(frozen=True)
class HydrophoneArray:
    """Positions of the hydrophones [m], dims (hydrophone, 3): east, north, down of the array's origin."""

    positions_m: np.ndarray
    sound_speed_mps: float = 1500.0

    def __post_init__(self) -> None:
        positions = np.array(self.positions_m, float)
        if positions.ndim != 2 or positions.shape[1] != 3 or len(positions) < 2:
            raise ConfigError(
                f"positions must have dims (hydrophone, 3), 2 rows at least, found {positions.shape}"
            )
        if not np.isfinite(positions).all():
            raise ConfigError("hydrophone positions must be finite numbers, in metres")
        if not (np.isfinite(self.sound_speed_mps) and self.sound_speed_mps > 0):
            raise ConfigError(f"the sound speed must be positive, found {self.sound_speed_mps!r} m/s")
        positions.flags.writeable = False
        object.__setattr__(self, "positions_m", positions)

    @classmethod
    def line(
        cls, count: int, spacing_m: float, axis_deg: float = 90.0, sound_speed_mps: float = 1500.0
    ) -> HydrophoneArray:
        """Horizontal line of `count` hydrophones, centred on the origin, along azimuth `axis_deg`.

        It cannot tell the two sides of its axis apart: azimuths ψ and 2·axis − ψ give the same delays.
        """
        if count < 2 or not spacing_m > 0:
            raise ConfigError(
                f"a line array needs 2 hydrophones and a spacing above 0 m, found {count}, {spacing_m}"
            )
        along = (np.arange(count) - (count - 1) / 2.0) * spacing_m
        axis = np.deg2rad(axis_deg)
        positions = np.stack([along * np.sin(axis), along * np.cos(axis), np.zeros(count)], axis=1)
        return cls(positions, sound_speed_mps)

    @property
    def count(self) -> int:
        """Number of hydrophones."""
        return len(self.positions_m)

    def delays_s(
        self, azimuth_deg: np.ndarray | float, elevation_deg: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Arrival of a plane wave at each hydrophone after the origin [s], dims (…, hydrophone).

        Parameters
        ----------
        azimuth_deg : array or float
            Towards the source, clockwise from north.
        elevation_deg : array or float
            Of the source above the horizontal; broadcasts with the azimuth.
        """
        azimuth, elevation = np.broadcast_arrays(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg))
        towards = np.stack(
            [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), -np.sin(elevation)],
            axis=-1,
        )
        return -(towards @ self.positions_m.T) / self.sound_speed_mps


@dataclass(frozen=True)
class Beamformer:
    """Delay-and-sum over a grid of azimuths, for batches of one length.

    Parameters
    ----------
    array : HydrophoneArray
    sampling_rate : float, Hz
    nperseg : int
        N, samples per batch; even.
    carrier_hz : float
        Frequency that the samples were demodulated by; 0 where they were not.
    azimuth_deg : array, dims (azimuth,)
        Where `power` looks.
    whitening : NoiseModel, optional
        Match the beams to what the whitening leaves of a plane wave: phases h(f) become g(f) = Σ^−½ A(f)
        h(f), scaled so that ‖g(f)‖² = M, hence still HᵀH = M I: the model of a source whose spectrum
        follows that of the noise it stands out of. Without it, beams are the paper's, which after whitening
        are pulled away from the noise.

    Source: Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data, eqs 9–11.
    """

    array: HydrophoneArray
    sampling_rate: float
    nperseg: int
    azimuth_deg: np.ndarray
    carrier_hz: float = 0.0
    whitening: NoiseModel | None = None
    _weights: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.nperseg < 2 or self.nperseg % 2:
            raise ConfigError(f"a batch needs an even number of samples, at least 2, found {self.nperseg}")
        if not (self.sampling_rate > 0 and self.carrier_hz >= 0):
            raise ConfigError(
                "the sampling rate must be positive and the carrier not negative, "
                f"found {self.sampling_rate} and {self.carrier_hz} Hz"
            )
        azimuth = np.atleast_1d(np.asarray(self.azimuth_deg, float))
        object.__setattr__(self, "azimuth_deg", azimuth)
        weights = self.steering(azimuth).conj().astype(np.complex64)
        object.__setattr__(self, "_weights", np.ascontiguousarray(np.moveaxis(weights, -1, 0)))

    @property
    def frequency_hz(self) -> np.ndarray:
        """Frequencies of the N/2 bins before demodulation [Hz]."""
        return self.carrier_hz + (np.arange(self.nperseg // 2) + 0.5) * self.sampling_rate / self.nperseg

    def phases(self, azimuth_deg: np.ndarray | float) -> np.ndarray:
        """Factor on each bin at each hydrophone for a plane wave, complex, dims (…, hydrophone, bin)."""
        return np.exp(-2j * np.pi * self.array.delays_s(azimuth_deg)[..., None] * self.frequency_hz)

    def steering(self, azimuth_deg: np.ndarray | float) -> np.ndarray:
        """What a beam is matched to, dims (…, hydrophone, bin): `phases`, whitened if asked for."""
        phases = self.phases(azimuth_deg)
        if self.whitening is None:
            return phases
        transfer = self.whitening.transfer((self.frequency_hz - self.carrier_hz) / self.sampling_rate)
        white = np.einsum("fij,...jf->...if", transfer, phases)
        return white * np.sqrt(self.array.count) / np.linalg.norm(white, axis=-2, keepdims=True)

    def delay(self, signal: np.ndarray, azimuth_deg: np.ndarray | float) -> np.ndarray:
        """H(ψ) s: what the hydrophones receive from a source at `azimuth_deg`, after whitening if there is
        one.

        Parameters
        ----------
        signal : array, dims (…, N)
        azimuth_deg : float, or array of the leading dims of `signal`

        Returns
        -------
        array, dims (…, N, hydrophone)
        """
        spectrum = odd_spectrum(np.asarray(signal, float)[..., None, :])
        return np.swapaxes(odd_signal(spectrum * self.steering(azimuth_deg)), -1, -2)

    def matrix(self, azimuth_deg: float) -> np.ndarray:
        """H(ψ) written out, dims (N·M, N); rows in the order of a batch (sample, hydrophone) flattened."""
        columns = self.delay(np.eye(self.nperseg), azimuth_deg)
        return columns.reshape(self.nperseg, -1).T

    def power(self, batches: np.ndarray) -> np.ndarray:
        """B(ψ, y) = ‖Hᵀ(ψ) y‖², dims (batch, azimuth), float32; units of the samples, squared.

        Parameters
        ----------
        batches : array, dims (batch, N, hydrophone)

        Raises
        ------
        WaveformError
            The shape is not this beamformer's.
        """
        batches = np.asarray(batches)
        wanted = (self.nperseg, self.array.count)
        if batches.ndim != 3 or batches.shape[1:] != wanted:
            raise WaveformError(
                f"batches must have dims (batch, {wanted[0]}, {wanted[1]}), found {batches.shape}"
            )
        power = np.empty((len(batches), len(self.azimuth_deg)), np.float32)
        for start in range(0, len(batches), BLOCK):
            power[start : start + BLOCK] = self._power(batches[start : start + BLOCK])
        return power

    def _power(self, batches: np.ndarray) -> np.ndarray:
        spectrum = odd_spectrum(np.swapaxes(batches, 1, 2).astype(np.float32, order="C"))
        power = np.zeros((len(self.azimuth_deg), len(batches)), np.float32)
        for weights, values in zip(
            self._weights, np.ascontiguousarray(spectrum.transpose(2, 1, 0)), strict=True
        ):
            squares = (weights @ values).view(np.float32)
            np.square(squares, out=squares)
            power += squares[:, ::2]
            power += squares[:, 1::2]
        return 2.0 * power.T


def odd_spectrum(signal: np.ndarray) -> np.ndarray:
    """Unitary discrete Fourier transform at the frequencies (n + 1/2)/N, n < N/2, along the last axis.

    N is even. Energy: Σ x² = 2 Σ |X|².
    """
    count = signal.shape[-1]
    signal = np.asarray(signal)
    twist = np.exp(-1j * np.pi * np.arange(count) / count)
    shifted = signal * twist.astype(np.result_type(signal.dtype, np.complex64))
    return fft.fft(shifted, axis=-1)[..., : count // 2] / count**0.5


def odd_signal(spectrum: np.ndarray) -> np.ndarray:
    """Real signal of N samples with the N/2 odd bins `spectrum`: the inverse of `odd_spectrum`."""
    half = spectrum.shape[-1]
    count = 2 * half
    padded = np.concatenate([spectrum, np.zeros_like(spectrum)], axis=-1)
    twist = np.exp(1j * np.pi * np.arange(count) / count)
    return 2.0 * count**0.5 * (fft.ifft(padded, axis=-1) * twist).real
