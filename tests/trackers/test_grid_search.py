"""Grid search: known courses come back, on the right side, where the ship was; nothing comes from nothing."""

import re
from unittest.mock import ANY

import numpy as np
import pytest
import xarray as xr

from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import from_posix
from obsnet.trackers.course_grid import shares
from obsnet.trackers.grid_search import GridSearchConfig, _Finder, search
from obsnet.trackers.score_maps import lobe
from obsnet.trackers.track import Segment, Track

T0 = 1_369_123_200.0
AZIMUTH = np.arange(0.0, 360.0)
RANGE = 70.0 * np.arange(715)
RATE = 0.5 * np.arange(-26, 27)


def delay(range_m):
    """Travel time of the second path in 4340 m of water of 1500 m/s."""
    return np.hypot(range_m, 3 * 4340.0) / 1500.0


def heard(course, times):
    emitted = np.array(times, float)
    for _ in range(20):
        emitted = times - delay(course.observables(emitted)[1])
    return course.observables(emitted)


def maps_of(courses, minutes, rng, azimuth_std=3.0, range_std=250.0, strength=8.0, miss=0.15, ghosts=True):
    """Maps with one blob per ship and minute, scattered, missed now and then, with a ghost range branch."""
    azimuth_llr = -2.0 + 0.3 * rng.standard_normal((len(minutes), 360))
    range_llr = -1.0 + 0.3 * rng.standard_normal((len(minutes), len(RANGE), len(RATE)))
    for course in courses:
        azimuth, distance, rate = heard(course, minutes)
        for m in range(len(minutes)):
            if rng.random() > miss and distance[m] < 90_000:
                seen = azimuth[m] + azimuth_std * rng.standard_normal()
                azimuth_llr[m] += (strength + 2) * np.exp(-0.5 * (wrap180(AZIMUTH - seen) / azimuth_std) ** 2)
            if 7_000 < distance[m] < 45_000 and rng.random() > miss:
                seen = distance[m] + 0.3 * range_std * rng.standard_normal()
                speed = np.exp(-0.5 * ((RATE - rate[m]) / 0.7) ** 2)
                for where in (seen, 0.6 * seen)[: 2 if ghosts else 1]:
                    blob = np.exp(-0.5 * ((RANGE - where) / range_std) ** 2)
                    range_llr[m] += (strength + 1) * blob[:, None] * speed
    return xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), azimuth_llr.astype(np.float32)),
            "range_llr": (("time", "range", "range_rate"), range_llr.astype(np.float32)),
            "azimuth_coverage": ("time", np.ones(len(minutes), np.float32)),
            "range_coverage": ("time", np.ones(len(minutes), np.float32)),
        },
        coords={"time": from_posix(minutes), "azimuth": AZIMUTH, "range": RANGE, "range_rate": RATE},
    )


MINUTES = T0 + 60.0 * np.arange(240)
SEGMENT = Segment(MINUTES[0], MINUTES[-1], T0 + 7200.0)


@pytest.mark.parametrize(
    ("cpa_range", "course"),
    [(10_000.0, 5.0), (-10_000.0, 122.0), (4_000.0, 122.0), (-25_000.0, 5.0), (9_000.0, 263.0)],
)
def test_known_course_comes_back_on_its_side(cpa_range, course):
    truth = StraightCourse(T0 + 7000.0, cpa_range, course, 8.3)
    maps = maps_of([truth], MINUTES, np.random.default_rng(int(abs(cpa_range) + course)))
    segment = SEGMENT if course < 200 else Segment(MINUTES[0], MINUTES[-1], None)
    (found, *_) = search(maps, segment, delay)
    assert abs(found.motion.cpa_time - truth.cpa_time) < 60.0
    assert abs(found.motion.cpa_range_m - cpa_range) < 400.0
    assert abs(wrap180(found.motion.course_deg - course)) < 2.0
    assert abs(found.motion.speed_mps - 8.3) < 0.2
    assert found.log_bayes_factor > 50.0


