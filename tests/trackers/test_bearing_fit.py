import numpy as np
import pytest
from scipy.optimize import least_squares

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.trackers.bearing_bounds import azimuths, cramer_rao, derivatives, mismatched_covariance, whitener
from obsnet.trackers.bearing_errors import BearingErrors
from obsnet.trackers.bearing_fit import fit

TIME = np.arange(-100.0, 101.0, 2.0)
ERRORS = BearingErrors(2.0, 60.0)
COVARIANCE = ERRORS.covariance(TIME)


def theta_of(course, time=0.0):
    east, north = course.position(np.array(time))
    return np.array([float(east), float(north), course.course_deg])


def random_courses(count, rng):
    for _ in range(count):
        yield StraightCourse(
            rng.uniform(-80, 80),
            rng.uniform(100, 1200) * rng.choice([-1, 1]),
            rng.uniform(0, 360),
            rng.uniform(3, 12),
        )


def test_exact_bearings_give_back_any_course_on_either_side():
    for course in random_courses(60, np.random.default_rng(0)):
        found = fit(course.observables(TIME)[0], TIME, COVARIANCE, course.speed_mps)
        assert found.converged[0]
        assert found.chi2[0] < 1e-6
        assert found.cpa_range_m[0] == pytest.approx(course.cpa_range_m, rel=1e-3)
        assert found.cpa_time[0] == pytest.approx(course.cpa_time, abs=0.1)
        assert abs(wrap180(found.theta[0, 2] - course.course_deg)) < 0.01


@pytest.mark.parametrize("cpa_time", [-400.0, 300.0])
def test_a_ship_that_only_approaches_or_leaves(cpa_time):
    course = StraightCourse(cpa_time, -600.0, 250.0, 8.0)
    found = fit(course.observables(TIME)[0], TIME, 1e-4 * COVARIANCE, 8.0)
    assert found.cpa_range_m[0] == pytest.approx(-600.0, rel=0.02)
    assert found.cpa_time[0] == pytest.approx(cpa_time, abs=5)


def test_small_errors_are_met_by_the_linear_closed_form():
    course = StraightCourse(20.0, 700.0, 300.0, 6.0)
    theta = theta_of(course)
    small = BearingErrors(1e-4, 60.0)
    noise = small.sample(TIME, 20, np.random.default_rng(1))
    found = fit(course.observables(TIME)[0] + noise, TIME, small.covariance(TIME), 6.0)
    slopes = derivatives(theta, TIME, 6.0)[:, :3]
    weighted = np.linalg.solve(small.covariance(TIME), slopes)
    closed = np.linalg.solve(slopes.T @ weighted, weighted.T @ noise.T).T
    np.testing.assert_allclose(found.theta - theta, closed, rtol=0.02, atol=2e-4)


def test_minimum_is_global():
    """No start of an independent optimiser, the truth included, finds less misfit."""
    rng = np.random.default_rng(2)
    white = whitener(COVARIANCE)
    for course in random_courses(6, rng):
        seen = course.observables(TIME)[0] + ERRORS.sample(TIME, 1, rng)[0]
        found = fit(seen, TIME, COVARIANCE, course.speed_mps)

        def residual(theta, seen=seen, speed=course.speed_mps):
            return white @ wrap180(seen - azimuths(theta, TIME, speed))

        starts = [theta_of(course), found.theta[0]]
        starts += [theta_of(other) for other in random_courses(6, rng)]
        least = min(2 * least_squares(residual, start, x_scale=(100, 100, 10)).cost for start in starts)
        assert found.chi2[0] <= least * (1 + 1e-5) + 1e-5


