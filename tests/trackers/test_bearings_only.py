import numpy as np
import pytest

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.trackers.bearing_errors import BearingErrors
from obsnet.trackers.bearings_only import track_bearings

EPOCH = 1.7e9
HEARD = EPOCH + 60.0 * np.arange(-90, 91)
PRIOR = {"correlation_s": 180.0, "speed_mps": 7.5, "speed_std_mps": 2.0}


def delay(distance):
    return np.hypot(distance, 3500.0) / 1500.0


def emitted(course, heard=HEARD):
    time = heard.copy()
    for _ in range(8):
        time = heard - delay(course.observables(time)[1])
    return time


def hear(course, rng, std=4.0, false=0.0, missing=0.0):
    azimuth = (
        course.observables(emitted(course))[0]
        + BearingErrors(std, 180.0, nugget=0.05).sample(HEARD, 1, rng)[0]
    )
    wrong = rng.random(len(HEARD)) < false
    azimuth[wrong] = rng.uniform(0, 360, wrong.sum())
    azimuth[rng.random(len(HEARD)) < missing] = np.nan
    return azimuth % 360, wrong


def test_exact_bearings_give_the_course_where_the_ship_was():
    course = StraightCourse(EPOCH + 300.0, -12e3, 200.0, 7.5)
    azimuth = course.observables(emitted(course))[0]
    track = track_bearings(HEARD, azimuth, 2.0, **PRIOR, delay=delay)
    assert track.motion.cpa_time == pytest.approx(course.cpa_time, abs=0.5)
    assert track.motion.cpa_range_m == pytest.approx(-12e3, rel=1e-3)
    assert track.motion.course_deg == pytest.approx(200.0, abs=0.02)
    assert track.start == pytest.approx(emitted(course)[0], abs=0.5)


def test_a_constant_delay_is_taken_off_the_time():
    azimuth, _ = hear(StraightCourse(EPOCH, 6e3, 80.0, 7.5), np.random.default_rng(9))
    late = track_bearings(HEARD, azimuth, 4.0, **PRIOR)
    track = track_bearings(HEARD, azimuth, 4.0, **PRIOR, delay=lambda distance: np.full_like(distance, 40.0))
    assert late.motion.cpa_time - track.motion.cpa_time == pytest.approx(40.0, abs=0.1)
    assert track.motion.cpa_range_m == pytest.approx(late.motion.cpa_range_m, rel=1e-3)
    np.testing.assert_allclose(track.covariance, late.covariance, rtol=1e-2, atol=1e-2)


def test_errors_are_as_large_as_the_covariance_says():
    rng = np.random.default_rng(0)
    normalised = []
    for _ in range(30):
        speed = np.clip(7.5 + 2.0 * rng.standard_normal(), 3.0, 12.0)
        course = StraightCourse(
            EPOCH + rng.uniform(-1500, 1500),
            rng.uniform(1e3, 2e4) * rng.choice([-1, 1]),
            rng.uniform(0, 360),
            speed,
        )
        track = track_bearings(HEARD, hear(course, rng, false=0.2, missing=0.2)[0], 4.0, **PRIOR, delay=delay)
        error = np.array(
            [
                track.motion.cpa_time - course.cpa_time,
                track.motion.cpa_range_m - course.cpa_range_m,
                wrap180(track.motion.course_deg - course.course_deg),
                track.motion.speed_mps - course.speed_mps,
            ]
        )
        assert np.sign(track.motion.cpa_range_m) == np.sign(course.cpa_range_m)
        normalised.append(error / track.std)
        assert np.linalg.eigvalsh(track.covariance / np.outer(track.std, track.std)).min() > 0
    spread = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert (spread > 0.6).all() and (spread < 1.5).all()


def test_false_bearings_are_left_out():
    rng = np.random.default_rng(1)
    course = StraightCourse(EPOCH, 6e3, 80.0, 7.5)
    azimuth, wrong = hear(course, rng, false=0.35)
    track = track_bearings(HEARD, azimuth, 4.0, **PRIOR, delay=delay)
    far = np.abs(wrap180(azimuth - course.observables(emitted(course))[0])) > 25
    assert not track.extra["used"][far].any()
    assert track.extra["used"][~wrong].mean() > 0.95
    assert abs(wrap180(track.motion.course_deg - 80.0)) < 4 * track.std[2]
    assert track.std[2] < 3


