"""Spectra: physical units, the same at every rate, clock and split, and missing data that stays missing."""

import math
import subprocess
import sys
import tracemalloc
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import obspy
import pytest

from obsnet.errors import ConfigError, StationError, WaveformError
from obsnet.layout import SPECTRA, require, to_posix
from obsnet.signals.frames import FrameTransform, clipped
from obsnet.signals.spectra import SpectraConfig, iter_spectra, spectra
from obsnet.signals.station import Channel, Station
from obsnet.signals.waveforms import open_waveforms

from .conftest import START, channel, flat, inventory, standard, trace

HOP_NS = 10_240_000_000
P = Station("YV.RR03", -21.4, 54.2, 4340.0, (Channel("YV.RR03.00.BDH", "pressure"),))
FOUR = Station.from_stationxml(inventory(standard(1.0, 1.0)))


class Tones:
    """A sum of tones at random frequencies below 22 Hz, known at every instant."""

    def __init__(self, seed=0, count=40, top=22.0):
        rng = np.random.default_rng(seed)
        self.frequency = rng.uniform(0.5, top, count)
        self.amplitude = rng.uniform(0.2, 2.0, count)
        self.phase = rng.uniform(0, 2 * np.pi, count)

    def at(self, seconds):
        """Values at times in s after START."""
        angle = 2 * np.pi * np.multiply.outer(seconds, self.frequency) + self.phase
        return np.cos(angle) @ self.amplitude

    def trace(self, hours=0.1, rate=50.0, offset=0.0, true_rate=None, code="BDH"):
        times = offset + np.arange(round(hours * 3600 * rate)) / (true_rate or rate)
        return trace(self.at(times), code, rate=true_rate or rate, start=START + offset)

    def frames(self, centres):
        """The oracle: each frame sampled at 50 Hz from its own start, windowed and transformed on its own."""
        window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(1024) / 1024)
        starts = (centres.astype("datetime64[ns]").astype(np.int64) - HOP_NS - START.ns) / 1e9
        rows = [
            np.fft.rfft(self.at(start + np.arange(1024) / 50) * window) * 2 / window.sum() for start in starts
        ]
        return np.array(rows).T


def close(got, tones, tolerance):
    """Against the oracle, leaving out 0 Hz (the mean is removed) and the Nyquist bin."""
    expected = tones.frames(got["time"].values)
    error = np.abs(got["p"].values - expected)[2:-2]
    assert np.nanmax(error) < tolerance * np.abs(expected).max()
    assert not np.isnan(error).any()


def test_a_tone_has_its_amplitude_its_phase_and_its_time():
    frequency = 256 / 20.48
    data = 3.0 * np.cos(2 * np.pi * frequency * np.arange(6000) / 50 + 0.4)
    station = Station.from_stationxml(inventory([channel("BDH", response=flat(250.0, "PA"))]))
    got = spectra(trace(data * 250.0), station)
    require(got, SPECTRA)
    assert got["p"].dims == ("frequency", "time")
    assert got["p"].dtype == np.complex64
    assert got["p"].attrs["units"] == "Pa"
    np.testing.assert_allclose(got["frequency"], np.arange(513) / 20.48)
    starts = got["time"].values.astype(np.int64) - HOP_NS
    assert (starts % HOP_NS == 0).all()
    assert (np.diff(starts) == HOP_NS).all()
    assert starts[0] - START.ns < HOP_NS
    assert START.ns + 120_000_000_000 - starts[-1] < 2 * HOP_NS + HOP_NS
    # exp(+iωt): a frame that starts at T shows the tone's phase at T
    turned = 3.0 * np.exp(1j * (0.4 + 2 * np.pi * frequency * (starts - START.ns) / 1e9))
    np.testing.assert_allclose(got["p"].sel(frequency=frequency).values, turned, rtol=1e-4)


@pytest.mark.parametrize("rate", [50.0, 62.5, 100.0, 125.0, 200.0, 250.0, 500.0, 51.2, 64.0, 80.0, 128.0])
def test_every_rate_gives_what_50_hz_gives(rate):
    tones = Tones()
    source = open_waveforms(tones.trace(rate=rate), P)
    got = spectra(source, P)
    assert got["p"].shape[0] == 513
    # off the sampling grid of the rate a frame's window sits up to half a sample off
    on_grid = (10.24 * rate).is_integer()
    close(got, tones, 1e-5 if on_grid else 3e-3)
    said = source.report.channels["YV.RR03.00.BDH"].transform
    assert said == ("FFT" if on_grid else "chirp-z transform") + ("" if rate == 50 else " cut at 25 Hz")


