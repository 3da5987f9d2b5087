"""What options mean for a whole command: the same waveforms, however the metadata lay them out."""

import copy

import obspy
import pytest

from .conftest import START


@pytest.fixture
def detected(tracked, inventory, record, tmp_path):
    """Run ``obsnet detect`` under changed metadata; its rows."""

    def run(change, *options):
        change(channels := copy.deepcopy(inventory))
        channels.write(str(tmp_path / "s.xml"), "STATIONXML")
        given = ("--detector", "analytic", *options)
        out = tracked(record / "waveforms.mseed", *given, station=tmp_path / "s.xml", command="detect")
        return (out / "detections.csv").read_text()

    return run


def as_it_is(inventory):
    pass


def two_epochs(inventory):
    """Every channel described anew, and alike, from the middle of the record on."""
    station = inventory[0][0]
    later = [copy.deepcopy(channel) for channel in station]
    for channel, after in zip(station, later, strict=True):
        channel.end_date = after.start_date = START + 3600
    station.channels += later


def begun_lately(inventory):
    for channel in inventory[0][0]:
        channel.start_date = START - 20 * 86400


@pytest.mark.parametrize(
    ("change", "start"),
    [(two_epochs, START), (two_epochs, START + 1800), (begun_lately, obspy.UTCDateTime(2013, 1, 1))],
)
def test_a_start_chooses_waveforms_and_no_epochs(detected, change, start):
    span = ("--start", start, "--end", START + 5400)
    assert detected(change, *span) == detected(as_it_is, *span)
