"""Station metadata: the right channels, directions, epochs and depth; one line for all that is wrong."""

import math
import re

import numpy as np
import obspy
import pytest
from obspy.core.inventory import Inventory

from obsnet.errors import StationError
from obsnet.signals.station import Channel, Station

from .conftest import channel, deployments, inventory, standard


def codes(station):
    return [c.code for c in station.channels]


def place(station):
    return station.latitude, station.longitude, station.depth_m


def test_a_file_and_an_inventory_say_the_same(xml):
    from_file = Station.from_stationxml(xml(), "YV.RR03")
    assert from_file == Station.from_stationxml(inventory(standard()))
    assert (from_file.code, from_file.latitude, from_file.longitude) == ("YV.RR03", -21.4, 54.2)
    assert from_file.depth_m == 4340.0
    assert codes(from_file) == ["BDH", "BH1", "BH2", "BHZ"]
    assert from_file.pressure.kind == "pressure"
    assert from_file.orientation_deg == 30.0


def test_directions_are_seed():
    up, down = Channel("a.b.c.BHZ", "motion", 0.0, -90.0), Channel("a.b.c.BH3", "motion", 0.0, 90.0)
    north_east = Channel("a.b.c.BH1", "motion", 45.0, 0.0)
    np.testing.assert_allclose(up.direction, [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(down.direction, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(north_east.direction, [math.sqrt(0.5), math.sqrt(0.5), 0], atol=1e-15)


@pytest.mark.parametrize(
    ("horizontals", "expected"),
    [
        ({"BH1": 30.0, "BH2": 120.0}, {"BH1": 77.0, "BH2": 167.0}),
        ({"BH1": 30.0, "BH2": 300.0}, {"BH1": 77.0, "BH2": 347.0}),  # a left-handed pair stays left-handed
        ({"BHN": 0.0, "BHE": 90.0}, {"BHN": 77.0, "BHE": 167.0}),
        ({"BHX": 10.0, "BHY": 100.0}, {"BHX": 77.0, "BHY": 167.0}),
        ({"BH1": None, "BH2": None}, {"BH1": 77.0, "BH2": 167.0}),
        ({"BH1": 0.0, "BH2": 0.0}, {"BH1": 77.0, "BH2": 167.0}),  # zeros that stand for unknown
    ],
)
def test_orientation_turns_the_first_horizontal_and_keeps_the_angle_between_them(horizontals, expected):
    made = inventory([channel(code, azimuth, 0.0) for code, azimuth in horizontals.items()])
    station = Station.from_stationxml(made, orientation_deg=77.0)
    assert {c.code: c.azimuth_deg for c in station.horizontals} == expected
    assert station.orientation_deg == 77.0
    assert station.calibrated(orientation_deg=80.0).orientation_deg == 80.0


def test_overrides_replace_position_depth_and_polarity():
    station = Station.from_stationxml(
        inventory(standard(), elevation=0.0),
        latitude=1.0,
        longitude=2.0,
        depth_m=500.0,
        hydrophone_polarity=-1,
    )
    assert (station.latitude, station.longitude, station.depth_m) == (1.0, 2.0, 500.0)
    assert station.pressure.polarity == -1
    assert all(c.polarity == 1 for c in station.motion)


@pytest.mark.parametrize("code", ["BDH", "HDF", "EDG", "BHH"])
def test_pressure_is_an_instrument_code_d_or_an_orientation_code_h(code):
    assert Station.from_stationxml(inventory([channel(code)])).pressure.code == code


def test_other_instruments_are_no_channels():
    with pytest.raises(StationError, match="no hydrophone and no motion channel"):
        Station.from_stationxml(inventory([channel("LOG"), channel("VKI"), channel("BFE")]))


def test_a_hydrophone_goes_before_a_gauge_and_its_own_location_before_another():
    made = inventory([*standard(), channel("BDG"), channel("BDH", location="10")])
    assert Station.from_stationxml(made).pressure.seed_id == "YV.RR03.00.BDH"


def test_the_sensor_with_most_components_wins_then_the_lowest_rate():
    full = [channel(f"HH{c}", azimuth, 0.0, rate=100.0) for c, azimuth in (("1", 0.0), ("2", 90.0))]
    poor = [channel("BHZ", 0.0, -90.0)]
    station = Station.from_stationxml(inventory([*poor, *full, channel("HHZ", 0.0, -90.0, rate=100.0)]))
    assert [c.code for c in station.motion] == ["HH1", "HH2", "HHZ"]
    both = inventory([*standard(), *full, channel("HHZ", 0.0, -90.0, rate=100.0)])
    station = Station.from_stationxml(both)
    assert codes(station) == ["BDH", "BH1", "BH2", "BHZ"]
    # where only the other sensor has waveforms, it serves
    assert [c.code for c in station.at(seed_ids={"YV.RR03.00.HH1", "YV.RR03.00.HH2"}).motion] == [
        "HH1",
        "HH2",
    ]


def test_five_components_of_one_sensor_are_cut_to_one_pair_and_the_vertical():
    extra = [channel("BHN", 0.0, 0.0), channel("BHE", 90.0, 0.0)]
    station = Station.from_stationxml(inventory([*standard(), *extra]))
    assert [c.code for c in station.motion] == ["BHN", "BHE", "BHZ"]


def test_epochs_follow_time():
    turn = obspy.UTCDateTime(2013, 1, 1)
    made = inventory([
        channel("BH1", 10.0, 0.0, start=obspy.UTCDateTime(2012, 1, 1), end=turn),
        channel("BH1", 20.0, 0.0, start=turn, end=obspy.UTCDateTime(2014, 1, 1)),
        channel("BH2", 110.0, 0.0, start=obspy.UTCDateTime(2012, 1, 1)),
    ])  # fmt: skip
    station = Station.from_stationxml(made)
    assert len(station.epochs) == 3
    assert station.orientation_deg == 20.0
    assert station.at(turn.timestamp - 1).orientation_deg == 10.0
    assert station.at(turn.timestamp).orientation_deg == 20.0
    assert Station.from_stationxml(made, time="2012-06-01T00:00:00Z").orientation_deg == 10.0
    with pytest.raises(
        StationError, match=r"no channel of YV\.RR03 has an epoch at 2011.*span 2012-01-01.* to now"
    ):
        Station.from_stationxml(made, time="2011-01-01")
    # an override reaches every epoch
    turned = station.calibrated(orientation_deg=50.0)
    assert turned.at(turn.timestamp - 1).orientation_deg == 50.0


def test_the_place_follows_time():
    made = deployments()
    first, second = (-20.0, 54.2, 4000.0), (-25.0, 54.2, 2000.0)
    station = Station.from_stationxml(made)
    assert place(station) == second  # nothing says when: the latest
    assert place(station.placed(obspy.UTCDateTime(2012, 6, 1).timestamp)) == first
    assert place(station.placed(obspy.UTCDateTime(2013, 6, 1).timestamp)) == first
    assert place(station.placed(obspy.UTCDateTime(2014, 6, 1).timestamp)) == second
    assert place(station.placed(0.0)) == first
    for time, expected in (("2012-06-01", first), ("2014-06-01", second)):
        timed = Station.from_stationxml(made, time=time)
        assert place(timed) == expected
        assert place(timed.placed(0.0)) == expected  # the time has decided


def test_a_place_that_is_given_holds_for_all_times():
    early = obspy.UTCDateTime(2012, 6, 1).timestamp
    given = Station.from_stationxml(deployments(), latitude=1.0, longitude=2.0, depth_m=500.0)
    assert place(given.placed(early)) == (1.0, 2.0, 500.0)
    shallow = Station.from_stationxml(deployments()).calibrated(depth_m=500.0)
    assert place(shallow.placed(early)) == (-20.0, 54.2, 500.0)


def test_a_depth_that_was_not_known_is_asked_for_only_where_it_is_needed():
    made = deployments()
    made[0][0].elevation = 3.0
    station = Station.from_stationxml(made)
    assert station.depth_m == 2000.0
    with pytest.raises(StationError, match="give its depth"):
        station.placed(obspy.UTCDateTime(2012, 6, 1).timestamp)


def test_the_code_may_be_left_out_or_shortened_where_that_is_unique():
    two = Inventory([*inventory(standard()).networks, *inventory(standard(), code="RR04").networks])
    assert Station.from_stationxml(two, "RR04").code == "YV.RR04"
    with pytest.raises(StationError, match=r"describes 2 stations; name one with --code: YV\.RR03, YV\.RR04"):
        Station.from_stationxml(two)


@pytest.mark.parametrize("code", ["../../../evil", "RR/03", "..", "R R", "RÄ03", "R" * 30])
def test_codes_that_could_lead_out_of_a_folder_are_refused(xml, code):
    """Codes become names of files and folders."""
    path = xml()
    text = path.read_text()
    for element in ("Network", "Station"):
        path.write_text(re.sub(rf"(<{element} [^>]*code=)\"[^\"]*\"", rf'\g<1>"{code}"', text))
        with pytest.raises(StationError, match=rf"station\.xml has the code '{re.escape(code)}'"):
            Station.from_stationxml(path)
    with pytest.raises(StationError, match="the inventory has the code"):
        Station.from_stationxml(inventory(standard(), code=code))
    with pytest.raises(StationError, match="has the code"):
        Station.from_stationxml(inventory([channel(code)]))


BAD_FILES = {
    "empty": (b"", "is empty"),
    "text": (b"network,station\nYV,RR03\n", "is not a StationXML"),
    "random": (bytes(np.random.default_rng(0).integers(0, 256, 2000, np.uint8)), "is not a StationXML"),
    "other xml": (b"<?xml version='1.0'?><html><body/></html>", "is not a StationXML|describes no station"),
    "entities": (b"<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/hostname'>]><x>&e;</x>", "declares entities"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_files_that_are_no_stationxml_give_one_line(tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / "station.xml"
    path.write_bytes(content)
    with pytest.raises(StationError, match=message) as caught:
        Station.from_stationxml(path)
    assert "\n" not in str(caught.value)
    assert "station.xml" in str(caught.value)


def test_a_truncated_file_is_named(xml):
    path = xml()
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(StationError, match=r"station\.xml is not a StationXML that can be read"):
        Station.from_stationxml(path)


@pytest.mark.parametrize("value", ["NaN", ""])
@pytest.mark.parametrize("place", ["Latitude", "Elevation"])
def test_a_place_that_is_no_number_is_named(xml, place, value):
    path = xml()
    text, count = re.subn(rf"(<{place}[^>]*>)[^<]+(</{place}>)", rf"\g<1>{value}\g<2>", path.read_text())
    assert count
    path.write_text(text)
    with pytest.raises(StationError, match="latitude, longitude or elevation is missing or no number"):
        Station.from_stationxml(path)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda xml: Station.from_stationxml("nowhere.xml"),
            "cannot read the StationXML nowhere.xml: No such file",
        ),
        (lambda xml: Station.from_stationxml(xml().parent), "cannot read the StationXML .*: Is a directory"),
        (lambda xml: Station.from_stationxml(17), "found int"),
        (lambda xml: Station.from_stationxml(xml(), "YV.RR99"), r"has YV\.RR03, not YV\.RR99"),
        (lambda xml: Station.from_stationxml(xml(elevation=12.0)), r"elevation of 12 m.*--depth"),
        (lambda xml: Station.from_stationxml(xml(), depth_m=-4.0), r"depth of -4 m.*--depth"),
        (lambda xml: Station.from_stationxml(xml(), latitude=91.0), "latitude 91"),
        (lambda xml: Station.from_stationxml(xml(), hydrophone_polarity=2), "must be 1 or -1, found 2"),
        (
            lambda xml: Station.from_stationxml(xml(), orientation_deg=math.nan),
            "azimuth in degrees, found nan",
        ),
        (lambda xml: Station.from_stationxml(xml(), time="yesterday"), "cannot read the time 'yesterday'"),
        (lambda xml: Station.from_stationxml(Inventory()), "describes no station"),
    ],
)
def test_bad_requests_say_what_was_found(xml, call, message):
    with pytest.raises(StationError, match=message):
        call(xml)
