"""Time differences of arrival: one click on several hydrophones in, TDOAs finer than a sample out."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from obsnet.errors import ConfigError, LayoutError

Interpolation = Literal["none", "parabolic", "upsampled"]

UPSAMPLING = 8
"""Points of the correlation a sample before the parabola: its bias, in samples, falls with the third power of
this."""


def highest_tdoa(
    correlation: np.ndarray, rate: float, interpolation: Interpolation = "upsampled"
) -> tuple[np.ndarray, np.ndarray]:
    """Lag [s] and height of each pair's highest peak; NaN where there is no correlation."""
    tdoa, coefficient = np.full(len(correlation), np.nan), np.full(len(correlation), np.nan)
    for row, values in enumerate(correlation):
        if np.isfinite(values).any():
            tdoa[row], coefficient[row] = peak(values, int(np.nanargmax(values)), rate, interpolation)
    return tdoa, coefficient


def cross_correlations(
    segments: np.ndarray,
    sampling_rate: float,
    pairs: np.ndarray,
    max_tdoa_s: np.ndarray,
    band_hz: list[tuple[float, float]] | None = None,
    interpolation: Interpolation = "upsampled",
) -> tuple[np.ndarray, float]:
    """Correlation coefficients against lag, dims (pair, lag), and the rate [Hz] of the lags.

    Lag zero is in the middle; lags beyond a pair's `max_tdoa_s` are NaN, as are pairs with a silent
    hydrophone.

    Parameters
    ----------
    segments : array (hydrophone, time), the same stretch of time on every hydrophone; a gap is silence.
    sampling_rate : Hz
    pairs : int array (pair, 2)
    max_tdoa_s : array (pair,), s; lags are t_i − t_j within ± this.
    band_hz : frequency bands (low, high) to correlate in, Hz; all by default.
    interpolation : of the peaks. ``none`` stays on the sampling grid (the stairs of the paper's figures 3–6: errors
        uniform over a sample); ``parabolic`` puts a parabola through a peak and its neighbours, biased by a hundredth
        of a sample and more where the click fills the band; ``upsampled`` evaluates the correlation `UPSAMPLING` times
        denser first, by zero-padding the cross-spectrum, which is exact for what is band-limited.
    """
    segments = np.asarray(segments, float)
    if segments.ndim != 2 or segments.shape[1] < 4:
        raise LayoutError(f"segments must have dims (hydrophone, time), found shape {segments.shape}")
    factor = _factor(interpolation)
    limit = np.broadcast_to(np.asarray(max_tdoa_s, float), (len(pairs),))
    spectra, size = _spectra(segments, sampling_rate, float(limit.max()), band_hz)
    energy = np.sqrt((np.abs(spectra) ** 2).sum(axis=1))
    rate = sampling_rate * factor
    reach = np.ceil(limit * rate).astype(int)
    widest = int(reach.max())
    correlation = np.full((len(pairs), 2 * widest + 1), np.nan)
    for row, (i, j) in enumerate(np.asarray(pairs)):
        norm = energy[i] * energy[j]
        if not (np.isfinite(norm) and norm > 0):
            continue
        cross = irfft(spectra[i] * np.conj(spectra[j]), size * factor) * (size * factor / 2.0) / norm
        inside = np.concatenate([cross[-reach[row] :], cross[: reach[row] + 1]])
        correlation[row, widest - reach[row] : widest + reach[row] + 1] = inside
    return correlation, rate


def peak(
    correlation: np.ndarray, index: int, rate: float, interpolation: Interpolation = "upsampled"
) -> tuple[float, float]:
    """Lag [s] and height of the maximum at `index` of one pair's correlation."""
    middle = len(correlation) // 2
    shift, height = 0.0, float(correlation[index])
    if interpolation != "none" and 0 < index < len(correlation) - 1:
        shift, height = _vertex(correlation[index - 1 : index + 2])
    return (index - middle + shift) / rate, height


def tdoa_variance(
    coefficient: np.ndarray, duration_s: float, band_hz: list[tuple[float, float]]
) -> tuple[float, float]:
    """Variance [s²] of a hydrophone's arrival time, which its pairs share, and that of each pair alone.

    With coherence ρ = S/(1 + S) the bound of a delay is (1 − ρ²)/ρ² / (2 T ∫(2πf)² df) (Carter 1987), and
    (1 − ρ²)/ρ² = 2/S + 1/S²: each hydrophone's noise against the click gives 1/S, noise against noise 1/S².

    Parameters
    ----------
    coefficient : correlation coefficients of one click's pairs; their median stands for ρ.
    duration_s : length of the correlated stretch, s.
    """
    rho = float(np.clip(np.nanmedian(coefficient), 1e-3, 1.0 - 1e-9))
    ratio = rho / (1.0 - rho)
    information = (
        2.0 * duration_s * sum((2.0 * np.pi) ** 2 * (high**3 - low**3) / 3.0 for low, high in band_hz)
    )
    return 1.0 / (ratio * information), 1.0 / (ratio**2 * information)


def quantised(tdoa: np.ndarray, sampling_rate: float) -> np.ndarray:
    """TDOAs rounded to whole samples: error uniform, standard deviation 1/(√12 sampling_rate)."""
    return np.round(np.asarray(tdoa, float) * sampling_rate) / sampling_rate


def _factor(interpolation: str) -> int:
    if interpolation not in ("none", "parabolic", "upsampled"):
        raise ConfigError(f"interpolation must be none, parabolic or upsampled, found {interpolation!r}")
    return UPSAMPLING if interpolation == "upsampled" else 1


def _spectra(
    segments: np.ndarray, sampling_rate: float, reach_s: float, band_hz: list[tuple[float, float]] | None
) -> tuple[np.ndarray, int]:
    """Spectra in the bands, zero-padded so that lags do not wrap, and the transform's length."""
    length = segments.shape[1]
    size = next_fast_len(length + int(np.ceil(reach_s * sampling_rate)) + 2, real=True)
    spectra = rfft(segments - segments.mean(axis=1, keepdims=True), size, axis=1)
    keep = np.ones(spectra.shape[1], bool)
    if band_hz is not None:
        frequency = np.arange(spectra.shape[1]) * sampling_rate / size
        keep = np.zeros(spectra.shape[1], bool)
        for low, high in band_hz:
            keep |= (frequency >= low) & (frequency < high)
    keep[0] = False
    if size % 2 == 0:
        keep[-1] = False
    return spectra * keep, size


def _vertex(values: np.ndarray) -> tuple[float, float]:
    """Offset in points and height of the parabola through three neighbouring values."""
    before, top, after = values
    bend = before - 2.0 * top + after
    if not bend < 0:
        return 0.0, float(top)
    shift = float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
    return shift, float(top - 0.25 * (before - after) * shift)