def test_energy_above_the_analysis_band_does_not_fold_into_it():
    quiet = spectra(Tones(1).trace(rate=250.0), P)
    loud = Tones(1).trace(rate=250.0)
    loud.data += 1000 * np.cos(2 * np.pi * 40.3 * np.arange(loud.data.size) / 250)
    np.testing.assert_allclose(spectra(loud, P)["p"].values[:500], quiet["p"].values[:500], atol=2e-3)


@pytest.mark.parametrize("offset", [0.0073, 0.0131, 12.3456])
def test_a_start_off_the_sampling_grid_shifts_nothing(offset):
    tones = Tones(2)
    close(spectra(tones.trace(offset=offset), P), tones, 3e-3)


@pytest.mark.parametrize("true_rate", [49.9987, 50.0021])
def test_a_clock_that_runs_at_its_own_rate_shifts_nothing(true_rate):
    tones = Tones(3)
    got = spectra(tones.trace(hours=2.0, true_rate=true_rate), P).isel(time=slice(-40, None))
    close(got, tones, 3e-3)
    # were the samples taken to be 20 ms apart, the end would be late by several samples
    assert abs(2 * 3600 * 50 / true_rate - 7200) > 0.15


def test_records_of_a_drifting_clock_shift_nothing(tmp_path):
    tones, chunk, records, true_rate = Tones(4), 250, 240, 50.005
    rows = np.arange(records * chunk).reshape(records, chunk) / true_rate
    data = tones.at(rows.ravel()).reshape(rows.shape).astype(np.float32)
    with open(tmp_path / "a.mseed", "wb") as file:
        for row, time in zip(data, rows[:, 0], strict=True):
            obspy.Stream([trace(row, start=START + float(time))]).write(file, "MSEED", reclen=4096)
    assert len(obspy.read(str(tmp_path / "a.mseed"))) == 1  # obspy sees nothing amiss
    got = spectra(tmp_path / "a.mseed", P)
    assert got.sizes["time"] > 110
    # the header times are good to 0.1 ms, which is 0.014 rad at 22 Hz
    close(got, tones, 2e-2)


def four_channels(hours, seed=0, rate=50.0):
    rng = np.random.default_rng(seed)
    count = round(hours * 3600 * rate)
    return obspy.Stream(
        [trace(rng.normal(0, 1e4, count).astype(np.int32), c.code, rate=rate) for c in FOUR.channels]
    )


def identical(one, other):
    assert list(one) == list(other)
    for name in one:
        np.testing.assert_array_equal(one[name].values, other[name].values)
    np.testing.assert_array_equal(one["time"], other["time"])


@pytest.mark.parametrize("block_s", [10.24, 100.0, 3600.0])
def test_blocks_make_no_difference(block_s):
    stream = four_channels(0.5)
    whole = spectra(stream, FOUR)
    assert list(whole) == ["p", "east", "north", "down"]
    identical(spectra(stream, FOUR, SpectraConfig(block_s=block_s)), whole)


def test_consecutive_spans_make_the_whole():
    stream = four_channels(0.5)
    whole = spectra(stream, FOUR)
    cuts = [START, START + 333.3, START + 901.7, START + 1800]
    parts = [spectra(stream, FOUR, starttime=a, endtime=b) for a, b in pairwise(cuts)]
    assert sum(part.sizes["time"] for part in parts) == whole.sizes["time"]
    first = 0
    for part in parts:
        identical(part, whole.isel(time=slice(first, first + part.sizes["time"])))
        first += part.sizes["time"]


def test_how_a_record_is_stored_makes_no_difference(tmp_path):
    stream = four_channels(0.3)
    whole = spectra(stream, FOUR)
    stream.write(str(tmp_path / "one.mseed"), "MSEED")
    identical(spectra(tmp_path / "one.mseed", FOUR), whole)
    pieces = obspy.Stream()
    for n, item in enumerate(stream):
        for a in range(0, 1080, 97):
            part = item.slice(START + a, START + a + 97 + 5 * (n % 2))  # half of them overlapping
            part.data = np.ascontiguousarray(part.data)
            pieces.append(part)
    pieces.traces = [pieces[i] for i in np.random.default_rng(0).permutation(len(pieces))]
    identical(spectra(pieces, FOUR), whole)
    folder = tmp_path / "pieces"
    folder.mkdir()
    for n, item in enumerate(pieces):
        item.write(str(folder / f"{n}.mseed"), "MSEED")
    identical(spectra(folder, FOUR), whole)