def test_speed_with_a_prior_is_estimated_as_its_mean():
    """The four-parameter maximum a posteriori of an independent optimiser is the fit at the prior's mean."""
    rng = np.random.default_rng(3)
    course = StraightCourse(10.0, -500.0, 120.0, 8.0)
    seen = course.observables(TIME)[0] + ERRORS.sample(TIME, 1, rng)[0]
    found = fit(seen, TIME, COVARIANCE, 7.0)
    white = whitener(COVARIANCE)

    def residual(values):
        misfit = wrap180(seen - azimuths(values[:3], TIME, values[3]))
        return np.append(white @ misfit, (values[3] - 7.0) / 1.5)

    start = np.append(theta_of(course), 8.0)
    best = least_squares(residual, start, x_scale=(100, 100, 10, 1), xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(best.x[:2], found.theta[0, :2], rtol=1e-3)
    assert best.x[2:] == pytest.approx([found.theta[0, 2], 7.0], abs=1e-2)
    bound = found.bounds(TIME, COVARIANCE, 1.5)
    numeric = np.linalg.inv(best.jac.T @ best.jac)
    np.testing.assert_allclose(np.sqrt(np.diag(bound.full)), np.sqrt(np.diag(numeric)), rtol=1e-2)


@pytest.mark.parametrize("turned", [0.0, 37.0, 135.0, 300.0])
def test_turning_the_bearings_turns_the_course(turned):
    rng = np.random.default_rng(4)
    seen = StraightCourse(0.0, 700.0, 45.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 30, rng)
    one, other = (fit((seen + angle) % 360, TIME, COVARIANCE, 7.0) for angle in (0.0, turned))
    np.testing.assert_allclose(wrap180(other.theta[:, 2] - one.theta[:, 2] - turned), 0, atol=1e-2)
    np.testing.assert_allclose(other.cpa_range_m, one.cpa_range_m, rtol=1e-3)
    np.testing.assert_allclose(other.chi2, one.chi2, rtol=1e-4)


def test_mirroring_the_bearings_changes_the_side():
    rng = np.random.default_rng(5)
    seen = StraightCourse(-30.0, 700.0, 45.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 30, rng)
    one, other = fit(seen, TIME, COVARIANCE, 7.0), fit(-seen, TIME, COVARIANCE, 7.0)
    np.testing.assert_allclose(other.cpa_range_m, -one.cpa_range_m, rtol=1e-3)
    np.testing.assert_allclose(wrap180(other.theta[:, 2] + one.theta[:, 2]), 0, atol=1e-2)
    np.testing.assert_allclose(other.cpa_time, one.cpa_time, atol=0.1)


def test_reversing_time_reverses_the_course():
    rng = np.random.default_rng(6)
    seen = StraightCourse(-30.0, 700.0, 45.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 10, rng)
    one, other = fit(seen, TIME, COVARIANCE, 7.0), fit(seen[:, ::-1], TIME, COVARIANCE, 7.0)
    np.testing.assert_allclose(other.cpa_range_m, -one.cpa_range_m, rtol=1e-3)
    np.testing.assert_allclose(wrap180(other.theta[:, 2] - one.theta[:, 2] - 180), 0, atol=1e-2)


def test_whole_turns_do_not_matter():
    rng = np.random.default_rng(7)
    seen = StraightCourse(0.0, 400.0, 265.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 5, rng)
    assert (np.abs(np.diff(seen % 360, axis=1)) > 300).any()
    turns = 360.0 * rng.integers(-3, 4, seen.shape)
    one, other = fit(seen, TIME, COVARIANCE, 7.0), fit(seen + turns, TIME, COVARIANCE, 7.0)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-4)


def test_all_together_is_one_by_one():
    rng = np.random.default_rng(8)
    seen = StraightCourse(0.0, 700.0, 45.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 8, rng)
    speeds = rng.uniform(5, 9, 8)
    together = fit(seen, TIME, COVARIANCE, speeds)
    for run in range(8):
        alone = fit(seen[run], TIME, COVARIANCE, speeds[run])
        np.testing.assert_allclose(together.theta[run], alone.theta[0], rtol=1e-5)
    np.testing.assert_allclose(
        together.theta[:, 0] / speeds, fit(seen, TIME, COVARIANCE, 1.0).theta[:, 0], rtol=1e-6
    )


def test_range_is_in_units_of_the_speed():
    rng = np.random.default_rng(9)
    seen = StraightCourse(0.0, 700.0, 45.0, 7.0).observables(TIME)[0] + ERRORS.sample(TIME, 5, rng)
    one, other = fit(seen, TIME, COVARIANCE, 7.0), fit(seen, TIME, COVARIANCE, 14.0)
    np.testing.assert_allclose(other.cpa_range_m, 2 * one.cpa_range_m)
    np.testing.assert_allclose(other.theta[:, 2], one.theta[:, 2])
    np.testing.assert_allclose(other.cpa_time, one.cpa_time)


