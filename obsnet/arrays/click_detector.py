"""Clicks on several hydrophones: samples in, arrival times of the same click on each hydrophone out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.fft import irfft, rfft
from scipy.ndimage import uniform_filter1d
from scipy.signal import find_peaks
from scipy.signal.windows import hann
from scipy.stats import chi2

from obsnet.arrays.recording import Recording
from obsnet.errors import ConfigError

BLOCK_FRAMES = 2000
SECOND_ARRIVAL = 0.1
ENVELOPE_S = 0.001


@dataclass(frozen=True)
class DetectorConfig:
    """Octave-band energy detector with an adaptive threshold, and coincidence between hydrophones.

    Attributes
    ----------
    window_s, hop_s : length of the sliding window and its step, s.
    first_octave_hz, last_octave_hz : centres of the lowest and the highest octave, Hz; by default the highest
        below the Nyquist frequency.
    false_alarm : probability that a window of Gaussian noise exceeds the threshold of one octave.
    margin : threshold above the background as a share of it; replaces the one set by `false_alarm`.
    memory_s : time constant of the background, s; 0 takes the last window without a detection.
    longest_s : a detection lasting longer is a change of level: the background starts again from it.
    dead_time_s : arrivals of one hydrophone are at least this far apart, s.
    coincidence_s : arrivals of one click lie within this on all hydrophones, s (never less than the array's
        own width).
    min_hydrophones : hydrophones on which a click must be detected; by default all.

    The paper's own rule, a threshold 10 % above the last quiet window, is ``margin=0.1, memory_s=0``. In
    noise alone an octave with B·T = 90 scatters by as much as those 10 %, which is why the default asks for a
    false-alarm probability instead.
    """

    window_s: float = 0.020
    hop_s: float = 0.005
    first_octave_hz: float = 100.0
    last_octave_hz: float | None = None
    false_alarm: float = 1e-3
    margin: float | None = None
    memory_s: float = 2.0
    longest_s: float = 1.0
    dead_time_s: float = 0.010
    coincidence_s: float = 0.005
    min_hydrophones: int | None = None

    def __post_init__(self) -> None:
        for name in ("window_s", "hop_s", "first_octave_hz", "longest_s", "dead_time_s", "coincidence_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name} must be positive, found {value!r}")
        if self.hop_s > self.window_s:
            raise ConfigError(f"hop_s must not exceed window_s = {self.window_s}, found {self.hop_s}")
        if not 0.0 < self.false_alarm < 0.5:
            raise ConfigError(f"false_alarm must lie between 0 and 0.5, found {self.false_alarm!r}")
        if self.margin is not None and not self.margin > 0:
            raise ConfigError(f"margin must be positive, found {self.margin!r}")
        if not self.memory_s >= 0:
            raise ConfigError(f"memory_s must be at least 0, found {self.memory_s!r}")
        if self.min_hydrophones is not None and self.min_hydrophones < 2:
            raise ConfigError(f"min_hydrophones must be at least 2, found {self.min_hydrophones!r}")

    def octaves(self, sampling_rate: float) -> list[tuple[float, float]]:
        """Edges [Hz] of the octaves, the last one cut at the Nyquist frequency.

        Raises
        ------
        ConfigError
            No octave lies below the Nyquist frequency, or the first one is narrower than the window resolves.
        """
        nyquist = sampling_rate / 2.0
        top = nyquist if self.last_octave_hz is None else min(self.last_octave_hz * 1.001, nyquist)
        if not self.first_octave_hz < top:
            raise ConfigError(
                f"the octaves must start below {top:g} Hz at a sampling rate of {sampling_rate:g} Hz, found "
                f"first_octave_hz = {self.first_octave_hz:g}"
            )
        if self.first_octave_hz * self.window_s < 1.5:
            raise ConfigError(
                f"a window of {self.window_s:g} s cannot resolve the octave at {self.first_octave_hz:g} Hz; "
                f"raise first_octave_hz to {1.5 / self.window_s:g} or lengthen window_s"
            )
        count = int(np.ceil(np.log2(top / self.first_octave_hz)))
        centres = self.first_octave_hz * 2.0 ** np.arange(max(count, 1))
        return [(centre / np.sqrt(2.0), min(centre * np.sqrt(2.0), nyquist)) for centre in centres]


@dataclass(frozen=True)
class Arrival:
    """Detection on one hydrophone: time from the record's start [s], octaves that exceeded, SNR [dB] there."""

    time: float
    hydrophone: int
    octaves: frozenset[int]
    snr_db: float


