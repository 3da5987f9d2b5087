"""SDS archives of simulated waveforms, and parameters that are quick."""

import os

import obspy
import pytest

FAST = (
    "cepstrogram.clutter_window_s=3600",
    "azimuth.background_window_s=10800",
    "range.max_range_m=30000",
)


@pytest.fixture(scope="session")
def fast():
    """Overrides that keep all stages and every filter's memory, at a fraction of the time."""
    return FAST


@pytest.fixture(scope="session")
def write_sds():
    """Cut a stream at midnight into the files of an SDS archive."""
    return _write_sds


def _write_sds(stream, root):
    for trace in stream:
        midnight = obspy.UTCDateTime(trace.stats.starttime.date)
        while midnight < trace.stats.endtime:
            part = trace.slice(midnight, midnight + 86400 - 1e-3, nearest_sample=False)
            name = f"{trace.id}.D.{midnight.year}.{midnight.julday:03d}"
            network, station, _, channel = trace.id.split(".")
            path = root / str(midnight.year) / network / station / f"{channel}.D" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write(str(path), format="MSEED", encoding="STEIM2")
            midnight += 86400


@pytest.fixture(scope="session")
def sds(stream, tmp_path_factory):
    """The two simulated hours of one day."""
    root = tmp_path_factory.mktemp("sds")
    _write_sds(stream, root)
    return root


@pytest.fixture(scope="session")
def three_days(stream, tmp_path_factory):
    """The same hours on three days, the second of which is no waveform at all."""
    root = tmp_path_factory.mktemp("three")
    for day in range(3):
        later = stream.copy()
        for trace in later:
            trace.stats.starttime += 86400 * day
        _write_sds(later, root)
    for path in root.rglob("*.142"):
        path.write_bytes(b"not a waveform" * 100)
    return root


@pytest.fixture
def command(obsnet, record):
    """Run ``obsnet archive`` on an archive with quick parameters: status, lines, errors."""

    def run(root, out, *options, start="2013-05-21", end="2013-05-22", fast=FAST):
        chosen = [word for override in fast for word in ("--set", override)]
        return obsnet(
            "archive", root, "--stations", record / "station.xml", "--start", start, "--end", end, "--out", out, *chosen,
            *options,
        )  # fmt: skip

    return run


@pytest.fixture(autouse=True)
def same_environment():
    """Dask sets the threads of BLAS for its workers in this process, whose other children would then round otherwise."""
    kept = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(kept)
