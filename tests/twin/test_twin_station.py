"""The whole twin: what comes out is where, when and how loud it should be, however it is cut, and files
hold all of it.
"""

import json

import numpy as np
import obspy
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from obsnet.errors import AISError, ConfigError, OutputError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import to_posix
from obsnet.ocean.rays import phase_difference, propagation_table, tdoa
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.signals.station import Station
from obsnet.twin import station as twin
from obsnet.twin.course import WaypointCourse, local_projection
from obsnet.twin.faults import Faults, Gap
from obsnet.twin.instrument import Recorder
from obsnet.twin.sea import Ambient
from obsnet.twin.ship import LineSeries, Ship
from obsnet.twin.station import (
    Passage,
    Scenario,
    simulate,
    simulate_blocks,
    simulate_folder,
    write_simulation,
)

START = 1369130400.0
OCEAN = OceanConfig(max_range_m=60e3)
TABLE = propagation_table(OCEAN, 4340.0)
COURSE = StraightCourse(START + 900.0, 9000.0, 30.0, 9.0)


def scenario(**changes) -> Scenario:
    ship = Ship.random(11, source_level_db=196.0)
    fixed = {"hours": 0.5, "passages": (Passage(ship, COURSE),), "ocean": OCEAN, "seed": 3}
    return Scenario(**{**fixed, **changes})


def counts(simulation, code: str) -> np.ndarray:
    (trace,) = simulation.stream.select(channel=code)
    return trace.data


@pytest.fixture(scope="module")
def half_hour():
    return simulate(scenario(), TABLE)


def test_stream_is_four_channels_of_counts(half_hour):
    assert [trace.id for trace in half_hour.stream] == [
        f"XX.SIM01.00.{c}" for c in ("BDH", "BH1", "BH2", "BHZ")
    ]
    for trace in half_hour.stream:
        assert trace.data.dtype == np.int32 and trace.stats.npts == 90_000
        assert trace.stats.starttime.timestamp == START and trace.stats.sampling_rate == 50.0


def test_the_same_seed_gives_the_same_record_and_another_does_not(half_hour):
    np.testing.assert_array_equal(counts(simulate(scenario(), TABLE), "BH1"), counts(half_hour, "BH1"))
    other = counts(simulate(scenario(seed=4), TABLE), "BDH")
    assert abs(np.corrcoef(other, counts(half_hour, "BDH"))[0, 1]) < 0.2


def test_a_record_does_not_depend_on_its_start_and_length(half_hour):
    longer = simulate(scenario(start=START - 2000.0, hours=1.3), TABLE)
    for code in ("BDH", "BH2"):
        np.testing.assert_array_equal(counts(longer, code)[100_000:190_000], counts(half_hour, code))


def test_blocks_are_the_whole_record_and_have_no_seam(monkeypatch):
    asked = scenario(start=START - 1000.0)
    whole = simulate(asked, TABLE)
    merged = sum(simulate_blocks(asked, TABLE), obspy.Stream()).merge()
    assert len(list(simulate_blocks(asked, TABLE))) == 2
    for trace in merged:
        np.testing.assert_array_equal(trace.data, counts(whole, trace.stats.channel))
    monkeypatch.setattr(twin, "BLOCK_S", 1000.0)
    for code in ("BDH", "BH1", "BHZ"):
        found, expected = counts(simulate(asked, TABLE), code), counts(whole, code)
        assert np.abs(found.astype(float) - expected).max() < 2e-3 * expected.std() + 1.0


@pytest.mark.parametrize("rate", [62.5, 100.0, 125.0, 250.0])
def test_other_rates_record_the_same_sound(half_hour, monkeypatch, rate):
    monkeypatch.setattr(twin, "BLOCK_S", 900.0)
    recorder = Recorder(sampling_rate=rate)
    other = simulate(scenario(recorder=recorder, hours=0.25), TABLE)
    for part, code in recorder.channels.items():
        slow = counts(half_hour, Recorder().channels[part])[: 15 * 60 * 50]
        fast = counts(other, code)
        assert fast.size == 15 * 60 * rate
        low, high = (np.fft.rfft(x * np.hanning(x.size))[900:18_000] / x.size for x in (slow, fast))
        assert np.linalg.norm(high - low) < 0.02 * np.linalg.norm(low)


