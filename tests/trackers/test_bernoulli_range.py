import numpy as np
import pytest

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.trackers.bernoulli_range import StationTracker, StationTrackerConfig, track_station

AZIMUTH = np.arange(0.0, 360.0, 2.0)
RANGE = np.arange(0.0, 30e3, 300.0)
RATE = np.arange(-13.0, 13.5, 1.0)
MINUTES = np.arange(80) * 60.0
PASSAGE = StraightCourse(cpa_time=2400.0, cpa_range_m=4000.0, course_deg=70.0, speed_mps=6.0)


def maps(rng, ghost_m=0.0):
    """Gaussian bumps about the truth, 4 deg, 400 m, 1 m/s wide; a second branch `ghost_m` further."""
    azimuth, distance, rate = PASSAGE.observables(MINUTES)
    azimuth, distance = azimuth + 3.0 * rng.normal(size=80), distance + 200.0 * rng.normal(size=80)
    seen = wrap180(AZIMUTH - azimuth[:, None])
    azimuth_llr = 3.0 * np.maximum(3.5 - 0.5 * (seen / 4.0) ** 2, -2.0)
    near = 0.5 * ((RANGE - distance[:, None]) / 400.0) ** 2
    if ghost_m:
        near = np.minimum(near, 0.5 * ((RANGE - distance[:, None] - ghost_m) / 400.0) ** 2)
    quick = 0.5 * (RATE - rate[:, None]) ** 2
    range_llr = 3.0 * np.maximum(3.5 - near[:, :, None] - quick[:, None, :], -1.0)
    return azimuth_llr, range_llr


def truth():
    east, north = PASSAGE.position(MINUTES)
    course = np.deg2rad(PASSAGE.course_deg)
    velocity = np.tile(PASSAGE.speed_mps * np.array([np.sin(course), np.cos(course)]), (len(MINUTES), 1))
    return np.column_stack([east, north, velocity])


def test_both_maps_give_position_and_velocity_within_the_stated_covariance():
    azimuth_llr, range_llr = maps(np.random.default_rng(1))
    track = track_station(MINUTES, azimuth_llr, AZIMUTH, range_llr, RANGE, RATE)
    assert (track.existence[5:] > 0.9).all()
    error = (track.state - truth())[20:]
    assert np.hypot(*error[:, :2].T).mean() < 500.0
    assert np.hypot(*error[:, 2:].T).mean() < 1.0
    normalised = np.einsum("ti,tij,tj->t", error, np.linalg.inv(track.covariance[20:]), error)
    assert 0.5 < normalised.mean() < 12.0
    assert np.abs(track.range_m - np.hypot(*truth()[:, :2].T))[20:].mean() < 400.0


def test_motion_decides_between_two_branches_of_the_range():
    azimuth_llr, range_llr = maps(np.random.default_rng(2), ghost_m=7000.0)
    track = track_station(MINUTES, azimuth_llr, AZIMUTH, range_llr, RANGE, RATE)
    assert track.range_std_m[2] > 1500.0
    assert np.abs(track.range_m - np.hypot(*truth()[:, :2].T))[60:].max() < 1000.0


def test_azimuth_alone_still_tells_that_a_ship_is_there_and_leaves_the_range_open():
    azimuth_llr, _ = maps(np.random.default_rng(3))
    track = track_station(MINUTES, azimuth_llr, AZIMUTH, None, RANGE, RATE)
    assert (track.existence[5:] > 0.9).mean() > 0.9
    assert np.abs(wrap180(track.azimuth_deg - PASSAGE.observables(MINUTES)[0]))[10:].max() < 20.0
    assert (track.range_std_m / track.range_m)[10:].min() > 0.1


def test_a_restarted_tracker_goes_on_as_if_it_had_never_stopped():
    azimuth_llr, range_llr = maps(np.random.default_rng(4))
    config = StationTrackerConfig(max_range_m=25e3)
    tracker = StationTracker(AZIMUTH, RANGE, RATE, config, seed=3)
    for row, chart in zip(azimuth_llr[:10], range_llr[:10], strict=True):
        tracker.step(row, chart)
    restarted = StationTracker.from_state_dict(tracker.state_dict(), config)
    for row, chart in zip(azimuth_llr[10:16], range_llr[10:16], strict=True):
        assert tracker.step(row, chart) == restarted.step(row, chart)
    assert tracker.range_m == restarted.range_m and tracker.azimuth == restarted.azimuth
    assert tracker.confirmed == restarted.confirmed
    restarted = StationTracker.from_state_dict(StationTracker(AZIMUTH, RANGE, RATE).state_dict())
    assert restarted.step(None, None) > 0.0


def test_gaps_and_missing_rows_are_the_same():
    azimuth_llr, range_llr = maps(np.random.default_rng(5))
    azimuth_llr[10:14], range_llr[10:14] = np.nan, np.nan
    kept = np.r_[0:10, 14:20]
    short = [values[:20] for values in (azimuth_llr, range_llr)]
    whole = track_station(MINUTES[:20], short[0], AZIMUTH, short[1], RANGE, RATE)
    without = track_station(MINUTES[kept], azimuth_llr[kept], AZIMUTH, range_llr[kept], RANGE, RATE)
    np.testing.assert_array_equal(whole.existence[kept], without.existence)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None, AZIMUTH, None, RANGE, RATE), "found neither"),
        ((np.zeros((3, 7)), AZIMUTH, None, RANGE, RATE), r"shape \(180,\)"),
        ((np.zeros((3, 180)), AZIMUTH, np.zeros((2, 100, 27)), RANGE, RATE), "same times|as many times"),
        ((np.zeros((3, 180)), AZIMUTH, None, RANGE**2, RATE), "equal steps"),
    ],
)
def test_maps_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(LayoutError, match=message):
        track_station(np.arange(3) * 60.0, *arguments)


@pytest.mark.parametrize("settings", [{"interval_s": 0.0}, {"speed_std_mps": -1.0}])
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        StationTrackerConfig(**settings)