def test_a_fast_liner_is_a_ship_and_leaves_nothing_to_be_taken_for_one():
    truth = StraightCourse(T0 + 6600.0, 8_000.0, 92.0, 12.9)
    (found,) = search(maps_of([truth], MINUTES, np.random.default_rng(12)), SEGMENT, delay)
    assert abs(found.motion.speed_mps - 12.9) < 0.4
    assert abs(found.motion.cpa_range_m - 8_000.0) < 500.0


def test_one_ship_gives_one_track_and_ghosts_none():
    truth = StraightCourse(T0 + 7000.0, 12_000.0, 60.0, 9.0)
    tracks = search(maps_of([truth], MINUTES, np.random.default_rng(2)), SEGMENT, delay)
    assert len(tracks) == 1


def test_a_detector_that_prefers_any_ship_to_none_gives_no_further_ship():
    """Log-likelihood ratios against no ship are positive at all azimuths where a loud ship is heard."""
    truth = StraightCourse(T0 + 7000.0, 12_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(8))
    bend = 1.5 * np.cos(np.deg2rad(2.0 * (AZIMUTH - 100.0)))
    maps["azimuth_llr"] += (5.0 + bend).astype(np.float32)
    assert len(search(maps, SEGMENT, delay)) == 1


@pytest.mark.parametrize("speed", [1.2, 1.9])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_whale_that_swims_about_is_no_ship(speed, side):
    """Its echoes place it as a ship's do, and heard for half an hour it seems to go at 3 or 4 m/s."""
    whale = StraightCourse(T0 + 3000.0, side * 26_000.0, 280.0, speed)
    minutes = MINUTES[:36]
    for seed in range(4):
        maps = maps_of([whale], minutes, np.random.default_rng(seed), 6.0, 500.0, 7.0, ghosts=False)
        assert not search(maps, Segment(minutes[0], minutes[-1]), delay)


def test_a_slow_ship_is_told_from_a_whale_within_the_hour():
    ship = StraightCourse(T0 + 1500.0, -14_000.0, 40.0, 4.0)
    minutes = MINUTES[:60]
    (found,) = search(
        maps_of([ship], minutes, np.random.default_rng(5)), Segment(minutes[0], minutes[-1]), delay
    )
    assert abs(found.motion.speed_mps - 4.0) < 0.3


def test_two_ships_at_once_are_two_tracks():
    ships = [
        StraightCourse(T0 + 6000.0, 12_000.0, 60.0, 9.0),
        StraightCourse(T0 + 9000.0, -18_000.0, 240.0, 7.0),
    ]
    tracks = search(maps_of(ships, MINUTES, np.random.default_rng(3)), SEGMENT, delay)
    assert len(tracks) == 2
    for ship in ships:
        assert (
            min(
                abs(t.motion.cpa_time - ship.cpa_time) + abs(t.motion.cpa_range_m - ship.cpa_range_m)
                for t in tracks
            )
            < 600
        )


def test_a_further_ship_may_pass_hours_from_the_segments_turn():
    """The segment's turn from closing to opening is the first ship's alone."""
    ships = [
        StraightCourse(T0 + 2500.0, 12_000.0, 60.0, 9.0),
        StraightCourse(T0 + 12_000.0, -9_000.0, 240.0, 7.0),
    ]
    segment = Segment(MINUTES[0], MINUTES[-1], T0 + 2500.0)
    tracks = search(maps_of(ships, MINUTES, np.random.default_rng(7)), segment, delay)
    assert len(tracks) == 2
    assert min(abs(t.motion.cpa_time - ships[1].cpa_time) for t in tracks) < 60.0


