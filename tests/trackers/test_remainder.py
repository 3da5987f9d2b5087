"""What is left when a known ship is taken out: its ghosts lie where other path pairs have its delays, and hide no other ship."""

import numpy as np
import pytest
import xarray as xr

from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import from_posix
from obsnet.trackers.course_grid import Delay
from obsnet.trackers.grid_search import search
from obsnet.trackers.remainder import Ghosts, Remainder
from obsnet.trackers.track import Segment, Track

DEPTH_M, SPEED_MPS = 4000.0, 1500.0
PAIRS = ("1-3", "3-5", "5-7")
T0 = 1_369_123_200.0
MINUTES = T0 + 60.0 * np.arange(180)
AZIMUTH, RANGE, RATE = np.arange(0.0, 360.0), 140.0 * np.arange(358), 1.0 * np.arange(-13, 14)


def travel(range_m, path):
    """Travel time in water of one speed: path 1 goes straight, 3 is reflected once at the surface, and so on."""
    return np.hypot(range_m, path * DEPTH_M) / SPEED_MPS


@pytest.fixture(scope="module")
def table():
    grid = np.arange(0.0, 60_000.0, 50.0)
    paths = np.array([1, 3, 5, 7])
    delay = np.stack([travel(grid, path) for path in paths])
    return xr.Dataset({"delay": (("path", "range"), delay)}, {"path": paths, "range": grid})


def lag(range_m, later):
    """Delay of the pair of `later` and the path before it."""
    return travel(range_m, later) - travel(range_m, later - 2)


def ghost_range(range_m):
    """Where pair 1-3 has the delay that 3-5 has at `range_m`."""
    return np.interp(-lag(range_m, 5), -lag(RANGE, 3), RANGE)


def test_a_ghost_has_another_pairs_delay_and_moves_with_it(table):
    range_m, rate = np.array([5_000.0, 20_000.0]), np.array([-6.0, 4.0])
    ghosts = Ghosts(table, PAIRS)
    ranges, rates = ghosts.of(range_m, rate)
    later, _ = ghosts.of(range_m + 10.0 * rate, rate)
    said = [travel(range_m, j) - travel(range_m, i) for i in (1, 3, 5) for j in (3, 5, 7) if i < j]
    assert np.isfinite(ranges).sum() > 10
    for ship, number in np.argwhere(np.isfinite(ranges)):
        place = ranges[ship, number]
        assert min(abs(delay[ship] - lag(place, j)) for delay in said for j in (3, 5, 7)) < 1e-4
        moved = (later[ship, number] - place) / 10.0
        assert moved == pytest.approx(rates[ship, number], rel=0.05, abs=0.2)
    assert np.nanmin(abs(ranges[1] - ghost_range(20_000.0))) < 20.0


def test_a_ship_that_is_not_there_has_no_ghosts(table):
    ranges, rates = Ghosts(table, PAIRS).of(np.array([np.nan, 3e5]), np.array([1.0, 1.0]))
    assert np.isnan(ranges).all()
    assert ranges.shape == rates.shape


def test_a_path_that_is_nowhere_makes_no_ghost(table):
    lost = table.copy(deep=True)
    lost["delay"][3] = np.nan
    ranges, _ = Ghosts(lost, PAIRS).of(np.array([5_000.0]), np.array([-6.0]))
    without = Ghosts(table.isel(path=slice(3)), PAIRS).of(np.array([5_000.0]), np.array([-6.0]))[0]
    np.testing.assert_allclose(np.sort(ranges[np.isfinite(ranges)]), np.sort(without[np.isfinite(without)]))