def test_a_gap_costs_the_frames_that_touch_it_and_no_more():
    tones = Tones(5)
    full = tones.trace(hours=1.0)
    gappy = obspy.Stream([full.slice(START, START + 1200), full.slice(START + 1800, START + 3600)])
    whole, got = spectra(full, P), spectra(gappy, P)
    start = to_posix(got["time"].values) - 10.24 - START.timestamp
    touched = (start + 20.48 > 1200.02) & (start < 1800)
    np.testing.assert_array_equal(np.isnan(got["p"].values).any(axis=0), touched)
    np.testing.assert_array_equal(np.isnan(got["p"].values).all(axis=0), touched)
    np.testing.assert_array_equal(got["p"].values[:, ~touched], whole["p"].values[:, ~touched])


def test_one_lost_sample_is_a_gap():
    full = Tones(5).trace()
    broken = obspy.Stream([full.slice(START, START + 100), full.slice(START + 100.04, START + 360)])
    assert 1 <= np.isnan(spectra(broken, P)["p"].values).all(axis=0).sum() <= 2


def test_nan_samples_are_a_gap():
    item = Tones(5).trace()
    item.data[5000] = np.nan
    source = open_waveforms(item, P)
    got = np.isnan(spectra(source, P)["p"].values)
    assert 1 <= got.all(axis=0).sum() <= 2
    np.testing.assert_array_equal(got.all(axis=0), got.any(axis=0))
    report = source.report.channels["YV.RR03.00.BDH"]
    assert (report.usable_frames, report.dead_frames) == ((~got[0]).sum(), got[0].sum())


def test_a_silence_of_years_is_passed_over():
    full = Tones(5).trace()
    early = full.copy()
    early.stats.starttime -= 33 * 365 * 86400
    source = open_waveforms(obspy.Stream([full, early]), P)
    got = spectra(source, P)
    assert got.sizes["time"] == 2 * spectra(full, P).sizes["time"]
    assert not np.isnan(got["p"].values).any()
    assert any("passed over" in note for note in source.report.notes)


def test_infinite_samples_are_a_gap_without_a_warning():
    item = Tones(5).trace()
    item.data[5000] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        got = np.isnan(spectra(item, P)["p"].values)
    assert 1 <= got.all(axis=0).sum() <= 2
    np.testing.assert_array_equal(got.all(axis=0), got.any(axis=0))


def test_channels_that_start_and_end_apart_are_aligned():
    stream = four_channels(0.5)
    whole = spectra(stream, FOUR)
    stream[1].trim(START + 100.3, START + 1500)
    stream[2].trim(START + 17.02, START + 1777)
    got = spectra(stream, FOUR)
    np.testing.assert_array_equal(got["time"], whole["time"])
    np.testing.assert_array_equal(got["p"], whole["p"])
    held = ~np.isnan(got["east"].values[0])
    assert 130 <= held.sum() <= 136
    np.testing.assert_array_equal(got["east"].values[:, held], whole["east"].values[:, held])
    np.testing.assert_array_equal(np.isnan(got["north"].values[0]), ~held)


@pytest.mark.parametrize("value", [0, 4321])
def test_a_channel_that_sticks_is_missing(value):
    stream = four_channels(0.5)
    stream[0].data[20000:30000] = value  # 200 s
    source = open_waveforms(stream, FOUR)
    got = spectra(source, FOUR)
    start = to_posix(got["time"].values) - 10.24 - START.timestamp
    touched = (start + 20.48 > 400) & (start < 600)
    np.testing.assert_array_equal(np.isnan(got["p"].values[5]), touched)
    assert not np.isnan(got["east"].values).any()
    assert source.report.channels["YV.RR03.00.BDH"].dead_frames == touched.sum()
    identical(spectra(stream, FOUR, SpectraConfig(block_s=50.0)), got)


