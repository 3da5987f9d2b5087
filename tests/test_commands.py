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


def test_what_is_given_counts_before_the_calibration(record, tmp_path):
    """An orientation, polarity or place on the command line is not overruled by a calibration's."""
    from obsnet.commands import _calibrated
    from obsnet.pipeline import RunConfig

    (tmp_path / "c.yaml").write_text(
        "station: XX.SIM01\npassages: 1\norientation: {azimuth_deg: 30.0, std_deg: 1.0, cells: 100}\n"
        "polarity: {sign: -1, significance: 9.0}\nposition: null\necho: null\n"
        "amplitudes: {depth_m: 4340.0, pairs: {3-5: {k: 1000.0, alpha: 2.0, xi_m: 20000.0, omega_m: 9000.0}}}\n"
        "fitted_pairs: []\nnotes: []\n"
    )
    file, none = record / "station.xml", {"orientation_deg": None, "hydrophone_polarity": None}
    found, *_ = _calibrated(file, None, tmp_path / "c.yaml", RunConfig(), **none)
    assert (found.orientation_deg, found.pressure.polarity) == (30.0, -1)
    given = {"orientation_deg": 75.0, "hydrophone_polarity": 1}
    station, *_ = _calibrated(file, None, tmp_path / "c.yaml", RunConfig(), **given)
    assert (station.orientation_deg, station.pressure.polarity) == (75.0, 1)
