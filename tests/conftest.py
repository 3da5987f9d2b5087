"""A simulated record for the tests of whole runs, and the command line in this process."""

import shutil
from pathlib import Path

import obspy
import pytest

from obsnet.cli import main
from obsnet.kinematics import StraightCourse
from obsnet.run import Run
from obsnet.twin.scenario import Passage, Scenario
from obsnet.twin.ship import Ship
from obsnet.twin.station import simulate

START = obspy.UTCDateTime(2013, 5, 21, 10)
HOURS = 2.0


@pytest.fixture(scope="session")
def record(tmp_path_factory):
    """Two simulated hours with one ship, 6 km off after an hour: waveforms.mseed, station.xml, ais.csv, truth."""
    folder = tmp_path_factory.mktemp("record")
    course = StraightCourse(START.timestamp + 3600.0, 6000.0, 60.0, 8.0)
    passage = Passage(Ship.random(3, 100000001), course)
    simulate(Scenario(START.timestamp, HOURS, (passage,), seed=4)).write(folder)
    return folder


@pytest.fixture(scope="session")
def stream(record):
    return obspy.read(record / "waveforms.mseed")


@pytest.fixture(scope="session")
def inventory(record):
    return obspy.read_inventory(str(record / "station.xml"))


@pytest.fixture
def unplotted(monkeypatch):
    """Runs without the seconds of drawing."""
    monkeypatch.setattr(Run, "plot", lambda run, path=None, reference=None: Path(path).touch())


@pytest.fixture
def obsnet(capsys):
    """Run a command in this process: exit status, lines on standard output, lines on standard error."""

    def command(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        said = capsys.readouterr()
        return left.value.code, said.out.splitlines(), said.err.splitlines()

    return command


@pytest.fixture
def tracked(record, tmp_path_factory, obsnet, unplotted):
    """Run ``obsnet track`` on waveforms, by default the record's; its folder."""

    def run(waveforms=record / "waveforms.mseed", *options, station=record / "station.xml", command="track"):
        out = tmp_path_factory.mktemp("run") / "out"
        paths = waveforms if isinstance(waveforms, list) else [waveforms]
        status, _, errors = obsnet(command, *paths, "--station", station, "--out", out, *options)
        assert (status, errors) == (0, [])
        return out

    return run


@pytest.fixture(scope="session")
def finished(record, tmp_path_factory):
    """The record's run, drawn and all."""
    out = tmp_path_factory.mktemp("finished") / "out"
    with pytest.raises(SystemExit) as left:
        main(
            [
                "track", str(record / "waveforms.mseed"), "--station", str(record / "station.xml"), "--out",
                str(out), "--ais", str(record / "ais.csv"), "--quiet",
            ]
        )  # fmt: skip
    assert left.value.code == 0
    yield out
    shutil.rmtree(out)


@pytest.fixture(scope="session")
def alive():
    """Whether a process of that number runs; one that nobody waited for does not."""

    def runs(process):
        try:
            with open(f"/proc/{process}/stat", encoding="ascii") as file:
                return file.read().rsplit(")", 1)[1].split()[0] not in "ZX"
        except FileNotFoundError:
            return False

    return runs
