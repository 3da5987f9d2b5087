"""A live station on a simulated hour, small enough to be run many times."""

import pytest

import obsnet
from obsnet.config import build
from obsnet.live.config import WatchConfig
from obsnet.live.packets import Packet
from obsnet.live.station import LiveStation
from obsnet.pipeline import RunConfig
from obsnet.signals.station import Station

SMALL = {
    "azimuth": {"azimuth_step_deg": 4.0},
    "range": {"range_step_m": 500.0, "max_range_m": 20_000.0, "range_rate_step_mps": 2.0},
    "segmentation": {"shortest_min": 30.0, "average_min": [21.0], "range_average_min": 11.0},
    "grid_search": {"shortest_s": 900.0},
}
"""Coarse grids, and segments of half an hour."""


class Given:
    """A source of given batches; `after` is called before each."""

    def __init__(self, batches, before=lambda number: None):
        self.name, self.trouble, self.position, self.counts = "given", "", {}, {}
        self._batches, self._before, self._ended = batches, before, False

    def batches(self):
        for number, batch in enumerate(self._batches):
            if self._ended:
                return
            self._before(number)
            yield batch

    def close(self):
        self._ended = True


def packets(stream, seconds):
    """Packets of the lengths that `seconds()` gives, channel after channel."""
    made = []
    for trace in stream:
        at = 0
        while at < len(trace.data):
            count = max(int(seconds() * trace.stats.sampling_rate), 1)
            start = (trace.stats.starttime + at / trace.stats.sampling_rate).ns
            made.append(Packet(trace.id, start, trace.stats.sampling_rate, trace.data[at : at + count]))
            at += count
    return made


def by_eight(made):
    """Packets in batches of eight."""
    return [made[i : i + 8] for i in range(0, len(made), 8)]


@pytest.fixture(scope="session")
def station(record):
    return Station.from_stationxml(record / "station.xml")


@pytest.fixture(scope="session")
def hour(stream):
    """The record's middle hour."""
    start = stream[0].stats.starttime + 1800
    return stream.slice(start, start + 3600)


@pytest.fixture(scope="session")
def table(station):
    from obsnet.ocean.rays import propagation_table

    return propagation_table(RunConfig().ocean, station.depth_m)


@pytest.fixture(scope="session")
def small():
    return build(WatchConfig, SMALL)


@pytest.fixture(scope="session")
def batch(hour, station, table, tmp_path_factory):
    """What `obsnet.track` says of the hour: detections and tracks as the CSV files have them."""
    from obsnet.run import write_tables

    folder = tmp_path_factory.mktemp("batch")
    run = obsnet.track(hour, station, build(RunConfig, SMALL), table=table, folder=folder, threads=1)
    write_tables(run, folder)
    return folder


@pytest.fixture
def live(station, small, table, tmp_path):
    """Make a live station that writes into a folder."""
    made = []

    def make(folder=tmp_path / "live", config=small, **options):
        while made:
            made.pop().close()
        made.append(LiveStation(station, config, folder, table=table, **options))
        return made[-1]

    yield make
    while made:
        made.pop().close()


def rows(folder):
    """Lines of the detections of all days, without the header."""
    files = sorted(folder.glob("detections*.csv"))
    return [line for file in files for line in file.read_text().splitlines()[1:]]


def differences(got, expected):
    """Rows that differ by more than rounding may: a unit of the last place of a value."""
    wrong = []
    for a, b in zip(got, expected, strict=True):
        if a != b:
            pairs = list(zip(a.split(","), b.split(","), strict=True))
            units = (10.0 ** -len(max(x.partition(".")[2], y.partition(".")[2], key=len)) for x, y in pairs)
            same = [
                x == y or (x and y and i > 0 and abs(float(x) - float(y)) < 1.01 * unit)
                for i, ((x, y), unit) in enumerate(zip(pairs, units, strict=True))
            ]
            wrong += [] if all(same) else [(a, b)]
    return wrong
