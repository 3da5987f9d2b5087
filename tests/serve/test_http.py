"""The page's server by plain HTTP: what it answers, and what it refuses."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

httpx = pytest.importorskip("httpx")
pytest.importorskip("starlette")
ROOT = Path(__file__).parents[2]


def raw(address, request):
    """Answer to a request that no client library would send."""
    host, _, port = address.removeprefix("http://").partition(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(request.encode())
        answer = b""
        while part := connection.recv(65536):
            answer += part
    return answer


def test_the_numbers_are_those_of_the_run(page, finished):
    about = httpx.get(f"{page}/api/about").json()
    assert about["station"]["code"] == "XX.SIM01" and about["kind"] == "run"
    (track,) = httpx.get(f"{page}/api/tracks").json()["tracks"]
    lines = (finished / "tracks.csv").read_text().splitlines()
    row = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert track["cpa_distance_m"] == pytest.approx(float(row["cpa_distance_m"]), rel=1e-4)
    shape = track["shape"]
    nearest = min(shape["range_km"])
    assert nearest == pytest.approx(float(row["cpa_distance_m"]) / 1e3, rel=0.02)
    assert len(shape["band"][0]) == 2 * len(shape["time"]) and len(shape["ellipse"][0]) > 50
    (ship,) = httpx.get(f"{page}/api/tracks").json()["ais"]
    assert min(ship["range_km"]) == pytest.approx(6.0, rel=0.05)


def test_the_band_holds_ninety_percent_of_drawn_courses():
    import numpy as np

    from obsnet.kinematics import StraightCourse
    from obsnet.serve.geometry import NINETY_PERCENT, across_std
    from obsnet.trackers.track import Track

    motion = StraightCourse(1e9, 8000.0, 40.0, 8.0)
    covariance = np.diag([10.0, 200.0, 0.8, 0.05]) ** 2
    covariance[1, 2] = covariance[2, 1] = 0.5 * 200.0 * 0.8
    track = Track(1e9 - 3600, 1e9 + 3600, motion, covariance, 100.0)
    time = np.array([1e9 - 3000.0, 1e9, 1e9 + 3000.0])
    half = NINETY_PERCENT * across_std(track, time)
    drawn = np.random.default_rng(1).multivariate_normal([1e9, 8000.0, 40.0, 8.0], covariance, 4000)
    course = np.deg2rad(40.0)
    east, north = motion.position(time)
    aside = [
        np.abs((e - east) * np.cos(course) - (n - north) * np.sin(course))
        for e, n in (StraightCourse(*map(float, row)).position(time) for row in drawn)
    ]
    assert np.mean(np.stack(aside) < half, axis=0) == pytest.approx([0.9] * 3, abs=0.02)


def test_the_live_way_is_one_ships(station_folder, listening):
    from obsnet.live.store import LIVE_COLUMNS

    folder, write = station_folder
    write.minutes(40)
    with write.store.transaction() as store:
        for minute in (10, 20):  # the filter takes up another ship
            time = stamp_of(minute)
            store.put(
                "live", LIVE_COLUMNS, [(time, 0.99, 200.0, 2.0, 19_000.0, 300.0, 20.0, 8.0, 54.0, -21.0)]
            )
    with listening(folder) as address:
        live = httpx.get(f"{address}/api/tracks").json()["live"]
        assert live["now"]["time"] == stamp_of(39) and len(live["ellipse"][0]) == 49
        assert len(live["trail"]["time"]) == 19
    write.store.close()
    assert not (folder / "obsnet.sqlite-wal").exists()
    with listening(folder) as address:
        assert len(httpx.get(f"{address}/api/detections").json()["time"]) == 40


def stamp_of(minute):
    return f"2013-05-21T10:{minute:02d}:00Z"


def test_a_database_that_is_none_is_said_in_one_line(station_folder, listening):
    folder, write = station_folder
    write.store.close()
    for path in folder.glob("obsnet.sqlite*"):
        path.unlink()
    (folder / "obsnet.sqlite").write_bytes(b"no database at all" * 100)
    with listening(folder) as address:
        answer = httpx.get(f"{address}/api/tracks")
    assert (
        answer.status_code == 503
        and "cannot read" in answer.json()["error"]
        and "Traceback" not in answer.text
    )


def test_a_folder_that_goes_away_is_said_in_one_line(finished, listening, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    with listening(folder) as address:
        shutil.rmtree(folder)
        for path in ("api/about", "api/strips", "files/tracks.csv"):
            answer = httpx.get(f"{address}/{path}")
            assert answer.status_code == 503 and str(folder) in answer.json()["error"]


@pytest.mark.parametrize("said", ["[]", "3", "null", "{"])
def test_a_status_that_is_none_is_none(station_folder, listening, said):
    folder, _ = station_folder
    (folder / "status.json").write_text(said)
    with listening(folder) as address:
        about = httpx.get(f"{address}/api/about").json()
    assert about["healthy"] is False and "no status.json" in about["trouble"]


def test_strips_are_the_maps(page, finished):
    import base64

    import numpy as np

    from obsnet.run import read_run

    answer = httpx.get(f"{page}/api/strips", params={"columns": 1440}).json()
    run = read_run(finished)
    strip = answer["strips"]["azimuth"]
    cells = np.frombuffer(base64.b64decode(strip["bytes"]), np.uint8).reshape(strip["count"], -1)
    assert cells.shape == (180, len(run.detections)) == (180, len(answer["time"]))
    values = strip["low"] + (cells.astype(float) - 1) * (strip["high"] - strip["low"]) / 254
    truth = run.maps["azimuth_llr"].values.reshape(-1, 180, 2).max(axis=2).T
    inside = (cells > 0) & (np.abs(truth) < 29)
    np.testing.assert_allclose(values[inside], truth[inside], atol=0.13)
    assert ((cells == 0) == np.isnan(truth)).all()
    few = httpx.get(f"{page}/api/strips", params={"columns": 10}).json()
    assert len(few["time"]) <= 10
    assert set(answer["strips"]) == {"azimuth", "range", "spectrum"}


def test_a_span_of_time_is_kept_to(page):
    times = httpx.get(f"{page}/api/detections").json()["time"]
    part = httpx.get(f"{page}/api/detections", params={"start": times[10], "end": times[20]}).json()
    assert part["time"] == times[10:21] and len(part["azimuth_deg"]) == 11
    early = httpx.get(f"{page}/api/tracks", params={"start": 0, "end": times[0] - 86400}).json()
    assert early["tracks"] == [] and early["ais"] == []


@pytest.mark.parametrize(
    "path", ["/", "/static/page.js", "/static/plotly.js", "/api/about", "/api/none", "/files/none", "/x"]
)
def test_every_answer_has_the_security_headers(page, path):
    answer = httpx.get(f"{page}{path}")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
    scripts = next(part for part in policy.split(";") if "script-src" in part)
    assert scripts.split() == ["script-src", "'self'"]
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["x-frame-options"] == "DENY"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert "server" not in answer.headers or "uvicorn" in answer.headers["server"]
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
@pytest.mark.parametrize("path", ["/", "/api/tracks", "/files/tracks.csv", "/api/events"])
def test_only_reading_is_allowed(page, finished, method, path):
    before = (finished / "tracks.csv").read_bytes()
    assert httpx.request(method, f"{page}{path}").status_code == 405
    assert (finished / "tracks.csv").read_bytes() == before


@pytest.mark.parametrize(
    "path",
    [
        "/files/../run.json", "/files/..%2f..%2fetc%2fpasswd", "/files/%2e%2e/%2e%2e/etc/passwd", "/files//etc/passwd",
        "/files/....//etc/passwd", "/files/..\\..\\etc\\passwd", "/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e%2fapp.py",
        "/files/%00", "/files/.", "/files/", "/files/secret.csv", "/files/link.csv", "/files/folder.csv", "/files/.hidden.csv", "/files/maps.nc",
        "/../../etc/passwd", "//etc/passwd",
    ],
)  # fmt: skip
def test_nothing_outside_the_folder_is_given(page, finished, tmp_path, path):
    secret = tmp_path / "secret.csv"
    secret.write_text("root secret")
    made = [finished / "link.csv", finished / "folder.csv", finished / ".hidden.csv"]
    made[0].symlink_to(secret)
    made[1].mkdir()
    made[2].write_text("root hidden")
    try:
        answer = raw(page, f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
    finally:
        made[0].unlink()
        made[1].rmdir()
        made[2].unlink()
    status = int(answer.split()[1])
    assert status in (400, 404), answer[:200]
    assert b"root" not in answer and b"import" not in answer


def test_the_folders_own_files_are_given(page, finished):
    about = httpx.get(f"{page}/api/about").json()
    assert {"detections.csv", "tracks.csv", "tracks.geojson", "run.json", "report.png"} <= set(about["files"])
    answer = httpx.get(f"{page}/files/tracks.geojson")
    assert answer.json() == json.loads((finished / "tracks.geojson").read_text())
    assert answer.headers["content-disposition"].startswith("attachment")


def test_another_host_name_is_refused(page):
    assert httpx.get(page, headers={"host": "evil.example"}).status_code == 400
    assert httpx.get(page, headers={"host": "localhost:8080"}).status_code == 200


@pytest.mark.parametrize("query", ["start=x", "end=nan", "start=-1", "end=inf", "columns=x", "start=1e300"])
def test_a_number_that_is_none_is_refused(page, query):
    answer = httpx.get(f"{page}/api/strips?{query}")
    assert answer.status_code == 400 and "must be a number" in answer.json()["error"]


def test_nothing_is_asked_of_other_servers():
    static = ROOT / "obsnet" / "serve" / "static"
    for path in static.iterdir():
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in text and "https://" not in text, path.name
    page = (static / "index.html").read_text()
    assert "onclick" not in page and "<style" not in page and "<script>" not in page


def test_a_folder_of_neither_kind_and_a_taken_port_are_one_line(obsnet, finished, tmp_path):
    status, _, errors = obsnet("serve", tmp_path)
    assert status == 2 and len(errors) == 1 and "neither run.json nor obsnet.sqlite" in errors[0]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        status, _, errors = obsnet("serve", finished, "--port", taken.getsockname()[1])
    assert status == 2 and len(errors) == 1 and "give another --host or --port" in errors[0]


def test_without_the_extra_the_error_says_which(obsnet, finished, monkeypatch):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "plotly" else find(name))
    status, _, errors = obsnet("serve", finished)
    assert status == 2 and len(errors) == 1 and "obsnet[serve]" in errors[0]


def test_it_listens_on_loopback_alone_and_a_signal_ends_it(finished):
    command = [sys.executable, "-m", "obsnet", "serve", str(finished), "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as started:
        try:
            address = started.stdout.readline().split(" at ")[1].split()[0].rstrip("/")
            assert address.startswith("http://127.0.0.1:")
            assert httpx.get(f"{address}/api/about", timeout=30).status_code == 200
            port = int(address.rpartition(":")[2])
            listening = Path("/proc/net/tcp")
            if listening.exists():
                own = [
                    line.split()[1]
                    for line in listening.read_text().splitlines()
                    if f":{port:04X} 00000000:0000 0A" in line
                ]
                assert own == [f"0100007F:{port:04X}"]
        finally:
            started.send_signal(signal.SIGINT)
            _, errors = started.communicate(timeout=20)
    assert errors == "" and started.returncode == 130
