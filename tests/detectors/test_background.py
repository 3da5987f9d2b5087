"""The background's direction: what has been heard for hours, not the ship that has just come."""

import numpy as np
import pytest
import xarray as xr

from obsnet.detectors.background import BackgroundDirection
from obsnet.layout import from_posix

FREQUENCY, HOP_S = np.arange(5.0, 24.0, 0.5), 10.0
START = 1.6e9 - 1.6e9 % 21600


def azigram(hours, azimuth_deg, begin_h=0.0):
    time = START + 3600.0 * begin_h + HOP_S * np.arange(int(3600 * hours / HOP_S))
    phasor = np.full((len(FREQUENCY), len(time)), np.exp(1j * np.deg2rad(azimuth_deg)), np.complex64)
    return xr.DataArray(
        phasor, dims=("frequency", "time"), coords={"frequency": FREQUENCY, "time": from_posix(time)}
    )


def test_a_ship_that_comes_in_for_half_an_hour_is_not_the_background():
    heard = BackgroundDirection(21600.0, 600.0, 3600.0)(azigram(0.5, 40.0))
    assert np.abs(heard).max() < 0.3


def test_what_lasts_is_the_background():
    heard = BackgroundDirection(21600.0, 600.0, 3600.0)(azigram(7.0, 40.0))
    assert np.abs(heard[:, -1]) == pytest.approx(6 / 7, abs=0.01)
    assert np.rad2deg(np.angle(heard[:, -1])) == pytest.approx(40.0, abs=0.01)


def test_any_split_gives_the_same():
    whole = BackgroundDirection(21600.0, 600.0, 3600.0)(azigram(3.0, 40.0))
    cut = BackgroundDirection(21600.0, 600.0, 3600.0)
    parts = [azigram(1.25, 40.0), azigram(1.75, 40.0, begin_h=1.25)]
    np.testing.assert_array_equal(whole, np.concatenate([cut(part) for part in parts], axis=1))
