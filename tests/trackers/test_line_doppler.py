"""The Doppler shift of lines: physics of the shift, and which scale of a course it tells."""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter1d

from obsnet.kinematics import StraightCourse
from obsnet.trackers.course_grid import Delay
from obsnet.trackers.grid_search import search
from obsnet.trackers.line_doppler import Lines, doppler
from tests.trackers.test_grid_search import MINUTES, SEGMENT, T0, delay, maps_of

FREQUENCY = np.arange(62, 492) / 20.48
SCALES = np.exp(0.05 * np.arange(-20, 21))
TABLE = Delay(delay(np.arange(0.0, 150_001.0, 250.0)), 250.0)
PITCHES = (6.1, 8.9, 11.3, 13.7, 17.2, 19.9)


def shift_of(course, times):
    """Pitch heard over pitch emitted: by how much emission times follow each other faster than they are heard."""

    def emitted(at):
        when = np.array(at, float)
        for _ in range(20):
            when = at - delay(course.observables(when)[1])
        return when

    return (emitted(times + 5.0) - emitted(times - 5.0)) / 10.0


def levels(course, times, rng, pitches=PITCHES, steady=(), strength=2.5, wander=0.0):
    """Line levels as `line_level` has them: lines of a course that move, whose shaft wanders within ten minutes, lines that stay, noise."""
    level = 0.3 * rng.standard_normal((len(times), len(FREQUENCY)))
    turns = gaussian_filter1d(rng.standard_normal(len(times)), 300.0 / np.diff(times).mean())
    turns = 1.0 + wander * turns / turns.std()
    for pitch, moved in [(p, turns * shift_of(course, times)) for p in pitches] + [
        (p, np.ones(len(times))) for p in steady
    ]:
        level += strength * np.exp(-0.5 * ((FREQUENCY - (pitch * moved)[:, None]) / 0.045) ** 2)
    return level.astype(np.float32)


def with_lines(maps, level):
    return maps.assign(
        line_level=xr.DataArray(
            level, {"time": maps["time"], "line_frequency": FREQUENCY}, ("time", "line_frequency")
        )
    )


def test_the_shift_is_the_rate_of_emission():
    course = StraightCourse(T0 + 7200.0, 6_000.0, 60.0, 9.0)
    point = np.array([7200.0, 3_000.0, 60.0, 4.5])
    found = doppler(point, np.array([2.0]), MINUTES - T0, TABLE)[0]
    np.testing.assert_allclose(found, shift_of(course, MINUTES), atol=2e-5)
    assert found[0] > 1.004 and found[-1] < 0.996  # pitch falls as the ship goes by


@pytest.mark.parametrize("steady", [(), (5.0, 7.5, 10.0, 12.5, 15.0, 20.0)])
@pytest.mark.parametrize("scale", [0.5, 0.75, 1.0, 1.6])
def test_lines_fall_on_each_other_along_the_right_scale(scale, steady):
    course = StraightCourse(T0 + 7200.0, 9_000.0, 60.0, 9.0)
    point = np.array([7200.0, 9_000.0 / scale, 60.0, 9.0 / scale])
    tiles = MINUTES[::3]
    lines = Lines.of(levels(course, tiles, np.random.default_rng(1), steady=steady), FREQUENCY)
    said = lines.evidence(point, SCALES, tiles - T0, 0, len(tiles) - 1, TABLE)
    assert said.max() > 300.0
    assert np.log(SCALES[said.argmax()]) == pytest.approx(np.log(scale), abs=0.16)


@pytest.mark.parametrize("steady", [(), (5.0, 10.0, 20.0)])
def test_noise_and_lines_that_stay_say_little(steady):
    tiles = MINUTES[::3]
    course = StraightCourse(T0 + 7200.0, 9_000.0, 60.0, 9.0)
    level = levels(course, tiles, np.random.default_rng(2), pitches=(), steady=steady)
    point = np.array([7200.0, 9_000.0, 60.0, 9.0])
    said = Lines.of(level, FREQUENCY).evidence(point, SCALES, tiles - T0, 0, len(tiles) - 1, TABLE)
    assert said.max() < 300.0


