import contextlib
import io
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from fnmatch import fnmatch
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import obspy
import pytest
from obspy import UTCDateTime
from obspy.clients.filesystem.sds import Client as SDSClient
from obspy.core.inventory import Channel, Inventory, Network, Response, Site, Station

from obsnet.errors import ConfigError, OutputError, SourceError, StationError
from obsnet.fdsn import Retry, fetch
from obsnet.fdsn.data_centre import read_stationxml
from obsnet.signals.station import Station as ObsnetStation
from obsnet.signals.waveforms import open_waveforms

pytest.importorskip("portable_fdsnws_dataselect")

DAY = UTCDateTime(2013, 5, 21)
CHANNELS = ("BDH", "BH1", "BHZ")
QUICK = Retry(attempts=3, wait_s=0.01)
TEXTS = (
    "network station location channel quality starttime endtime filename hash timeindex timespans timerates"
)
SCHEMA = [(name, "TEXT") for name in f"{TEXTS} format filemodtime updated scanned".split()]
SCHEMA += [("version", "INTEGER"), ("byteoffset", "INTEGER"), ("bytes", "INTEGER"), ("samplerate", "REAL")]


def record(channel: str, start: UTCDateTime, hours: float, rate=1.0, station="RR03") -> obspy.Trace:
    seed = CHANNELS.index(channel) * 1000 + int(start - DAY) // 3600
    samples = np.random.default_rng(seed).integers(-1000, 1000, int(hours * 3600 * rate), dtype=np.int32)
    header = {
        "network": "YV",
        "station": station,
        "location": "00",
        "channel": channel,
        "sampling_rate": rate,
    }
    return obspy.Trace(samples, {**header, "starttime": start})


@pytest.fixture(scope="module")
def data():
    """Three days of three channels at 1 Hz; BH1 has no second day, and BHZ has a gap."""
    stream = obspy.Stream()
    for channel in CHANNELS:
        for day in range(3):
            if (channel, day) == ("BH1", 1):
                continue
            stream += record(channel, DAY + 86400 * day, 10 if channel == "BHZ" else 24)
            if channel == "BHZ":
                stream += record(channel, DAY + 86400 * day + 12 * 3600, 12)
    return stream


@pytest.fixture(scope="module")
def fast():
    """Half an hour of another station's hydrophone, as fast as obsnet needs it."""
    return record("BDH", DAY, 0.5, rate=50.0, station="RR04")


