import numpy as np
import pytest

from obsnet.errors import LayoutError
from obsnet.trackers.azimuth_grid import AzimuthGrid


def test_reading_around_the_circle_is_periodic_interpolation():
    azimuth = np.arange(0.5, 360.0, 3.0)
    row = np.random.default_rng(1).normal(size=len(azimuth))
    read = np.random.default_rng(2).uniform(-720.0, 720.0, 500)
    np.testing.assert_allclose(AzimuthGrid(azimuth)(row, read), np.interp(read, azimuth, row, period=360.0))


def test_reading_a_sector_is_interpolation_inside_and_impossible_outside():
    azimuth = np.linspace(-90.0, 90.0, 181)
    row = np.random.default_rng(3).normal(size=181)
    grid = AzimuthGrid(azimuth)
    read = np.array([-90.0, -12.3, 90.0])
    np.testing.assert_allclose(grid(row, read), np.interp(read, azimuth, row))
    assert (grid(row, np.array([-90.01, 270.0, np.nan])) == -np.inf).all()


@pytest.mark.parametrize("azimuth", [[0.0], [0.0, 1.0, 3.0], [2.0, 1.0], np.arange(0.0, 400.0, 10.0)])
def test_other_grids_are_refused(azimuth):
    with pytest.raises(LayoutError, match="azimuths of a map"):
        AzimuthGrid(np.asarray(azimuth))