def test_estimator_reaches_the_whole_bound_and_pays_for_ignored_correlation_what_theory_says():
    course = StraightCourse(0.0, 750.0, 45.0, 7.0)
    rng = np.random.default_rng(10)
    seen = course.observables(TIME)[0] + ERRORS.sample(TIME, 1500, rng)
    independent = np.diag(np.diag(COVARIANCE))
    bound = cramer_rao(theta_of(course), TIME, COVARIANCE, 7.0)
    penalty = mismatched_covariance(theta_of(course), TIME, independent, COVARIANCE, 7.0)
    for weights, theory in ((COVARIANCE, bound), (independent, penalty)):
        found = fit(seen, TIME, weights, 7.0)
        rmse = np.sqrt(np.mean((np.abs(found.cpa_range_m) - 750.0) ** 2))
        assert rmse == pytest.approx(theory.cpa_range_std_m, rel=0.07)
        course_rmse = np.sqrt(np.mean(wrap180(found.theta[:, 2] - 45.0) ** 2))
        assert course_rmse == pytest.approx(theory.course_std_deg, rel=0.07)
        east = found.theta[:, 0] - theta_of(course)[0]
        assert np.sqrt(np.mean(east**2)) == pytest.approx(np.sqrt(theory.full[0, 0]), rel=0.07)
    assert penalty.cpa_range_std_m > 1.05 * bound.cpa_range_std_m
    assert found.chi2.mean() > 0


def test_misfit_is_chi_square_with_three_degrees_fewer():
    course = StraightCourse(0.0, 500.0, 45.0, 7.0)
    seen = course.observables(TIME)[0] + ERRORS.sample(TIME, 600, np.random.default_rng(11))
    chi2 = fit(seen, TIME, COVARIANCE, 7.0).chi2
    assert chi2.mean() == pytest.approx(len(TIME) - 3, abs=4 * np.sqrt(2 * len(TIME) / 600))


@pytest.mark.parametrize("model", ["sinc", "exponential"])
def test_smooth_covariances_can_be_used(model):
    errors = BearingErrors(2.0, 60.0, model)
    course = StraightCourse(0.0, 500.0, 45.0, 7.0)
    seen = course.observables(TIME)[0] + errors.sample(TIME, 300, np.random.default_rng(12))
    found = fit(seen, TIME, errors.covariance(TIME), 7.0)
    bound = cramer_rao(theta_of(course), TIME, errors.covariance(TIME), 7.0)
    assert found.converged.mean() > 0.99
    rmse = np.sqrt(np.mean((found.cpa_range_m - 500.0) ** 2))
    assert rmse == pytest.approx(bound.cpa_range_std_m, rel=0.15)


def test_epoch_times_lose_nothing():
    seen = StraightCourse(1.7e9 + 5.0, 700.0, 45.0, 7.0).observables(1.7e9 + TIME)[0]
    found = fit(seen, 1.7e9 + TIME, COVARIANCE, 7.0)
    assert found.cpa_time[0] - 1.7e9 == pytest.approx(5.0, abs=1e-2)
    assert found.course().cpa_range_m == pytest.approx(700.0, rel=1e-4)


def test_what_is_refused():
    seen = np.linspace(0, 90, len(TIME))
    with pytest.raises(LayoutError, match="101 bearings need as many times"):
        fit(seen, TIME[:-1], COVARIANCE, 7.0)
    with pytest.raises(LayoutError, match="must be finite; leave out the minutes"):
        fit(np.where(TIME > 0, seen, np.nan), TIME, COVARIANCE, 7.0)
    with pytest.raises(LayoutError, match="four bearings or more, found 3"):
        fit(seen[:3], TIME[:3], COVARIANCE[:3, :3], 7.0)
    with pytest.raises(LayoutError, match="times of bearings must increase"):
        fit(seen, TIME[::-1], COVARIANCE, 7.0)
    with pytest.raises(ConfigError, match="speed_mps must be positive, found 0"):
        fit(seen, TIME, COVARIANCE, 0.0)
    with pytest.raises(LayoutError, match="singular"):
        fit(seen, TIME, np.ones_like(COVARIANCE), 7.0)