def test_a_channel_that_is_dead_throughout_is_left_out():
    stream = four_channels(0.2)
    stream[1].data[:] = 0
    assert list(spectra(stream, FOUR)) == ["p", "down"]
    stream[0].data[:] = 7
    assert list(spectra(stream, FOUR)) == ["down"]


def test_a_clipped_stretch_is_missing_and_loud_ones_are_not():
    stream = four_channels(0.5)
    loud = stream[0].data.copy()
    loud[40000:50000] *= 30
    stream[0].data = loud
    assert not np.isnan(spectra(stream, FOUR)["p"].values).any()
    stream[0].data = np.clip(loud, -200_000, 200_000).astype(np.int32)
    source = open_waveforms(stream, FOUR)
    got = spectra(source, FOUR)
    start = to_posix(got["time"].values) - 10.24 - START.timestamp
    inside, outside = (start > 800) & (start + 20.48 < 1000), (start > 1000) | (start + 20.48 < 800)
    assert np.isnan(got["p"].values[5, inside]).all()
    assert not np.isnan(got["p"].values[5, outside]).any()
    assert source.report.channels["YV.RR03.00.BDH"].clipped_frames >= inside.sum()


@pytest.mark.parametrize("amplitude", [3, 40, 100, 1000, 1e6])
@pytest.mark.parametrize("frequency", [0.1, 0.3, 1.0, 5.0, 240 / 20.48, 256 / 20.48])
def test_tones_are_not_taken_for_clipped(amplitude, frequency):
    n = np.arange(1024)
    frames = np.rint(amplitude * np.sin(2 * np.pi * frequency * n / 50 + np.array([[0.1], [1.0]])))
    assert not clipped(frames, 0.01).any()
    assert not clipped(frames.astype(float) * 1e-9, 0.01).any()


def test_a_large_offset_costs_no_precision():
    tones = Tones(6)
    item = tones.trace()
    expected = spectra(item, P)["p"].values[2:-2]
    item.data = item.data + 4e7  # an absolute pressure gauge under 4 km of water, Pa
    np.testing.assert_allclose(spectra(item, P)["p"].values[2:-2], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("directions", "names"),
    [
        ({"BH1": (30, 0), "BH2": (120, 0), "BHZ": (0, -90)}, ["east", "north", "down"]),
        ({"BH1": (200, 0), "BH2": (110, 0), "BH3": (0, 90)}, ["east", "north", "down"]),
        ({"BHN": (0, 0), "BHE": (90, 0)}, ["east", "north"]),
        ({"BHX": (10, 0), "BHY": (80, 0), "BHZ": (0, -90)}, ["east", "north", "down"]),  # not orthogonal
        ({"BH1": (5, 12), "BH2": (95, -7), "BHZ": (40, -80)}, ["east", "north", "down"]),  # tilted
        ({"BHU": (90, -35.3), "BHV": (210, -35.3), "BHW": (330, -35.3)}, ["east", "north", "down"]),
        ({"BHZ": (0, -90)}, ["down"]),
        ({"BH1": (0, 0), "BHZ": (0, -90)}, ["down"]),
    ],
)
def test_components_come_back_from_any_independent_channels(directions, names):
    truth = {"east": Tones(7), "north": Tones(8), "down": Tones(9)}
    times = np.arange(18000) / 50
    ground = {name: tones.at(times) for name, tones in truth.items()}
    items, stream = [], obspy.Stream()
    for code, (azimuth, dip) in directions.items():
        a, d = math.radians(azimuth), math.radians(dip)
        data = (
            ground["east"] * math.cos(d) * math.sin(a)
            + ground["north"] * math.cos(d) * math.cos(a)
            + ground["down"] * math.sin(d)
        )
        items.append(channel(code, float(azimuth), float(dip), response=flat(2e9, "M/S")))
        stream.append(trace(data * 2e9, code))
    got = spectra(stream, Station.from_stationxml(inventory(items)))
    assert list(got) == names
    for name in names:
        expected = truth[name].frames(got["time"].values)
        error = np.abs(got[name].values - expected)[2:-2]
        assert error.max() < 1e-4 * np.abs(expected).max()
        assert got[name].attrs["units"] == "m/s"


