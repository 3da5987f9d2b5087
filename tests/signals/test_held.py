"""Frames held between blocks: a minute's mean is of its own frames, whatever came before."""

import numpy as np
import pytest
import xarray as xr

from obsnet.layout import from_posix
from obsnet.signals.held import per_minute

MINUTES = 1_369_094_400.0 + 60.0 * np.arange(1, 31)


def frames(dtype=np.float32, seed=0):
    """Half an hour of frames every 10.24 s of 8 bins, a gap of three minutes in it."""
    time = 1_369_094_400.0 + 10.24 * np.arange(177)
    values = np.random.default_rng(seed).exponential(1.0, (8, time.size)).astype(dtype)
    values[:, (time > MINUTES[9] + 30) & (time < MINUTES[12] + 30)] = np.nan
    return xr.DataArray(values, {"bin": np.arange(8.0), "time": from_posix(time)}, ("bin", "time"), "power")


def mean_of(held, minute):
    time = held["time"].values
    low, high = from_posix(np.array([minute - 30.0, minute + 30.0]))
    own = held.values[:, (time >= low) & (time < high)]
    own = own[:, ~np.isnan(own[0])]
    return own.mean(axis=1) if own.size else np.full(8, np.nan)


@pytest.mark.parametrize("dtype", [np.float32, np.complex64])
def test_a_minute_is_the_mean_of_its_frames(dtype):
    held = frames(dtype)
    later = np.append(MINUTES, MINUTES[-1] + 60.0 * np.arange(1, 4))  # the last have no frame
    got = per_minute(held, later, 60.0)
    expected = np.stack([mean_of(held, minute) for minute in later], axis=1)
    np.testing.assert_allclose(got.values, expected, rtol=1e-6)
    assert np.isnan(got.values).all(axis=0).tolist() == [10 <= i < 13 or i > 29 for i in range(33)]


def test_no_frame_is_no_mean():
    for held in (frames()[:, :0], frames()[:, -1:]):
        assert np.isnan(per_minute(held, MINUTES[:3], 60.0).values).all()


def test_a_loud_minute_changes_no_other():
    held = frames()
    loud = held.copy(deep=True)
    loud.values[:, 7:10] *= np.float32(1e10)
    quiet = slice(5, None)
    np.testing.assert_array_equal(
        per_minute(loud, MINUTES, 60.0)[:, quiet], per_minute(held, MINUTES, 60.0)[:, quiet]
    )