def free_port() -> int:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def dataselect(tmp_path_factory, data, fast):
    """The package's own server over an indexed archive; gives its address."""
    folder = tmp_path_factory.mktemp("archive")
    with contextlib.closing(sqlite3.connect(folder / "index.sqlite")) as base:
        base.execute(f"CREATE TABLE tsindex ({', '.join(map(' '.join, SCHEMA))})")
        for i, trace in enumerate([*data, fast]):
            path = folder / f"{i}.mseed"
            trace.write(str(path), format="MSEED", reclen=512)
            row = {key: trace.stats[key] for key in ("network", "station", "location", "channel")}
            row |= {"starttime": f"{trace.stats.starttime}"[:-1], "endtime": f"{trace.stats.endtime}"[:-1]}
            row |= {
                "samplerate": trace.stats.sampling_rate,
                "filename": str(path),
                "quality": "D",
                "version": 1,
            }
            row |= {
                "byteoffset": 0,
                "bytes": path.stat().st_size,
                "format": "2",
                "updated": "2024-01-01T00:00:00",
            }
            base.execute(
                f"INSERT INTO tsindex ({', '.join(row)}) VALUES ({','.join('?' * len(row))})",
                list(row.values()),
            )
        base.commit()
    port = free_port()
    (folder / "server.ini").write_text(
        f"[index_db]\npath = {folder / 'index.sqlite'}\n[server]\ninterface = 127.0.0.1\nport = {port}\n"
    )
    code = "from portable_fdsnws_dataselect.server import main; main()"
    server = subprocess.Popen(
        [sys.executable, "-c", code, str(folder / "server.ini")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    url = f"http://127.0.0.1:{port}"
    for _ in range(100):
        with contextlib.suppress(OSError):
            urllib.request.urlopen(f"{url}/fdsnws/dataselect/1/version", timeout=1).close()
            break
        time.sleep(0.1)
    yield url
    server.terminate()
    server.wait(5)


class Centre:
    """A data centre on loopback: its StationXML, waveforms from the dataselect server, faults on demand."""

    def __init__(self, dataselect: str):
        self.dataselect, self.asked, self.faults = dataselect, [], []
        self.closing = threading.Event()
        self.slow, self.longest_s, self.station_xml = 0.0, np.inf, self._inventory()
        centre = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                centre.answer(self)

            def log_message(self, *args):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    @staticmethod
    def _inventory() -> Inventory:
        channels = [
            Channel(code, "00", -21.3732, 54.1294, -4340.0, 0.0, azimuth=0.0, dip=0.0, sample_rate=1.0,
                    start_date=DAY - 86400, response=Response())
            for code in CHANNELS
        ]  # fmt: skip
        slow, fast = (
            Station(code, -21.3732, 54.1294, -4340.0, channels=part, site=Site(code))
            for code, part in (("RR03", channels), ("RR04", channels[:1]))
        )
        return Inventory([Network("YV", [slow, fast])], source="test")

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        url = urllib.parse.urlsplit(request.path)
        query = {key: values[0] for key, values in urllib.parse.parse_qs(url.query).items()}
        is_station = "/station/" in url.path
        if not is_station:
            self.asked.append((query["channel"], query["starttime"][:10]))
            if self.closing.wait(self.slow):
                return
        fault = self.faults.pop(0) if self.faults and not is_station else None
        if fault == "cut short":
            status, body = 200, b"\0" * 700
        elif fault == "html":
            status, body = 200, b"<html>Please log in</html>".ljust(512)
        elif not is_station and self._length(query) > self.longest_s:
            status, body = 413, b"too much"
        elif isinstance(fault, int):
            status, body = fault, b"trouble"
        else:
            status, body = self._stations(query) if is_station else self._waveforms(request.path)
        with contextlib.suppress(ConnectionError):
            request.send_response(status)
            request.send_header("Content-Length", str(len(body)))
            request.end_headers()
            request.wfile.write(body)

    @staticmethod
    def _length(query) -> float:
        return UTCDateTime(query["endtime"]) - UTCDateTime(query["starttime"])

    def _stations(self, query) -> tuple[int, bytes]:
        patterns = query.get("channel", "*").split(",")
        found = self.station_xml.select(network=query["network"], station=query["station"])
        for station in (station for network in found for station in network):
            station.channels = [c for c in station if any(fnmatch(c.code, pattern) for pattern in patterns)]
        if not found.get_contents()["channels"]:
            return 204, b""
        text = io.BytesIO()
        found.write(text, format="STATIONXML")
        return 200, text.getvalue()

    def _waveforms(self, path: str) -> tuple[int, bytes]:
        with urllib.request.urlopen(self.dataselect + path) as answer:
            return answer.status, answer.read()


@pytest.fixture
def centre(dataselect):
    centre = Centre(dataselect)
    yield centre
    centre.closing.set()
    centre.server.shutdown()
    centre.server.server_close()


def get(centre, out, start=DAY, end=DAY + 3 * 86400, **options):
    options.setdefault("retry", QUICK)
    return fetch("YV.RR03", start, end, out, base_url=centre.url, **options)


def test_the_archive_holds_every_sample_once(centre, data, tmp_path):
    steps = []
    report = get(centre, tmp_path, progress=lambda done, total: steps.append((done, total)))
    assert (report.fetched, report.present, len(report.missing)) == (8, 0, 1)
    assert report.missing == ["YV.RR03.00.BH1.D.2013.142"]
    assert steps[0] == (0, 9) and steps[-1] == (9, 9)
    assert (tmp_path / "2013/YV/RR03/BHZ.D/YV.RR03.00.BHZ.D.2013.141").is_file()
    client = SDSClient(str(tmp_path))
    for channel in CHANNELS:
        found = client.get_waveforms("YV", "RR03", "00", channel, DAY, DAY + 3 * 86400).merge()
        expected = data.select(channel=channel).copy().merge()
        assert len(found) == len(expected) == 1
        np.testing.assert_array_equal(found[0].data, expected[0].data)
    assert sum(len(obspy.read(str(path))) >= 1 for path in tmp_path.glob("2013/*/*/*/*")) == 8
    inventory = obspy.read_inventory(str(tmp_path / "station.xml"))
    assert [channel.code for channel in inventory[0][0]] == list(CHANNELS)
    assert str(report).startswith("YV.RR03 (BDH, BH1, BHZ): 8 channel-days fetched")
    assert not list(tmp_path.rglob("*.tmp"))


def test_obsnet_reads_what_was_fetched(centre, fast, tmp_path):
    fetch("YV.RR04", DAY, DAY + 7200, tmp_path, base_url=centre.url, retry=QUICK)
    station = ObsnetStation.from_stationxml(tmp_path / "station.xml", "YV.RR04")
    source = open_waveforms([str(tmp_path)], station)
    assert list(source.timelines) == [fast.id]
    assert source.begin_ns == fast.stats.starttime.ns


def test_what_was_described_before_stays_described(centre, tmp_path):
    def described():
        found = obspy.read_inventory(str(tmp_path / "station.xml"))
        return sorted({f"{sta.code}.{channel.code}" for net in found for sta in net for channel in sta})

    get(centre, tmp_path, end=DAY + 7200, channels="BDH")
    get(centre, tmp_path, end=DAY + 7200, channels=("BH?",))
    assert described() == ["RR03.BDH", "RR03.BH1", "RR03.BHZ"]
    fetch("YV.RR04", DAY, DAY + 7200, tmp_path, base_url=centre.url, retry=QUICK)
    assert described() == ["RR03.BDH", "RR03.BH1", "RR03.BHZ", "RR04.BDH"]
    station = ObsnetStation.from_stationxml(tmp_path / "station.xml", "YV.RR03")
    assert {channel.code for channel in station.epochs} == set(CHANNELS)
    before = (tmp_path / "station.xml").read_bytes()
    fetch("YV.RR04", DAY, DAY + 7200, tmp_path, base_url=centre.url, retry=QUICK)
    again = obspy.read_inventory(io.BytesIO(before))
    assert described() == sorted({f"{s.code}.{c.code}" for n in again for s in n for c in s})


def test_the_command_says_what_it_fetched(centre, obsnet, tmp_path):
    span = ("--start", str(DAY), "--end", str(DAY + 7200), "--out", tmp_path / "out")
    status, said, errors = obsnet(
        "fetch", "YV.RR03", *span, "--base-url", centre.url, "--channels", "BDH,BH1"
    )
    assert (status, errors) == (0, [])
    assert said[-1].startswith("YV.RR03 (BDH, BH1): 2 channel-days fetched")


def test_a_second_run_asks_for_nothing(centre, tmp_path):
    get(centre, tmp_path)
    before = len(centre.asked)
    report = get(centre, tmp_path)
    assert len(centre.asked) == before == 9
    assert (report.fetched, report.present, len(report.missing)) == (0, 9, 1)


def test_a_lost_or_shortened_file_is_fetched_again(centre, tmp_path):
    get(centre, tmp_path)
    centre.asked.clear()
    (tmp_path / "2013/YV/RR03/BHZ.D/YV.RR03.00.BHZ.D.2013.141").unlink()
    with open(tmp_path / "2013/YV/RR03/BDH.D/YV.RR03.00.BDH.D.2013.143", "r+b") as file:
        file.truncate(1024)
    assert get(centre, tmp_path).fetched == 2
    assert sorted(centre.asked) == [("BDH", "2013-05-23"), ("BHZ", "2013-05-21")]


def test_part_of_a_day_grows_to_the_whole(centre, data, tmp_path):
    get(centre, tmp_path, start=DAY + 3600, end=DAY + 7200, channels="BDH")
    day = obspy.read(str(tmp_path / "2013/*/*/*/*"))
    assert day[0].stats.starttime == DAY + 3600 and day[-1].stats.endtime == DAY + 7200
    get(centre, tmp_path, start=DAY + 7200, end=DAY + 86400, channels="BDH")
    assert get(centre, tmp_path, start=DAY + 3600, end=DAY + 9000, channels="BDH").present == 1
    day = obspy.read(str(tmp_path / "2013/*/*/*/*")).merge()
    np.testing.assert_array_equal(day[0].data, data.select(channel="BDH")[0].data[3600:])


def test_days_that_have_hardly_ended_are_asked_for_again(centre, tmp_path):
    now = UTCDateTime()
    get(centre, tmp_path, start=now - 7200, end=now, channels="BDH")
    first = len(centre.asked)
    get(centre, tmp_path, start=now - 7200, end=now, channels="BDH")
    assert len(centre.asked) == 2 * first


def test_killed_in_the_middle_it_goes_on(centre, tmp_path):
    centre.slow = 0.15
    arguments = f"'YV.RR03', '{DAY}', '{DAY + 3 * 86400}', {str(tmp_path)!r}, base_url={centre.url!r}"
    code = f"from obsnet.fdsn import fetch; fetch({arguments})"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment)
    while len(centre.asked) < 4 and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait(10) == -signal.SIGKILL
    first, centre.slow = list(centre.asked), 0.0
    report = get(centre, tmp_path)
    second = centre.asked[len(first) :]
    assert 3 <= report.present <= len(first) < 9
    assert len(second) == 9 - report.present and not set(first[: report.present]) & set(second)
    assert not list(tmp_path.rglob("*.tmp"))


def test_troubles_that_pass_are_waited_out(centre, tmp_path):
    centre.faults = [503, "cut short", 429, 502]
    report = get(centre, tmp_path, retry=Retry(attempts=5, wait_s=0.01))
    assert report.fetched == 8 and len(centre.asked) == 13


def test_waits_double(centre, tmp_path, monkeypatch):
    waits = []
    monkeypatch.setattr("obsnet.fdsn.data_centre.time.sleep", waits.append)
    centre.faults = [503] * 4
    get(
        centre,
        tmp_path,
        end=DAY + 86400,
        channels="BDH",
        retry=Retry(attempts=5, wait_s=2.0, longest_wait_s=10.0),
    )
    assert [wait for wait in waits if wait] == [2.0, 4.0, 8.0, 10.0]


def test_too_large_requests_are_halved(centre, data, tmp_path):
    centre.longest_s = 50_000.0
    get(centre, tmp_path, end=DAY + 86400, channels="BDH")
    assert len(centre.asked) == 3
    day = obspy.read(str(tmp_path / "2013/*/*/*/*")).merge()
    np.testing.assert_array_equal(day[0].data, data.select(channel="BDH")[0].data)


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        (
            [503] * 9,
            r"failed on YV.RR03.00.BDH.D.2013.141: .*\(3 attempts\); run it again to go on from here",
        ),
        (["html"], "answers for YV.RR03.00.BDH.D.2013.141 with no miniSEED"),
        ([403], "does not give YV.RR03.00.BDH.D.2013.141 to everybody"),
        ([404], "has no FDSN dataselect service"),
        ([400], "failed on .*Bad request"),
    ],
)
def test_troubles_that_stay_are_one_line(centre, tmp_path, faults, message):
    centre.faults = faults
    with pytest.raises(SourceError, match=message) as caught:
        get(centre, tmp_path)
    assert "\n" not in str(caught.value)
    centre.faults = []
    assert get(centre, tmp_path).fetched == 8


