"""Live rows are the batch's rows, whatever the sizes, delays and order of the packets within the latency."""

import json
import shutil
import sqlite3

import numpy as np
import pytest

import obsnet
from obsnet.config import build
from obsnet.detectors.azimuth_features import LOOK_AHEAD_S
from obsnet.layout import to_posix
from obsnet.live.sources import Folder
from obsnet.pipeline import RunConfig

from .conftest import SMALL, Given, by_eight, differences, packets, rows


def arrivals(made, delay, rng, latency=55.0):
    """Packets in the order in which they come, in batches, each delayed after its end by up to `latency` s."""
    when = np.array([packet.end_ns / 1e9 + delay() for packet in made])
    order = np.argsort(when, kind="stable")
    cuts = np.sort(rng.choice(len(made), len(made) // 7, replace=False))
    return [[made[i] for i in part] for part in np.split(order, cuts)]


@pytest.mark.parametrize("seed", [0])
def test_any_packets_within_the_latency_give_the_batch_rows(live, hour, batch, tmp_path, seed):
    rng = np.random.default_rng(seed)
    made = packets(hour, lambda: rng.uniform(0.3, 25.0))
    station = live()
    station.run(Given(arrivals(made, lambda: rng.uniform(0.0, 55.0), rng)), once=True)
    got, expected = rows(tmp_path / "live"), rows(batch)
    assert [row[:20] for row in got] == [row[:20] for row in expected]
    assert differences(got, expected) == []
    assert station.buffer.counts["late"] == 0
    assert station.buffer.counts["used"] == len(made)


def test_tracks_of_a_closed_segment_are_the_batch_tracks(live, hour, batch, tmp_path):
    rng = np.random.default_rng(5)
    live().run(Given(arrivals(packets(hour, lambda: 10.0), lambda: 0.0, rng)), once=True)
    got, expected = ((f / "tracks.csv").read_text().splitlines() for f in (tmp_path / "live", batch))
    assert len(got) == len(expected) == 2
    a, b = (np.array([float(v) for v in lines[1].split(",")[4:]]) for lines in (got, expected))
    assert got[1].split(",")[:3] == expected[1].split(",")[:3]
    np.testing.assert_allclose(a, b, rtol=1e-3)
    shape = json.loads((tmp_path / "live" / "tracks.geojson").read_text())
    assert shape["features"][0]["geometry"]["type"] == "LineString"


@pytest.mark.parametrize("size", [4, 400])
def test_a_ship_is_said_when_its_segment_closes_not_only_when_the_record_ends(
    live, hour, station, table, tmp_path, size
):
    again = hour.copy()
    for trace in again:
        trace.stats.starttime += 3 * 3600
    both = hour + again
    expected = obsnet.track(both, station, build(RunConfig, SMALL), table=table, threads=1).tracks
    assert len(expected) == 2
    made = sorted(packets(both, lambda: 10.0), key=lambda packet: packet.end_ns)
    said = []
    watched = live(say=said.append)
    watched.run(Given([made[i : i + size] for i in range(0, len(made), size)]), once=True)
    got = (tmp_path / "live" / "tracks.csv").read_text().splitlines()[1:]
    whole = [track.row(1) for track in expected]
    assert [line.split(",")[1:3] for line in got] == [[row["start"], row["end"]] for row in whole]
    cpa = [np.datetime64(line.split(",")[3].removesuffix("Z")) for line in got]
    for found, track in zip(cpa, expected, strict=True):
        assert abs(to_posix(found) - track.motion.cpa_time) < 0.5  # maps are stored packed
    assert len([line for line in said if "track" in line]) == 2


def test_horizontals_that_come_late_still_give_a_course(live, hour, tmp_path):
    begin = hour[0].stats.starttime.ns / 1e9
    early = [
        p
        for p in packets(hour, lambda: 10.0)
        if p.seed_id.endswith("BDH") or p.start_ns / 1e9 - begin > 600.0
    ]
    made = sorted(early, key=lambda p: p.end_ns)
    live().run(Given([made[i : i + 4] for i in range(0, len(made), 4)]), once=True)
    (line,) = (tmp_path / "live" / "tracks.csv").read_text().splitlines()[1:]
    course, std = (float(line.split(",")[i]) for i in (6, 10))
    assert abs(course - 60.0) < 5.0 + 3.0 * std


def test_packets_beyond_the_latency_are_counted_and_cost_only_their_minutes(live, hour, batch, tmp_path):
    made = packets(hour, lambda: 10.0)
    lost = [
        p
        for p in made
        if p.seed_id.endswith("BDH") and 1200 < (p.start_ns / 1e9 - made[0].start_ns / 1e9) < 1230
    ]
    rest = sorted((p for p in made if p not in lost), key=lambda p: p.end_ns)
    late = [*rest[:700], *lost, *rest[700:]]
    station = live()
    station.run(Given(by_eight(late)), once=True)
    assert station.buffer.counts["late"] == len(lost) == 2
    got, expected = rows(tmp_path / "live"), rows(batch)
    share = [[float(row.split(",")[1]) for row in table] for table in (got, expected)]
    gone = [i for i, (a, b) in enumerate(zip(*share, strict=True)) if a != b]
    assert 2 <= len(gone) <= 5
    assert max(gone) - min(gone) < 5
    assert all(share[0][i] < share[1][i] for i in gone)
    assert [row[:20] for row in got] == [row[:20] for row in expected]
    # A minute's cells look ahead of its window (`LOOK_AHEAD_S`): the one beside may hear that something is missing.
    before = slice(0, min(gone) - 1)
    assert LOOK_AHEAD_S < 60.0
    assert differences(got[before], expected[before]) == []


def test_repeated_and_foreign_packets_change_nothing(live, hour, batch, tmp_path):
    rng = np.random.default_rng(2)
    made = sorted(packets(hour, lambda: 12.0), key=lambda p: p.end_ns)
    doubled = [q for p in made for q in (p, p)]
    from dataclasses import replace

    foreign = [replace(p, seed_id="ZZ.OTHER.00.BHZ", start_ns=p.start_ns + 10**16) for p in made[::50]]
    mixed = doubled + foreign
    station = live()
    station.run(Given(by_eight(sorted(mixed, key=lambda p: p.end_ns % 10**16 + rng.random()))), once=True)
    assert differences(rows(tmp_path / "live"), rows(batch)) == []
    assert station.buffer.counts["repeated"] + station.buffer.counts["late"] == len(made)
    assert station.buffer.counts["unknown"] == len(foreign)


def test_the_command_on_a_folder_gives_what_track_gives(obsnet, record, finished, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(record / "waveforms.mseed", folder)
    out = tmp_path / "out"
    status, _, errors = obsnet("watch", folder, "--station", record / "station.xml", "--out", out, "--once")
    assert (status, errors) == (0, [])
    assert differences(rows(out), rows(finished)) == []
    assert len((out / "tracks.csv").read_text().splitlines()) == len(
        (finished / "tracks.csv").read_text().splitlines()
    )
    stored = sqlite3.connect(out / "obsnet.sqlite").execute(
        "SELECT count(*), sum(azimuth_deg > 0) FROM detections"
    )
    count, azimuths = stored.fetchone()
    assert count == len(rows(finished))
    assert azimuths == sum(bool(row.split(",")[2]) for row in rows(finished))
    state = json.loads((out / "status.json").read_text())
    assert state["packets"]["used"] > 0
    assert state["live"]["existence"] > 0.5


def test_a_folder_that_grows_is_followed(live, hour, station, small, batch, tmp_path):
    """Day files of an SDS archive grow while they are read; cut records and other files beside them do no harm."""
    day = tmp_path / "sds" / "2013" / "XX" / "SIM01"
    (tmp_path / "notes.txt").write_text("not a waveform")
    begin = hour[0].stats.starttime

    def grow(number):
        for trace in hour.slice(begin, begin + 600.0 * (number + 1), nearest_sample=False):
            folder = day / f"{trace.stats.channel}.D"
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{trace.id}.D.2013.141"
            trace.write(str(path), "MSEED", reclen=512)
            with path.open("ab") as file:
                file.write(b"000001D XX" if number < 5 else b"")
        if number == 6:
            source.close()

    looks = iter(range(20))
    source = Folder(tmp_path / "sds", station, small.live, None, once=False)
    source._wait = lambda: grow(next(looks))
    running = live()
    running.run(source, once=True)
    running.stopping.clear()
    running.finish()
    assert differences(rows(tmp_path / "live"), rows(batch)) == []
