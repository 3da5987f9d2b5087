import numpy as np
import pytest

from obsnet.errors import LayoutError
from obsnet.kinematics import StraightCourse
from obsnet.trackers.bearing_bounds import (
    azimuths,
    cpa_jacobian,
    cramer_rao,
    derivatives,
    mismatched_covariance,
    speed_scale_variance,
)
from obsnet.trackers.bearing_errors import BearingErrors

TIME = np.arange(-100.0, 101.0, 4.0)
ERRORS = BearingErrors(2.0, 60.0)
CASES = [(900.0, -400.0, 45.0, 7.0), (-300.0, 800.0, 200.0, 4.0), (20.0, -1500.0, 359.0, 12.0)]


def steps(function, point, sizes):
    """Central differences of a vector function, one column per parameter."""
    columns = []
    for index, size in enumerate(sizes):
        shift = np.zeros(len(point))
        shift[index] = size
        columns.append((function(point + shift) - function(point - shift)) / (2 * size))
    return np.stack(columns, axis=-1)


def unwrapped(values):
    return np.rad2deg(np.unwrap(np.deg2rad(azimuths(values[:3], TIME, values[3]))))


@pytest.mark.parametrize("case", CASES)
def test_azimuths_are_those_of_the_straight_course(case):
    x0, y0, course, speed = case
    sin, cos = np.sin(np.deg2rad(course)), np.cos(np.deg2rad(course))
    straight = StraightCourse(-(x0 * sin + y0 * cos) / speed, x0 * cos - y0 * sin, course, speed)
    expected = straight.observables(TIME)[0]
    np.testing.assert_allclose((azimuths(np.array(case[:3]), TIME, speed) - expected + 180) % 360, 180.0)


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_the_azimuth(case):
    numeric = steps(unwrapped, np.array(case), (0.1, 0.1, 0.01, 0.001))
    np.testing.assert_allclose(derivatives(np.array(case[:3]), TIME, case[3]), numeric, rtol=1e-4, atol=1e-7)


def test_derivatives_broadcast_over_ships():
    many = derivatives(np.array([case[:3] for case in CASES]), TIME, np.array([case[3] for case in CASES]))
    assert many.shape == (3, len(TIME), 4)
    for row, case in zip(many, CASES, strict=True):
        np.testing.assert_allclose(row, derivatives(np.array(case[:3]), TIME, case[3]))