def test_turning_mirroring_and_shuffling():
    rng = np.random.default_rng(2)
    azimuth, _ = hear(StraightCourse(EPOCH, 6e3, 80.0, 7.5), rng, false=0.2)
    one = track_bearings(HEARD, azimuth, 4.0, **PRIOR, delay=delay)
    order = rng.permutation(len(HEARD))
    turned = track_bearings(HEARD[order], (azimuth[order] + 123.0) % 360, 4.0, **PRIOR, delay=delay)
    mirrored = track_bearings(HEARD, (-azimuth) % 360, 4.0, **PRIOR, delay=delay)
    assert wrap180(turned.motion.course_deg - one.motion.course_deg) == pytest.approx(123.0, abs=0.05)
    assert turned.motion.cpa_range_m == pytest.approx(one.motion.cpa_range_m, rel=1e-3)
    assert turned.log_bayes_factor == pytest.approx(one.log_bayes_factor, abs=0.05)
    np.testing.assert_array_equal(turned.extra["used"], one.extra["used"][order])
    assert mirrored.motion.cpa_range_m == pytest.approx(-one.motion.cpa_range_m, rel=1e-3)
    assert wrap180(mirrored.motion.course_deg + one.motion.course_deg) == pytest.approx(0.0, abs=0.05)


def test_speed_prior_widens_range_alone():
    azimuth, _ = hear(StraightCourse(EPOCH, 6e3, 80.0, 7.5), np.random.default_rng(3))
    known = track_bearings(HEARD, azimuth, 4.0, correlation_s=180.0, speed_mps=7.5, speed_std_mps=0.0)
    wide = track_bearings(HEARD, azimuth, 4.0, **PRIOR)
    np.testing.assert_allclose(wide.std[[0, 2]], known.std[[0, 2]])
    added = wide.covariance[1, 1] - known.covariance[1, 1]
    assert added == pytest.approx((wide.motion.cpa_range_m * 2.0 / 7.5) ** 2)
    assert wide.std[3] == pytest.approx(2.0)
    assert wide.covariance[1, 3] == pytest.approx(wide.motion.cpa_range_m / 7.5 * 4.0)
    assert "7.5 ± 2 m/s" in wide.method


def test_a_wrong_range_shifts_the_time_of_emission():
    azimuth, _ = hear(StraightCourse(EPOCH, 15e3, 80.0, 7.5), np.random.default_rng(4), std=1.0)
    without, with_delay = (track_bearings(HEARD, azimuth, 1.0, **PRIOR, delay=one) for one in (None, delay))
    slowness = 15e3 / np.hypot(15e3, 3500.0) / 1500.0
    expected = without.covariance[0, 0] + (slowness * without.std[1]) ** 2
    assert with_delay.covariance[0, 0] == pytest.approx(expected, rel=0.05)
    assert with_delay.covariance[0, 1] < 0


@pytest.mark.parametrize("false", [0.0, 0.3])
def test_a_fixed_direction_is_no_ship(false):
    rng = np.random.default_rng(5)
    for _ in range(10):
        azimuth = 90.0 + BearingErrors(4.0, 180.0, nugget=0.05).sample(HEARD, 1, rng)[0]
        wrong = rng.random(len(HEARD)) < false
        azimuth[wrong] = rng.uniform(0, 360, wrong.sum())
        assert track_bearings(HEARD, azimuth, 4.0, **PRIOR) is None


def test_no_direction_is_no_ship():
    rng = np.random.default_rng(6)
    for _ in range(10):
        assert track_bearings(HEARD, rng.uniform(0, 360, len(HEARD)), 4.0, **PRIOR) is None


def test_too_few_bearings_are_no_ship():
    azimuth = StraightCourse(EPOCH, 6e3, 80.0, 7.5).observables(HEARD)[0]
    few = np.where(np.arange(len(HEARD)) % 80 == 0, azimuth, np.nan)
    assert np.isfinite(few).sum() == 3
    assert track_bearings(HEARD, few, 4.0, **PRIOR, delay=delay) is None
    for count in (0, 1, 3):
        assert track_bearings(HEARD[:count], azimuth[:count], 4.0, **PRIOR) is None