def test_a_plane_wave_comes_back_through_its_instruments():
    """Pressure p and velocity p/(ρc) along the propagation, on a high-passed hydrophone and geophones."""
    impedance, azimuth = 1025.0 * 1500.0, math.radians(250.0)  # travelling towards 250°
    corner, w0, damping = 2 * np.pi * 2.0, 2 * np.pi * 4.5, 0.7
    tones = Tones(10)
    tones.frequency = np.maximum(tones.frequency, 8.0)  # where a bin's width changes the responses little
    s = 2j * np.pi * tones.frequency
    hydrophone = 5000.0 * s / (s + corner)
    geophone = 1e9 * s**2 / (s**2 + 2 * damping * w0 * s + w0**2)

    def record(transfer, scale):
        made = Tones(10)
        made.frequency = tones.frequency
        made.amplitude = tones.amplitude * np.abs(transfer) * scale
        made.phase = tones.phase + np.angle(transfer)
        return made.at(np.arange(18000) / 50)

    stages = obspy.core.inventory.response.PolesZerosResponseStage
    pressure = obspy.core.inventory.Response(
        response_stages=[stages(1, 5000.0, 0, "PA", "COUNTS", "LAPLACE (RADIANS/SECOND)", 0, [0], [-corner])]
    )
    poles = np.roots([1, 2 * damping * w0, w0**2])
    motion = obspy.core.inventory.Response(
        response_stages=[stages(1, 1e9, 0, "M/S", "COUNTS", "LAPLACE (RADIANS/SECOND)", 0, [0, 0], poles)]
    )
    station = Station.from_stationxml(
        inventory([
            channel("BDH", response=pressure),
            channel("BH1", 20.0, 0.0, response=motion),
            channel("BH2", 110.0, 0.0, response=motion),
        ])
    )  # fmt: skip
    along = {"BH1": math.cos(azimuth - math.radians(20)), "BH2": math.cos(azimuth - math.radians(110))}
    stream = obspy.Stream([trace(record(hydrophone, 1.0))])
    stream += obspy.Stream([trace(record(geophone, cos / impedance), code) for code, cos in along.items()])
    got = spectra(stream, station, SpectraConfig(water_level_db=80.0))
    expected = tones.frames(got["time"].values)
    strong = np.abs(expected) > 0.05
    assert strong.sum() > 1000
    np.testing.assert_allclose(got["p"].values[strong], expected[strong], atol=2e-2)
    for name, share in (("east", math.sin(azimuth)), ("north", math.cos(azimuth))):
        np.testing.assert_allclose(got[name].values[strong] * impedance, expected[strong] * share, atol=2e-2)
    intensity = [
        0.5 * np.real(np.conj(got["p"].values) * got[name].values)[strong].sum() for name in ("east", "north")
    ]
    assert math.degrees(math.atan2(-intensity[0], -intensity[1])) == pytest.approx(70.0, abs=0.05)


def test_the_water_level_bounds_what_is_undone():
    corner = 2 * np.pi * 20.0
    stage = obspy.core.inventory.response.PolesZerosResponseStage(
        1, 1.0, 0, "PA", "COUNTS", "LAPLACE (RADIANS/SECOND)", 0, [0, 0, 0], [-corner] * 3
    )
    response = obspy.core.inventory.Response(response_stages=[stage])
    station = Station.from_stationxml(inventory([channel("BDH", response=response)]))
    item = trace(np.random.default_rng(0).normal(size=6000))
    gain = np.abs(spectra(item, station)["p"].values[1:-1] / spectra(item, P)["p"].values[1:-1])
    s = 2j * np.pi * np.arange(1, 512) / 20.48
    shape = np.abs(s / (s + corner)) ** 3
    top = np.abs(2j * np.pi * 25 / (2j * np.pi * 25 + corner)) ** 3
    expected = 1 / np.maximum(shape, top / 100)
    np.testing.assert_allclose(gain, np.broadcast_to(expected[:, None], gain.shape), rtol=1e-3)


def test_a_reversed_hydrophone_is_turned():
    item = Tones(12).trace()
    reversed_one = P.calibrated(hydrophone_polarity=-1)
    np.testing.assert_array_equal(spectra(item, reversed_one)["p"], -spectra(item, P)["p"])


