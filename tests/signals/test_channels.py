"""Channels of one sensor are combined only where they speak the same unit; what has none is said."""

import numpy as np
import obspy
import pytest

from obsnet.errors import StationError
from obsnet.signals.spectra import spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms

from .conftest import inventory, standard, trace

CODES = ("BDH", "BH1", "BH2", "BHZ")


@pytest.fixture
def stream():
    rng = np.random.default_rng(0)
    return obspy.Stream([trace(rng.integers(-9999, 9999, 9000), code) for code in CODES])


def without_response(*codes, dip=-90.0):
    channels = standard(1.0, 1.0)
    channels[-1].dip = dip
    for item in channels:
        if item.code in codes:
            item.response = None
    return Station.from_stationxml(inventory(channels))


def units(made):
    return {name: array.attrs["units"] for name, array in made.items()}


def test_every_channel_without_a_response_is_said(stream):
    source = open_waveforms(stream, without_response(*CODES))
    assert set(units(spectra(source, source.station)).values()) == {"count"}
    assert source.report.notes == [
        f"YV.RR03.00.{code} has no response: its samples are taken as they are" for code in CODES
    ]


@pytest.mark.parametrize(("bare", "other"), [("BH1", "BH2"), ("BH2", "BH1")])
def test_counts_and_metres_a_second_make_no_azimuth(stream, bare, other):
    with pytest.raises(StationError, match=f"{bare} has no response, but .*{other} has one: .*StationXML"):
        spectra(stream, without_response(bare))


def test_a_vertical_without_a_response_matters_only_where_it_leans(stream):
    assert units(spectra(stream, without_response("BHZ"))) == {
        "p": "Pa", "east": "m/s", "north": "m/s", "down": "count",
    }  # fmt: skip
    leaning = without_response("BH1", "BH2", dip=-70.0)
    with pytest.raises(StationError, match=r"BH1 and .+ have no response, but .+BHZ has"):
        spectra(stream, leaning)