def octave_energies(recording: Recording, config: DetectorConfig) -> tuple[np.ndarray, np.ndarray]:
    """Energy of sliding Hann windows by octave (paper's eq. 1 in each), and noise's degrees of freedom.

    Returns
    -------
    energy : float32 array (window, hydrophone, octave); window k starts at sample k·hop; NaN in gaps.
    freedom : array (octave,), degrees of freedom of the χ² that the energy of white noise follows.
    """
    size, hop = _samples(recording, config)
    bands = config.octaves(recording.sampling_rate)
    frames = max((recording.length - size) // hop + 1, 0)
    edges = np.array([int(np.ceil(low * size / recording.sampling_rate)) for low, _ in bands])
    end = min(int(np.ceil(bands[-1][1] * size / recording.sampling_rate)), size // 2)
    bins = np.diff(np.append(edges, end)).astype(float)
    if not np.all(bins > 0):
        raise ConfigError(
            f"an octave of {config} holds no frequency at {recording.sampling_rate:g} Hz; widen window_s"
        )
    taper = hann(size, sym=False).astype(np.float32)
    energy = np.empty((frames, recording.count, len(bands)), np.float32)
    for first in range(0, frames, BLOCK_FRAMES):
        last = min(first + BLOCK_FRAMES, frames)
        samples = recording.segment(first * hop, (last - 1) * hop + size, np.float32)
        for hydrophone, series in enumerate(samples):
            windows = np.lib.stride_tricks.sliding_window_view(series, size)[::hop]
            spectra = rfft(windows * taper, axis=1)[:, :end]
            power = spectra.real**2 + spectra.imag**2
            energy[first:last, hydrophone] = np.add.reduceat(power, edges, axis=1)
    neighbours = bins + 2.0 * (4.0 / 9.0) * np.maximum(bins - 1, 0) + 2.0 / 36.0 * np.maximum(bins - 2, 0)
    return energy, 2.0 * bins**2 / neighbours


def exceedances(
    energy: np.ndarray, freedom: np.ndarray, hop_s: float, config: DetectorConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Windows and octaves above the adaptive threshold of one hydrophone.

    The background follows the energy with `memory_s` and is frozen in all octaves while one of them exceeds.

    Parameters
    ----------
    energy : array (window, octave); NaN in gaps.
    freedom : array (octave,)

    Returns
    -------
    over : bool array (window, octave)
    background : array (window, octave), against which each window was held.
    """
    energy = np.asarray(energy, np.float64)
    if not len(energy):
        return np.zeros(energy.shape, bool), np.zeros(energy.shape)
    if config.margin is None:
        ratio = chi2.isf(config.false_alarm, freedom) / freedom
    else:
        ratio = np.full(energy.shape[1], 1.0 + config.margin)
    opening = energy[: max(int(max(config.memory_s, hop_s) / hop_s), 1)]
    present = np.isfinite(opening).all(axis=1)
    start = np.median(opening[present], axis=0) if present.any() else np.full(energy.shape[1], np.nan)
    background = start * freedom / chi2.median(freedom)
    pace = 1.0 if config.memory_s == 0 else 1.0 - np.exp(-hop_s / config.memory_s)
    return _adapt(energy, background, ratio, pace, max(int(config.longest_s / hop_s), 1))


def arrivals(recording: Recording, config: DetectorConfig) -> list[Arrival]:
    """Detections of every hydrophone in the order of time, each placed at the peak of its 1 ms energy."""
    energy, freedom = octave_energies(recording, config)
    size, hop = _samples(recording, config)
    bands = config.octaves(recording.sampling_rate)
    found: list[Arrival] = []
    for hydrophone in range(recording.count):
        over, background = exceedances(energy[:, hydrophone], freedom, hop / recording.sampling_rate, config)
        active = np.concatenate([[False], over.any(axis=1), [False]])
        edges = np.flatnonzero(np.diff(active.astype(np.int8)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            octaves = np.flatnonzero(over[begin:end].any(axis=0))
            start, stop = begin * hop, (end - 1) * hop + size
            filtered = _whitened(
                recording.segment(start, stop)[hydrophone],
                recording.sampling_rate,
                [bands[k] for k in octaves],
                background[begin, octaves] / freedom[octaves],
            )
            for sample, snr_db in _peaks(filtered, recording.sampling_rate, config):
                time = (start + sample) / recording.sampling_rate
                found.append(Arrival(time, hydrophone, frozenset(octaves.tolist()), snr_db))
    return sorted(found, key=lambda arrival: (arrival.time, arrival.hydrophone))


def coincidences(found: Sequence[Arrival], within_s: float, least: int) -> list[list[Arrival]]:
    """Group arrivals into clicks: the first one unused, and the next one on every other hydrophone.

    Parameters
    ----------
    found : arrivals in the order of time.
    within_s : longest time from the first to the last arrival of a click, s.
    least : hydrophones that a click needs.
    """
    clicks, used = [], [False] * len(found)
    for i, first in enumerate(found):
        if used[i]:
            continue
        group = {first.hydrophone: i}
        for j in range(i + 1, len(found)):
            if found[j].time - first.time > within_s:
                break
            if not used[j]:
                group.setdefault(found[j].hydrophone, j)
        if len(group) >= least:
            for j in group.values():
                used[j] = True
            clicks.append([found[j] for j in group.values()])
    return clicks


def _samples(recording: Recording, config: DetectorConfig) -> tuple[int, int]:
    size = round(config.window_s * recording.sampling_rate)
    return size, max(round(config.hop_s * recording.sampling_rate), 1)


def _whitened(
    series: np.ndarray, sampling_rate: float, bands: list[tuple[float, float]], density: np.ndarray
) -> np.ndarray:
    """Samples in the bands, each over its background, so that a loud low octave does not hide the click."""
    spectrum = rfft(np.nan_to_num(series))
    frequency = np.arange(len(spectrum)) * sampling_rate / len(series)
    gain = np.zeros(len(spectrum))
    for (low, high), power in zip(bands, density, strict=True):
        gain[(frequency >= low) & (frequency < high)] = 1.0 / np.sqrt(max(power, 1e-30))
    return irfft(spectrum * gain, len(series))


def _peaks(filtered: np.ndarray, sampling_rate: float, config: DetectorConfig) -> list[tuple[int, float]]:
    """Samples at which the 1 ms energy peaks, and its height [dB] over the stretch's median."""
    envelope = uniform_filter1d(filtered**2, max(round(ENVELOPE_S * sampling_rate), 1), mode="constant")
    top, floor = envelope.max(), np.median(envelope)
    height = max(SECOND_ARRIVAL * top, 5.0 * floor)
    peaks, _ = find_peaks(envelope, height=height, distance=max(round(config.dead_time_s * sampling_rate), 1))
    samples = peaks if len(peaks) else np.array([envelope.argmax()])
    return [(int(k), float(10.0 * np.log10(max(envelope[k], 1e-300) / max(floor, 1e-300)))) for k in samples]


@njit(cache=True, nogil=True)
def _adapt(energy, background, ratio, pace, longest):
    frames, octaves = energy.shape
    over = np.zeros((frames, octaves), np.bool_)
    level = np.empty((frames, octaves))
    running = 0
    for t in range(frames):
        level[t] = background
        finite = True
        for k in range(octaves):
            finite = finite and np.isfinite(energy[t, k])
        if not finite:
            running = 0
            continue
        detected = False
        for k in range(octaves):
            if not np.isfinite(background[k]):
                background[k] = energy[t, k]
            over[t, k] = energy[t, k] > ratio[k] * background[k]
            detected = detected or over[t, k]
        if detected and running < longest:
            running += 1
            continue
        for k in range(octaves):
            if detected:
                background[k] = energy[t, k]
                over[t, k] = False
            else:
                background[k] += pace * (energy[t, k] - background[k])
        running = 0
    return over, level