def test_metadata_epochs_are_followed():
    turn = START + 600
    made = inventory([
        channel("BDH", response=flat(10.0, "PA"), start=START - 10, end=turn),
        channel("BDH", response=flat(40.0, "PA"), start=turn, end=START + 1200),
    ])  # fmt: skip
    station = Station.from_stationxml(made)
    item = Tones(13).trace(hours=0.5)
    got, plain = spectra(item, station), spectra(item, P)
    seconds = to_posix(got["time"].values) - START.timestamp
    for span, gain in ((seconds < 600, 10.0), ((seconds >= 600) & (seconds < 1200), 40.0)):
        np.testing.assert_allclose(
            got["p"].values[2:-2, span] * gain, plain["p"].values[2:-2, span], atol=1e-5
        )
    assert np.isnan(got["p"].values[:, seconds >= 1200]).all()
    identical(spectra(item, station, SpectraConfig(block_s=70.0)), got)


def test_samples_without_a_response_are_counts_and_it_is_said():
    source = open_waveforms(Tones(14).trace(), P)
    assert spectra(source, P)["p"].attrs["units"] == "count"
    assert "YV.RR03.00.BDH has no response: its samples are taken as they are" in source.report.notes


def test_what_a_station_lacks_is_left_out():
    stream = four_channels(0.2)
    assert list(spectra(obspy.Stream(stream[:1]), FOUR)) == ["p"]
    assert list(spectra(obspy.Stream(stream[1:3]), FOUR)) == ["east", "north"]
    source = open_waveforms(obspy.Stream([stream[0], stream[1]]), FOUR)
    assert list(spectra(source, FOUR)) == ["p"]
    assert "YV.RR03.00.BH1 is the only horizontal: no azimuth" in source.report.notes


def without_azimuth(*azimuths):
    items = [
        channel(f"BH{n + 1}", azimuth, 0.0, response=flat(1.0, "M/S")) for n, azimuth in enumerate(azimuths)
    ]
    return Station.from_stationxml(inventory([channel("BDH", response=flat(1.0, "PA")), *items]))


def test_horizontals_need_an_azimuth_only_where_they_are_used():
    stream = four_channels(0.2)
    station = without_azimuth(None, None)
    with pytest.raises(
        StationError, match=r"YV\.RR03\.00\.BH1 has no azimuth in its StationXML; give --orientation"
    ):
        spectra(stream, station)
    assert list(spectra(obspy.Stream(stream[:1]), station)) == ["p"]
    assert list(spectra(stream, station.calibrated(orientation_deg=12.0))) == ["p", "east", "north"]
    with pytest.raises(StationError, match="point along 0° and 0°: they are not independent"):
        spectra(stream, without_azimuth(0.0, 0.0))


def test_a_record_shorter_than_a_frame_is_refused():
    with pytest.raises(WaveformError, match=r"hold no whole frame: 12 s .*give at least 30\.72 s"):
        spectra(trace(np.random.default_rng(0).normal(size=600)), P)


def test_metadata_of_another_time_are_refused():
    made = inventory([channel("BDH", response=flat(1.0, "PA"), start=START + 1e6)])
    with pytest.raises(
        StationError, match=r"no channel of YV\.RR03 has an epoch at the time of its waveforms"
    ):
        spectra(Tones(0).trace(), Station.from_stationxml(made))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"window_s": 0.0}, "window_s must be positive"),
        ({"hop_s": 30.0}, "hop_s must not exceed window_s"),
        ({"window_s": 20.5}, "even number of samples at analysis_rate_hz, found 1025; try"),
        ({"water_level_db": math.nan}, "water_level_db must be positive"),
        ({"clip_share": 0.0}, r"clip_share must lie in \(0, 1\]"),
    ],
)
def test_a_configuration_is_checked(values, message):
    with pytest.raises(ConfigError, match=message):
        SpectraConfig(**values)


def test_another_window_and_rate_follow_the_configuration():
    config = SpectraConfig(window_s=5.12, hop_s=1.28, analysis_rate_hz=100.0)
    data = 2.0 * np.cos(2 * np.pi * 35.15625 * np.arange(20000) / 200)
    got = spectra(trace(data, rate=200.0), P, config)
    assert got["frequency"].values[-1] == 50.0
    np.testing.assert_allclose(np.abs(got["p"].sel(frequency=35.15625).values), 2.0, rtol=1e-5)
    assert ((got["time"].values.astype(np.int64) - 2_560_000_000) % 1_280_000_000 == 0).all()


