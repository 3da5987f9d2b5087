"""A page's server over simulated folders: of a finished run, and of a live station that a test writes on."""

import contextlib
import threading
import time

import pytest

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
