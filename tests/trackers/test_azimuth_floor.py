"""A floor under a whole azimuth map is no evidence: neither for a ship nor for the next one beside a known ship."""

import numpy as np

from obsnet.detectors.learned import without_floor
from obsnet.trackers.score_maps import above_floor

AZIMUTH = np.arange(360.0)


def rows(floor, *peaks):
    llr = np.full((3, 360), floor, np.float32)
    for azimuth, height in peaks:
        llr = np.maximum(llr, height - 0.5 * abs((AZIMUTH - azimuth + 180) % 360 - 180)).astype(np.float32)
    return llr


def test_a_floor_comes_off_and_a_peak_keeps_its_height_above_it():
    found = without_floor(rows(3.0, (120.0, 10.0)))
    assert np.median(found) == 0.0
    assert found.max() == 7.0 and found[0].argmax() == 120
    silent = rows(-4.0, (120.0, 10.0))
    assert np.array_equal(without_floor(silent), silent)
    assert np.isnan(without_floor(np.full((1, 360), np.nan, np.float32))).all()


def test_beside_a_known_ship_only_what_stands_out_is_a_second_one():
    llr = rows(2.5, (60.0, 11.0), (200.0, 10.0))
    explained = np.broadcast_to(abs(AZIMUTH - 60.0) <= 30.0, llr.shape)
    left = above_floor(np.where(explained, 0.0, llr), explained)
    elsewhere = ~explained & (abs(AZIMUTH - 200.0) > 20.0)
    assert left[elsewhere].max() < 0.0
    assert left[0].argmax() == 200 and left.max() > 4.0


def test_maps_that_deny_a_ship_elsewhere_are_left_alone():
    llr = rows(-30.0, (200.0, 12.0))
    explained = np.zeros(llr.shape, bool)
    assert np.array_equal(above_floor(llr, explained), llr)
    everything = np.ones(llr.shape, bool)
    assert np.array_equal(above_floor(llr, everything), llr)
    missing = np.full((2, 360), np.nan, np.float32)
    assert np.isnan(above_floor(missing, np.zeros(missing.shape, bool))).all()
