"""Where a record ends and another begins: new channels, long silences, clocks set back, other settings; and kills there."""

from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise

import pytest

import obsnet
from obsnet.config import build
from obsnet.layout import iso, parse_utc
from obsnet.live.config import LiveConfig
from obsnet.live.sources import Folder
from obsnet.pipeline import RunConfig
from obsnet.run import detections_csv
from obsnet.serve.folder import LiveFolder

from .conftest import SMALL, Given, by_eight, differences, rows
from .test_survival import Ring
from .test_trouble import in_order, shifted

DAY_S = 86400.0


class Killed(BaseException):
    """The process is no more."""


def killed_after(station, commits):
    """Let a station write so many transactions and not one more."""
    real, left = station.store.transaction, [commits]

    @contextmanager
    def counted():
        with real() as store:
            yield store
        left[0] -= 1
        if not left[0]:
            raise Killed

    station.store.transaction = counted


def killed_again_and_again(live, made, first, last):
    """A station that is killed after every commit of the packets from `first` to `last`, and the one after it."""
    live().run(Ring(made[:first], {}))
    running = live()
    while running.resume["sequence"] < last:
        killed_after(running, 1 + running.resume["sequence"] % 2)
        with suppress(Killed):
            running.run(Ring(made[:last], running.resume))
        running = live()
    running.run(Ring(made, running.resume), once=True)
    return running


