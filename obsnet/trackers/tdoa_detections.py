"""Cepstrogram in, unlabelled delays out: ridges of its envelope that stand above their surroundings and hang
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numba import njit

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.clustering import NOISE, dbscan


@dataclass(frozen=True)
class TdoaDetectionConfig:
    """Which delays are looked for and how much they must stand out; the defaults are those of a deep station.

    Parameters
    ----------
    min_tdoa_s, max_tdoa_s : delays looked for, s.
    envelope : take the modulus of the analytic cepstrum along quefrency, free of the arrivals' phases; else
        that of the cepstrum itself, as the paper does.
    centre_frequency_hz, pulse_width_s : with `envelope`, the pulse exp(−τ²/2Δτ²) at this frequency that the
        cepstrum is matched with (Trabattoni et al. 2023, eq. 17); no matching where the width is 0.
    stack_s, scan_step_s, max_drift : with `envelope`, frames within a window of this length are averaged
        along straight ridges of every slope up to this one [s/s], at UTC multiples of the step, and the best
        slope counts: a delay changes by milliseconds per second, so that frames add up in phase. Every frame
        is a scan of its own where `stack_s` is 0.
    background_tdoa_s, background_time_s : sides of the window of the two-dimensional running median.
    threshold : peaks must exceed the median by this factor.
    cluster_tdoa_s, cluster_time_s, cluster_points : DBSCAN. A peak is kept where it lies in a cluster: at
        least `cluster_points` peaks, itself included, within an ellipse of these semi-axes, or one such
        peak's neighbour.
    """

    min_tdoa_s: float = 0.3
    max_tdoa_s: float = 6.5
    envelope: bool = True
    centre_frequency_hz: float = 15.0
    pulse_width_s: float = 0.05
    stack_s: float = 92.16
    scan_step_s: float = 61.44
    max_drift: float = 2.5e-3
    background_tdoa_s: float = 1.0
    background_time_s: float = 300.0
    threshold: float = 1.6
    cluster_tdoa_s: float = 0.16
    cluster_time_s: float = 130.0
    cluster_points: int = 3

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_tdoa_s < self.max_tdoa_s:
            raise ConfigError(
                "min_tdoa_s must be at least 0 and below max_tdoa_s, found "
                f"{self.min_tdoa_s} and {self.max_tdoa_s}"
            )
        for name in (
            "background_tdoa_s",
            "background_time_s",
            "cluster_tdoa_s",
            "cluster_time_s",
            "threshold",
        ):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        if self.pulse_width_s < 0 or self.centre_frequency_hz < 0:
            raise ConfigError(
                "pulse_width_s and centre_frequency_hz must not be negative, found "
                f"{self.pulse_width_s} s and {self.centre_frequency_hz} Hz"
            )
        if self.stack_s < 0 or self.max_drift < 0 or not self.scan_step_s > 0:
            raise ConfigError(
                "stack_s and max_drift must not be negative and scan_step_s must be positive, found "
                f"{self.stack_s} s, {self.max_drift} s/s and {self.scan_step_s} s"
            )
        if self.cluster_points < 1:
            raise ConfigError(f"cluster_points must be at least 1, found {self.cluster_points}")

    @property
    def context_s(self) -> float:
        """Detections at a time depend on the cepstrogram this long before and after it [s]."""
        return self.stack_s / 2 + self.background_time_s / 2 + 2 * self.cluster_time_s


@dataclass(frozen=True)
class TdoaDetections:
    """Detected delays of a record, scan by scan.

    Parameters
    ----------
    times_s : array, dims (scan,), s.
    valid : array of bool, dims (scan,), False in gaps.
    scan_of : array of int, dims (detection,), index of the detection's scan, not decreasing.
    tdoa_s : array, dims (detection,), s.
    prominence : array, dims (detection,), amplitude over the background's median.
    quefrency_s, floor : arrays, dims (quefrency,): the delays looked for, s, and the amplitude that a peak must
        exceed there, median over the scans.
    """

    times_s: np.ndarray
    valid: np.ndarray
    scan_of: np.ndarray
    tdoa_s: np.ndarray
    prominence: np.ndarray
    quefrency_s: np.ndarray
    floor: np.ndarray

    def scan(self, index: int) -> np.ndarray | None:
        """Delays [s] of the scan with this index; None in a gap."""
        if not self.valid[index]:
            return None
        first, last = np.searchsorted(self.scan_of, [index, index + 1])
        return self.tdoa_s[first:last]


def detect_tdoas(
    values: np.ndarray,
    quefrency_s: np.ndarray,
    times_s: np.ndarray,
    config: TdoaDetectionConfig = TdoaDetectionConfig(),
) -> TdoaDetections:
    """Delays between paths, as the local maxima over quefrency that exceed the background and lie in
    clusters.

    Parameters
    ----------
    values : array, dims (quefrency, time), cepstrogram without the source's clutter; NaN in gaps.
    quefrency_s : array, dims (quefrency,), s, uniform, from 0.
    times_s : array, dims (time,), s, increasing.
    config : TdoaDetectionConfig

    Raises
    ------
    LayoutError
        Sizes or order of the coordinates do not fit.
    ConfigError
        No delay looked for lies on the quefrency axis.

    Notes
    -----
    Nothing is random, and what is detected at a time depends on no more than `config.context_s` around it.

    Source: Watkins et al., section II; Trabattoni et al. 2023, appendix C for the analytic cepstrum.
    """
    values, quefrency, times = _checked(values, quefrency_s, times_s)
    step = quefrency[1] - quefrency[0]
    first, stop = np.searchsorted(quefrency, [config.min_tdoa_s, config.max_tdoa_s])
    if stop - first < 3:
        raise ConfigError(
            f"delays from {config.min_tdoa_s} to {config.max_tdoa_s} s leave no peak on a quefrency axis "
            f"that ends at {quefrency[-1]:.4g} s in steps of {step:.3g} s"
        )
    scan_times, valid, envelope = scan_envelope(values, step, times, config)
    half_rows = max(1, round(config.background_tdoa_s / 2 / step))
    median = running_median(envelope, scan_times, valid, half_rows, config.background_time_s / 2, first, stop)
    floor = median * config.threshold
    rows, scans, shift = _peaks(envelope, floor, valid, first, stop)
    tdoa = quefrency[rows] + shift * step
    points = np.stack([tdoa / config.cluster_tdoa_s, scan_times[scans] / config.cluster_time_s], axis=1)
    kept = dbscan(points, 1.0, config.cluster_points) != NOISE
    prominence = envelope[rows, scans] / median[rows - first, scans]
    usual = np.median(floor[:, valid], axis=1) if valid.any() else np.full(stop - first, np.nan)
    return TdoaDetections(
        scan_times, valid, scans[kept], tdoa[kept], prominence[kept], quefrency[first:stop], usual
    )


def scan_envelope(
    values: np.ndarray, step_s: float, times_s: np.ndarray, config: TdoaDetectionConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of the scans [s], whether they hold data, and the envelope there, dims (quefrency, scan).

    A window that holds less than half of its frames is a gap. With the Fourier transform Y(ν, t) of the
    analytic, matched cepstrum along quefrency, a slope s and a window W of valid frames around t, the
    envelope is max_s |F⁻¹ mean_W Y(ν, t') exp(2πiν s (t' − t))|: a pulse
    a·cos(2πf₀(τ−τ₀)+φ)·exp(−(τ−τ₀)²/2Δτ²) that drifts along a straight ridge peaks at τ₀(t), whatever φ.
    """
    there = np.isfinite(values).all(axis=0)
    clean = np.where(there, values, 0.0)
    if not config.envelope:
        return times_s, there, np.abs(clean)
    size = scipy.fft.next_fast_len(2 * len(values))
    frequency, response = _matched_band(size, step_s, config)
    spectrum = scipy.fft.fft(clean, size, axis=0)[response > 0] * response[response > 0, None]
    if config.stack_s == 0:
        return times_s, there, _modulus(spectrum, response > 0, len(values))
    scans, left, right = _windows(times_s, config)
    total = np.concatenate([[0], np.cumsum(there)])
    count = total[right] - total[left]
    whole = config.stack_s / np.diff(times_s).min(initial=config.stack_s)
    envelope = np.zeros((len(values), len(scans)))
    for drift in _drifts(config):
        stacked = _stack(spectrum, frequency[response > 0] * drift, times_s, scans, left, right)
        stacked /= np.maximum(count, 1)
        np.maximum(envelope, _modulus(stacked, response > 0, len(values)), out=envelope)
    return scans, count >= whole / 2, envelope