def test_a_centre_s_codes_stay_within_the_folder():
    """Channels and locations of the answer become names of files."""
    for location, code in (("../..", "BHZ"), ("", "../../../BHZ")):
        made = Channel(code, location, -21.0, 54.0, -4000.0, 4000.0)
        station = Station("RR03", -21.0, 54.0, -4000.0, channels=[made])
        text = io.BytesIO()
        Inventory([Network("YV", [station])]).write(text, format="STATIONXML")
        with pytest.raises(StationError, match=r"centre has the code '\.\./"):
            read_stationxml(text.getvalue(), "http://centre")


def test_unknown_stations_channels_and_services(centre, tmp_path):
    with pytest.raises(SourceError, match=r"knows no station YV.RR99 between"):
        fetch("YV.RR99", DAY, DAY + 9, tmp_path, base_url=centre.url, retry=QUICK)
    with pytest.raises(SourceError, match=r"no channel LH\? at location \* .*it has BDH, BH1, BHZ"):
        get(centre, tmp_path, channels="LH?")
    with pytest.raises(SourceError, match="answers with no StationXML"):
        fetch("YV.RR03", DAY, DAY + 9, tmp_path, base_url=centre.dataselect, retry=QUICK)
    centre._stations = lambda query: (404, b"")
    with pytest.raises(SourceError, match="has no FDSN station service"):
        get(centre, tmp_path)
    centre._stations = lambda query: (200, b"<html>welcome</html>")
    with pytest.raises(SourceError, match="answers with no StationXML"):
        get(centre, tmp_path)
    assert not list(tmp_path.glob("2013"))


