"""A ship's passage over shallow water in, the sound at the receiver and the delays detected in it out: what the
focalization paper's recordings were, simulated.

Fields go as exp(+iωt), paths as in the image method: group b has b reflections at the bottom and b − 1 or b at the
surface, and each path a second one from the source's own image in the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import xarray as xr
from scipy.fft import rfft
from scipy.interpolate import CubicSpline

from obsnet.ocean.bottom import Bottom
from obsnet.signals.cepstrogram import cepstrogram
from obsnet.trackers.tdoa_detections import TdoaDetectionConfig, detect_tdoas
from obsnet.twin.noise import below_nyquist, gaussian_noise
from obsnet.twin.propagate import INTERPOLATOR, OVERSAMPLING, sample_at
from obsnet.twin.ship import MICROPASCAL

SILT = Bottom(p_speed_mps=1575.0, s_speed_mps=80.0, density_kgm3=1700.0, water_density_kgm3=1000.0)
"""Silt of Jensen et al. 2011, Computational Ocean Acoustics, table 1.3."""

KNOTS_PER_S = 20
LEAD_S = 4.0
"""The source's sound begins this long before the record: longer than any path takes."""


@dataclass(frozen=True)
class Sound:
    """Source, sea and recording.

    Parameters
    ----------
    source_level_db : one-sided PSD at 1 kHz, dB re 1 µPa²/Hz at 1 m (monopole); flat below `knee_hz` and falling
        by 20 dB a decade above.
    source_depth_m : m, where the propeller makes the noise; the tracker takes the source to be at the surface.
    noise_level_db : PSD of the sea's noise at 1 kHz, dB re 1 µPa²/Hz, falling by 17 dB a decade from 100 Hz on.
    bottom, bounces : the sea floor, and at most how many reflections there a path has.
    sampling_rate, window_s : Hz, s; frames overlap by three quarters.
    """

    source_level_db: float
    source_depth_m: float
    knee_hz: float = 300.0
    noise_level_db: float = 62.0
    bottom: Bottom = SILT
    bounces: int = 6
    sampling_rate: float = 6000.0
    window_s: float = 0.512

    def source_amplitude(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Spectral amplitude at 1 m [Pa/√Hz], one-sided, limited to the recording's band."""
        power = (1.0 + (1000.0 / self.knee_hz) ** 2) / (1.0 + (frequency_hz / self.knee_hz) ** 2)
        level = MICROPASCAL * 10 ** (self.source_level_db / 20) * np.sqrt(power)
        return level * below_nyquist(frequency_hz, self.sampling_rate)

    def noise_amplitude(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Spectral amplitude of the sea's noise [Pa/√Hz], one-sided."""
        fall = (np.maximum(frequency_hz, 100.0) / 1000.0) ** -0.85
        return MICROPASCAL * 10 ** (self.noise_level_db / 20) * fall


def record(
    time_s: np.ndarray,
    range_m: np.ndarray,
    receiver_m: np.ndarray,
    water_depth_m: float,
    sound_speed_mps: float,
    sound: Sound,
    seed: tuple[int, ...],
) -> np.ndarray:
    """Pressure at the receiver [Pa], dims (sample,), from half a scan before the first to half a scan after the last.

    Parameters
    ----------
    time_s, range_m, receiver_m : arrays, dims (scan,): uniform times, range of the source, the receiver's depth.
    seed : names the realisation of source and sea.

    Notes
    -----
    A path of length q reflected b times at the bottom adds Re{(−1)^s R(p)^b a(t − q/c)/q}, a the source's analytic
    signal, R the bottom's reflection coefficient at the path's slowness p, s its reflections at the surface, the
    source's image included. Range and depth are those of the moment of arrival: at most 2 s × 6 m/s off, the same
    for all paths of a moment.
    """
    rate, scan_s = sound.sampling_rate, float(time_s[1] - time_s[0])
    count = round((time_s[-1] - time_s[0] + scan_s) * rate)
    step = round(rate / KNOTS_PER_S)
    knots_s = np.arange((count - 1) // step + 2) * (step / rate)
    at = time_s[0] - scan_s / 2 + knots_s
    distance, depth = CubicSpline(time_s, range_m)(at), CubicSpline(time_s, receiver_m)(at)
    source = gaussian_noise(
        (*seed, 0),
        0,
        round((knots_s[-1] + 2 * LEAD_S) * OVERSAMPLING * rate),
        OVERSAMPLING * rate,
        lambda frequency, variates: variates * sound.source_amplitude(frequency).astype(np.float32),
        analytic=True,
    )[0]
    pressure = gaussian_noise(
        (*seed, 1),
        0,
        count,
        rate,
        lambda frequency, variates: variates * sound.noise_amplitude(frequency).astype(np.float32),
    )[0].astype(float)
    for bottom, surface, image in _images(water_depth_m, depth, sound.bounces):
        for dipole in (0, 1):
            lengths = np.hypot(distance, image - (1 - 2 * dipole) * sound.source_depth_m)
            slowness = np.minimum(distance / lengths, 1.0 - 1e-9) / sound_speed_mps
            strength = sound.bottom.reflection(slowness, sound_speed_mps) ** bottom / lengths
            if (surface + dipole) % 2:
                strength = -strength
            position = (knots_s - lengths / sound_speed_mps + LEAD_S) * OVERSAMPLING * rate
            _add_path(pressure, source, position, strength.astype(np.complex128), step, INTERPOLATOR)
    return pressure


@dataclass(frozen=True)
class Heard:
    """Delays detected in a record [s], scan by scan, None where there is no scan; and the cepstral amplitude,
    dims (quefrency,), that a peak must exceed to be detected at each quefrency [s].
    """

    scans: list[np.ndarray | None]
    quefrency_s: np.ndarray
    floor: np.ndarray


def detect(pressure: np.ndarray, time_s: np.ndarray, sound: Sound, tdoa_s: tuple[float, float]) -> Heard:
    """Delays detected in a record.

    The mean cepstrum of the record is subtracted (Ferguson et al. 2019), which takes the source's own spectrum away.
    """
    rate, scan_s = sound.sampling_rate, float(time_s[1] - time_s[0])
    values, quefrency, middle = _cepstra(pressure, rate, round(sound.window_s * rate))
    kept = quefrency < 1.1 * tdoa_s[1]
    config = TdoaDetectionConfig(
        min_tdoa_s=tdoa_s[0],
        max_tdoa_s=tdoa_s[1],
        centre_frequency_hz=1000.0,
        pulse_width_s=0.0,
        stack_s=scan_s,
        scan_step_s=scan_s,
        max_drift=7.5e-4,
        background_tdoa_s=0.02,
        background_time_s=60.0,
        threshold=2.0,
        cluster_tdoa_s=2e-3,
        cluster_time_s=7.0,
        cluster_points=3,
    )
    values = values[kept] - values[kept].mean(axis=1, keepdims=True)
    found = detect_tdoas(values, quefrency[kept], middle - scan_s / 2, config)
    scans = {round(float(at) / scan_s): i for i, at in enumerate(found.times_s)}
    wanted = [round(float(at - time_s[0]) / scan_s) for at in time_s]
    listed = [found.scan(scans[number]) if number in scans else None for number in wanted]
    return Heard(listed, found.quefrency_s, found.floor)


def _cepstra(pressure: np.ndarray, rate: float, nperseg: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cepstra, dims (quefrency, frame), quefrencies [s] and middles of the frames since the first sample [s]."""
    begins = np.arange(0, len(pressure) - nperseg + 1, nperseg // 4)
    frames = np.lib.stride_tricks.sliding_window_view(pressure.astype(np.float32), nperseg)[begins]
    spectra = rfft(frames * np.hanning(nperseg).astype(np.float32), axis=1)
    middle = (begins + nperseg / 2) / rate
    dataset = xr.Dataset(
        {"p": (("frequency", "time"), spectra.T)},
        {"frequency": np.arange(nperseg // 2 + 1) * (rate / nperseg), "time": middle},
    )
    cepstra = cepstrogram(dataset)
    return cepstra.values, cepstra["quefrency"].values, middle


def _images(water_depth_m: float, depth_m: np.ndarray, bounces: int) -> list[tuple[int, int, np.ndarray]]:
    """Reflections at the bottom and at the surface of each path, and its image of the receiver [m]."""
    images = [(0, 0, depth_m)]
    for bottom in range(1, bounces + 1):
        images.append((bottom, bottom - 1, 2 * bottom * water_depth_m - depth_m))
        images.append((bottom, bottom, 2 * bottom * water_depth_m + depth_m))
    return images


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_path(pressure, signal, position, strength, step, table):  # type: ignore[no-untyped-def]
    for m in range(position.size - 1):
        for i in range(m * step, min((m + 1) * step, pressure.size)):
            w = (i - m * step) / step
            real, imag = sample_at(signal, position[m] + (position[m + 1] - position[m]) * w, table)
            a = strength[m] + (strength[m + 1] - strength[m]) * w
            pressure[i] += a.real * real - a.imag * imag
