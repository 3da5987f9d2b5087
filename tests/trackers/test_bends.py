"""Courses that bend: the truth at CPA lies in the stated regions as often as said, and a straight ship stays straight."""

from dataclasses import replace

import numpy as np
import pytest

from obsnet.kinematics import BentCourse, StraightCourse, wrap180
from obsnet.trackers.bends import WANDER, bends, wander
from obsnet.trackers.course_grid import Delay, score_points
from obsnet.trackers.grid_search import search
from obsnet.trackers.posterior import posterior
from obsnet.trackers.score_maps import ScoreMaps
from tests.trackers.test_grid_search import MINUTES, SEGMENT, T0, delay, maps_of

TIME = 180.0 * np.arange(-30, 31)
REACH = np.array([7200.0, 7200.0])
AZIMUTH_STD, RANGE_STD, RATE_STD = 2.0, 250.0, 0.5
BENT = BentCourse(
    T0 + 7000.0,
    9_000.0,
    60.0,
    8.0,
    (5400.0, 5400.0),
    ((0.05, -0.12), (0.01, 0.0)),
    ((-0.06, 0.04), (0.0, 0.01)),
)


class Wandering:
    """A ship at (0, CPA range, course, speed) whose velocity walks at random from there."""

    def __init__(self, rng, state, wander_per_hour):
        self.state, step = state, 20.0
        steps = wander_per_hour * state[3] * np.sqrt(step / 3600.0) * rng.standard_normal((2, 2, 600))
        velocity = np.cumsum(steps, axis=2)
        self.time = step * np.arange(-600, 601)
        walked = np.cumsum(velocity, axis=2) * step
        self.aside, self.ahead = (np.concatenate([-w[0][::-1], [0.0], w[1]]) for w in walked)

    def position(self, time):
        _, cpa, course, speed = self.state
        turn = np.deg2rad(course)
        side = cpa + np.interp(time, self.time, self.aside)
        ahead = speed * time + np.interp(time, self.time, self.ahead)
        return side * np.cos(turn) + ahead * np.sin(turn), -side * np.sin(turn) + ahead * np.cos(turn)

    def observables(self, time):
        (east, north), (later_e, later_n) = self.position(time), self.position(time + 20.0)
        distance = np.hypot(east, north)
        rate = (np.hypot(later_e, later_n) - distance) / 20.0
        return np.rad2deg(np.arctan2(east, north)) % 360.0, distance, rate


def measured(rng, ship):
    """Log-likelihood of hypotheses, straight or bent, given noisy azimuths, ranges and range rates of a ship."""
    azimuth, distance, rate = ship.observables(TIME)
    azimuth = azimuth + AZIMUTH_STD * rng.standard_normal(TIME.size)
    distance = distance + RANGE_STD * rng.standard_normal(TIME.size)
    rate = rate + RATE_STD * rng.standard_normal(TIME.size)

    def log_likelihood(points):
        said = np.array([course_of(point).observables(TIME) for point in points])
        off = wrap180(said[:, 0] - azimuth) / AZIMUTH_STD
        per_tile = -0.5 * (off**2 + ((said[:, 1] - distance) / RANGE_STD) ** 2)
        per_tile -= 0.5 * ((said[:, 2] - rate) / RATE_STD) ** 2
        return per_tile.sum(axis=1), per_tile.T

    return log_likelihood


def course_of(point):
    if len(point) == 4:
        return StraightCourse(*point)
    across, along = point[4:12].reshape(2, 2, 2).transpose(1, 0, 2)
    return BentCourse(*point[:4], tuple(REACH), across, along, *point[12:])


def found(rng, ship):
    """Errors of the course at CPA with their covariances, straight and marginalised over bends."""
    log_likelihood = measured(rng, ship)
    allowed = lambda points: np.ones(len(points), bool)  # noqa: E731
    state = np.array(ship.state)
    straight = posterior(state, log_likelihood, allowed, np.ones(4, bool), samples=600)
    known = bends(straight, log_likelihood, allowed, REACH, least_of_turn=60.0, samples=1200)
    mean = known.mean[:4] if known.bent else straight.mean
    errors = [straight.mean - state, mean - state]
    for error in errors:
        error[2] = wrap180(error[2])
    return errors, [straight.covariance, known.covariance], known


def test_regions_hold_the_truth_at_cpa_of_wandering_ships():
    """Joint 90 % regions (χ² of four degrees of freedom) over ships that wander as real ones do."""
    inside = {"straight": [], "bent": []}
    for seed in range(16):
        rng = np.random.default_rng(seed)
        state = (0.0, rng.choice([-1, 1]) * rng.uniform(3e3, 15e3), rng.uniform(0, 360), rng.uniform(6, 11))
        errors, covariances, _ = found(rng, Wandering(rng, state, 1.5 * WANDER))
        for name, error, covariance in zip(inside, errors, covariances, strict=True):
            inside[name].append(error @ np.linalg.solve(covariance, error) < 7.78)
    assert np.mean(inside["bent"]) > 0.75
    assert np.mean(inside["straight"]) < 0.5


