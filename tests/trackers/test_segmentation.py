"""Segmentation: presence over hours becomes segments, a departure before an approach splits them."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from obsnet.errors import ConfigError
from obsnet.trackers.segmentation import SegmentationConfig, mixture, quiet_until, segments

T0 = 1_369_123_200.0


def presence(count=1440, ships=(), rng=None):
    """Minutes of presence; a ship is (start, cpa, end) in minutes, closing before its CPA and opening after."""
    rng = rng or np.random.default_rng(0)
    table = pd.DataFrame(
        {
            name: -6.0 + 0.5 * rng.standard_normal(count)
            for name in ("azimuth", "range", "approaching", "leaving")
        },
        index=T0 + 60.0 * np.arange(count),
    )
    for start, cpa, end in ships:
        table.iloc[start:end, 0] = 20.0
        table.iloc[start + 30 : end - 30, 1] = 8.0
        table.iloc[start + 30 : cpa, 2] = 8.0
        table.iloc[cpa : end - 30, 3] = 8.0
    return table


def test_one_ship_is_one_segment_with_its_cpa():
    (segment,) = segments(presence(ships=[(400, 600, 800)]))
    assert segment.start == pytest.approx(T0 + 60 * 400, abs=60 * 45)
    assert segment.end == pytest.approx(T0 + 60 * 800, abs=60 * 45)
    assert segment.cpa == pytest.approx(T0 + 60 * 600, abs=60 * 10)


def test_silence_around_a_record_changes_nothing():
    record = presence(count=200, ships=[(0, 100, 200)])
    (segment,) = segments(record)
    for before, after in ((200, 0), (0, 200), (30, 200)):
        padded = record.reindex(T0 + 60.0 * np.arange(-before, len(record) + after))
        assert segments(padded) == [segment]


def test_a_gap_of_minutes_does_not_split_a_segment():
    whole = presence(ships=[(400, 600, 800)])
    cut = whole.copy()
    cut.iloc[590:610] = np.nan
    assert len(segments(cut)) == len(segments(whole)) == 1


def test_no_segment_reaches_over_times_that_are_left_out():
    # As after a clock that started in 1980: a few minutes, thirty years of nothing, the record.
    record = presence(count=400, ships=[(0, 100, 200)])
    for minutes in (1, 7):
        early = presence(count=minutes)
        early.index -= 1e9
        early[:] = 5.0
        joined = pd.concat([early, record])
        assert segments(joined) == segments(record)
        assert segments(joined, ended=False) == segments(record, ended=False)
        assert quiet_until(joined) == quiet_until(record)
    ships = presence(count=300, ships=[(100, 200, 300)]), presence(count=300, ships=[(0, 100, 200)])
    ships[1].index += 12 * 86400.0
    assert segments(pd.concat(ships)) == [*segments(ships[0]), *segments(ships[1])]


def test_a_segment_is_said_while_the_record_goes_on_once_nothing_can_change_it():
    ships = [(100, 250, 380), (380, 520, 640), (900, 1000, 1100)]
    table = presence(ships=ships)
    whole = segments(table)
    assert len(whole) == 3
    said = []
    for minute in range(2, len(table), 3):
        now = segments(table.iloc[:minute], ended=False)
        assert now == whole[: len(now)]
        said += now[len(said) :]
        if said[1:2]:  # what lies hours before the segments to come no longer matters
            late = table.iloc[max(minute - 500, 0) : minute]
            assert [s for s in segments(late, ended=False) if s.start > late.index[0] + 3 * 3600] == [
                s for s in now if s.start > late.index[0] + 3 * 3600
            ]
    assert said == whole


def test_departure_before_an_approach_splits():
    first, second = segments(presence(ships=[(200, 350, 500), (500, 650, 800)]))
    assert first.end == second.start == pytest.approx(T0 + 60 * 500, abs=60 * 20)
    assert (first.cut, second.cut) == ((False, True), (True, False))
    assert first.cpa == pytest.approx(T0 + 60 * 350, abs=600)
    assert second.cpa == pytest.approx(T0 + 60 * 650, abs=600)


def two_at_once(seed, start=100, end=1100):
    """Presence of a long stretch in whose middle one ship opens while another closes, either missed now and then."""
    rng = np.random.default_rng(seed)
    table = presence(ships=[(start, 200, end)])
    table.iloc[start + 30 : end - 30, 2:] = [8.0, -6.0]
    table.iloc[200:400, 2:] = [-6.0, 8.0]
    both = np.where(rng.random((400, 2)) < 0.2, -6.0, 8.0)
    table.iloc[400:800, 2:] = both
    return table


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_heard_belongs_to_a_segment(seed):
    found = segments(two_at_once(seed))
    whole = segments(presence(ships=[(100, 600, 1100)]))
    assert found[0].start == whole[0].start and found[-1].end == whole[0].end
    assert all(before.end == after.start for before, after in pairwise(found))
    assert all(segment.end - segment.start >= 1800 for segment in found)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_said_of_two_ships_at_once_while_the_record_goes_on_is_what_is_said_in_the_end(seed):
    table = two_at_once(seed)
    whole, said = segments(table), []
    for minute in range(2, len(table), 3):
        now = segments(table.iloc[:minute], ended=False)
        assert now == whole[: len(now)] and now[: len(said)] == said
        said = now
    assert said == whole


def test_silence_is_no_segment():
    assert segments(presence()) == []


def test_one_loud_minute_cannot_make_a_segment():
    table = presence()
    table.iloc[700] = 500.0
    assert segments(table) == []


def test_shorter_than_the_shortest_is_dropped():
    config = SegmentationConfig(average_min=(10,), range_average_min=10, shortest_min=60)
    assert segments(presence(ships=[(400, 420, 440)]), config) == []
    assert len(segments(presence(ships=[(400, 500, 600)]), config)) == 1


def test_a_ship_heard_for_forty_minutes_is_a_segment_although_two_hours_drown_it():
    table = presence(count=600)
    table.iloc[280:320, 0] = 6.0
    assert segments(table, SegmentationConfig(average_min=(120,))) == []
    (segment,) = segments(table)
    assert segment.start == pytest.approx(T0 + 60 * 280, abs=60 * 30)
    assert segment.end == pytest.approx(T0 + 60 * 320, abs=60 * 30)


def test_ten_loud_minutes_are_no_segment():
    table = presence(count=600)
    table.iloc[295:305, 0] = 20.0
    assert segments(table) == []


def test_averaging_windows_must_be_positive():
    with pytest.raises(ConfigError, match="average_min must hold positive minutes"):
        SegmentationConfig(average_min=())
    with pytest.raises(ConfigError, match="average_min must hold positive minutes"):
        SegmentationConfig(average_min=(60, 0))


def test_missing_data_says_nothing():
    table = presence(ships=[(400, 600, 800)])
    table.iloc[580:620] = np.nan
    assert len(segments(table)) == 1
    table.iloc[:] = np.nan
    assert segments(table) == []


def test_azimuth_alone_makes_segments_without_cpa():
    table = presence(ships=[(400, 600, 800)])[["azimuth"]]
    (segment,) = segments(table)
    assert segment.cpa is None


def test_mixture_is_bounded_below_by_a_miss():
    assert mixture(np.array([-1e3]), 0.9)[0] == pytest.approx(np.log(0.1))
    assert mixture(np.array([0.0]), 0.6)[0] == pytest.approx(0.0, abs=1e-12)
    assert mixture(np.array([np.nan]), 0.6)[0] == 0.0


def test_wrong_probability_is_refused():
    with pytest.raises(ConfigError, match="azimuth_detection_probability"):
        SegmentationConfig(azimuth_detection_probability=1.0)