def _windows(times_s: np.ndarray, config: TdoaDetectionConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of the scans [s] around which something was recorded; first and one-past-last frame of each."""
    first = np.ceil(times_s[0] / config.scan_step_s - 1e-9)
    last = np.floor(times_s[-1] / config.scan_step_s + 1e-9)
    scans = config.scan_step_s * np.arange(first, last + 1)
    left = np.searchsorted(times_s, scans - config.stack_s / 2 - 1e-6)
    right = np.searchsorted(times_s, scans + config.stack_s / 2 + 1e-6)
    recorded = right > left
    return scans[recorded], left[recorded], right[recorded]


def _matched_band(size: int, step_s: float, config: TdoaDetectionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and the response of analytic signal and matched pulse; zero where it is below −80 dB."""
    frequency = scipy.fft.fftfreq(size, step_s)
    response = np.where(frequency > 0, 2.0, 0.0)
    if config.pulse_width_s > 0:
        detuning = 2.0 * np.pi * config.pulse_width_s * (frequency - config.centre_frequency_hz)
        response = response * np.exp(-0.5 * detuning**2)
    return frequency, np.where(response > 1e-4, response, 0.0)


def _drifts(config: TdoaDetectionConfig) -> np.ndarray:
    """Slopes [s/s], spaced so that the window's ends are at most 1/8 period of the pulse out of phase with
    one of them.
    """
    spacing = 0.5 / (config.stack_s * max(config.centre_frequency_hz, 1.0))
    half = int(np.ceil(config.max_drift / spacing))
    return spacing * np.arange(-half, half + 1)


def _stack(
    spectrum: np.ndarray,
    slope_hz: np.ndarray,
    times_s: np.ndarray,
    scans_s: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
) -> np.ndarray:
    origin = times_s[0]
    ramped = spectrum * np.exp(2j * np.pi * np.outer(slope_hz, times_s - origin))
    total = np.concatenate([np.zeros((len(ramped), 1)), np.cumsum(ramped, axis=1)], axis=1)
    return (total[:, right] - total[:, left]) * np.exp(-2j * np.pi * np.outer(slope_hz, scans_s - origin))


def _modulus(band: np.ndarray, inside: np.ndarray, rows: int) -> np.ndarray:
    full = np.zeros((len(inside), band.shape[1]), complex)
    full[inside] = band
    return np.abs(scipy.fft.ifft(full, axis=0)[:rows])


def running_median(
    values: np.ndarray,
    times_s: np.ndarray,
    valid: np.ndarray,
    half_rows: int,
    half_time_s: float,
    first: int,
    stop: int,
) -> np.ndarray:
    """Median of the valid values in a window around each cell, dims (quefrency from `first` to `stop`, time).

    It is taken at every quarter of the window over quefrency and interpolated between; windows are cut at the
    edges.
    """
    stride = max(1, half_rows // 2)
    centres = np.unique(np.append(np.arange(first, stop, stride), stop - 1))
    left = np.searchsorted(times_s, times_s - half_time_s - 1e-6)
    right = np.searchsorted(times_s, times_s + half_time_s + 1e-6)
    frames = np.ascontiguousarray(values.T)
    coarse = _median_windows(frames, valid, centres, half_rows, left, right)
    rows = np.arange(first, stop)
    upper = np.clip(np.searchsorted(centres, rows, side="right"), 1, max(len(centres) - 1, 1))
    lower = upper - 1
    part = (rows - centres[lower]) / (centres[upper] - centres[lower])
    return coarse[lower] * (1.0 - part)[:, None] + coarse[upper] * part[:, None]


def _peaks(
    envelope: np.ndarray, floor: np.ndarray, valid: np.ndarray, first: int, stop: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, frames and sub-sample shifts (parabola through three samples) of the peaks above the floor, by
    frame.
    """
    low, high = max(first, 1), min(stop, len(envelope) - 1)
    middle, before, after = envelope[low:high], envelope[low - 1 : high - 1], envelope[low + 1 : high + 1]
    found = (middle > before) & (middle >= after) & (middle > floor[low - first : high - first]) & valid
    frames, rows = np.nonzero(found.T)
    before, middle, after = before[rows, frames], middle[rows, frames], after[rows, frames]
    shift = 0.5 * (before - after) / (before - 2.0 * middle + after)
    return rows + low, frames, shift


def _checked(
    values: np.ndarray, quefrency_s: np.ndarray, times_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    values = np.asarray(values, float)
    quefrency, times = np.asarray(quefrency_s, float), np.asarray(times_s, float)
    if values.shape != (len(quefrency), len(times)):
        raise LayoutError(
            f"a cepstrogram must have dims (quefrency, time) = ({len(quefrency)}, {len(times)}), "
            f"found {values.shape}"
        )
    if not len(times):
        raise LayoutError("the cepstrogram holds no frame; nothing can be detected in it")
    steps = np.diff(quefrency)
    if len(steps) < 2 or not (steps[0] > 0 and np.allclose(steps, steps[0], rtol=1e-3)):
        raise LayoutError("the quefrency axis must be uniform and increasing, with three points at least")
    if not (np.diff(times) > 0).all():
        raise LayoutError("the cepstrogram's times must increase")
    return values, quefrency, times


@njit(cache=True, nogil=True)
def _median_windows(frames, valid, centres, half_rows, left, right):
    n_time, n_rows = frames.shape
    medians = np.zeros((len(centres), n_time))
    widest = 0
    for t in range(n_time):
        widest = max(widest, right[t] - left[t])
    window = np.empty(widest * (2 * half_rows + 1))
    for t in range(n_time):
        for place in range(len(centres)):
            top, bottom = max(centres[place] - half_rows, 0), min(centres[place] + half_rows + 1, n_rows)
            count = 0
            for frame in range(left[t], right[t]):
                if valid[frame]:
                    for row in range(top, bottom):
                        window[count] = frames[frame, row]
                        count += 1
            if count > 0:
                medians[place, t] = np.median(window[:count])
    return medians