def test_a_rate_that_is_no_whole_number_records_the_same_lines():
    tones = Ship(source_level_db=60.0, lines=(LineSeries(1.5, (3, 4, 5), (195.0, 192.0, 190.0)),))
    asked = scenario(passages=(Passage(tones, COURSE),), ambient=None, hours=0.1)
    plain = counts(simulate(asked, TABLE), "BDH")[1000:17_000]
    rate = 49.9987
    (trace,) = simulate(asked.replace(recorder=Recorder(sampling_rate=rate)), TABLE).stream.select(
        channel="BDH"
    )
    assert trace.stats.sampling_rate == rate
    assert 0.0 <= trace.stats.starttime.timestamp - START <= 1 / rate
    time = trace.stats.starttime.timestamp - START + trace.times()
    resampled = CubicSpline(time, trace.data)(np.arange(1000, 17_000) / 50.0)
    assert np.linalg.norm(resampled - plain) < 0.03 * np.linalg.norm(plain)


def intensity_azimuth(simulation) -> tuple[float, float]:
    """Azimuth of minus the intensity, 11–20 Hz, by the metadata alone; and its reliability |ΣI|/Σ|I|."""
    station = Station.from_stationxml(simulation.inventory)
    window = np.hanning(1024)
    spectra = {}
    for channel in station.channels:
        (trace,) = simulation.stream.select(channel=channel.code)
        frames = trace.data[: trace.data.size // 1024 * 1024].reshape(-1, 1024) * window
        frequency = np.fft.rfftfreq(1024, trace.stats.delta)
        gain = channel.response.get_evalresp_response_for_frequencies(
            frequency[1:], "DEF" if channel.kind == "pressure" else "VEL"
        )
        spectra[channel.code] = np.fft.rfft(frames)[:, 1:] / gain
    band = (frequency[1:] > 11.0) & (frequency[1:] < 20.0)
    first, second = station.horizontals
    flow = np.zeros(spectra[first.code].shape, complex)
    for channel in (first, second):
        east, north, _ = channel.direction
        flow += np.real(np.conj(spectra[station.pressure.code]) * spectra[channel.code]) * (north + 1j * east)
    total = -flow[:, band].sum()
    return np.rad2deg(np.angle(total)) % 360.0, abs(total) / np.abs(flow[:, band]).sum()


@pytest.mark.parametrize(
    ("orientation", "polarity", "azimuth"), [(0.0, 1, 75.0), (133.0, 1, 310.0), (250.0, -1, 200.0)]
)
def test_intensity_points_back_to_the_ship_after_orientation_and_polarity(orientation, polarity, azimuth):
    still = StraightCourse(START, 9000.0, azimuth - 90.0, 0.0)
    asked = scenario(
        hours=0.1,
        passages=(Passage(Ship(source_level_db=205.0), still),),
        recorder=Recorder(orientation_deg=orientation, hydrophone_polarity=polarity),
    )
    found, reliability = intensity_azimuth(simulate(asked, TABLE))
    assert abs(wrap180(found - azimuth)) < 1.0 and reliability > 0.9
    unknown = Recorder(orientation_deg=orientation, hydrophone_polarity=polarity, declare_polarity=False)
    flipped, _ = intensity_azimuth(simulate(asked.replace(recorder=unknown), TABLE))
    assert abs(wrap180(flipped - azimuth - (180.0 if polarity < 0 else 0.0))) < 1.0


def mean_cepstrum(
    pressure: np.ndarray, band: tuple[float, float] = (5.0, 20.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the log spectra's inverse transform over `band` alone, and its quefrencies (oversampled
    tenfold).
    """
    frames = np.lib.stride_tricks.sliding_window_view(pressure.astype(float), 1024)[::512] * np.hanning(1024)
    log = np.log(np.abs(np.fft.rfft(frames, axis=1))).mean(axis=0)
    frequency = np.fft.rfftfreq(1024, 0.02)
    inside = (frequency > band[0]) & (frequency < band[1])
    log = log[inside] - np.polyval(np.polyfit(frequency[inside], log[inside], 6), frequency[inside])
    tau = np.arange(0.5, 9.0, 0.002)
    taper = np.hanning(inside.sum())
    return tau, np.cos(2 * np.pi * tau[:, None] * frequency[inside]) @ (log * taper) / taper.sum()


@pytest.mark.parametrize(("pair", "distance"), [("1-3", 11_000.0), ("3-5", 24_000.0), ("5-7", 38_000.0)])
def test_cepstrum_peaks_at_the_tdoa_with_the_phase_difference(pair, distance):
    """Eq. 17 with +Δφ: cos(2πf₀(τ − τ_ij) + Δφ_ij) under an envelope that peaks at τ_ij."""
    still = StraightCourse(START, distance, 10.0, 0.0)
    ship = Ship(source_level_db=205.0, modulation=0.0, ripple_db=0.0)
    asked = scenario(passages=(Passage(ship, still),), ambient=Ambient.isotropic(60.0))
    tau, cepstrum = mean_cepstrum(counts(simulate(asked, TABLE), "BDH"))
    expected = float(np.interp(distance, TABLE["range"], tdoa(TABLE, pair)))
    i = int(np.argmin(np.abs(TABLE["range"].values - distance)))
    phase = float(phase_difference(TABLE, pair)[i])
    shape = np.exp(2j * np.pi * 12.5 * (tau - expected)) * np.exp(-0.5 * ((tau - expected) / 0.06) ** 2)
    fit = np.sum(cepstrum * shape)
    assert abs(wrap180(-np.rad2deg(np.angle(fit)) - phase)) < 35.0
    near = np.abs(tau - expected) < 0.5
    envelope = np.abs(np.convolve(cepstrum * np.exp(-2j * np.pi * 12.5 * tau), np.hanning(80), "same"))
    assert tau[near][np.argmax(envelope[near])] == pytest.approx(expected, abs=0.03)


def test_received_level_is_source_level_less_transmission_loss():
    still = StraightCourse(START, 10_000.0, 10.0, 0.0)
    ship = Ship(source_level_db=200.0, modulation=0.0, level_spread_db=0.0)
    asked = scenario(passages=(Passage(ship, still),), ambient=None, bottom_loss_db=4.0)
    simulation = simulate(asked, TABLE)
    recorder = Recorder()
    f, psd = welch(counts(simulation, "BDH"), 50.0, nperseg=1024)
    band = (f > 10.0) & (f < 20.0)
    measured = psd[band] / np.abs(recorder.transfer("H").at(f[band])) ** 2
    at = TABLE.sel(range=10_000.0, method="nearest")
    sine = np.sqrt(TABLE.attrs["surface_speed_mps"] ** -2.0 - at["slowness"].values ** 2)
    dipole = 2 * np.sin(2 * np.pi * f[band] * ship.source_depth_m * sine[:, None])
    bounces = (TABLE["path"].values - 1) // 2
    pressure = at["pressure"].values * 10 ** (-4.0 / 20 * bounces)
    loss = np.nansum(np.abs(pressure[:, None] * dipole) ** 2, axis=0)
    expected = 1e-12 * 10 ** (ship.spectrum_level_db(f[band]) / 10) * loss
    assert 10 * np.log10(measured.mean() / expected.mean()) == pytest.approx(0.0, abs=0.5)


def test_a_typical_ship_stands_out_as_the_paper_saw():
    """10 km off, 11–20 Hz: broadband noise 10–20 dB above ordinary ambient noise."""
    still = StraightCourse(START, 10_000.0, 10.0, 0.0)
    ship = Ship(level_spread_db=0.0)
    loud = simulate(scenario(passages=(Passage(ship, still),), ambient=None), TABLE)
    sea = simulate(scenario(passages=(), ambient=Ambient(level_spread_db=0.0)), TABLE)
    level = []
    for simulation in (loud, sea):
        f, psd = welch(counts(simulation, "BDH"), 50.0, nperseg=1024)
        level.append(10 * np.log10(psd[(f > 11.0) & (f < 20.0)].mean()))
    assert 10.0 < level[0] - level[1] < 20.0


def test_truth_says_where_the_ship_was(half_hour):
    minutes = half_hour.truth.minutes
    assert len(minutes) == 30
    heard, emitted = to_posix(minutes["time"].to_numpy()), to_posix(minutes["emitted"].to_numpy())
    azimuth, distance, rate = COURSE.observables(emitted)
    np.testing.assert_allclose(minutes["range_m"], distance, atol=0.01)
    np.testing.assert_allclose(minutes["range_rate_mps"], rate, atol=1e-3)
    np.testing.assert_allclose(wrap180(minutes["azimuth_deg"] - azimuth), 0.0, atol=1e-4)
    np.testing.assert_allclose(heard - emitted, minutes["delay_s"], atol=1e-5)
    assert minutes["delay_s"].between(6.0, 25.0).all()
    (row,) = half_hour.truth.passages.to_dict("records")
    assert (row["cpa_range_m"], row["course_deg"], row["speed_mps"]) == (9000.0, 30.0, 9.0)
    assert row["cpa_azimuth_deg"] == 120.0 and row["cpa_time"] == pd.Timestamp(START + 900.0, unit="s")


def test_ais_is_the_course_in_longitude_and_latitude(half_hour):
    ais = half_hour.ais
    assert list(ais.columns) == ["mmsi", "time", "lon", "lat", "sog", "cog"]
    east, north = local_projection(-21.3732, 54.1294)(ais["lon"].to_numpy(), ais["lat"].to_numpy())
    expected = COURSE.position(to_posix(ais["time"].to_numpy()))
    np.testing.assert_allclose([east, north], expected, atol=0.2)
    np.testing.assert_allclose(ais["sog"], 9.0 * 3600 / 1852, atol=0.06)
    np.testing.assert_allclose(ais["cog"], 30.0, atol=0.06)


def test_files_hold_the_record(half_hour, tmp_path):
    written = half_hour.write(tmp_path / "new" / "folder")
    assert sorted(path.name for path in (tmp_path / "new" / "folder").iterdir()) == sorted(
        p.name for p in written
    )
    stream = obspy.read(tmp_path / "new" / "folder" / "waveforms.mseed")
    for trace in stream:
        assert trace.stats.mseed.encoding == "STEIM2"
        np.testing.assert_array_equal(trace.data, counts(half_hour, trace.stats.channel))
    station = Station.from_stationxml(tmp_path / "new" / "folder" / "station.xml")
    assert station.depth_m == 4340.0 and station.orientation_deg == 0.0
    ais = pd.read_csv(tmp_path / "new" / "folder" / "ais.csv")
    assert ais["time"].str.fullmatch(r"2013-05-21T\d\d:\d\d:\d\dZ").all() and len(ais) == len(half_hour.ais)
    np.testing.assert_allclose(ais["lat"], half_hour.ais["lat"], atol=1e-6)
    truth = json.loads((tmp_path / "new" / "folder" / "truth.json").read_text())
    assert truth["simulated"] is True and truth["passages"][0]["cpa_time"] == "2013-05-21T10:15:00Z"
    assert len(pd.read_csv(tmp_path / "new" / "folder" / "truth.csv")) == 30


def test_writing_block_by_block_gives_the_same_files(tmp_path):
    asked = scenario(start=START - 1000.0, faults=Faults(gaps=(Gap(300.0, 20.0, "1"),)))
    simulate(asked, TABLE).write(tmp_path / "whole")
    done = []
    write_simulation(asked, tmp_path / "blocks", TABLE, progress=lambda *at: done.append(at))
    assert done == [(1, 2), (2, 2)]
    one, two = (obspy.read(tmp_path / name / "waveforms.mseed").merge() for name in ("whole", "blocks"))
    for trace, other in zip(one.sort(), two.sort(), strict=True):
        np.testing.assert_array_equal(np.ma.filled(trace.data, -1), np.ma.filled(other.data, -1))
    for name in ("ais.csv", "truth.csv", "truth.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "blocks" / name).read_bytes()


def test_an_interrupted_write_leaves_nothing(tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulation(scenario(), tmp_path, TABLE, progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_is_a_file_is_refused(half_hour, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="it is a file, name a folder"):
        half_hour.write(tmp_path / "file")
    with pytest.raises(OutputError, match="cannot write the simulation"):
        half_hour.write(tmp_path / "file" / "below")


def test_faults_are_gaps_zeros_clipping_and_late_starts(half_hour):
    gaps = (Gap(600.0, 60.0), Gap(900.0, 1.0, "2"))
    faults = Faults(gaps, dead="Z", clipped="H", clip_counts=400_000, late_s=(0.0, 7.0, 0.0, 0.0))
    stream = simulate(scenario(faults=faults), TABLE).stream
    assert [len(stream.select(channel=code)) for code in ("BDH", "BH1", "BH2", "BHZ")] == [2, 2, 3, 2]
    first, second = stream.select(channel="BH1")
    assert first.stats.starttime.timestamp == START + 7.0
    assert first.stats.endtime.timestamp == START + 599.98
    assert second.stats.starttime.timestamp == START + 660.0
    np.testing.assert_array_equal(second.data, counts(half_hour, "BH1")[33_000:])
    assert not np.any(stream.select(channel="BHZ")[0].data)
    hydrophone = stream.select(channel="BDH")[0].data
    assert hydrophone.max() == 4000 and np.mean(hydrophone == 4000) > 0.1


def test_missing_channels_are_missing():
    stream = simulate(scenario(hours=0.02, recorder=Recorder(components="H")), TABLE).stream
    assert [trace.stats.channel for trace in stream] == ["BDH"]


def test_random_scenarios_are_reproducible_and_vary():
    drawn = [Scenario.random(seed, hours=6.0, ships=2) for seed in range(30)]
    assert Scenario.random(7, hours=6.0, ships=2) == drawn[7]
    assert len({s.recorder.orientation_deg for s in drawn}) == 30
    assert {bool(s.whales) for s in drawn} == {bool(s.faults.gaps) for s in drawn} == {True, False}
    for s in drawn:
        for passage in s.passages:
            assert s.start + 1.5 * 3600 <= passage.course.cpa_time <= s.end - 1.5 * 3600
    plain = Scenario.random(7, hours=6.0, nuisances=False, recorder=Recorder())
    assert plain.recorder == Recorder() and not plain.whales and plain.tremor is None
    assert Scenario.random(7, ships=0).passages == ()


def test_scenario_of_ais_follows_the_ships_that_come_near():
    inverse = local_projection(-21.3732, 54.1294)
    time = START + np.arange(0.0, 7200.0, 600.0)
    near = inverse(*COURSE.position(time), inverse=True)
    far = inverse(500e3 + 0 * time, 8.0 * (time - START), inverse=True)
    frame = pd.concat(
        pd.DataFrame({"mmsi": mmsi, "time": pd.to_datetime(time, unit="s"), "lon": lon, "lat": lat})
        for mmsi, (lon, lat) in ((538004321, near), (538009999, far))
    )
    asked = Scenario.from_ais(frame, START, 1.0, seed=2)
    assert [passage.ship.mmsi for passage in asked.passages] == [538004321]
    course = asked.passages[0].course
    assert isinstance(course, WaypointCourse) and course.span == (START, START + 6600.0)
    np.testing.assert_allclose(course.position(time + 100.0), COURSE.position(time + 100.0), atol=20.0)
    assert Scenario.from_ais(frame, START, 1.0, seed=2).passages[0].ship == asked.passages[0].ship
    with pytest.raises(ConfigError, match="AIS lacks lat"):
        Scenario.from_ais(frame.drop(columns="lat"), START, 1.0)


def test_passages_of_curved_courses_have_a_closest_approach():
    time = START + np.arange(0.0, 3601.0, 60.0)
    course = WaypointCourse(time, *COURSE.position(time))
    (row,) = simulate(
        scenario(hours=0.02, passages=(Passage(Ship(), course),)), TABLE
    ).truth.passages.to_dict("records")
    assert row["cpa_range_m"] == pytest.approx(9000.0, abs=1.0) and row["course_deg"] == pytest.approx(
        30.0, abs=0.01
    )
    assert row["cpa_time"].timestamp() == pytest.approx(START + 900.0, abs=1.0)


def test_bad_scenarios_are_refused():
    with pytest.raises(ConfigError, match="hours must be positive, found 0"):
        Scenario(hours=0)
    with pytest.raises(ConfigError, match="different mmsi"):
        Scenario(passages=(Passage(Ship(), COURSE), Passage(Ship(), COURSE)))
    with pytest.raises(ConfigError, match="start must be seconds"):
        Scenario(start=float("nan"))
    with pytest.raises(ConfigError, match="components are letters of H12Z"):
        Faults(dead="X")
    with pytest.raises(ConfigError, match="late_s holds a delay"):
        Faults(late_s=(1.0,))


def test_a_record_without_ships_has_empty_tables(tmp_path):
    quiet = simulate(scenario(hours=0.02, passages=()), TABLE)
    assert len(quiet.truth.minutes) == len(quiet.truth.passages) == len(quiet.ais) == 0
    quiet.write(tmp_path)
    assert list(pd.read_csv(tmp_path / "ais.csv").columns) == ["mmsi", "time", "lon", "lat", "sog", "cog"]


def test_folder_of_random_ships_and_of_ais(tmp_path):
    said = simulate_folder(tmp_path / "one", hours=0.2, seed=5, ships=2, start="2014-01-02T03:04:00Z")
    assert said.startswith(
        "simulated 0.2 h of XX.SIM01 from 2014-01-02T03:04:00Z with 2 ships: waveforms.mseed"
    )
    again = simulate_folder(
        tmp_path / "two",
        hours=0.1,
        seed=5,
        ais=tmp_path / "one" / "ais.csv",
        station=tmp_path / "one" / "station.xml",
    )
    assert "of XX.SIM01 from 2014-01-02T" in again
    one, two = (Station.from_stationxml(tmp_path / name / "station.xml") for name in ("one", "two"))
    assert one.depth_m == two.depth_m == 4340.0 and one.orientation_deg == pytest.approx(two.orientation_deg)
    truth = json.loads((tmp_path / "two" / "truth.json").read_text())
    assert {row["mmsi"] for row in truth["passages"]} <= {100000001, 100000002}
    with pytest.raises(ConfigError, match="cannot read the start 'noon'"):
        simulate_folder(tmp_path / "three", start="noon")


@pytest.mark.parametrize("start", ["1970-01-01T00:00:00Z", "1968-12-31T23:55:00Z"])
def test_a_record_begins_when_it_should(tmp_path, start):
    said = simulate_folder(tmp_path, hours=0.1, seed=5, start=start)
    assert f"from {start}" in said
    stream = obspy.read(str(tmp_path / "waveforms.mseed"))
    assert abs(min(trace.stats.starttime for trace in stream) - obspy.UTCDateTime(start)) < 1.0


def test_ais_without_a_ship_near_the_station_is_refused(half_hour, tmp_path):
    half_hour.write(tmp_path)
    Recorder(latitude=-25.0, longitude=54.0).inventory().write(tmp_path / "far.xml", format="STATIONXML")
    with pytest.raises(AISError, match=r"no ship of .*ais.csv comes within 100 km of -25, 54"):
        simulate_folder(tmp_path / "out", ais=tmp_path / "ais.csv", station=tmp_path / "far.xml")