def test_gaps_hold_no_lines():
    level = np.full((50, len(FREQUENCY)), np.nan, np.float32)
    point = np.array([0.0, 9_000.0, 60.0, 9.0])
    said = Lines.of(level, FREQUENCY).evidence(point, SCALES, 180.0 * np.arange(50), 0, 49, TABLE)
    np.testing.assert_array_equal(said, 0.0)


def test_lines_tell_the_speed_of_a_ship_whose_range_is_not_heard():
    truth = StraightCourse(T0 + 7000.0, 14_000.0, 60.0, 12.0)
    rng = np.random.default_rng(3)
    maps = maps_of([truth], MINUTES, rng).drop_vars(["range_llr", "range_coverage"])
    (without,) = search(maps, SEGMENT, delay)
    assert abs(without.motion.speed_mps - 7.5) < 2.0
    (found,) = search(with_lines(maps, levels(truth, MINUTES, rng)), SEGMENT, delay)
    assert "from the Doppler shift of its lines" in found.method
    assert found.motion.speed_mps == pytest.approx(12.0, rel=0.2)
    assert abs(found.motion.speed_mps - 12.0) < 2.0 * found.std[3]
    assert abs(found.motion.cpa_range_m - 14_000.0) < 2.0 * found.std[1]


def test_lines_tell_a_ship_from_its_ghost():
    truth = StraightCourse(T0 + 7000.0, 16_000.0, 60.0, 11.0)
    ghost = StraightCourse(T0 + 7000.0, 8_000.0, 60.0, 5.5)
    rng = np.random.default_rng(4)
    maps = maps_of([truth], MINUTES, rng, strength=3.0, ghosts=False)
    maps["range_llr"] = np.maximum(
        maps["range_llr"], maps_of([ghost], MINUTES, rng, strength=3.6, ghosts=False)["range_llr"]
    )
    (taken_in,) = search(maps, SEGMENT, delay)
    assert taken_in.motion.speed_mps == pytest.approx(5.5, abs=0.5)
    (found,) = search(with_lines(maps, levels(truth, MINUTES, rng)), SEGMENT, delay)
    assert found.motion.speed_mps == pytest.approx(11.0, abs=0.6)
    assert found.motion.cpa_range_m == pytest.approx(16_000.0, abs=800.0)


def test_lines_that_agree_change_nothing():
    truth = StraightCourse(T0 + 7000.0, 12_000.0, 60.0, 9.0)
    rng = np.random.default_rng(5)
    maps = maps_of([truth], MINUTES, rng)
    (without,) = search(maps, SEGMENT, delay)
    (found,) = search(with_lines(maps, levels(truth, MINUTES, rng)), SEGMENT, delay)
    assert found.motion == without.motion and found.method == without.method


@pytest.mark.parametrize("seed", range(4))
def test_a_shaft_that_turns_unevenly_moves_no_ship_whose_range_is_heard(seed):
    truth = StraightCourse(T0 + 7000.0, 14_000.0, 60.0, 7.5)
    rng = np.random.default_rng(seed)
    maps = maps_of([truth], MINUTES, rng)
    (found,) = search(
        with_lines(maps, levels(truth, MINUTES, rng, (8.7, 17.4), wander=0.002)), SEGMENT, delay
    )
    assert found.motion.speed_mps == pytest.approx(7.5, abs=0.4)
    assert found.motion.cpa_range_m == pytest.approx(14_000.0, abs=600.0)


def test_the_speed_of_uneven_lines_is_as_uncertain_as_they_are():
    """Of ships whose range is not heard, the stated speeds hold the true ones."""
    off, std = [], []
    for seed, speed in enumerate((5.0, 7.0, 9.0, 11.0, 13.0) * 2):
        truth = StraightCourse(T0 + 7000.0, 6_000.0, 60.0, speed)
        rng = np.random.default_rng(seed)
        maps = maps_of([truth], MINUTES, rng).drop_vars(["range_llr", "range_coverage"])
        (found,) = search(
            with_lines(maps, levels(truth, MINUTES, rng, (9.5, 19.0), wander=0.002)), SEGMENT, delay
        )
        off.append(found.motion.speed_mps - speed)
        std.append(found.std[3])
    assert (np.abs(off) < 2.0 * np.array(std)).mean() >= 0.8
