import io

import numpy as np
import pytest

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.trackers.bernoulli import AzimuthTracker, AzimuthTrackerConfig, intervals, tempered, track_azimuth

AZIMUTH = np.arange(0.0, 360.0, 2.0)
MINUTES = np.arange(180) * 60.0
PASSAGE = StraightCourse(cpa_time=90 * 60.0, cpa_range_m=-6000.0, course_deg=80.0, speed_mps=6.0)


def azimuth_map(rng, heard=(40, 140), concentration=20.0):
    """Wrapped-normal bumps about the passing ship while it is heard, ratios of mean one before and after."""
    truth = PASSAGE.observables(MINUTES)[0]
    seen = truth + 4.0 * rng.normal(size=len(truth))
    absent = (np.arange(len(truth)) < heard[0]) | (np.arange(len(truth)) >= heard[1])
    bump = concentration * (np.cos(np.deg2rad(AZIMUTH - seen[:, None])) - 1.0) + 0.5 * np.log(
        2 * np.pi * concentration
    )
    noise = 1.5 * rng.normal(size=(len(truth), len(AZIMUTH))) - 1.125
    llr = 3.0 * np.where(absent[:, None], noise, np.maximum(bump, -3.0))
    return truth, llr


def test_a_ship_is_confirmed_followed_across_north_and_let_go():
    truth, llr = azimuth_map(np.random.default_rng(1))
    assert truth.min() < 5.0 and truth.max() > 355.0
    track = track_azimuth(MINUTES, llr, AZIMUTH)
    assert (track.existence[:40] < 0.5).all()
    assert (track.existence[50:140] > 0.9).all()
    assert track.existence[-1] < 0.1
    error = wrap180(track.azimuth_deg - truth)[50:140]
    assert np.sqrt(np.mean(error**2)) < 3.0
    assert np.abs(error / track.azimuth_std_deg[50:140]).mean() < 1.5


def test_the_filter_is_causal():
    llr = azimuth_map(np.random.default_rng(2))[1]
    whole, begun = track_azimuth(MINUTES, llr, AZIMUTH), track_azimuth(MINUTES[:70], llr[:70], AZIMUTH)
    np.testing.assert_array_equal(whole.existence[:70], begun.existence)
    np.testing.assert_array_equal(whole.azimuth_deg[:70], begun.azimuth_deg)


def test_a_gap_widens_the_estimate_and_the_ship_is_found_again():
    truth, llr = azimuth_map(np.random.default_rng(3))
    llr[80:100] = np.nan
    track = track_azimuth(MINUTES, llr, AZIMUTH)
    assert track.azimuth_std_deg[99] > 2 * track.azimuth_std_deg[79]
    assert track.existence[99] < track.existence[79]
    assert (track.existence[103:140] > 0.9).all()
    assert np.abs(wrap180(track.azimuth_deg - truth))[103:140].max() < 10.0


def test_missing_rows_are_gaps():
    llr = azimuth_map(np.random.default_rng(4))[1]
    gap = llr.copy()
    gap[80:100] = np.nan
    kept = np.r_[0:80, 100:180]
    with_rows, without = (
        track_azimuth(MINUTES, gap, AZIMUTH),
        track_azimuth(MINUTES[kept], llr[kept], AZIMUTH),
    )
    np.testing.assert_array_equal(with_rows.existence[kept], without.existence)


def test_a_restarted_tracker_goes_on_as_if_it_had_never_stopped():
    llr = azimuth_map(np.random.default_rng(5))[1]
    tracker = AzimuthTracker(AZIMUTH, seed=7)
    for row in llr[:60]:
        tracker.step(row)
    file = io.BytesIO()
    np.savez(file, **tracker.state_dict())
    file.seek(0)
    restarted = AzimuthTracker.from_state_dict(dict(np.load(file, allow_pickle=False)))
    for row in llr[60:]:
        assert tracker.step(row) == restarted.step(row)
    assert tracker.azimuth == restarted.azimuth and tracker.confirmed == restarted.confirmed


def test_turning_the_map_turns_the_track():
    llr = azimuth_map(np.random.default_rng(6))[1]
    track = track_azimuth(MINUTES, llr, AZIMUTH)
    turned = track_azimuth(MINUTES, np.roll(llr, 45, axis=1), AZIMUTH)
    np.testing.assert_allclose(turned.existence[50:140], track.existence[50:140], atol=0.05)
    turn = wrap180(turned.azimuth_deg - track.azimuth_deg - 90.0)[50:140]
    assert np.abs(turn).max() < 2.0


def test_a_map_without_a_ship_confirms_none():
    rng = np.random.default_rng(7)
    llr = 3.0 * (1.5 * rng.normal(size=(500, len(AZIMUTH))) - 1.125)
    assert track_azimuth(np.arange(500) * 60.0, llr, AZIMUTH).existence.max() < 0.5


def test_a_sector_that_does_not_close_bounds_the_azimuth():
    sector = np.arange(-60.0, 61.0, 2.0)
    llr = np.tile(10.0 * np.exp(-0.5 * ((sector - 55.0) / 5.0) ** 2) - 3.0, (20, 1))
    track = track_azimuth(np.arange(20) * 60.0, llr, sector)
    assert track.existence[-1] > 0.9
    assert abs(wrap180(track.azimuth_deg[-1] - 55.0)) < 3.0


def test_tempering_bounds_what_a_minute_can_take_and_unknown_cells_say_nothing():
    values = tempered(np.array([-1e6, 0.0, 300.0, np.nan]), 1 / 3, 0.9)
    np.testing.assert_allclose(values, [np.log(0.1), 0.0, 100.0 + np.log(0.9), 0.0], atol=1e-12)
    assert tempered(np.array([-2.0]), 1.0, 1.0)[0] == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 60.0], "3 rows"),
        ([0.0, 90.0, 180.0], "whole intervals"),
        ([0.0, 60.0, 60.0], "whole intervals"),
    ],
)
def test_irregular_times_are_refused(times, message):
    with pytest.raises(LayoutError, match=message):
        track_azimuth(np.array(times), np.zeros((3, len(AZIMUTH))), AZIMUTH)


def test_intervals_count_missing_rows_up_to_a_day():
    assert intervals(np.array([0.0, 60.0, 240.0, 1e7 * 60]), 4, 60.0).tolist() == [1, 1, 3, 1440]


def test_rows_and_states_that_do_not_fit_are_refused():
    tracker = AzimuthTracker(AZIMUTH)
    with pytest.raises(LayoutError, match=r"180 log-likelihood ratios below infinity, found shape \(3,\)"):
        tracker.step(np.zeros(3))
    with pytest.raises(LayoutError, match="below infinity"):
        tracker.step(np.full(len(AZIMUTH), np.inf))
    with pytest.raises(LayoutError, match="lacks states"):
        AzimuthTracker.from_state_dict({k: v for k, v in tracker.state_dict().items() if k != "states"})
    with pytest.raises(ConfigError, match="detection_probability"):
        AzimuthTrackerConfig(detection_probability=0.0)