@pytest.mark.parametrize("case", CASES)
def test_cpa_jacobian_is_that_of_cpa(case):
    def motion(values):
        x0, y0, course, speed = values
        sin, cos = np.sin(np.deg2rad(course)), np.cos(np.deg2rad(course))
        return np.array([-(x0 * sin + y0 * cos) / speed, x0 * cos - y0 * sin, course, speed])

    numeric = steps(motion, np.array(case), (0.1, 0.1, 0.01, 0.001))
    np.testing.assert_allclose(cpa_jacobian(np.array(case[:3]), case[3]), numeric, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("speed_std", [0.0, 1.5])
@pytest.mark.parametrize("case", CASES)
def test_full_bound_inverts_the_curvature_of_the_expected_log_likelihood(case, speed_std):
    covariance = ERRORS.covariance(TIME)
    truth = np.array(case)

    def expected(values):
        misfit = unwrapped(values) - unwrapped(truth)
        misfit -= 360 * np.round(misfit[0] / 360)
        prior = ((values[3] - truth[3]) / speed_std) ** 2 if speed_std else 0.0
        return -0.5 * (misfit @ np.linalg.solve(covariance, misfit) + prior)

    free = 4 if speed_std else 3
    sizes = np.array([0.5, 0.5, 0.05, 0.005])
    fisher = np.zeros((free, free))
    for i in range(free):
        for j in range(free):
            one, other = np.eye(4)[i] * sizes, np.eye(4)[j] * sizes
            mixed = (
                expected(truth + one + other)
                - expected(truth + one - other)
                - expected(truth - one + other)
                + expected(truth - one - other)
            )
            fisher[i, j] = -mixed / (4 * sizes[i] * sizes[j])
    bounds = cramer_rao(truth[:3], TIME, covariance, truth[3], speed_std)
    scale = np.sqrt(np.diag(bounds.full)[:free])
    unit = bounds.full[:free, :free] / np.outer(scale, scale)
    oracle = np.linalg.inv(fisher * np.outer(scale, scale))
    np.testing.assert_allclose(unit, oracle, atol=0.02)
    np.testing.assert_allclose(bounds.block[0, 0], np.linalg.inv(fisher[:2, :2])[0, 0], rtol=0.02)


def test_speed_prior_adds_one_relative_error_to_every_range():
    theta, covariance = np.array([900.0, -400.0, 45.0]), ERRORS.covariance(TIME)
    known = cramer_rao(theta, TIME, covariance, 7.0).full
    prior = cramer_rao(theta, TIME, covariance, 7.0, 1.4).full
    scale = np.array([900.0, -400.0, 0.0, 7.0]) * 1.4 / 7.0
    np.testing.assert_allclose(prior, known + np.outer(scale, scale), rtol=1e-6, atol=1e-6)


def test_block_bound_is_that_of_a_known_course_and_far_too_low_at_the_start():
    theta, covariance = np.array([900.0, -400.0, 45.0]), ERRORS.covariance(TIME)
    bounds = cramer_rao(theta, TIME - TIME[0], covariance, 7.0)
    known = np.linalg.inv(np.linalg.inv(bounds.full[:3, :3])[:2, :2])
    np.testing.assert_allclose(bounds.block, known, rtol=1e-6)
    assert bounds.block_position_std_m < 0.7 * bounds.position_std_m


def test_bounds_turn_with_the_scene():
    covariance = ERRORS.covariance(TIME)
    one = cramer_rao(np.array([900.0, -400.0, 45.0]), TIME, covariance, 7.0, 1.0)
    turned = np.rad2deg(np.arctan2(900.0, -400.0)) + 77.0
    position = np.hypot(900.0, 400.0) * np.array([np.sin(np.deg2rad(turned)), np.cos(np.deg2rad(turned))])
    other = cramer_rao(np.array([*position, 122.0]), TIME, covariance, 7.0, 1.0)
    for name in ("cpa_range_std_m", "course_std_deg", "position_std_m", "curved_cpa_range_rmse_m"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9)


def test_right_weights_cost_nothing_and_wrong_ones_something():
    theta, covariance = np.array([900.0, -400.0, 45.0]), ERRORS.covariance(TIME)
    bound = cramer_rao(theta, TIME, covariance, 7.0, 1.0)
    right = mismatched_covariance(theta, TIME, covariance, covariance, 7.0, 1.0)
    wrong = mismatched_covariance(theta, TIME, np.eye(len(TIME)), covariance, 7.0, 1.0)
    np.testing.assert_allclose(right.full, bound.full, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(right.block, bound.block, rtol=1e-8)
    assert wrong.cpa_range_std_m > 1.02 * bound.cpa_range_std_m
    assert np.linalg.eigvalsh(wrong.full - bound.full).min() > -1e-6


def test_weights_scaled_by_a_number_do_not_matter():
    theta, covariance = np.array([900.0, -400.0, 45.0]), ERRORS.covariance(TIME)
    one, other = (
        mismatched_covariance(theta, TIME, np.eye(len(TIME)) * gain, covariance, 7.0).full
        for gain in (1.0, 9.0)
    )
    np.testing.assert_allclose(one, other)


def test_curvature_vanishes_with_the_errors_and_adds_to_large_ones():
    theta = np.array([2000 * np.cos(np.deg2rad(45)), -2000 * np.sin(np.deg2rad(45)), 45.0])
    for std, low, high in ((0.02, 0.999, 1.001), (2.0, 1.05, 10.0)):
        bounds = cramer_rao(theta, TIME, BearingErrors(std, 60.0).covariance(TIME), 7.0)
        assert low < bounds.curved_cpa_range_rmse_m / bounds.cpa_range_std_m < high


def test_curvature_leaves_the_speed_alone():
    theta, covariance = np.array([350.0, -350.0, 45.0]), BearingErrors(0.05).covariance(TIME)
    bounds = cramer_rao(theta, TIME, covariance, 7.0, 1.0)
    assert bounds.curved_cpa_range_rmse_m == pytest.approx(bounds.cpa_range_std_m, rel=1e-3)


def test_speed_scale_variance_is_that_of_a_ratio():
    speed = 7 + 0.7 * np.random.default_rng(0).standard_normal(400_000)
    assert speed_scale_variance(7.0, 0.7) == pytest.approx(np.mean((7 / speed - 1) ** 2), rel=0.02)
    assert speed_scale_variance(7.0, 0.01) == pytest.approx((0.01 / 7) ** 2, rel=1e-3)
    assert speed_scale_variance(7.0, 0.0) == 0.0


def test_bearings_that_determine_nothing_are_refused():
    with pytest.raises(LayoutError, match="do not determine position and course"):
        cramer_rao(np.array([0.0, 1000.0, 0.0]), TIME, np.eye(len(TIME)), 7.0)
    with pytest.raises(LayoutError, match="singular; give the error model a white share"):
        cramer_rao(np.array([900.0, -400.0, 45.0]), TIME, np.ones((len(TIME), len(TIME))), 7.0)
