"""The command ``obsnet watch``: what it refuses, what it checks, how it ends."""

import copy
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from obspy import UTCDateTime

from .conftest import differences, rows

ROOT = Path(__file__).parents[2]


def process(*arguments, **options):
    command = [sys.executable, "-m", "obsnet", "watch", *map(str, arguments)]
    paths = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, env=paths, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


@pytest.mark.parametrize(
    ("source", "options", "words"),
    [
        ("nowhere", [], "no folder nowhere; SOURCE is seedlink://HOST:PORT/NET.STA, a folder, or -"),
        ("seedlink://host/XX.SIM01", [], "SOURCE must be seedlink://HOST:PORT, found"),
        ("seedlink://host:18000/XX.OTHER", [], "SOURCE names XX.OTHER, the StationXML describes XX.SIM01"),
        (
            ".",
            ["--set", "live.latencys=3"],
            "unknown key 'live.latencys' in the configuration; did you mean 'latency_s'?",
        ),
        (".", ["--latency", "-1"], "latency_s must not be negative"),
        (".", ["--set", "tracker=bernoulli"], "tracker must be grid"),
        (
            ".",
            ["--set", "live.nmea=serial"],
            "nmea must be udp://HOST:PORT or tcp://HOST:PORT, found 'serial'",
        ),
        (".", ["--set", "live.http=loopback"], "http must be HOST:PORT, found"),
    ],
)
@pytest.mark.parametrize("check", [[], ["--check"]])
def test_what_cannot_serve_is_one_line(obsnet, record, tmp_path, source, options, words, check):
    given = ("watch", source, "--station", record / "station.xml", "--out", tmp_path / "out", "--once")
    status, said, errors = obsnet(*given, *options, *check)
    assert (status, said) == (2, [])
    assert len(errors) == 1
    assert errors[0].startswith("obsnet: error: ")
    assert words in errors[0]


def test_check_says_that_all_is_well_and_watches_nothing(obsnet, record, tmp_path):
    yaml = tmp_path / "station.yaml"
    yaml.write_text("azimuth: {azimuth_step_deg: 2.0}\nlive: {latency_s: 30, http: '127.0.0.1:9108'}\n")
    status, said, errors = obsnet(
        "watch",
        tmp_path,
        "--station",
        record / "station.xml",
        "--out",
        tmp_path / "out",
        "--config",
        yaml,
        "--check",
    )
    assert (status, errors) == (0, [])
    assert said == ["XX.SIM01: configuration, station, detector, source and output folder are in order"]
    assert list((tmp_path / "out").iterdir()) == []


def test_standard_input_gives_what_track_gives(record, finished, tmp_path):
    with (record / "waveforms.mseed").open("rb") as waveforms:
        given = ("-", "--station", record / "station.xml", "--out", tmp_path, "--once", "--latency", "8000")
        _, errors = process(*given, stdin=waveforms).communicate(timeout=120)
    assert errors == b""
    assert differences(rows(tmp_path), rows(finished)) == []


def test_what_was_not_used_is_said(record, tmp_path):
    """A file that holds one channel after the other is late by its own length."""
    with (record / "waveforms.mseed").open("rb") as waveforms:
        given = ("-", "--station", record / "station.xml", "--out", tmp_path / "out", "--once")
        said, errors = process(*given, stdin=waveforms).communicate(timeout=120)
    assert errors == b""
    assert b"packets were not used" in said and b"raise --latency" in said


def test_nothing_usable_is_said(record, tmp_path):
    (tmp_path / "junk").write_bytes(bytes(4000))
    with (tmp_path / "junk").open("rb") as junk:
        given = ("-", "--station", record / "station.xml", "--out", tmp_path / "out", "--once")
        said, errors = process(*given, stdin=junk).communicate(timeout=120)
    assert errors == b""
    assert said.splitlines()[-1] == b"nothing usable came"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(record, tmp_path, number):
    source = tmp_path / "in"
    source.mkdir()
    out = tmp_path / "out"
    running = process(source, "--station", record / "station.xml", "--out", out)
    while not (out / "status.json").exists():
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(number)
    assert running.communicate(timeout=30) == (b"", b"")
    assert running.returncode == 0


def test_the_configuration_of_the_docs_is_one(tmp_path, obsnet, record):
    text = (ROOT / "docs" / "station.md").read_text(encoding="utf-8")
    (yaml,) = [part.split("```")[0] for part in text.split("```yaml\n")[1:]]
    (tmp_path / "station.yaml").write_text(yaml)
    given = ("watch", tmp_path, "--station", record / "station.xml", "--out", tmp_path / "out", "--check")
    status, _, errors = obsnet(*given, "--config", tmp_path / "station.yaml")
    assert (status, errors) == (0, [])


def test_which_place_serves_of_a_station_that_was_moved_is_said(obsnet, record, inventory, tmp_path):
    moved = inventory.copy()
    again = copy.deepcopy(moved[0][0])
    before, again.start_date = moved[0][0], UTCDateTime(2022, 1, 1)
    again.latitude = before.latitude + 1.0
    before.end_date = again.start_date
    for first, second in zip(before, again, strict=True):
        first.end_date, second.start_date, second.latitude = (
            again.start_date,
            again.start_date,
            again.latitude,
        )
        second.end_date = None
    moved[0].stations.append(again)
    moved.write(str(tmp_path / "moved.xml"), format="STATIONXML")
    for station, notes in ((record / "station.xml", 0), (tmp_path / "moved.xml", 1)):
        status, lines, errors = obsnet(
            "watch", record, "--station", station, "--out", tmp_path / "out", "--check"
        )
        assert (status, errors) == (0, [])
        said = [line for line in lines if f"the last one serves, {again.latitude:g}" in line]
        assert len(said) == notes