def test_addresses_that_lead_nowhere(tmp_path):
    for url, message in (
        ("http://nowhere.invalid", "nowhere.invalid is an unknown host"),
        (f"http://127.0.0.1:{free_port()}", "refuses connections"),
        ("ATLANTIS", "ATLANTIS is no FDSN data centre"),
    ):
        started = time.monotonic()
        with pytest.raises(SourceError, match=message) as caught:
            fetch("YV.RR03", DAY, DAY + 9, tmp_path, base_url=url)
        assert "\n" not in str(caught.value) and time.monotonic() - started < 2.0


def test_a_silent_server_is_given_up(centre, tmp_path):
    centre.slow = 1.0
    with pytest.raises(SourceError, match=r"did not answer in time about YV.RR03.00.BDH"):
        get(centre, tmp_path, channels="BDH", timeout_s=0.2, retry=Retry(attempts=2, wait_s=0.0))


def test_bad_requests_and_folders(centre, tmp_path):
    for station in ("YV", "YV.RR03.00", "Y V.RR03", ""):
        with pytest.raises(ConfigError, match=re.escape(f"NET.STA (YV.RR03), found '{station}'")):
            fetch(station, DAY, DAY + 9, tmp_path, base_url=centre.url)
    with pytest.raises(ConfigError, match="must be before the end"):
        get(centre, tmp_path, start=DAY + 9, end=DAY)
    with pytest.raises(ConfigError, match="the start must be an ISO 8601 time in UTC, found 'soon'"):
        get(centre, tmp_path, start="soon")
    with pytest.raises(ConfigError, match="at least one attempt"):
        Retry(attempts=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file; give a folder"):
        get(centre, tmp_path / "file")
    (tmp_path / "fetch.json").write_text("[]")
    with pytest.raises(OutputError, match="is not a manifest of obsnet fetch"):
        get(centre, tmp_path)
