"""SeedLink, protocols 3 and 4: cuts, silences, new numbers, garbage, a full queue; and kill −9 at fifty instants."""

import os
import random
import select
import signal
import sqlite3
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from obsnet.live.config import LiveConfig
from obsnet.live.packets import Packet
from obsnet.live.seedlink import SeedLinkServer
from obsnet.live.station import LiveStation

from .conftest import differences, rows
from .server import Server, records
from .test_survival import in_a_child

QUICK = LiveConfig(retry_s=0.02, retry_max_s=0.2, silence_s=2.0, connect_s=2.0, keepalive_s=0.0)


@pytest.fixture(scope="session")
def ring(hour):
    return records(hour)


def follow(live, small, server, count, config=QUICK):
    """Run a live station until it has used so many packets, then close the record."""
    station = live(config=replace(small, live=config))
    source = SeedLinkServer("127.0.0.1", server.port, "XX.SIM01", config, station.resume)
    batches = source.batches

    def until_all():
        deadline = time.monotonic() + 60.0
        for batch in batches():
            yield batch
            if station.buffer.counts["used"] >= count or time.monotonic() > deadline:
                return

    source.batches = until_all
    station.run(source, once=True)
    return station, source


@pytest.mark.parametrize(("protocol", "first"), [(3, (1 << 24) - 500), (4, 1)])
def test_every_packet_comes_once_through_cuts(live, small, ring, batch, tmp_path, protocol, first):
    rng = random.Random(0)
    cuts = [rng.randrange(1, 400) for _ in range(100)]
    with Server(ring, first, protocol, lambda c, sent: "close" if sent == cuts[c] else None) as server:
        station, source = follow(live, small, server, len(ring))
    assert station.buffer.counts["used"] == len(ring)
    assert source.counts["connections"] > 4
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


@pytest.mark.parametrize("protocol", [3, 4])
def test_a_server_that_counts_anew_is_asked_by_time(live, small, ring, batch, tmp_path, protocol):
    half, more = len(ring) // 2, len(ring) // 2 + 300
    with Server(ring, 5000, protocol, held=half) as server:
        port = server.port
        _, first = follow(live, small, server, half)
    # what came while the client was away has numbers that mean nothing to it
    with Server(ring[half - 200 :], 9_000_000, protocol, held=more - half + 200, port=port) as server:
        served, source = server, SeedLinkServer("127.0.0.1", port, "XX.SIM01", QUICK, first.position)
        restarted = live(config=replace(small, live=QUICK))
        batches = source.batches

        def until_all():
            for number, got in enumerate(batches()):
                yield got
                served.held = min(served.held + 50 * (number > 0), len(served.ring))
                if restarted.buffer.head_ns and restarted.buffer.counts["used"] >= len(ring):
                    return

        source.batches = until_all
        restarted.run(source, once=True)
    assert source.counts["renumbered"] == 1
    assert server.asked[1][0] == ("TIME" if protocol == 3 else "DATA")
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


@pytest.mark.parametrize("protocol", [3, 4])
def test_garbage_is_stepped_over(live, small, ring, batch, tmp_path, protocol):
    rng = np.random.default_rng(3)
    spoiled = list(ring)
    for place in sorted(rng.choice(len(ring), 6, replace=False))[::-1]:
        spoiled.insert(int(place), (spoiled[place][0], rng.bytes(512)))
    spoiled.insert(700, (spoiled[700][0], rng.bytes(512)))
    with Server(spoiled, 1, protocol) as server:
        station, source = follow(live, small, server, len(ring))
    assert station.buffer.counts["used"] == len(ring)
    assert source.counts["garbage"] >= 7
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


def test_silence_is_noticed_and_the_server_tried_again(live, small, ring, batch, tmp_path):
    silent = replace(QUICK, silence_s=0.6)
    told = []
    with Server(ring, script=lambda c, sent: "silence" if c < 3 and sent == 500 else None) as server:
        station = live(config=replace(small, live=silent))
        source = SeedLinkServer("127.0.0.1", server.port, "XX.SIM01", silent, {})
        failed = source._failed
        source._failed = lambda error: (failed(error), told.append(source.trouble))
        for batch_of in source.batches():
            station.take(batch_of)
            if station.buffer.counts["used"] == len(ring):
                break
        source.close()
    assert server.connections >= 3
    assert sum("No data for over" in words for words in told) >= 2
    station.finish()
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


NOW_NS = 1_700_000_000 * 10**9


