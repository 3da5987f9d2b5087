import numpy as np
import pytest
from obspy import Stream, Trace, UTCDateTime

from obsnet.errors import ConfigError
from obsnet.signals.station import Station
from obsnet.twin.instrument import Coupling, Recorder
from obsnet.twin.noise import gaussian_noise
from obsnet.twin.propagate import Field

RATE = 50.0
CONTEXT, COUNT = 7500, 30_000


def motion(seed: int = 1) -> Field:
    """1–20 Hz noise: 0.1 Pa, 50 nm/s."""

    def colour(frequency, z):
        return z * ((frequency > 1.0) & (frequency < 20.0)).astype(np.float32)

    noise = gaussian_noise((seed,), 0, COUNT + 2 * CONTEXT, RATE, colour, draws=4)
    noise /= noise.std()
    return Field(0.1 * noise[0], *(5e-8 * row for row in noise[1:].astype(float)))


def recorded(recorder: Recorder, field: Field) -> Stream:
    network, station = recorder.code.split(".")
    counts = recorder.record(field, CONTEXT, COUNT)
    header = {"network": network, "station": station, "location": "00", "sampling_rate": RATE}
    return Stream(
        [
            Trace(counts[part].copy(), header | {"channel": code, "starttime": UTCDateTime(2013, 5, 21)})
            for part, code in recorder.channels.items()
        ]
    )


@pytest.mark.parametrize(
    "recorder",
    [
        Recorder(orientation_deg=0.0),
        Recorder(
            orientation_deg=0.0,
            seismometer_period_s=1 / 4.5,
            seismometer_counts=6e7,
            hydrophone_corner_hz=2.0,
        ),
        Recorder(orientation_deg=0.0, hydrophone_polarity=-1),
    ],
)
def test_obspy_removes_the_response_to_pascal_and_metre_a_second(recorder):
    field = motion()
    stream = recorded(recorder, field)
    inventory = recorder.inventory()
    truth = {"H": field.pressure, "1": field.north, "2": field.east, "Z": -field.down}
    for part, code in recorder.channels.items():
        trace = stream.select(channel=code)[0]
        output = "DEF" if part == "H" else "VEL"
        trace.remove_response(inventory, output=output, pre_filt=(0.3, 0.5, 24.0, 24.9), taper_fraction=0.02)
        inner = slice(2000, COUNT - 2000)
        exact = truth[part][CONTEXT : CONTEXT + COUNT]
        error = np.std(trace.data[inner] - exact[inner]) / np.std(exact)
        assert error < 0.005, part


def test_orientation_turns_the_horizontals():
    field = motion()
    recorder = Recorder(orientation_deg=25.0)
    north_east = recorded(Recorder(orientation_deg=0.0), field)
    turned = recorded(recorder, field)
    north, east = (north_east.select(channel=code)[0].data for code in ("BH1", "BH2"))
    azimuths = {c.code: np.deg2rad(c.azimuth) for c in recorder.inventory()[0][0] if c.code in ("BH1", "BH2")}
    for code, azimuth in azimuths.items():
        expected = north * np.cos(azimuth) + east * np.sin(azimuth)
        np.testing.assert_allclose(turned.select(channel=code)[0].data, expected, atol=1e-6 * np.std(north))


def test_a_reversed_hydrophone_is_reversed_in_counts_and_known_or_not_in_the_metadata():
    field = motion()
    plain, reversed_ = (recorded(Recorder(hydrophone_polarity=sign), field)[0].data for sign in (1, -1))
    np.testing.assert_allclose(reversed_, -plain)
    for declared, sign in ((True, -1), (False, 1)):
        inventory = Recorder(hydrophone_polarity=-1, declare_polarity=declared).inventory()
        gain = inventory[0][0].select(channel="BDH")[0].response.instrument_sensitivity.value
        assert np.sign(gain) == sign


