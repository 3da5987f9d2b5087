"""Levels of spectral lines over the broad spectrum."""

import numpy as np
import xarray as xr

from obsnet.detectors.lines import BAND_HZ, line_level, line_power
from obsnet.layout import from_posix

HOP_S = 10.24
FREQUENCY = np.arange(513) / 20.48
MINUTES = 60.0 * np.arange(2, 9)


def spectra(rng, tone_hz=12.5, tone=3.0, count=60):
    noise = rng.standard_normal((513, count)) + 1j * rng.standard_normal((513, count))
    values = noise / np.maximum(FREQUENCY, 0.05)[:, None]
    cell = int(np.argmin(np.abs(FREQUENCY - tone_hz)))
    values[cell] *= tone
    coords = {"frequency": FREQUENCY, "time": from_posix(HOP_S * np.arange(count))}
    return xr.Dataset({"p": (("frequency", "time"), values.astype(np.complex64))}, coords)


def test_a_tone_stands_out_of_a_sloping_spectrum_and_nothing_else_does():
    level = line_level(line_power(spectra(np.random.default_rng(0), tone=6.0, count=120)), MINUTES, 180.0)
    assert level.dims == ("time", "line_frequency") and level.dtype == np.float32
    frequency = level["line_frequency"].values
    assert frequency[0] >= BAND_HZ[0] and frequency[-1] <= BAND_HZ[1]
    at = np.argmin(np.abs(frequency - 12.5))
    np.testing.assert_allclose(level[:, at], np.log(36.0), atol=1.2)
    others = np.delete(level.values, at, axis=1)
    assert abs(np.median(others)) < 0.05 and others.max() < 1.5


def test_minutes_of_a_gap_are_not_known_and_frames_of_one_are_left_out():
    power = line_power(spectra(np.random.default_rng(1)))
    power[:, 10:40] = np.nan  # 102 to 410 s
    level = line_level(power, np.array([60.0, 240.0, 360.0, 500.0]), 180.0)
    known = np.isfinite(level.values).all(axis=1)
    np.testing.assert_array_equal(known, [True, False, True, True])
    assert np.isnan(level.values[1]).all()


def test_levels_do_not_depend_on_how_the_record_is_cut():
    power = line_power(spectra(np.random.default_rng(2)))
    whole = line_level(power, MINUTES, 180.0)
    part = line_level(power[:, 12:55], MINUTES[3:6], 180.0)
    np.testing.assert_array_equal(whole[3:6], part)


def test_without_a_hydrophone_the_ground_motion_serves():
    of_p = spectra(np.random.default_rng(3))
    level = line_level(line_power(of_p.rename(p="down")), MINUTES, 180.0)
    np.testing.assert_array_equal(level, line_level(line_power(of_p), MINUTES, 180.0))