@pytest.mark.parametrize(
    ("ends_s", "first", "start_s", "asked_s"),
    [
        ({"BDH": -90 * 86400, "BHZ": 0, "BH1": -20}, "BHZ", 5, -20),  # one is dead: the others' time
        ({"BDH": -90 * 86400, "BHZ": 0, "BH1": -20}, "BDH", 5, None),  # it is back, and nothing was lost
        ({"BDH": -90 * 86400, "BHZ": -40, "BH1": -30}, "BHZ", 3 * 86400, -40),  # the server was away for days
        ({"BDH": 400 * 86400, "BHZ": 0, "BH1": -20}, "BHZ", 5, -20),  # nonsense was dated far ahead
    ],
)
def test_a_server_that_counts_anew_is_asked_since_what_the_living_channels_lack(
    monkeypatch, ends_s, first, start_s, asked_s
):
    class Connection:
        def collect(self, reconnect):
            yield SimpleNamespace(payload=b"", seqnum=6)

    ends = {f"XX.SIM01..{channel}": NOW_NS + s * 10**9 for channel, s in ends_s.items()}
    source = SeedLinkServer("127.0.0.1", 1, "XX.SIM01", QUICK, {"sequence": 5, "newest": ends})
    packet = Packet(f"XX.SIM01..{first}", NOW_NS + start_s * 10**9, 50.0, np.zeros(500, int))
    monkeypatch.setattr("obsnet.live.seedlink.packet_of", lambda payload: packet)
    got = list(source._received(Connection()))
    assert source._since_ns == (None if asked_s is None else NOW_NS + asked_s * 10**9)
    assert got == ([packet] if asked_s is None else [])


def test_waits_grow_by_chance_up_to_a_limit():
    config = replace(QUICK, retry_s=0.05, retry_max_s=0.4)
    source = SeedLinkServer("127.0.0.1", 1, "XX.SIM01", config, {})
    waits = []
    source._stop.wait = lambda seconds: waits.append(seconds) or (len(waits) == 12 and source.close())
    source._run()
    assert source.counts["failures"] == 12
    assert "Could not connect" in source.trouble
    assert 0.05 <= waits[0] < 0.16
    assert all(0.2 <= wait <= 0.6 for wait in waits[4:])
    assert len({round(wait, 6) for wait in waits}) == 12


def test_a_slow_station_makes_the_server_wait(ring):
    with Server(ring * 20) as server:
        source = SeedLinkServer("127.0.0.1", server.port, "XX.SIM01", QUICK, {})
        batches = source.batches()
        next(batches)
        time.sleep(0.5)
        assert source._queue.qsize() <= 2000
        source.close()


def test_killed_at_fifty_instants(station, small, table, ring, batch, tmp_path):
    out, rng = tmp_path / "live", random.Random(1)
    config = replace(small, live=QUICK)

    def watch():
        live = LiveStation(station, config, out, table=table)
        source = SeedLinkServer("127.0.0.1", port, "XX.SIM01", QUICK, live.resume)
        batches = source.batches

        def counted():
            for got in batches():
                if got:
                    os.write(begun, b".")
                yield got

        source.batches = counted
        live.run(source)

    __import__("seedlink_client")  # once, not in every child
    (reading, writing), (beginning, begun) = os.pipe(), os.pipe()

    def serve():
        with Server(ring, pause=0.003) as server:
            os.write(writing, b"%6d" % server.port)
            time.sleep(100)

    serving = in_a_child(serve)
    port = int(os.read(reading, 6))
    progress = []
    try:
        for number in range(50):
            pid = in_a_child(watch)
            for _ in range(rng.randrange(16) if number % 5 else 0):
                if not select.select([beginning], [], [], 1.0)[0]:
                    break
                os.read(beginning, 1)
            time.sleep(rng.random() * 0.05)
            os.kill(pid, signal.SIGKILL)
            assert os.waitpid(pid, 0)[1] == signal.SIGKILL
            progress.append(len(rows(out)))
    finally:
        os.kill(serving, signal.SIGKILL)
        os.waitpid(serving, 0)
    assert len(set(progress)) > 5
    live = LiveStation(station, config, out, table=table)
    assert 0 < live.buffer.counts["used"] <= len(ring)
    with Server(ring) as server:
        source = SeedLinkServer("127.0.0.1", server.port, "XX.SIM01", QUICK, live.resume)
        for got in source.batches():
            live.take(got)
            if live.buffer.counts["used"] >= len(ring):
                break
        source.close()
    live.finish()
    live.close()
    assert differences(rows(out), rows(batch)) == []
    times = [row[:20] for row in rows(out)]
    assert len(times) == len(set(times))
    stored = sqlite3.connect(out / "obsnet.sqlite").execute("SELECT time FROM detections ORDER BY time")
    assert [t for (t,) in stored] == times
