"""A station that is killed, or has no room, loses no minute and doubles none."""

import errno
import json
import os
import resource
import sqlite3
import time
from contextlib import closing

import numpy as np
import pytest

import obsnet
from obsnet.config import build
from obsnet.errors import ConfigError, OutputError
from obsnet.live import files
from obsnet.live.config import WatchConfig
from obsnet.live.station import LiveStation
from obsnet.live.store import Store, from_bytes, to_bytes
from obsnet.pipeline import RunConfig
from obsnet.run import detections_csv

from .conftest import SMALL, Given, by_eight, differences, packets, rows


def in_order(hour, seconds=8.0):
    """Packets as a server holds them: numbered, in order of their ends."""
    return sorted(packets(hour, lambda: seconds), key=lambda packet: packet.end_ns)


class Ring(Given):
    """A server that remembers everything and sends from a number on, a few packets at a time."""

    def __init__(self, made, position, pause=0.0):
        super().__init__([], None)
        self._made, self._pause, self._ended = made, pause, False
        self.position = position or {"sequence": 0}

    def batches(self):
        while not self._ended and self.position["sequence"] < len(self._made):
            first = self.position["sequence"]
            following = self._made[first : first + 6]
            self.position = {"sequence": first + len(following)}
            yield following
            time.sleep(self._pause)


def in_a_child(task):
    """Run a task in a forked process; its pid."""
    pid = os.fork()
    if pid:
        return pid
    status = 70
    try:
        task()
        status = 0
    finally:
        os._exit(status)


def test_a_restart_goes_on_as_if_nothing_had_happened(live, hour, batch, tmp_path):
    made = in_order(hour)
    for stop in (150, 333, 700, 701, len(made)):
        running = live()
        source = Ring(made[:stop], running.resume)
        running.run(source)
        assert json.loads((tmp_path / "live" / "status.json").read_text())["packets"]["used"] == stop
    live().run(Ring(made, {"sequence": len(made)}), once=True)
    assert differences(rows(tmp_path / "live"), rows(batch)) == []


def test_learned_detectors_go_on_too(live, hour, station, table, tmp_path):
    made, settings = in_order(hour), SMALL | {"detector": "learned"}
    config = build(WatchConfig, settings)
    run = obsnet.detect(hour, station, build(RunConfig, settings), table=table, threads=1)
    running = live(config=config)
    running.run(Ring(made[:700], {}))
    running = live(config=config)
    running.run(Ring(made, running.resume), once=True)
    expected = detections_csv(run.detections).splitlines()[1:]
    assert differences(rows(tmp_path / "live"), expected) == []
    said = json.loads((tmp_path / "live" / "status.json").read_text())["models"]
    assert said == run.info["models"] == running.pipeline.models
    assert set(said) == {"azimuth", "range"}


def test_a_closed_record_that_goes_on_says_its_end_again(live, hour, batch, tmp_path):
    made = in_order(hour)
    live().run(Ring(made[:800], {}), once=True)
    cut = rows(tmp_path / "live")
    running = live()
    running.run(Ring(made, running.resume), once=True)
    assert len(cut) < len(rows(batch))
    assert differences(rows(tmp_path / "live"), rows(batch)) == []
    assert len((tmp_path / "live" / "tracks.csv").read_text().splitlines()) == 2


def test_torn_and_missing_files_are_made_again_from_the_database(live, hour, batch, tmp_path):
    made, out = in_order(hour), tmp_path / "live"
    live().run(Ring(made[:600], {}))
    (day,) = out.glob("detections-*.csv")
    text = day.read_text()
    for damage in (
        text[:-9],
        text + text.splitlines()[-1][:12],
        text + text.splitlines()[-1] + "\n",
        "",
        None,
    ):
        day.unlink() if damage is None else day.write_text(damage)
        live()
        running = live()
        running.files.repair()
        assert day.read_text() == text
    running.run(Ring(made, running.resume), once=True)
    assert differences(rows(out), rows(batch)) == []