def test_a_transform_at_an_odd_rate_is_the_sum_it_says():
    rate, window_s = 51.337, 20.48
    transform = FrameTransform(rate, window_s, 513)
    x = np.random.default_rng(0).normal(size=(1, transform.count))
    t = np.arange(transform.count) / rate
    w = np.sin(np.pi * t / window_s) ** 2
    kernel = np.exp(-2j * np.pi * np.outer(np.arange(513) / window_s, t))
    expected = kernel @ (w * (x[0] - (w * x[0]).sum() / w.sum()))
    np.testing.assert_allclose(transform(x.copy())[0], expected, atol=1e-4)


def test_memory_stays_flat(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "long.mseed"
    with open(path, "wb") as file:
        for hour in range(36):
            item = trace(rng.normal(0, 1e3, 180_000).astype(np.int32), start=START + 3600 * hour)
            obspy.Stream([item]).write(file, "MSEED", encoding="INT32", reclen=4096)

    def peak(hours):
        tracemalloc.start()
        source = open_waveforms(path, P, endtime=START + 3600 * hours)
        frames = sum(block.sizes["time"] for block in iter_spectra(source, SpectraConfig(block_s=3600.0)))
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return frames, top

    few, short = peak(4)
    many, long = peak(36)
    assert many > 8.9 * few
    assert long < 1.2 * short
    assert long < 40e6


def test_nothing_heavy_is_imported():
    code = (
        "import sys, obsnet.signals.spectra; "
        "heavy = {'scipy.signal', 'matplotlib', 'obspy.signal', 'torch', 'numba'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_real_ocean_bottom_record_has_plausible_levels():
    """Record of a short-period OBS that package lcheapo carries, against obspy's own response removal."""
    lcheapo = pytest.importorskip("lcheapo")
    folder = Path(lcheapo.__file__).parent
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lcheapo import lcread

        raw = folder / "_examples" / "20191107T14_SPOBS09_F02.raw.lch"
        stream = lcread.read(str(raw), 1500, 400, network="XX", station="SPOB2", obs_type="SPOBS2")
    station = Station.from_stationxml(folder / "data" / "SPOBS2.station.xml", depth_m=2000.0)
    got = spectra(stream, station)
    assert list(got) == ["p", "east", "north", "down"]
    assert not np.isnan(got["p"].values).any()
    band = slice(round(5 * 20.48), round(20 * 20.48))
    density = {name: np.median(np.abs(got[name].values[band]) ** 2) / 2 / (1.5 / 20.48) for name in got}
    assert -60 < 10 * math.log10(density["p"]) < -20  # dB re 1 Pa²/Hz
    for name in ("east", "north", "down"):
        assert -170 < 10 * math.log10(density[name]) < -110  # dB re 1 (m/s)²/Hz
    inventory_read = obspy.read_inventory(str(folder / "data" / "SPOBS2.station.xml"))
    for name, code in (("p", "CDH"), ("down", "DH3"), ("north", "DH1"), ("east", "DH2")):
        (item,) = stream.select(channel=code).copy()
        item.data = item.data.astype(float)
        item.remove_response(
            inventory_read,
            output="DEF" if name == "p" else "VEL",
            water_level=None,
            pre_filt=(0.5, 1, 40, 60),
        )
        middle = got["time"].values[got.sizes["time"] // 2]
        first = round((to_posix(middle) - 10.24 - item.stats.starttime.timestamp) * 250)
        cut = item.data[first : first + 5120]
        window = np.sin(np.pi * np.arange(5120) / 5120) ** 2
        oracle = np.fft.rfft(cut * window)[band] * 2 / window.sum()
        mine = got[name].sel(time=middle).values[band]
        assert np.abs(mine - oracle).max() < 0.02 * np.abs(oracle).max()


def test_a_sensor_that_serves_at_no_time_is_said_to_be_left_aside():
    """Where two are described, one serves throughout, even where its waveforms end early."""
    both = inventory([*standard(), *(channel(code, location="10") for code in ("BH1", "BH2", "BHZ"))])
    record = four_channels(0.2)
    beside = record.select(channel="BH*").copy()
    for other in beside:
        other.stats.location = "10"
    for short in record.select(channel="BH*"):
        short.trim(endtime=short.stats.starttime + 300)
    opened = open_waveforms(record + beside, Station.from_stationxml(both))
    list(iter_spectra(opened))
    reason = "another sensor serves in its stead"
    assert opened.report.left_aside == {other.id: reason for other in beside}
