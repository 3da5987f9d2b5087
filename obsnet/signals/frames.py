"""Frames of samples in, their windowed Fourier transforms out, and which of them cannot be trusted."""

from __future__ import annotations

import math

import numpy as np

_GRID_TOLERANCE = 1e-5
_MIN_LEVELS = 32
_NEAR = 0.02
_PILED = 3.0


class FrameTransform:
    """Hann-windowed Fourier transform of frames at one sampling rate, at multiples of 1 / `window_s`.

    An FFT cut at the last bin asked for, where the window holds a whole number of samples (to 1e-5, a
    hundredth of a bin at the top); else a chirp-z transform, the same sum at the same frequencies.

    Parameters
    ----------
    rate : float
        Sampling rate, Hz; at least twice the highest frequency.
    window_s : float
        Length of a frame, s.
    bins : int
        Frequencies, from 0 Hz up.

    Attributes
    ----------
    count : int
        Samples a frame.
    middle_s : float
        Time of sample `count // 2` after the frame's start, as the transform takes it, s.
    scale : ndarray
        Factor at each frequency that makes the modulus the amplitude of a tone.
    name : str
        What is done, for reports.
    """

    def __init__(self, rate: float, window_s: float, bins: int) -> None:
        self.bins = bins
        exact = rate * window_s
        self._chirp = abs(exact / round(exact) - 1) > _GRID_TOLERANCE
        self.count = math.ceil(exact) if self._chirp else round(exact)
        period = exact if self._chirp else float(self.count)
        self.middle_s = self.count // 2 * window_s / period
        self._window = np.sin(np.pi * np.arange(self.count) / period) ** 2
        self._weight = self._window.sum()
        self.scale = np.full(bins, 2 / self._weight)
        self.scale[0] /= 2
        if self.count == 2 * (bins - 1):
            self.scale[-1] /= 2
        cut = "" if self.count == 2 * (bins - 1) else f" cut at {(bins - 1) / window_s:g} Hz"
        self.name = ("chirp-z transform" if self._chirp else "FFT") + cut
        if self._chirp:
            self._prepare_chirp(period)

    def _prepare_chirp(self, period: float) -> None:
        n = np.arange(max(self.count, self.bins), dtype=float)
        quadratic = np.exp(-1j * np.pi * (n**2 / period % 2))
        self._up = quadratic[: self.count].astype(np.complex64)
        self._down = quadratic[: self.bins].astype(np.complex64)
        from scipy.fft import next_fast_len

        self._size = next_fast_len(self.count + self.bins - 1)
        kernel = np.zeros(self._size, complex)
        kernel[: self.bins] = np.conj(quadratic[: self.bins])
        kernel[-(self.count - 1) :] = np.conj(quadratic[self.count - 1 : 0 : -1])
        self._kernel = np.fft.fft(kernel).astype(np.complex64)

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Spectra (frame, bin) complex64 of frames (frame, sample) float64, which are overwritten.

        Each frame's windowed mean is removed, which leaves nothing at 0 Hz; a plain mean would put a loud
        tone's unfinished cycle into the lowest bins.
        """
        frames -= (frames @ self._window / self._weight)[:, None]
        frames *= self._window
        windowed = frames.astype(np.float32)
        if not self._chirp:
            return np.fft.rfft(windowed, axis=1)[:, : self.bins].astype(np.complex64, copy=False)
        # Bluestein: kn = (k² + n² − (k − n)²) / 2 turns the sum into a convolution
        mixed = np.fft.fft(windowed * self._up, self._size, axis=1)
        made = np.fft.ifft(mixed * self._kernel, axis=1)[:, : self.bins] * self._down
        return made.astype(np.complex64, copy=False)


def constant(samples: np.ndarray, count: int) -> np.ndarray:
    """Which samples lie in a stretch of at least `count` equal ones."""
    still = np.zeros(samples.size, bool)
    same = samples[1:] == samples[:-1]
    if np.count_nonzero(same) < count - 1:
        return still
    edges = np.diff(np.concatenate([[0], same.view(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    long = ends - begins >= count - 1
    for begin, end in zip(begins[long], ends[long], strict=True):
        still[begin : end + 1] = True
    return still


def touched(bad: np.ndarray, position: np.ndarray, count: int) -> np.ndarray:
    """Which frames of `count` samples from `position` on contain a bad sample."""
    if not bad.any():
        return np.zeros(position.size, bool)
    before = np.concatenate([[0], np.cumsum(bad)])
    return before[position + count] > before[position]


def clipped(frames: np.ndarray, share: float) -> np.ndarray:
    """Which frames are cut off at a level.

    The extreme value itself is taken by at least `share` of the samples, and by over three times as many as
    come within 2 % of the range of it: a sinusoid dwells near its crests, but only clipping piles samples
    up on one value. Frames with fewer than 32 distinct values are coarse, not clipped.
    """
    enough = max(share * frames.shape[1], 3)
    high, low = frames.max(axis=1, keepdims=True), frames.min(axis=1, keepdims=True)
    at_high, at_low = np.count_nonzero(frames == high, axis=1), np.count_nonzero(frames == low, axis=1)
    result = np.zeros(len(frames), bool)
    for row in np.flatnonzero(np.maximum(at_high, at_low) >= enough):
        frame, near = frames[row], _NEAR * (high[row, 0] - low[row, 0])
        below_high = np.count_nonzero(frame > high[row, 0] - near) - at_high[row]
        above_low = np.count_nonzero(frame < low[row, 0] + near) - at_low[row]
        piled_high = at_high[row] >= max(enough, _PILED * below_high)
        piled_low = at_low[row] >= max(enough, _PILED * above_low)
        result[row] = (piled_high or piled_low) and np.unique(frame).size >= _MIN_LEVELS
    return result