def test_the_next_ship_on_the_lane_is_not_taken_for_the_one_long_gone():
    """Both go to the same azimuth; only the first explains what was heard before it was out of earshot."""
    gone = StraightCourse(T0 - 6 * 3600.0, 15_000.0, 60.0, 7.0)
    known = Track(
        gone.cpa_time - 9000.0, gone.cpa_time + 9000.0, gone, np.diag([30.0, 200.0, 1.0, 0.1]) ** 2, 500.0
    )
    coming = StraightCourse(T0 + 5000.0, 4_000.0, 60.0, 8.0)
    (found,) = search(maps_of([coming], MINUTES, np.random.default_rng(4)), SEGMENT, delay, known=[known])
    assert abs(found.motion.cpa_time - coming.cpa_time) < 60.0
    assert found.end - found.start > 200 * 60.0


@pytest.mark.parametrize(
    ("std", "count"), [((30.0, 200.0), 2), ((2000.0, 3000.0), 1), ((300.0, 12_000.0), 1)]
)
def test_what_is_located_nowhere_may_be_a_first_ship_but_no_further_one(monkeypatch, std, count):
    """What is left of a known ship is a piece of course that fits many; of a far ship alone no more may be known."""

    def ship(cpa_range, spread):
        course = StraightCourse(T0 + 7000.0, cpa_range, 60.0, 8.0)
        extra = {"heard": 0.9, "log_bayes_factor_fixed": 200.0}
        covariance = np.diag([*spread, 5.0, 0.5]) ** 2
        return Track(MINUTES[0], MINUTES[-1], course, covariance, 300.0, extra=extra)

    for first in (std, (30.0, 200.0)):
        found = iter([ship(10_000.0, first), ship(-15_000.0, std), None])
        monkeypatch.setattr(_Finder, "find", lambda self, *maps, found=found: next(found))
        maps = maps_of([], MINUTES, np.random.default_rng(1))
        assert len(search(maps, SEGMENT, delay)) == count


@pytest.mark.parametrize(
    ("begins", "spread", "evidence", "count"),
    [(130, 900.0, 40.0, 2), (130, 900.0, 20.0, 1), (90, 900.0, 40.0, 1), (90, 900.0, 80.0, 2), (90, 200.0, 12.0, 2), (90, 200.0, 8.0, 1)],
)  # fmt: skip
def test_a_further_ship_apart_from_others_or_located_sharply_needs_less_evidence(
    monkeypatch, begins, spread, evidence, count
):
    """The first ship's remainder can only be heard while that ship is, and fits many courses: where that can not be, less is believed."""

    def ship(cpa_range, first, last, evidence):
        course = StraightCourse(T0 + 7000.0, cpa_range, 60.0, 8.0)
        extra = {"heard": 0.9, "log_bayes_factor_fixed": 200.0}
        covariance = np.diag([30.0, spread, 5.0, 0.5]) ** 2
        return Track(MINUTES[first], MINUTES[last], course, covariance, evidence, extra=extra)

    found = iter([ship(10_000.0, 0, 130, 300.0), ship(-15_000.0, begins, 239, evidence), None])
    monkeypatch.setattr(_Finder, "find", lambda self, *maps, found=found: next(found))
    maps = maps_of([], MINUTES, np.random.default_rng(1))
    assert len(search(maps, SEGMENT, delay)) == count


@pytest.mark.parametrize(
    ("minutes", "std", "moving", "count"),
    [(14, (10.0, 150.0), 60.0, 1), (20, (200.0, 150.0), 60.0, 0), (20, (10.0, 900.0), 60.0, 0),
     (20, (10.0, 150.0), 20.0, 0), (10, (10.0, 150.0), 60.0, 0), (30, (200.0, 900.0), 20.0, 1)],
)  # fmt: skip
def test_a_brief_ship_must_be_located_sharply_and_move(monkeypatch, minutes, std, moving, count):
    """A fast ship that passes overhead, or beside a louder one, is heard for a quarter of an hour, and where it was is then known well."""
    course = StraightCourse(T0 + 7000.0, 800.0, 60.0, 12.0)
    extra = {"heard": 0.9, "log_bayes_factor_fixed": moving}
    covariance = np.diag([*std, 5.0, 0.5]) ** 2
    found = iter([Track(MINUTES[100], MINUTES[100 + minutes], course, covariance, 60.0, extra=extra), None])
    monkeypatch.setattr(_Finder, "find", lambda self, *maps: next(found))
    assert len(search(maps_of([], MINUTES, np.random.default_rng(1)), SEGMENT, delay)) == count


