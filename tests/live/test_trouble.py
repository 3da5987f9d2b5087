"""What goes wrong at sea: a channel stops, clocks step, packets carry nonsense; and nothing grows without bound."""

from dataclasses import replace

import numpy as np

import obsnet
from obsnet.config import build
from obsnet.live.packets import RecordStream
from obsnet.pipeline import RunConfig
from obsnet.run import detections_csv

from .conftest import SMALL, Given, by_eight, differences, packets, rows


def in_order(stream, seconds=10.0):
    return sorted(packets(stream, lambda: seconds), key=lambda packet: packet.end_ns)


def shifted(packet, seconds):
    return replace(packet, start_ns=packet.start_ns + round(seconds * 1e9))


def test_a_channel_that_stops_costs_itself_alone(live, hour, station, table, tmp_path):
    stopped = hour.copy()
    (trace,) = stopped.select(channel="BDH")
    trace.trim(endtime=trace.stats.starttime + 1500)
    live().run(Given(by_eight(in_order(stopped))), once=True)
    run = obsnet.detect(stopped, station, build(RunConfig, SMALL), table=table, threads=1)
    expected = detections_csv(run.detections).splitlines()[1:]
    assert differences(rows(tmp_path / "live"), expected) == []
    _, coverage, azimuth, azimuth_llr, *ranges = rows(tmp_path / "live")[-20].split(",")
    assert coverage == "1.0" and azimuth == "" and azimuth_llr != "" and ranges == ["", "", ""]


def test_a_gap_of_hours_has_its_rows(live, hour, station, table, tmp_path):
    begin = hour[0].stats.starttime
    parted = hour.slice(begin, begin + 1200) + hour.slice(begin + 1800, begin + 3600).copy()
    for trace in parted[4:]:
        trace.stats.starttime += 3 * 3600.0
    live().run(Given(by_eight(in_order(parted))), once=True)
    run = obsnet.detect(parted, station, build(RunConfig, SMALL), table=table, threads=1)
    expected = detections_csv(run.detections).splitlines()[1:]
    assert len(expected) > 200
    assert differences(rows(tmp_path / "live"), expected) == []


def test_a_clock_that_is_set_forward_leaves_a_gap(live, hour, tmp_path):
    made = in_order(hour)
    half = len(made) // 2
    ahead = [*made[:half], *(shifted(p, 21600.0) for p in made[half:])]
    station = live()
    station.run(Given(by_eight(ahead)), once=True)
    said = rows(tmp_path / "live")
    assert said[0].startswith("2013-05-21T10:3")
    assert said[-1].startswith("2013-05-21T17:2")
    silent = [row for row in said if row.split(",")[1] == "0.0"]
    assert 340 < len(silent) < 360
    assert station.buffer.counts["late"] == 0


def test_a_clock_that_is_set_back_begins_a_new_record(live, hour, tmp_path, monkeypatch):
    made = in_order(hour)
    third = len(made) // 3
    said = []
    station = live(say=said.append)
    now = [1000.0]
    monkeypatch.setattr("obsnet.live.station.time.monotonic", lambda: now[0])

    def tick(number):
        now[0] += 24.0

    back = [*made[third:], *(shifted(p, -86400.0) for p in made)]
    station.run(Given(by_eight(back), tick), once=True)
    assert "the clock was set back" in said[0]
    days = {row[:10] for row in rows(tmp_path / "live")}
    assert days == {"2013-05-20", "2013-05-21"}
    times = [row[:20] for row in rows(tmp_path / "live")]
    assert times == sorted(set(times))


