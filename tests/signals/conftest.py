"""StationXML and streams for the tests of the room: made with obspy, independent of obsnet's own readers."""

import numpy as np
import obspy
import pytest
from obspy.core.inventory import Channel, Inventory, Network, Response, Site, Station
from obspy.core.inventory.response import InstrumentSensitivity, PolesZerosResponseStage

START = obspy.UTCDateTime(2013, 5, 21, 10)


def flat(value, units):
    """A sensor of constant sensitivity."""
    stage = PolesZerosResponseStage(
        1, value, 1.0, units, "COUNTS", "LAPLACE (RADIANS/SECOND)", 1.0, [], [], normalization_factor=1.0
    )
    return Response(
        instrument_sensitivity=InstrumentSensitivity(value, 1.0, units, "COUNTS"), response_stages=[stage]
    )


def channel(code, azimuth=None, dip=None, *, location="00", rate=50.0, response=None, start=None, end=None):
    return Channel(
        code, location, -21.4, 54.2, -4340.0, 0.0, azimuth, dip,
        sample_rate=rate, response=response, start_date=start, end_date=end,
    )  # fmt: skip


def standard(counts_per_pa=1000.0, counts_per_mps=1e9):
    """A hydrophone and three orthogonal components, the first at 30°."""
    motion = flat(counts_per_mps, "M/S")
    return [
        channel("BDH", response=flat(counts_per_pa, "PA")),
        channel("BH1", 30.0, 0.0, response=motion),
        channel("BH2", 120.0, 0.0, response=motion),
        channel("BHZ", 0.0, -90.0, response=motion),
    ]


def inventory(channels, code="RR03", network="YV", elevation=-4340.0):
    station = Station(code, -21.4, 54.2, elevation, channels=channels, site=Site("on the sea floor"))
    return Inventory([Network(network, [station])])


def deployments():
    """A station that lay at 20° S in 2012, 4000 m deep, and at 25° S in 2014, 2000 m deep."""
    made = []
    for year, latitude, depth_m in ((2012, -20.0, 4000.0), (2014, -25.0, 2000.0)):
        span = {"start": obspy.UTCDateTime(year, 1, 1), "end": obspy.UTCDateTime(year + 1, 1, 1)}
        (network,) = inventory([channel("BDH", **span)], elevation=-depth_m)
        network[0].latitude, network[0].start_date, network[0].end_date = latitude, *span.values()
        made += network.stations
    return Inventory([Network("YV", made)])


def trace(data, code="BDH", *, rate=50.0, start=START, location="00", station="RR03", network="YV"):
    header = {
        "network": network, "station": station, "location": location, "channel": code,
        "sampling_rate": rate, "starttime": start,
    }  # fmt: skip
    return obspy.Trace(np.asarray(data), header)


@pytest.fixture
def xml(tmp_path):
    """Write an inventory of the given channels to StationXML."""

    def write(channels=None, name="station.xml", **options):
        path = tmp_path / name
        inventory(standard() if channels is None else channels, **options).write(str(path), "STATIONXML")
        return path

    return write