def test_two_lobes_of_noise_that_take_turns_are_no_ship():
    """Opposite lobes look like a ship that comes from one and goes to the other, but they come and go."""
    rng = np.random.default_rng(6)
    maps = maps_of([], MINUTES, rng)
    towards = np.where(np.repeat(rng.random(16) < 0.5, 15), 345.0, 162.0) + 4.0 * rng.standard_normal(240)
    turn = wrap180(AZIMUTH - towards[:, None])
    maps["azimuth_llr"] = maps["azimuth_llr"] + 8.0 * np.exp(-0.5 * (turn / 6.0) ** 2).astype(np.float32)
    assert search(maps, SEGMENT, delay) == []


@pytest.mark.parametrize(("together", "agreeing"), [(240, 1.0), (0, 0.0)])
def test_sensors_agree_where_they_hear_a_course_in_the_same_tiles(together, agreeing):
    """A range heard in the first half and an azimuth in the second may be two ships'."""
    course = StraightCourse(MINUTES[120], 8000.0, 30.0, 7.0)
    maps = maps_of([course], MINUTES, np.random.default_rng(2), miss=0.0, ghosts=False)
    half = np.arange(240) < 120
    maps["azimuth_llr"][np.flatnonzero(half)[together:]] = -0.1
    maps["range_llr"][np.flatnonzero(~half)[together:]] = -0.1
    finder = _Finder(maps, MINUTES[::3], delay, GridSearchConfig(), 1)
    given = maps["azimuth_llr"].values[::3], maps["range_llr"].values[::3]
    scores = finder._score_maps(*given, jointly=False, pool=1, stds=(280.0, 3.0, 0.5))
    point = np.array([MINUTES[120] - MINUTES[0], 8000.0, 30.0, 7.0])
    assert shares(point, finder.tiles, finder.delay, scores).agreeing == pytest.approx(agreeing, abs=0.1)


@pytest.mark.parametrize(("extra", "count"), [({}, 1), ({"agreeing": 0.4}, 0), ({"steady": 400.0}, 0)])
def test_neither_two_ships_in_one_course_nor_steady_sources_are_a_track(monkeypatch, extra, count):
    course = StraightCourse(T0 + 7000.0, 8000.0, 60.0, 8.0)
    covariance = np.diag([30.0, 200.0, 5.0, 0.5]) ** 2
    said = {"heard": 0.9, "log_bayes_factor_fixed": 200.0, "score": 330.0} | extra
    found = iter([Track(MINUTES[0], MINUTES[-1], course, covariance, 300.0, extra=said), None])
    monkeypatch.setattr(_Finder, "find", lambda self, *maps: next(found))
    assert len(search(maps_of([], MINUTES, np.random.default_rng(1)), SEGMENT, delay)) == count


def test_a_ship_heard_for_a_third_of_an_hour_beside_a_louder_one_is_found_by_where_it_is():
    """What is left of a louder ship may say more, but of no one course."""
    rng = np.random.default_rng(5)
    loud, brief = (
        StraightCourse(T0 + 7000.0, 12_000.0, 60.0, 7.0),
        StraightCourse(MINUTES[150], -8_500.0, 330.0, 13.0),
    )
    maps, other = maps_of([loud], MINUTES, rng), maps_of([brief], MINUTES, rng, strength=6.0)
    there = abs(np.arange(len(MINUTES)) - 150) <= 9
    for name in ("azimuth_llr", "range_llr"):
        maps[name][there] = np.maximum(maps[name][there].values, other[name][there].values)
    first, second = search(maps, SEGMENT, delay)
    assert abs(first.motion.cpa_time - loud.cpa_time) < 60.0
    assert second.log_bayes_factor < GridSearchConfig().min_log_bayes_factor_next
    assert abs(second.motion.cpa_time - brief.cpa_time) < 60.0
    assert abs(second.motion.cpa_range_m - brief.cpa_range_m) < 500.0
    assert abs(wrap180(second.motion.course_deg - brief.course_deg)) < 15.0


