"""The Doppler shift of lines: physics of the shift, and which scale of a course it tells."""

import numpy as np
import pytest
import xarray as xr

from obsnet.kinematics import StraightCourse
from obsnet.trackers import line_doppler
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


def levels(course, times, rng, pitches=PITCHES, steady=(), strength=2.5):
    """Line levels as `line_level` has them: lines of a course that move, lines that stay, noise."""
    level = 0.3 * rng.standard_normal((len(times), len(FREQUENCY)))
    for pitch, moved in [(p, shift_of(course, times)) for p in pitches] + [
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


def test_where_another_path_is_the_loudest_the_shift_is_that_of_a_path():
    # Travel time jumps by 3 s at 14.4 km, where the first echo becomes louder than the direct sound.
    grid = np.arange(0.0, 60e3, 250.0)
    delay = Delay(np.hypot(grid, np.where(grid < 14_400.0, 1.0, 3.0) * 4340.0) / 1500.0, 250.0)
    point, tiles = np.array([7200.0, 10_000.0, 60.0, 9.0]), 20.0 * np.arange(720)
    shift = doppler(point, np.array([1.0]), tiles, delay)[0]
    assert np.abs(shift - 1.0).max() < 9.0 / 1500.0


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


@pytest.mark.parametrize(("own", "moved"), [(0.83, False), (0.75, True)])
def test_lines_overrule_ranges_that_are_heard_only_where_they_deny_them(monkeypatch, own, moved):
    """A shaft that turns unevenly leaves much for the ship's own scale, and more for a wrong one."""
    point = np.array([7200.0, 14_000.0, 60.0, 7.5])
    said = np.interp(
        np.log(SCALES), [-1.0, -0.2, 0.0, 0.2, 0.4, 0.7, 1.0], [0.3, own, own, own, 1.0, 0.5, 0.3]
    )
    ranged = np.where(np.abs(np.log(SCALES)) < 0.01, 150.0, 0.0)
    points = point * np.stack([np.ones_like(SCALES), SCALES, np.ones_like(SCALES), SCALES], axis=1)
    monkeypatch.setattr(Lines, "_say", lambda *_: 5000.0 * said)
    monkeypatch.setattr(line_doppler, "at_scales", lambda *_: (points, ranged))
    lines = Lines(np.zeros((2, 2), np.float32), 3.0, 0.02)
    found = lines.rescaled(point, SCALES, np.zeros(2), TABLE, None)
    assert (found is not None) == moved
    if found is not None:
        assert found[0][3] == pytest.approx(7.5 * np.exp(0.4), rel=0.01)


@pytest.mark.parametrize("width", [0.07, 0.42])
def test_a_speed_told_by_lines_is_as_uncertain_as_the_scales_they_agree_to(monkeypatch, width):
    point = np.array([7200.0, 14_000.0, 60.0, 7.5])
    monkeypatch.setattr(Lines, "_say", lambda *_: 1000.0 * (np.abs(np.log(SCALES)) < width))
    mean, std = Lines(np.zeros((2, 2), np.float32), 3.0, 0.02).speed(point, SCALES, np.zeros(2), TABLE, None)
    assert mean == pytest.approx(7.5, rel=1e-3)
    assert std / mean == pytest.approx(np.hypot(0.15, width / np.sqrt(3.0)), abs=0.02)
