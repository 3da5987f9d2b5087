"""Gaussian noise of any spectrum as a function of absolute time: block-seeded, seamless, the same at any
sampling rate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import fft

HOP_S = 450.0
FADE_S = 50.0

Colour = Callable[[np.ndarray, np.ndarray], np.ndarray]


def sample_index(time: float, sampling_rate: float) -> int:
    """Index of the first sample at or after `time` [s since 1970] on the grid whose sample 0 is at
    1970-01-01.
    """
    return int(np.ceil(round(time * sampling_rate, 4)))


def named(*numbers: int) -> np.random.SeedSequence:
    """The seed that whole numbers name; those of blocks before 1970 are negative."""
    return np.random.SeedSequence([number % 2**63 for number in numbers])


def gaussian_noise(
    seed: tuple[int, ...],
    first: int,
    count: int,
    sampling_rate: float,
    colour: Colour,
    draws: int = 1,
    analytic: bool = False,
) -> np.ndarray:
    """Stationary Gaussian noise at samples first … first + count − 1 of the absolute sample grid.

    Blocks of 500 s are drawn in the frequency domain, each from its own seed, lowest frequencies first, and
    joined every 450 s by cross-fades whose squares sum to one: the variance is stationary, any part can be
    made alone, and two sampling rates of which 450 s are whole samples give the same waveform below the lower
    Nyquist frequency.

    Parameters
    ----------
    seed : tuple of int
        Names the stream; the block's number is appended.
    first, count : int
        Samples since 1970-01-01 and how many.
    sampling_rate : float
        Hz.
    colour : callable
        ``colour(frequency [Hz], z)`` with `z` complex (draws, frequency) of independent unit-variance parts
        returns the one-sided spectral amplitudes (outputs, frequency) in unit/√Hz, so that |amplitude|²
        averages to twice the one-sided PSD.
    draws : int
        Independent variates per frequency.
    analytic : bool
        Return the analytic signal, whose real part is the noise.

    Returns
    -------
    array (outputs, count), float32, or complex64 if `analytic`.
    """
    hop, fade = round(HOP_S * sampling_rate), round(FADE_S * sampling_rate)
    length = hop + fade
    angle = 0.5 * np.pi * np.arange(fade) / fade
    window = np.concatenate([np.sin(angle), np.ones(hop - fade), np.cos(angle)]).astype(np.float32)
    frequency = np.arange(length // 2 + 1) * (sampling_rate / length)
    out: np.ndarray | None = None
    for block in range((first - length) // hop + 1, (first + count - 1) // hop + 1):
        piece = _block((*seed, block), frequency, length, colour, draws, analytic)
        if out is None:
            out = np.zeros((piece.shape[0], count), piece.dtype)
        start = block * hop - first
        low, high = max(start, 0), min(start + length, count)
        if low < high:
            part = slice(low - start, high - start)
            out[:, low:high] += piece[:, part] * window[part]
    if out is None:
        raise ValueError("count must be positive")
    return out


def _block(
    seed: tuple[int, ...], frequency: np.ndarray, length: int, colour: Colour, draws: int, analytic: bool
) -> np.ndarray:
    generator = np.random.Generator(np.random.SFC64(named(*seed)))
    parts = generator.standard_normal((frequency.size, draws, 2), dtype=np.float32)
    variates = np.ascontiguousarray(parts.view(np.complex64)[..., 0].T)
    amplitude = colour(frequency, variates) * np.float32(np.sqrt(frequency[1]))
    amplitude[:, 0] = 0.0
    if length % 2 == 0:
        amplitude[:, -1] = 0.0
    if not analytic:
        return fft.irfft(amplitude * np.float32(length / 2), length, axis=1).astype(np.float32, copy=False)
    full = np.zeros((amplitude.shape[0], length), np.complex64)
    full[:, : frequency.size] = amplitude * np.float32(length)
    return fft.ifft(full, axis=1, overwrite_x=True)


def below_nyquist(frequency: np.ndarray, sampling_rate: float) -> np.ndarray:
    """Gain of the digitiser's anti-alias filter: one to 0.46 of the rate, zero from 0.495 of it (cosine
    between).
    """
    position = np.clip((np.asarray(frequency) / sampling_rate - 0.46) / 0.035, 0.0, 1.0)
    return 0.5 * (1.0 + np.cos(np.pi * position))


class Wander:
    """A slow random function of absolute time: a band-limited random walk, standard deviation `spread`.

    A sum of cosines with log-uniform periods between `shortest_s` and `longest_s` and amplitudes growing with
    the square root of the period, so that it can be evaluated, and integrated, at any time without a history.
    """

    def __init__(
        self,
        generator: np.random.Generator,
        spread: float,
        shortest_s: float,
        longest_s: float,
        terms: int = 12,
    ) -> None:
        self.period = np.exp(generator.uniform(np.log(shortest_s), np.log(longest_s), terms))
        self.phase = generator.uniform(0.0, 2 * np.pi, terms)
        weight = np.sqrt(self.period)
        self.amplitude = spread * weight * np.sqrt(2.0 / np.sum(weight**2))

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Value at `time` [s since 1970]."""
        angle = 2 * np.pi * np.asarray(time, float)[..., None] / self.period + self.phase
        return np.cos(angle) @ self.amplitude

    def integral(self, time: np.ndarray) -> np.ndarray:
        """Antiderivative at `time` [s since 1970], value × s."""
        angle = 2 * np.pi * np.asarray(time, float)[..., None] / self.period + self.phase
        return np.sin(angle) @ (self.amplitude * self.period / (2 * np.pi))