def test_a_straight_ship_stays_straight():
    rng = np.random.default_rng(3)
    errors, covariances, known = found(rng, Wandering(rng, (0.0, 8_000.0, 30.0, 8.0), 0.0))
    assert not known.bent
    assert (errors[0] == errors[1]).all()
    assert errors[1] @ np.linalg.solve(covariances[1], errors[1]) < 7.78
    # That ships wander is known beforehand: it widens what is stated, not what is reported.
    assert (np.diag(covariances[1]) >= 0.9 * np.diag(covariances[0])).all()


def test_prior_grows_as_a_random_walk():
    assert wander(np.array([3600.0, 14_400.0]))[:2] == pytest.approx([WANDER, 2.0 * WANDER])
    assert wander(np.array([3600.0, 3600.0]))[4] == pytest.approx(WANDER / 3.0)


TURNING = replace(BENT, turn_s=1810.0, turn_deg=-35.0)


def test_bent_course_without_bends_is_straight_and_its_rate_is_the_ranges_slope():
    time = T0 + np.linspace(0.0, 14_000.0, 57)
    straight = StraightCourse(T0 + 7000.0, 9_000.0, 60.0, 8.0)
    none = BentCourse(T0 + 7000.0, 9_000.0, 60.0, 8.0, (5400.0, 5400.0))
    np.testing.assert_allclose(none.observables(time), straight.observables(time))
    np.testing.assert_allclose(none.position(time), straight.position(time), atol=1e-6)
    for course in (BENT, TURNING, replace(TURNING, turn_s=-1510.0)):
        _, distance, rate = course.observables(time)
        slope = (course.observables(time + 1.0)[1] - course.observables(time - 1.0)[1]) / 2.0
        np.testing.assert_allclose(rate, slope, atol=1e-3)
        np.testing.assert_allclose(np.hypot(*course.position(time)), distance)
        assert time[distance.argmin()] == course.cpa_time


@pytest.mark.parametrize("course", [BENT, TURNING, replace(TURNING, turn_s=-1510.0)])
def test_scores_put_the_ship_where_the_course_does(course):
    """A map that is a known function of range, range rate and azimuth scores what the course's observables say."""
    tiles = 180.0 * np.arange(70)
    range_m, rate = 70.0 * np.arange(715), 0.5 * np.arange(-26, 27)
    score = (1e-3 * range_m[:, None] + 0.1 * rate[None, :] + 10.0).astype(np.float32)
    pointing = np.cos(np.deg2rad(np.arange(360.0))).astype(np.float32)
    terms = [[*across, *along] for across, along in zip(course.across, course.along, strict=True)]
    point = np.concatenate([[7000.0, 9_000.0, 60.0, 8.0], *terms, [course.turn_s, course.turn_deg]])
    scores = ScoreMaps(
        np.repeat(score[None], len(tiles), 0), np.array([0.0, 70.0, -13.0, 0.5]),
        np.repeat(pointing[None], len(tiles), 0), 1.0, jointly=False,
    )  # fmt: skip
    table = Delay(delay(np.arange(0.0, 150_001.0, 250.0)), 250.0)
    out, per_tile = score_points(point[None], tiles, table, scores, np.array(course.reach_s))
    emitted = T0 + tiles
    for _ in range(30):
        emitted = T0 + tiles - delay(course.observables(emitted)[1])
    azimuth, distance, speed = course.observables(emitted)
    expected = np.where(distance < 49_900.0, 1e-3 * distance + 0.1 * speed + 10.0, 0.0)
    np.testing.assert_allclose(per_tile[:, 0], expected + np.cos(np.deg2rad(azimuth)), atol=0.02)
    assert out[0] >= per_tile.sum() - 1e-3  # the best run of tiles


@pytest.mark.parametrize("course", [BENT, TURNING, replace(TURNING, turn_s=-1510.0, turn_deg=50.0)])
def test_search_finds_a_ship_that_bends_or_turns_once_and_at_its_cpa(course):
    (track, *others) = search(maps_of([course], MINUTES, np.random.default_rng(1)), SEGMENT, delay)
    found = track.motion
    assert isinstance(found, BentCourse) and not others
    error = np.array([found.cpa_time - course.cpa_time, found.cpa_range_m - 9_000.0,
                      wrap180(found.course_deg - 60.0), found.speed_mps - 8.0])  # fmt: skip
    assert error @ np.linalg.solve(track.covariance, error) < 13.3  # 99 %
    assert found.turn_s == pytest.approx(course.turn_s, abs=300.0)
    for time in (T0 + 1500.0, T0 + 12_500.0):
        assert np.hypot(*np.subtract(found.position(time), course.position(time))) < 1000.0
