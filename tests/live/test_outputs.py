"""NMEA sentences that another parser reads, and health over HTTP."""

import json
import socket
import urllib.error
import urllib.request
from types import SimpleNamespace

import pynmea2
import pytest
from prometheus_client.parser import text_string_to_metric_families

from obsnet.errors import OutputError
from obsnet.live.health import Health
from obsnet.live.outputs import HealthServer, NmeaOutput, metrics, sentences
from obsnet.live.ships import LiveEstimate

ROW = {
    "time": "2013-05-21T11:02:00Z", "existence": 0.98, "azimuth_deg": 149.93, "azimuth_std_deg": 1.0, "range_m": 6032.2,
    "range_std_m": 90.0, "course_deg": 59.9, "speed_mps": 8.0, "longitude": 54.15861, "latitude": -21.42032,
}  # fmt: skip


def test_sentences_say_what_the_estimate_says():
    ttm, tll = (pynmea2.parse(text.strip(), check=True) for text in sentences(ROW))
    assert (ttm.talker, ttm.sentence_type, tll.sentence_type) == ("RA", "TTM", "TLL")
    assert float(ttm.distance) * 1852 == pytest.approx(6032.2, abs=10)
    assert float(ttm.bearing) == 149.9
    assert float(ttm.speed) * 1852 / 3600 == pytest.approx(8.0, abs=0.03)
    assert (float(ttm.cog), ttm.cog_unit, ttm.dist_unit, ttm.status) == (59.9, "T", "N", "T")
    assert int(tll.data[1][:2]) + float(tll.data[1][2:]) / 60 == pytest.approx(21.42032, abs=1e-6)
    assert int(tll.data[3][:3]) + float(tll.data[3][3:]) / 60 == pytest.approx(54.15861, abs=1e-6)
    assert (tll.data[2], tll.data[4], tll.data[6]) == ("S", "E", "110200.00")


def test_a_wrong_checksum_would_be_noticed():
    text = sentences(ROW)[0].strip()
    with pytest.raises(pynmea2.ChecksumError):
        pynmea2.parse(text[:-1] + ("0" if text[-1] != "0" else "1"), check=True)


def test_no_ship_is_no_sentence_and_an_unknown_range_is_empty():
    assert sentences({**ROW, "existence": 0.3}) == []
    assert sentences({"time": ROW["time"], "existence": 0.0}) == []
    (ttm,) = sentences({**ROW, "existence": 0.7, "range_m": None, "latitude": None, "longitude": None})
    parsed = pynmea2.parse(ttm.strip(), check=True)
    assert (parsed.distance, parsed.status) == (None, "Q")


def test_north_is_zero_degrees_however_it_is_rounded():
    ttm = pynmea2.parse(
        sentences({**ROW, "azimuth_deg": 359.96, "course_deg": 359.98})[0].strip(), check=True
    )
    assert (float(ttm.bearing), float(ttm.cog)) == (0.0, 0.0)
    assert (
        ",,T,8.0,,T,"
        in sentences({**ROW, "azimuth_deg": None, "course_deg": None, "speed_mps": 8.0 * 1852 / 3600})[0]
    )


def test_the_live_row_of_a_ship_in_the_north_reads_zero(station):
    held = SimpleNamespace(
        config=SimpleNamespace(interval_s=60.0),
        step=lambda azimuth, chart: 0.9,
        state=((-1e-3, 6000.0, -1e-3, 8.0), None),
        azimuth=(359.999, 1.0),
        range_m=(6000.0, 90.0),
    )
    row = LiveEstimate(station)._row(0.0, held, None, None)
    assert (row["azimuth_deg"], row["course_deg"]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("longitude", "latitude", "words"),
    [(-0.5, 0.0, "0000.0000,N,00030.0000,W"), (359.99999999, 89.99999999, "9000.0000,N,00000.0000"), (200.0, -5.25, "0515.0000,S,16000.0000,W")],
)  # fmt: skip
def test_places_at_the_edges(longitude, latitude, words):
    assert words in sentences({**ROW, "longitude": longitude, "latitude": latitude})[1]


def test_udp_reaches_a_listener_and_bears_none():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        output = NmeaOutput(f"udp://127.0.0.1:{listener.getsockname()[1]}", "RA")
        output(ROW)
        assert listener.recv(1000).decode() == "".join(sentences(ROW))
    for _ in range(3):
        output(ROW)
    output.close()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_tcp_serves_those_who_connect_and_drops_those_who_left():
    port = free_port()
    output = NmeaOutput(f"tcp://127.0.0.1:{port}", "SD")
    gone, reader = (socket.create_connection(("127.0.0.1", port)) for _ in range(2))
    output(ROW)
    gone.close()
    for _ in range(5):
        output(ROW)
    reader.settimeout(5)
    received = b""
    while received.count(b"$SDTTM") < 6:
        received += reader.recv(4096)
    assert all(pynmea2.parse(line, check=True) for line in received.decode().split())
    assert len(output._readers) == 1
    with pytest.raises(OutputError, match=r"cannot send NMEA to tcp://127\.0\.0\.1"):
        NmeaOutput(f"tcp://127.0.0.1:{port}", "SD")
    output.close()


def test_health_and_metrics(live, hour):
    station = live()
    port = free_port()
    server = HealthServer(f"127.0.0.1:{port}", station.status)

    def get(path):
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    code, body = get("/healthz")
    assert code == 200
    assert json.loads(body)["station"]["code"] == "XX.SIM01"
    station.health.trouble = "cannot write: disk full"
    code, body = get("/healthz")
    assert (code, json.loads(body)["trouble"]) == (503, "cannot write: disk full")
    code, body = get("/metrics")
    values = {s.name: s.value for family in text_string_to_metric_families(body) for s in family.samples}
    assert code == 200
    assert values["obsnet_healthy"] == 0
    assert values["obsnet_silent_seconds"] >= 0
    assert values["obsnet_info"] == 1
    assert get("/../etc/passwd")[0] == 404
    server.close()


def test_silence_is_trouble(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("obsnet.live.health.time.monotonic", lambda: now[0])
    health = Health(silence_s=300.0)
    health.heard()
    now[0] += 299
    assert health.said(None, "")["healthy"]
    now[0] += 2
    assert health.said(None, "")["trouble"] == "no packet for 301 s"
    assert health.said(None, "Connection closed")["trouble"] == "Connection closed"
    health.heard()
    assert health.said(None, "")["healthy"]


def test_metrics_carry_labels_and_digests(live):
    models = {"azimuth": "ab12", "range": "cd34"}
    status = live().status() | {"packets": {"used": 7, "late": 2}, "models": models, "tracks": 3}
    text = metrics(status).decode()
    described = [line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")]
    assert len(described) == len(set(described))
    assert 'obsnet_model_info{digest="cd34",name="range"} 1.0' in text
    assert "# TYPE obsnet_tracks_total counter\nobsnet_tracks_total 3.0" in text
    assert 'obsnet_packets_total{fate="late"} 2.0' in text
    assert 'obsnet_model_info{digest="ab12",name="azimuth"} 1.0' in text