def test_response_is_the_one_that_evalresp_computes():
    recorder = Recorder(hydrophone_corner_hz=0.7, seismometer_period_s=1 / 4.5, seismometer_counts=5e7)
    frequency = np.array([0.2, 1.0, 5.0, 10.0, 24.0])
    for part, code in recorder.channels.items():
        channel = recorder.inventory()[0][0].select(channel=code)[0]
        output = "DEF" if part == "H" else "VEL"
        found = channel.response.get_evalresp_response_for_frequencies(frequency, output)
        transfer = recorder.transfer(part)
        np.testing.assert_allclose(transfer.at(frequency), found, rtol=1e-5)
        assert abs(transfer.at(np.array([10.0]))[0]) == pytest.approx(abs(transfer.gain))


def test_metadata_make_the_station():
    recorder = Recorder(
        code="YV.TWIN", depth_m=3210.0, latitude=-30.5, longitude=60.25, orientation_deg=200.0
    )
    station = Station.from_stationxml(recorder.inventory())
    assert (station.code, station.latitude, station.longitude, station.depth_m) == (
        "YV.TWIN",
        -30.5,
        60.25,
        3210.0,
    )
    assert station.orientation_deg == pytest.approx(200.0)
    assert station.pressure.code == "BDH" and [c.code for c in station.motion] == ["BH1", "BH2", "BHZ"]
    unknown = Recorder(orientation_deg=200.0, declare_orientation=False)
    assert Station.from_stationxml(unknown.inventory()).orientation_deg == 0.0


@pytest.mark.parametrize(
    ("recorder", "codes"),
    [
        (Recorder(), "BDH BH1 BH2 BHZ"),
        (Recorder(sampling_rate=100.0), "HDH HH1 HH2 HHZ"),
        (Recorder(sampling_rate=125.0, seismometer_period_s=0.2, naming="123"), "EDH EH1 EH2 EH3"),
        (Recorder(sampling_rate=50.0, seismometer_period_s=0.2, naming="NEZ"), "SDH SHN SHE SHZ"),
        (Recorder(components="H1"), "BDH BH1"),
        (Recorder(components="12Z", band="C"), "CH1 CH2 CHZ"),
    ],
)
def test_channel_codes_follow_rate_and_sensor(recorder, codes):
    assert list(recorder.channels.values()) == codes.split()
    assert [c.code for c in recorder.inventory()[0][0]] == codes.split()


def test_coupling_is_one_at_low_frequency_and_resonates():
    coupling = Coupling(resonance_hz=40.0, damping=0.3)
    low, near, high = np.abs(coupling.at(np.array([0.5, 38.0, 200.0])))
    assert low == pytest.approx(1.0, abs=1e-3) and near > 1.8 and high < 0.3
    np.testing.assert_array_equal(Coupling().at(np.array([1.0, 20.0])), [1.0, 1.0])


def test_random_recorders_differ_but_little_in_the_band():
    recorders = [Recorder.random(np.random.default_rng(seed), 100.0) for seed in range(30)]
    assert {r.hydrophone_polarity for r in recorders} == {-1, 1}
    assert len({r.naming for r in recorders}) == 2
    band = np.linspace(5.0, 25.0, 50)
    for r in recorders:
        one, two = (coupling.at(band) for coupling in r.coupling)
        assert np.abs(np.abs(one / two) - 1).max() < 0.35
        assert np.abs(np.angle(one / two, deg=True)).max() < 25.0


def test_bad_recorders_are_refused():
    for message, bad in (
        ("a station code is NET.STA, found 'RR03'", {"code": "RR03"}),
        ("sampling_rate must lie", {"sampling_rate": 0.0}),
        ("hydrophone_polarity must be 1 or -1, found 2", {"hydrophone_polarity": 2}),
        ("depth_m must be positive", {"depth_m": -4000.0}),
        ("components must be letters of H12Z", {"components": "HXY"}),
        ("naming must be", {"naming": "XYZ"}),
    ):
        with pytest.raises(ConfigError, match=message):
            Recorder(**bad)
