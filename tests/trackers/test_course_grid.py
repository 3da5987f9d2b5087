"""A grid's bounds hold, its scores are those of single courses, and the best come first."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from obsnet.trackers import course_grid
from obsnet.trackers.course_grid import CourseGrid, Delay, best_first, score_points
from obsnet.trackers.score_maps import ScoreMaps

TILES = 180.0 * np.arange(12)
CPA_TIME, CPA_RANGE = 180.0 * np.arange(-2, 14), np.array([-9000.0, 1000.0, 6000.0])
SPEED, COURSE = np.array([4.0, 7.5]), np.arange(0.0, 360.0, 30.0)
DELAY = Delay(np.hypot(250.0 * np.arange(601), 4000.0) / 1500.0, 250.0)


def maps(jointly):
    rng = np.random.default_rng(4)
    geometry = np.array([0.0, 500.0, -13.0, 1.0])
    azimuth = np.repeat(rng.standard_normal((12, 12)), 30, axis=1)
    return ScoreMaps(
        rng.standard_normal((12, 30, 27), np.float32), geometry, azimuth.astype(np.float32), 1.0, jointly
    )


def slow_share(scores, tile, cpa_time, cpa_range, course, speed):
    emitted = TILES[tile] - cpa_time
    for _ in range(3):
        distance = np.hypot(cpa_range, speed * emitted)
        emitted = (
            TILES[tile] - cpa_time - np.interp(distance, 250.0 * np.arange(601), np.asarray(DELAY.seconds))
        )
    along = speed * emitted
    distance = np.hypot(cpa_range, along)
    x, y = distance / 500.0, speed * along / max(distance, 1.0) + 13.0
    share = 0.0
    if x < 29 and 0 <= y < 26:
        a, b = int(x), int(y)
        corners = scores.range_score[tile, a : a + 2, b : b + 2]
        share = np.array([1 - x + a, x - a]) @ corners @ np.array([1 - y + b, y - b])
    azimuth = course + np.rad2deg(np.arctan2(cpa_range, along))
    pointing = scores.azimuth_score[tile, int(np.floor(azimuth + 0.5)) % 360]
    return pointing + (min(share, 0.0) if scores.jointly and pointing <= 0 else share)


def best_run(shares):
    return max(
        0.0, *(sum(shares[lo:hi]) for lo in range(len(shares)) for hi in range(lo + 1, len(shares) + 1))
    )


@pytest.mark.parametrize("jointly", [False, True])
def test_scores_equal_the_slow_implementation_and_stay_below_their_bounds(jointly):
    scores = maps(jointly)
    grid = CourseGrid(CPA_TIME, CPA_RANGE, SPEED, COURSE, TILES, DELAY, scores)
    cells = np.arange(np.prod(grid.shape))
    found = grid.scores(cells).reshape(*grid.shape, len(COURSE))
    for t, i, j, q in np.random.default_rng(5).integers(0, found.shape, (60, 4)):
        course = (CPA_TIME[t], CPA_RANGE[i], COURSE[q], SPEED[j])
        expected = best_run([slow_share(scores, m, *course) for m in range(len(TILES))])
        assert found[t, i, j, q] == pytest.approx(expected, abs=1e-4)
    assert (grid.bounds(2) >= found.max(axis=3) - 1e-5).all()


@pytest.mark.parametrize("jointly", [False, True])
def test_single_courses_score_as_the_grid_does(jointly):
    """Between the steps of this azimuth map single courses interpolate: on its flats both read the same."""
    scores = maps(jointly)
    points = np.array([[900.0, 6000.0, 37.0, 7.5], [0.0, -9000.0, 200.0, 4.0]])
    found, per_tile = score_points(points, TILES, DELAY, scores)
    for point, score, shares in zip(points, found, per_tile.T, strict=True):
        grid = CourseGrid(point[:1], point[1:2], point[3:], point[2:3], TILES, DELAY, scores)
        assert grid.scores(np.array([0]))[0, 0] == pytest.approx(score, abs=0.5)
        assert best_run(shares) == pytest.approx(score)


@pytest.mark.parametrize("jointly", [False, True])
@pytest.mark.parametrize("many", [np.inf, 0])
def test_no_course_above_a_score_is_left_out(monkeypatch, jointly, many):
    """By arrays, and by the kernel of very many courses."""
    monkeypatch.setattr(course_grid, "_MANY", np.inf)
    heard = maps(jointly)
    quiet = replace(heard, azimuth_score=heard.azimuth_score - 1.5)
    grid = CourseGrid(CPA_TIME, CPA_RANGE, SPEED, COURSE, TILES, DELAY, quiet)
    cells = np.random.default_rng(7).permutation(np.prod(grid.shape))
    expected = grid.scores(cells)
    monkeypatch.setattr(course_grid, "_MANY", many)
    least = float(np.quantile(expected, 0.9))
    found = grid.scores_above(cells, least, threads=2)
    assert np.array_equal(found[expected > least], expected[expected > least])
    left_out = found == -np.inf
    assert left_out.mean() > 0.2 and (expected[left_out] <= least).all()
    assert np.array_equal(grid.scores_above(cells, -np.inf), expected)


@pytest.mark.parametrize("step", [0.5, 1.0, 3.0, 4.0, 6.0, 8.0, 15.0])
@pytest.mark.parametrize("course", [np.arange(0.0, 360.0, 10.0), 121.0 + 0.4 * np.arange(-5, 6)])
def test_courses_are_read_where_they_point_whatever_the_azimuths_step(step, course):
    # Maps that grow with the cosine from a bearing: what a course reads is that of where it points, to half of
    # a course's step and what lies between two azimuths of the map.
    azimuth = np.arange(0.0, 360.0, step)
    rows = np.cos(np.deg2rad(azimuth - 123.0))[None] * np.ones((len(TILES), 1))
    scores = ScoreMaps(
        np.zeros((len(TILES), 2, 2), np.float32), np.array([0.0, 1.0, -1.0, 1.0]),
        rows.astype(np.float32), step, False,
    )  # fmt: skip
    grid = CourseGrid(TILES[6:7], np.array([9000.0]), np.array([8.0]), course, TILES, DELAY, scores)
    heard = DELAY.emitted(TILES - TILES[6], np.float64(9000.0), np.float64(8.0))
    bearing = course[:, None] + np.rad2deg(np.arctan2(9000.0, 8.0 * heard))
    exact = [best_run(row) for row in np.cos(np.deg2rad(bearing - 123.0))]
    half = 0.5 * min(step, course[1] - course[0])
    worst = len(TILES) * (np.deg2rad(half) + np.deg2rad(step) ** 2 / 8)
    assert np.abs(grid.scores(np.array([0]))[0] - exact).max() < worst


def test_every_cell_comes_once_the_greatest_bounds_first():
    bounds = np.random.default_rng(6).standard_normal((30, 40, 3)).astype(np.float32)
    batches = list(best_first(bounds))
    for batch, following in pairwise(batches):
        assert bounds.flat[batch].min() >= bounds.flat[following].max()
    assert (np.sort(np.concatenate(batches)) == np.arange(bounds.size)).all()