def test_a_kill_after_a_channel_has_come_late_changes_nothing(live, hour, tmp_path):
    begin = hour[0].stats.starttime.ns / 1e9
    late = [p for p in in_order(hour) if p.seed_id[-3:] != "BDH" or p.start_ns / 1e9 - begin > 1500.0]
    first = next(i for i, p in enumerate(late) if p.seed_id.endswith("BDH"))
    live(tmp_path / "whole").run(Ring(late, {}), once=True)
    killed_again_and_again(live, late, first // 6 * 6 - 12, first + 60)
    expected = rows(tmp_path / "whole")
    assert sum(row.split(",")[2] != "" for row in expected) > 5
    assert rows(tmp_path / "live") == expected


def parted(hour, seconds, silence_s):
    """The hour with a silence after some seconds, and the part before it."""
    begin = hour[0].stats.starttime
    before, after = hour.slice(begin, begin + seconds).copy(), hour.slice(begin + seconds + 1).copy()
    for trace in after:
        trace.stats.starttime += silence_s
    return before + after, before


@pytest.mark.parametrize("how", ["whole", "killed"])
def test_a_silence_of_weeks_is_passed_over(live, hour, station, table, tmp_path, how):
    """As a digitiser that boots with an old clock makes it: the rows of a batch run, and the ship's track."""
    both, before = parted(hour, 2700, 12 * DAY_S)
    made = in_order(both)
    last = next(i for i, p in enumerate(made) if p.start_ns / 1e9 > before[0].stats.endtime.timestamp + DAY_S)
    if how == "killed":
        running = killed_again_and_again(live, made, last - 20, last + 60)
    else:
        running = live()
        running.run(Given(by_eight(made)), once=True)
    run = obsnet.detect(both, station, build(RunConfig, SMALL), table=table, threads=1)
    assert 50 < len(run.detections) < 70
    assert differences(rows(tmp_path / "live"), detections_csv(run.detections).splitlines()[1:]) == []
    assert any("passed over" in note for note in running.buffer.report.notes) or how == "killed"
    (track,) = obsnet.track(before, station, build(RunConfig, SMALL), table=table, threads=1).tracks
    (found,) = running.ships.tracks()
    assert (found.start, found.end) == (track.start, track.end)
    assert abs(found.motion.cpa_time - track.motion.cpa_time) < 0.5


def test_a_ship_before_a_silence_longer_than_the_memory_has_its_track(live, hour, small, tmp_path):
    both, before = parted(hour, 2700, 6 * 3600.0)
    running = live(config=replace(small, live=LiveConfig(memory_h=2.0)))
    running.run(Given(by_eight(in_order(both))), once=True)
    (found,) = running.ships.tracks()
    assert found.end <= before[0].stats.endtime.timestamp


def late_for_half_an_hour(monkeypatch):
    """Half an hour of the station's own clock passes in 75 batches."""
    now = [1000.0]
    monkeypatch.setattr("obsnet.live.station.time.monotonic", lambda: now[0])
    return lambda number: now.__setitem__(0, now[0] + 24.0)


def test_after_a_clock_that_ran_ahead_ships_have_tracks_and_the_present_is_shown(
    live, hour, tmp_path, monkeypatch
):
    made = in_order(hour)
    ahead = [shifted(p, 2 * DAY_S) for p in made]
    tick = late_for_half_an_hour(monkeypatch)
    running = live()
    running.run(Given(by_eight(ahead), tick), once=True)
    (wrong,) = running.ships.tracks()
    seen = []

    def look(number):
        tick(number)
        seen.append(running.status()["live"])

    running = live()
    later = [shifted(p, 3 * 3600.0) for p in made]
    running.run(Given(by_eight([*made, *later]), look), once=True)
    first, *others = running.ships.tracks()
    assert first.start == wrong.start
    assert len(others) > 0 and all(track.start < wrong.start - DAY_S for track in others)
    changed = seen.index(None)
    assert all(row["time"] > iso(wrong.start) for row in seen[:changed])
    assert all(row is None or row["time"] < iso(wrong.start - DAY_S) for row in seen[changed:])
    last = LiveFolder(tmp_path / "live", []).about()["span"][1]
    assert later[-1].end_ns / 1e9 - 180.0 < last < later[-1].end_ns / 1e9
    assert iso(last) == live().status()["live"]["time"]


def test_what_was_said_by_a_wrong_clock_is_no_neighbour(live, hour, tmp_path, monkeypatch):
    """A ship that was dated wrongly does not stand beside those that come at that time."""
    made, tick = in_order(hour), late_for_half_an_hour(monkeypatch)
    near = []
    running = live()
    running.run(Given(by_eight([shifted(p, DAY_S) for p in made]), tick), once=True)
    assert len(running.ships.tracks()) == 1
    running = live()
    search = running.ships.neighbours
    running.ships.neighbours = lambda segment: near.append(search(segment)) or near[-1]
    running.run(Given(by_eight([*made, *(shifted(p, DAY_S) for p in made)]), tick), once=True)
    assert len(running.ships.tracks()) > 1
    assert all(track.start < made[0].start_ns / 1e9 + 7200.0 for tracks in near for track in tracks)


def test_a_ship_under_way_has_its_track_when_the_clock_is_set_back(live, hour, tmp_path):
    running = live()
    made = in_order(hour)
    for batch in by_eight(made):
        running.take(batch)
    assert running.ships.tracks() == []
    running.begin_anew("the clock was set back")
    (track,) = running.ships.tracks()
    assert len((tmp_path / "live" / "tracks.csv").read_text().splitlines()) == 2
    assert running.ships.close(ended=True) == []
    ends = [row.split(",")[0] for row in rows(tmp_path / "live")]
    assert parse_utc(ends[-1]) / 1e9 > made[-1].end_ns / 1e9 - 90.0
    assert track.end > made[-1].end_ns / 1e9 - 900.0
    again = live()
    assert len(again.ships.tracks()) == 1


@pytest.mark.parametrize("section", ["azimuth", "segmentation", "grid_search"])
def test_a_ship_under_way_has_its_track_when_the_configuration_changes(live, small, hour, tmp_path, section):
    """Its segment is the one that the former configuration sees, and what comes later is another record."""
    other = {
        "azimuth": {"azimuth_step_deg": 6.0},
        "segmentation": SMALL["segmentation"] | {"shortest_min": 300.0},
        "grid_search": SMALL["grid_search"] | {"tile_s": 360.0},
    }
    made = in_order(hour)
    live().run(Ring(made[:1100], {}))
    said = []
    running = live(config=(config := build(type(small), SMALL | {section: other[section]})), say=said.append)
    assert "a new record begins" in said[0] and said[1].startswith("1 track from")
    (track,) = running.ships.tracks()
    assert len((tmp_path / "live" / "tracks.csv").read_text().splitlines()) == 2
    running = live(config=config)  # before anything came
    assert running.resume == {"sequence": 1100}
    running.run(Ring(made, running.resume))
    assert running.ships.tracks()[0].start == track.start


def test_what_another_version_kept_does_not_keep_a_station_from_beginning(live, small, hour):
    live().run(Ring(in_order(hour)[:1100], {}))
    running = live()
    with running.store.transaction() as store:
        store.execute("UPDATE tiles SET arrays = x'00'")
        store.note("snapshot", store.noted("snapshot") | {"fingerprint": "another"})
    said = []
    running = live(say=said.append)
    assert "a new record begins" in said[0] and "are left" in said[1]
    assert running.ships.close(ended=True) == [] and running.ships.tracks() == []


def test_a_folder_is_not_read_again_with_another_configuration(live, station, small, hour, tmp_path):
    sds = tmp_path / "sds"
    sds.mkdir()
    begin = hour[0].stats.starttime
    hour.slice(begin, begin + 2400).write(str(sds / "a.mseed"), "MSEED")
    out = tmp_path / "live"
    running = live()
    running.run(Folder(sds, station, small.live, running.buffer.floor_ns, once=True))
    before = rows(out)
    hour.slice(begin + 2400.02).write(str(sds / "b.mseed"), "MSEED")
    other = build(type(small), SMALL | {"azimuth": {"azimuth_step_deg": 6.0}})
    running = live(config=other)
    running = live(config=other)  # before anything came
    running.run(Folder(sds, station, small.live, running.buffer.floor_ns, once=True), once=True)
    after = rows(out)
    assert after[: len(before)] == before
    assert 55 <= len(after) <= 59
    spans = sorted((track.start, track.end) for track in running.ships.tracks())
    assert all(a[1] <= b[0] for a, b in pairwise(spans))