def test_one_ships_range_on_anothers_azimuth_is_looked_for_anew_where_both_are_heard(monkeypatch):
    """Taken out as it is, such a course would take both ships with it."""
    given = {"heard": 0.9, "log_bayes_factor_fixed": 200.0}

    def found(self, azimuth, distance, least, jointly):
        if (taken := azimuth is not whole) and len(asked) > 1:
            return None
        asked.append((jointly, taken))
        course = StraightCourse(T0 + 7000.0, 8000.0 if jointly else 5000.0, 60.0, 8.0)
        extra = given | {"agreeing": 1.0 if jointly else 0.2}
        return Track(
            MINUTES[0], MINUTES[-1], course, np.diag([30.0, 200.0, 5.0, 0.5]) ** 2, 300.0, extra=extra
        )

    maps = maps_of([], MINUTES, np.random.default_rng(1))
    finder = _Finder(maps, MINUTES[::3], delay, GridSearchConfig(), 1)
    whole, asked, tracks = maps["azimuth_llr"].values[::3], [], []
    monkeypatch.setattr(_Finder, "find", found)
    finder.one_by_one(tracks, [], whole, maps["range_llr"].values[::3])
    assert asked == [(False, False), (True, False)]
    assert [track.motion.cpa_range_m for track in tracks] == [8000.0]


def test_lobe_of_a_ship_ends_where_anothers_begins():
    azimuth = np.arange(360.0)
    row = 10.0 * np.exp(-0.5 * ((azimuth - 100.0) / 6.0) ** 2) + 8.0 * np.exp(
        -0.5 * ((azimuth - 125.0) / 4.0) ** 2
    )
    explained = lobe(row[None].astype(np.float32) - 1.0, azimuth, np.array([98.0]), 30.0)[0]
    assert explained[88:109].all()
    assert not explained[118:].any() and not explained[:68].any()
    assert (
        lobe(np.full((1, 360), 5.0), azimuth, np.array([1.0]), 30.0)[0].nonzero()[0]
        == [*range(32), *range(331, 360)]
    ).all()


def test_no_ship_gives_no_track():
    assert search(maps_of([], MINUTES, np.random.default_rng(4)), SEGMENT, delay) == []


def test_travel_time_is_undone():
    """Without the delay the CPA comes out late by a travel time, of the CPA's range at least."""
    truth = StraightCourse(T0 + 7000.0, 12_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(5), miss=0.0, azimuth_std=1.0, range_std=150.0)
    with_delay = search(maps, SEGMENT, delay)[0].motion.cpa_time
    without = search(maps, SEGMENT, lambda r: np.zeros_like(r))[0].motion.cpa_time
    assert abs(with_delay - truth.cpa_time) < 5.0
    assert delay(12_000.0) < without - with_delay < delay(60_000.0)


def test_ship_heard_for_part_of_the_segment_has_that_extent():
    truth = StraightCourse(T0 + 4000.0, 9_000.0, 300.0, 8.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(6))
    silent = slice(150, None)
    maps["azimuth_llr"][silent] = -2.0
    maps["range_llr"][silent] = -1.0
    (found, *_) = search(maps, SEGMENT, delay)
    assert found.end == pytest.approx(MINUTES[150], abs=600.0)
    assert abs(found.motion.cpa_time - truth.cpa_time) < 60.0