def test_ghosts_of_what_was_taken_out_are_silent_and_nothing_else(table):
    course = StraightCourse(MINUTES[90], 8000.0, 30.0, 7.0)
    track = Track(MINUTES[0], MINUTES[-1], course, np.diag([1.0, 1.0, 1.0, 1.0]), 100.0)
    rest = Remainder(MINUTES, Delay(np.zeros(601), 250.0), AZIMUTH, RANGE, RATE)
    llr = np.ones((len(MINUTES), len(RANGE), len(RATE)), np.float32)
    _, left = rest.without(track, None, llr)
    free = rest.without_ghosts(Ghosts(table, PAIRS), left)
    assert (llr == 1.0).all()
    assert not (free > left).any()
    _, distance, rate = course.observables(MINUTES)
    ranges, rates = Ghosts(table, PAIRS).of(distance, rate)
    for minute in range(0, len(MINUTES), 20):
        near = np.zeros(free.shape[1:], bool)
        for place, moves in zip(ranges[minute], rates[minute], strict=True):
            near |= (abs(RANGE - place) <= 1000.0)[:, None] & (abs(RATE - moves) <= 2.0)
        assert (free[minute][near] <= 0.0).all()
        np.testing.assert_array_equal(free[minute][~near], left[minute][~near])


def maps_of(loud, quiet, rng, pointed):
    """Range maps that hear both ships, the loud one with a ghost; azimuth maps that hear the quiet one in `pointed` tiles alone."""
    azimuth_llr = -2.0 + 0.3 * rng.standard_normal((len(MINUTES), len(AZIMUTH)))
    range_llr = -1.0 + 0.3 * rng.standard_normal((len(MINUTES), len(RANGE), len(RATE)))
    for course in (loud, quiet):
        azimuth, distance, rate = course.observables(MINUTES)
        for m in np.flatnonzero(distance < 30_000.0):
            blobs = [(distance[m], rate[m])]
            if course is loud:
                place = ghost_range(distance[m])
                moves = (ghost_range(distance[m] + 50.0) - ghost_range(distance[m] - 50.0)) / 100.0
                blobs.append((place, rate[m] * moves))
            for where, moves in blobs:
                speed = np.exp(-0.5 * ((RATE - moves) / 0.7) ** 2)
                range_llr[m] += 7.0 * np.exp(-0.5 * ((RANGE - where) / 250.0) ** 2)[:, None] * speed
            if course is loud or pointed[m]:
                turn = wrap180(AZIMUTH - azimuth[m])
                azimuth_llr[m] += 10.0 * np.exp(-0.5 * (turn / 3.0) ** 2)
    return xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), azimuth_llr.astype(np.float32)),
            "range_llr": (("time", "range", "range_rate"), range_llr.astype(np.float32)),
        },
        coords={"time": from_posix(MINUTES), "azimuth": AZIMUTH, "range": RANGE, "range_rate": RATE},
    )


@pytest.mark.parametrize(("minutes", "count"), [(12, 2), (0, 1)])
def test_a_ship_whose_azimuth_a_louder_one_hides_is_found_by_its_range(table, minutes, count):
    """Its range is heard for two hours, its azimuth about its CPA alone; without any azimuth it is not believed, nor is the ghost."""
    loud = StraightCourse(MINUTES[110], 9000.0, 20.0, 6.0)
    quiet = StraightCourse(MINUTES[60], -2500.0, 160.0, 7.0)
    pointed = abs(np.arange(len(MINUTES)) - 60) < minutes / 2
    maps = maps_of(loud, quiet, np.random.default_rng(2), pointed)
    segment = Segment(MINUTES[0], MINUTES[-1], None)
    found = search(maps, segment, np.zeros_like, ghosts=Ghosts(table, PAIRS))
    assert len(found) == count
    assert abs(found[0].motion.cpa_time - loud.cpa_time) < 60.0
    for track in found[1:]:
        assert abs(track.motion.cpa_time - quiet.cpa_time) < 60.0
        assert abs(track.motion.cpa_range_m - quiet.cpa_range_m) < 300.0
        assert abs(track.motion.speed_mps - quiet.speed_mps) < 0.3
    assert len(search(maps, segment, np.zeros_like)) == 1