def test_packets_of_nonsense_move_nothing(live, hour, batch, tmp_path):
    rng = np.random.default_rng(0)
    made = in_order(hour)
    first = made[0]
    nonsense = [
        shifted(first, 400 * 86400.0),
        shifted(first, -9000 * 86400.0),
        replace(first, rate=float("nan")),
        replace(first, rate=1e-3),
        replace(first, samples=np.empty(0, np.int32)),
        replace(first, samples=np.array(["a", "b"])),
        replace(first, seed_id="garbage"),
        replace(first, seed_id="....", rate=-50.0),
        replace(first, start_ns=2**62),
    ]
    mixed = list(made)
    for place in rng.choice(len(made), 60):
        mixed.insert(int(place), nonsense[int(rng.integers(len(nonsense)))])
    station = live()
    station.run(Given(by_eight(mixed)), once=True)
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


def of_location(packet, code):
    network, station, _, channel = packet.seed_id.split(".")
    return replace(packet, seed_id=f"{network}.{station}.{code}.{channel}")


def test_a_sensor_that_is_not_described_is_not_mixed_in(live, hour, batch, tmp_path):
    """Nor does what waits of it stay, once the described one comes."""
    rng = np.random.default_rng(7)
    made = in_order(hour)
    noise = [replace(of_location(p, "10"), samples=rng.integers(-999, 999, len(p.samples))) for p in made]
    batches = by_eight([p for pair in zip(noise, made, strict=True) for p in pair])
    station = live()
    station.run(Given([noise[:8], *batches]), once=True)
    assert differences(rows(tmp_path / "live"), rows(batch)) == []
    assert station.buffer.report.left_aside["XX.SIM01.10.BDH"] == "not described"


def test_another_location_code_serves_where_it_is_the_only_one(live, hour, batch, tmp_path):
    """And goes on to after a restart."""
    made = [of_location(packet, "") for packet in in_order(hour)]
    for some in (made[:4], made[4:400], made[400:]):
        station = live()
        for packets_of_eight in by_eight(some):
            station.take(packets_of_eight)
    station.finish()
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


def test_bytes_of_nonsense_between_records(record):
    data = (record / "waveforms.mseed").read_bytes()[: 60 * 4096]
    rng = np.random.default_rng(1)
    stream, clean = RecordStream(), RecordStream()
    expected = clean.push(data)
    spoiled = b"".join(
        data[i : i + 4096] + rng.bytes(int(rng.integers(0, 900))) for i in range(0, len(data), 4096)
    )
    found = []
    at = 0
    while at < len(spoiled):
        step = int(rng.integers(1, 9000))
        found += stream.push(spoiled[at : at + step])
        at += step
    assert len(expected) == 60
    assert [p.start_ns for p in found] == [p.start_ns for p in expected]
    assert all((a.samples == b.samples).all() for a, b in zip(found, expected, strict=True))
    assert 0 <= len(spoiled) - len(data) - stream.garbage < 64  # what may yet become a record is held
    assert len(RecordStream().push(rng.bytes(3_000_000))) == 0


def test_nothing_grows(live, hour, tmp_path, monkeypatch):
    """Half a day of an hour again and again: what is held in memory and in the store stays what it was after one."""
    monkeypatch.setattr("obsnet.live.station._REST_S", 0.0)  # a snapshot every ten minutes of data
    one_hour = in_order(hour, 30.0)
    station = live()

    def held():
        counted = {
            name: station.store.rows(f"SELECT count(*) FROM {name}")[0][0]
            for name in ("packets", "tiles", "state")
        }
        return counted | {
            "buffer": sum(map(len, station.buffer._packets.values())),
            "arrays": sum(v.nbytes for v in station.pipeline.state().values()) // 1_000_000,
            "written": len(station.store._written),
        }

    seen = []
    for number in range(12):
        batch_of = [shifted(p, 3600.0 * number) for p in one_hour]
        if number % 4:  # three hours of four are quick: the sea is not heard
            batch_of = batch_of[:120:4] + batch_of[-8:]
        for first in range(0, len(batch_of), 40):
            station.take(batch_of[first : first + 40])
        seen.append(held())
    for name in seen[0]:
        values = [state[name] for state in seen]
        assert max(values[8:]) <= 1.3 * max(values[4:8]) + 5, name