def test_a_disk_without_room_is_waited_for(station, small, table, hour, batch, tmp_path):
    """Files may not grow beyond a limit, then they may: every minute is there in the end."""
    made, out = in_order(hour), tmp_path / "live"
    patient = small.__class__(
        **{**small.__dict__, "live": small.live.__class__(retry_s=0.05, retry_max_s=0.1)}
    )
    told, saying = os.pipe()

    def watch():
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, resource.RLIM_INFINITY))
        say = lambda line: os.write(saying, line.encode() + b"\n")  # noqa: E731
        live = LiveStation(station, patient, out, table=table, say=say)
        live.run(Ring(made, live.resume))

    pid = in_a_child(watch)
    said = os.read(told, 4096).decode()
    assert "obsnet.sqlite" in said and "waiting" in said
    time.sleep(0.3)
    assert os.waitpid(pid, os.WNOHANG) == (0, 0)
    short = rows(out)
    assert differences(short, rows(batch)[: len(short)]) == []
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert os.waitpid(pid, 0)[1] == 0
    live = LiveStation(station, patient, out, table=table)
    live.run(Ring(made, live.resume), once=True)
    live.close()
    assert differences(rows(out), rows(batch)) == []


def test_rows_are_safe_when_their_file_cannot_be_written(live, hour, batch, tmp_path, monkeypatch):
    made, out = in_order(hour), tmp_path / "live"
    real, broken = files.Path.open, [True]

    def failing(path, mode="r", *args, **options):
        if broken[0] and path.name.startswith("detections-") and mode == "a":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return real(path, mode, *args, **options)

    def no_room(path, text):
        if broken[0] and path.name.startswith("detections-"):
            raise OutputError("no room")
        return kept(path, text)

    kept = files.write_text
    monkeypatch.setattr(files.Path, "open", failing)
    monkeypatch.setattr(files, "write_text", no_room)
    batches = [made[i : i + 40] for i in range(0, len(made), 40)]
    live().run(Given(batches, lambda n: broken.__setitem__(0, n < 20)), once=True)
    assert differences(rows(out), rows(batch)) == []


def test_another_configuration_begins_a_new_record(live, small, hour, tmp_path):
    made = in_order(hour)
    live().run(Ring(made[:600], {}))
    before = rows(tmp_path / "live")
    said = []
    other = small.__class__(**{**small.__dict__, "azimuth": small.azimuth.__class__(azimuth_step_deg=6.0)})
    running = live(config=other, say=said.append)
    assert "a new record begins" in said[0]
    running.run(Ring(made, running.resume), once=True)
    assert rows(tmp_path / "live")[: len(before) - 5] == before[:-5]


def test_two_stations_cannot_share_a_folder(station, small, table, tmp_path):
    first = LiveStation(station, small, tmp_path, table=table)
    with pytest.raises(OutputError, match="another obsnet watch writes into"):
        LiveStation(station, small, tmp_path, table=table)
    first.close()


def test_a_damaged_database_is_one_line(tmp_path):
    (tmp_path / "obsnet.sqlite").write_bytes(b"not a database at all" * 100)
    with pytest.raises(OutputError, match=r"cannot use .*obsnet\.sqlite"):
        Store(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE state SET value = '{' WHERE name = 'position'",
        "UPDATE state SET value = '[1]' WHERE name = 'position'",
        "UPDATE state SET value = '{}' WHERE name = 'snapshot'",
        "UPDATE state SET value = substr(value, 1, 40) WHERE name LIKE 'pipeline/%'",
    ],
)
def test_a_damaged_memory_is_one_line(live, hour, tmp_path, damage):
    first = live()
    first.run(Given(by_eight(packets(hour.slice(endtime=hour[0].stats.starttime + 1200), lambda: 60.0))))
    first.close()
    with closing(sqlite3.connect(tmp_path / "live" / "obsnet.sqlite")) as database:
        assert database.execute(damage).rowcount > 0
        database.commit()
    for _ in range(2):  # the folder is not held by the one that failed
        with pytest.raises(OutputError, match="move a damaged file away"):
            live()


def test_a_database_that_is_damaged_within_is_one_line(live, hour, tmp_path):
    live().run(Given(by_eight(packets(hour, lambda: 60.0))), once=True)
    live().close()
    path = tmp_path / "live" / "obsnet.sqlite"
    held = bytearray(path.read_bytes())
    for start in range(8192, len(held), 4096):
        held[start : start + 200] = b"\xff" * 200
    path.write_bytes(held)
    with pytest.raises(OutputError, match="damaged"):
        live()


def test_arrays_are_stored_without_pickles():
    with pytest.raises(ValueError, match="allow_pickle"):
        to_bytes(np.array([object()]))
    for array in (np.array(None, float), np.arange(6, dtype="c8").reshape(2, 3), np.array(7)):
        back = from_bytes(to_bytes(array))
        assert (back.dtype, back.shape) == (array.dtype, array.shape)


def test_trackers_without_a_memory_are_refused(small):
    with pytest.raises(ConfigError, match="tracker must be grid"):
        small.__class__(tracker="focalization")