def test_covariance_covers_the_errors():
    """Errors over many passages stay within what the covariance says: the mean squared normalised error is near 4."""
    squared = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        truth = StraightCourse(T0 + rng.uniform(5000, 9000), rng.choice([-1, 1]) * rng.uniform(5e3, 2e4),
                               rng.uniform(0, 360), rng.uniform(5, 11))  # fmt: skip
        (found, *_) = search(maps_of([truth], MINUTES, rng, ghosts=False), SEGMENT, delay)
        m = found.motion
        error = np.array([m.cpa_time - truth.cpa_time, m.cpa_range_m - truth.cpa_range_m,
                          wrap180(m.course_deg - truth.course_deg), m.speed_mps - truth.speed_mps])  # fmt: skip
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert np.median(squared) < 12.0
    assert all(np.isfinite(squared))


def test_range_alone_finds_the_passage_but_no_course():
    truth = StraightCourse(T0 + 7000.0, 10_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(8)).drop_vars(
        ["azimuth_llr", "azimuth_coverage", "azimuth"]
    )
    (found,) = search(maps, SEGMENT, delay)
    assert abs(found.motion.cpa_time - truth.cpa_time) < 60.0
    assert abs(found.motion.cpa_range_m) == pytest.approx(10_000.0, abs=400.0)
    assert np.isinf(found.std[2]) and np.isnan(found.row(1)["course_deg"])


@pytest.mark.parametrize("distance", [600.0, 1200.0])
def test_range_alone_tells_how_near_a_ship_passes_on_either_side(distance):
    """Both sides fit alike: their mean would be a ship overhead."""
    truth = StraightCourse(T0 + 7200.0, distance, 60.0, 9.0)
    minutes = MINUTES[::3]
    _, range_m, rate = heard(truth, minutes)
    beside, slower = (RANGE - range_m[:, None]) / 150.0, (RATE - rate[:, None]) / 0.7
    llr = 12.0 * np.exp(-0.5 * (beside[:, :, None] ** 2 + slower[:, None, :] ** 2)) - 3.0
    maps = xr.Dataset(
        {"range_llr": (("time", "range", "range_rate"), llr.astype(np.float32))},
        coords={"time": from_posix(minutes), "range": RANGE, "range_rate": RATE},
    )
    (found,) = search(maps, SEGMENT, delay)
    assert found.motion.cpa_range_m == pytest.approx(distance, abs=0.35 * distance)
    assert found.std[1] < 0.5 * distance


@pytest.mark.parametrize(("strength", "open"), [(1.2, True), (0.5, False)])
def test_a_ghost_as_loud_as_the_ship_is_said(strength, open):
    """A course at twice the distance and speed has the same bearings."""
    truth, twice = (StraightCourse(T0 + 7000.0, s * 6_000.0, 60.0, s * 5.0) for s in (1.0, 2.0))
    maps, ghost = (
        maps_of([course], MINUTES, np.random.default_rng(6), ghosts=False, miss=0.0) for course in (truth, twice)
    )  # fmt: skip
    maps["range_llr"] = np.maximum(maps["range_llr"], strength * ghost["range_llr"])
    (found,) = search(maps, SEGMENT, delay)
    assert found.motion.cpa_range_m == pytest.approx(6_000.0, abs=400.0)
    said = re.search(r"nearly as likely (.*) km at (.*) m/s", found.method)
    assert (said is not None) is open
    if said is not None:
        assert float(said[1]) == pytest.approx(12.0, abs=0.5) and float(said[2]) == pytest.approx(
            10.0, abs=0.3
        )
        assert found.std[1] > 2500.0 and found.std[3] > 2.0
    else:
        assert found.std[1] < 500.0


def test_azimuths_known_up_to_180_degrees_give_a_ship_once():
    truth = StraightCourse(T0 + 7000.0, 9_000.0, 60.0, 8.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(5)).drop_vars(["range_llr", "range_coverage"])
    opposite = np.roll(maps["azimuth_llr"].values, 180, axis=1)
    maps["azimuth_llr"] = ("time", "azimuth"), np.maximum(maps["azimuth_llr"].values, opposite)
    maps["azimuth"].attrs["ambiguity_deg"] = 180
    (found,) = search(maps, SEGMENT, delay)
    assert abs(found.motion.cpa_time - truth.cpa_time) < 120.0
    assert abs(wrap180(2.0 * (found.motion.course_deg - 60.0))) < 20.0
    assert found.motion.cpa_range_m > 0
    assert "no range maps: speed taken as 7.5" in found.method
    assert abs(found.motion.speed_mps - 7.5) < 2.0 and 1.0 < found.std[3] < 3.0


