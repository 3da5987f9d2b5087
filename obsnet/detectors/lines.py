"""Spectral lines above a ship's broad spectrum: what machinery leaves in a spectrogram of full resolution."""

from __future__ import annotations

import numpy as np
import xarray as xr

from obsnet.detectors.maps import window_bounds
from obsnet.layout import from_posix, to_posix
from obsnet.signals.held import power_of

BAND_HZ = (3.0, 24.0)
BROAD_BINS = 24
"""Bins whose median is the broad spectrum: six times a line's width, less than a cycle of the paths' interference."""


def line_power(spectra: xr.Dataset) -> xr.DataArray:
    """Power of the pressure (or of the ground motion without one) in the band of lines, (line_frequency, time) float32."""
    values = power_of(spectra)
    frequency = spectra["frequency"].values
    band = slice(*np.searchsorted(frequency, BAND_HZ))
    power = values.values[band].real ** 2 + values.values[band].imag ** 2
    coords = {"line_frequency": frequency[band], "time": spectra["time"].values}
    return xr.DataArray(power, coords, ("line_frequency", "time"), "line_power")


def line_level(power: xr.DataArray, minutes: np.ndarray, window_s: float) -> xr.DataArray:
    """Log power of lines over the broad spectrum, mean over the window of each minute.

    Parameters
    ----------
    power : DataArray (line_frequency, time) of `line_power`; NaN in gaps.
    minutes : s since 1970. window_s : s.

    Returns
    -------
    DataArray (time, line_frequency) float32 [nats], NaN for a minute without frames.
    """
    frames = np.ascontiguousarray(power.values.T)
    valid = ~np.isnan(frames[:, 0])
    mean = np.full((len(minutes), frames.shape[1]), np.nan, np.float32)
    for i, (first, last) in enumerate(
        zip(*window_bounds(to_posix(power["time"].values), minutes, window_s), strict=True)
    ):
        heard = frames[first:last][valid[first:last]]
        if len(heard):
            mean[i] = heard.mean(axis=0)
    level = np.log(np.maximum(mean, np.finfo(np.float32).tiny))
    if len(minutes):
        level -= _broad(level)
    coords = {"time": from_posix(minutes), "line_frequency": power["line_frequency"].values}
    attrs = {"long_name": "log power of spectral lines over the broad spectrum", "units": "1"}
    return xr.DataArray(level, coords, ("time", "line_frequency"), "line_level", attrs)


def _broad(level: np.ndarray) -> np.ndarray:
    """Broad spectrum of each row: medians of stretches that overlap by half, linear between their middles."""
    count = level.shape[1]
    size = min(BROAD_BINS, count)
    first = np.unique(np.append(np.arange(0, count - size + 1, max(size // 2, 1)), count - size))
    medians = np.stack([np.median(level[:, at : at + size], axis=1) for at in first], axis=1)
    middle = first + (size - 1) / 2
    place = np.clip(np.arange(count), middle[0], middle[-1])
    above = np.clip(np.searchsorted(middle, place), 1, max(len(middle) - 1, 1))
    if len(middle) == 1:
        return np.repeat(medians, count, axis=1)
    share = ((place - middle[above - 1]) / (middle[above] - middle[above - 1])).astype(np.float32)
    return medians[:, above - 1] * (1 - share) + medians[:, above] * share
