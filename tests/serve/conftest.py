"""A page's server over simulated folders: of a finished run, and of a live station that a test writes on."""

import contextlib
import json
import threading
import time

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("starlette")
uvicorn = pytest.importorskip("uvicorn")


@contextlib.contextmanager
def _listening(folder, ships=()):
    from obsnet.serve.app import make_app
    from obsnet.serve.folder import open_folder
    from obsnet.serve.server import LOOPBACK

    app = make_app(open_folder(folder, list(ships)), LOOPBACK)
    options = uvicorn.Config(app, port=0, log_level="error", lifespan="off", timeout_graceful_shutdown=1)
    server = uvicorn.Server(options)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(10)


@pytest.fixture(scope="session")
def listening():
    """Serve a folder within the block; its address."""
    return _listening


@pytest.fixture(scope="session")
def page(finished, record):
    """Address of the page of the simulated record's run, AIS overlaid."""
    from obsnet.ais import read, reference_tracks
    from obsnet.run import read_run

    station = read_run(finished).station
    with _listening(finished, reference_tracks(read(record / "ais.csv"), station)) as address:
        yield address


START = 1369130400.0


class _Writer:
    """Writes what a live station writes, into the station's own store; the values are made up."""

    def __init__(self, folder):
        from obsnet.live.store import Store

        self.folder, self.store = folder, Store(folder)
        self.status()

    def status(self, trouble="", code="XX.SIM01"):
        from obsnet.output import write_text

        place = {"code": code, "latitude": -21.4, "longitude": 54.1, "depth_m": 4340.0}
        said = {
            "obsnet": "0",
            "station": place,
            "healthy": not trouble,
            "trouble": trouble,
            "channels": {},
            "packets": {"used": 3},
        }
        write_text(self.folder / "status.json", json.dumps(said))

    def minutes(self, count):
        from obsnet import strips
        from obsnet.layout import from_posix, iso
        from obsnet.live.store import LIVE_COLUMNS
        from obsnet.tables import DETECTION_COLUMNS

        seconds = START + 60.0 * np.arange(count)
        times = [iso(t) for t in seconds]
        azimuth, distance, rate = (
            np.arange(0.0, 360.0, 2.0),
            np.arange(0.0, 20_000.0, 200.0),
            np.arange(-6.0, 7.0, 2.0),
        )
        values = np.random.default_rng(0).normal(0.0, 3.0, (count, 180)).astype(np.float32)
        ranged = np.zeros((count, len(distance), len(rate)), np.float32)
        axes = {"time": from_posix(seconds), "azimuth": azimuth, "range": distance, "range_rate": rate}
        maps = xr.Dataset(
            {
                "azimuth_llr": (("time", "azimuth"), values),
                "range_llr": (("time", "range", "range_rate"), ranged),
            },
            axes,
        )
        power = np.full((count, 32), 1e-6, np.float32)
        features = xr.Dataset(
            {"power": (("time", "spectrogram_frequency"), power)},
            {"time": axes["time"], "spectrogram_frequency": np.arange(32.0) * 0.7},
        )
        made, said = strips.columns(maps, features, 20.48)
        with self.store.transaction() as store:
            store.put(
                "detections",
                DETECTION_COLUMNS,
                [(t, 1.0, 40.0 + i, 12.0, 8000.0, -3.0, 9.0) for i, t in enumerate(times)],
            )
            store.put(
                "live",
                LIVE_COLUMNS,
                [
                    (t, 0.98, 40.0 + i, 2.0, 8000.0, 300.0, 200.0, 8.0, 54.1, -21.3)
                    for i, t in enumerate(times)
                ],
            )
            store.put_strips(times, made, strips.plain(said))

    def tracks(self, count, apart_h=2.0):
        from obsnet.layout import iso
        from obsnet.tables import TRACK_COLUMNS

        rows = []
        for number in range(count):
            cpa = START - 3600.0 * apart_h * (count - 1 - number)
            times = [iso(cpa - 3000.0), iso(cpa + 3000.0), iso(cpa)]
            rows.append(
                (number + 1, *times, 7000.0 + 900.0 * number, 120.0, 30.0, 8.0, 9.0, 90.0, 0.6, 0.04, 400.0)
            )
        with self.store.transaction() as store:
            store.put(
                "detections",
                ("time", "coverage"),
                [(iso(START - 3600.0 * apart_h * (count - 1)), 1.0), (iso(START + 3000.0), 1.0)],
            )
            store.put("tracks", TRACK_COLUMNS, rows)


@pytest.fixture
def station_folder(tmp_path):
    """A live station's folder, and who writes on it."""
    writer = _Writer(tmp_path)
    yield tmp_path, writer
    writer.store.close()