def test_azimuths_without_data_are_no_azimuths():
    """A horizontal that is dead throughout leaves maps of NaN: no course comes of them."""
    truth = StraightCourse(T0 + 7000.0, 10_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(8))
    maps["azimuth_llr"][:] = np.nan
    (found,) = search(maps, SEGMENT, delay)
    (alone,) = search(maps.drop_vars(["azimuth_llr", "azimuth_coverage", "azimuth"]), SEGMENT, delay)
    assert found.row(1) == alone.row(1) | dict.fromkeys(
        ["cpa_azimuth_deg", "course_deg", "course_std_deg"], ANY
    )
    assert np.isnan(found.row(1)["course_deg"]) and "course not observed" in found.method


def test_a_slow_ship_is_found_though_not_one_against_the_edge_of_the_prior():
    for speed, ships in ((3.15, 1), (2.6, 0)):
        truth = StraightCourse(T0 + 7000.0, 5_000.0, 60.0, speed)
        maps = maps_of([truth], MINUTES, np.random.default_rng(11))
        found = search(maps.drop_vars(["azimuth_llr", "azimuth_coverage", "azimuth"]), SEGMENT, delay)
        assert len(found) == ships
        assert all(abs(track.motion.speed_mps - speed) < 0.1 for track in found)


def test_missing_minutes_say_nothing():
    truth = StraightCourse(T0 + 7000.0, 10_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(9))
    maps["azimuth_llr"][90:130] = np.nan
    maps["range_llr"][60:150] = np.nan
    (found, *_) = search(maps, SEGMENT, delay)
    assert abs(found.motion.cpa_time - truth.cpa_time) < 60.0


def test_search_keeps_the_best_of_its_grid():
    """The best score is that of a slow scan over the finest grid around the truth, never below it."""
    truth = StraightCourse(T0 + 7000.0, 10_000.0, 60.0, 9.0)
    maps = maps_of([truth], MINUTES, np.random.default_rng(10))
    few = search(maps, SEGMENT, delay, GridSearchConfig(candidates=1))[0]
    many = search(maps, SEGMENT, delay, GridSearchConfig(candidates=8))[0]
    assert many.extra["score"] >= few.extra["score"] - 1e-6


def test_a_ship_whose_range_is_nowhere_heard_has_bearings_alone():
    """Range maps that speak against every range, most against near ones, must not decide how far away and fast it is."""
    rng = np.random.default_rng(7)
    course = StraightCourse(T0 + 7200.0, 3_000.0, 60.0, 6.0)
    minutes = T0 + 60.0 * np.arange(240)
    maps = maps_of([course], minutes, rng, strength=10.0)
    deaf = -1.0 - 2.0 * np.exp(-RANGE / 20_000.0) + 0.2 * rng.standard_normal(maps["range_llr"].shape[:2])
    maps["range_llr"] = maps["range_llr"].copy(
        data=np.repeat(deaf[..., None], len(RATE), axis=2).astype(np.float32)
    )
    (track,) = search(maps, Segment(minutes[0], minutes[-1]), delay)
    assert "no range heard" in track.method
    assert abs(track.motion.cpa_time - course.cpa_time) < 30.0
    assert abs(wrap180(track.motion.course_deg - course.course_deg)) < 2.0
    assert track.motion.cpa_range_m / track.motion.speed_mps == pytest.approx(500.0, rel=0.1)
    assert abs(track.motion.speed_mps - 7.5) < 2.0
    assert 1.0 < track.std[3] < 3.0
    assert abs(track.motion.cpa_range_m - 3_000.0) < 2.0 * track.std[1] < 3_000.0