def test_a_false_bearing_near_the_course_stands_out_against_its_neighbours():
    course = StraightCourse(EPOCH, 6e3, 80.0, 7.5)
    azimuth = (
        course.observables(HEARD)[0]
        + BearingErrors(4.0, 900.0).sample(HEARD, 1, np.random.default_rng(10))[0]
    )
    azimuth[40] += 11.0 if azimuth[40] < course.observables(HEARD)[0][40] else -11.0
    assert abs(wrap180(azimuth[40] - course.observables(HEARD)[0][40])) < 3 * 4.0
    track = track_bearings(HEARD, azimuth, 4.0, **{**PRIOR, "correlation_s": 900.0}, white_share=0.01)
    np.testing.assert_array_equal(np.flatnonzero(~track.extra["used"]), [40])


def test_evidence_grows_with_bearings_and_is_against_no_ship():
    azimuth, _ = hear(StraightCourse(EPOCH, 6e3, 80.0, 7.5), np.random.default_rng(7))
    half = track_bearings(HEARD[::2], azimuth[::2], 4.0, **PRIOR)
    whole = track_bearings(HEARD, azimuth, 4.0, **PRIOR)
    assert whole.log_bayes_factor > half.log_bayes_factor > 0
    assert whole.extra["log_bayes_factor_fixed"] > 0
    assert whole.extra["log_likelihood"] > whole.log_bayes_factor


def test_a_delay_table_that_ends_is_continued():
    course = StraightCourse(EPOCH, 12e3, 200.0, 7.5)
    azimuth = course.observables(emitted(course))[0]
    short = lambda distance: np.where(distance < 20e3, delay(distance), np.nan)  # noqa: E731
    track = track_bearings(HEARD, azimuth, 2.0, **PRIOR, delay=short)
    assert track.motion.cpa_time == pytest.approx(EPOCH, abs=2.0)


def test_each_bearing_may_have_its_own_error():
    rng = np.random.default_rng(8)
    course = StraightCourse(EPOCH, 6e3, 80.0, 7.5)
    std = np.where(np.arange(len(HEARD)) % 2, 2.0, 20.0)
    azimuth = course.observables(HEARD)[0] + std * rng.standard_normal(len(HEARD))
    track = track_bearings(HEARD, azimuth, std, correlation_s=0.0, speed_mps=7.5, speed_std_mps=0.0)
    good = track_bearings(
        HEARD[1::2], azimuth[1::2], 2.0, correlation_s=0.0, speed_mps=7.5, speed_std_mps=0.0
    )
    assert track.std[1] < good.std[1] < 1.1 * track.std[1]


def test_what_is_refused():
    azimuth = np.linspace(0, 90, len(HEARD))
    with pytest.raises(LayoutError, match="one azimuth per time is needed"):
        track_bearings(HEARD, azimuth[:-1], 4.0, **PRIOR)
    with pytest.raises(LayoutError, match="std_deg must be one number or one per bearing"):
        track_bearings(HEARD, azimuth, np.ones(3), **PRIOR)
    with pytest.raises(LayoutError, match="two bearings have the same time"):
        track_bearings(np.zeros(len(HEARD)), azimuth, 4.0, **PRIOR)
    with pytest.raises(ConfigError, match="std_deg must be positive and finite"):
        track_bearings(HEARD, azimuth, 0.0, **PRIOR)
    with pytest.raises(ConfigError, match="speed_mps must be positive, found -1"):
        track_bearings(HEARD, azimuth, 4.0, **{**PRIOR, "speed_mps": -1})
    with pytest.raises(ConfigError, match="speed_std_mps must be zero or positive"):
        track_bearings(HEARD, azimuth, 4.0, **{**PRIOR, "speed_std_mps": np.nan})
    with pytest.raises(ConfigError, match="correlation_s must be zero or positive"):
        track_bearings(HEARD, azimuth, 4.0, **{**PRIOR, "correlation_s": -5.0})
    with pytest.raises(ConfigError, match="false_share must lie between 0 and 1"):
        track_bearings(HEARD, azimuth, 4.0, **PRIOR, false_share=1.0)
    with pytest.raises(ConfigError, match="max_range_m must be positive"):
        track_bearings(HEARD, azimuth, 4.0, **PRIOR, max_range_m=0.0)
