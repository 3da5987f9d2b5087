"""Whales, earthquakes and tremor: when, from where and on which components they are heard, and in any
cut the same.
"""

from dataclasses import replace

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation
from obsnet.ocean.sound_speed import SoundSpeed
from obsnet.twin.propagate import Field, Paths
from obsnet.twin.seafloor import Earthquakes, Tremor, add_earthquakes, add_tremor
from obsnet.twin.whales import SONGS, Whale, add_whale

RATE = 50.0
START = 1369130400
FIRST = 50 * START
DEPTH, SPEED = 4000.0, 1500.0


@pytest.fixture(scope="module")
def paths() -> Paths:
    ranges = np.arange(0.0, 40e3, 70.0)
    return Paths(propagation(SoundSpeed.constant(SPEED), DEPTH, Bottom(), ranges, (1, 3)))


def at(azimuth: float, distance: float) -> StraightCourse:
    return StraightCourse(START, distance, azimuth - 90.0, 0.0)


def first_call(whale: Whale) -> float:
    return float(whale.calls(START, START + 7200.0)[0])


def test_a_fin_whale_is_heard_along_both_paths_after_their_travel_times(paths):
    call = first_call(Whale("fin", at(60.0, 5000.0)))
    alone = Whale("fin", at(60.0, 5000.0), span=(call - 1.0, call + 1.0))
    field = Field.silence(int(100 * RATE))
    first = int((call - 60.0) * RATE)
    add_whale(field, first, RATE, alone, paths)
    time = first / RATE + np.arange(field.pressure.size) / RATE
    loud = np.convolve(field.pressure**2, np.ones(25) / 25, "same")
    for k, gain in ((1, 1.0), (3, 0.01)):
        arrival = call + 0.5 + np.hypot(5000.0, k * DEPTH) / SPEED
        near = np.abs(time - arrival) < 2.0
        assert loud[near].max() > gain * 0.05 * loud.max()
        assert time[near][np.argmax(loud[near])] == pytest.approx(arrival, abs=0.15)
    silent = time < call + np.hypot(5000.0, DEPTH) / SPEED - 0.05
    assert np.abs(field.pressure[silent]).max() == 0.0


@pytest.mark.parametrize("species", list(SONGS))
def test_every_song_points_back_to_its_whale(paths, species):
    field = Field.silence(int(400 * RATE))
    whale = Whale(species, at(285.0, 9000.0), seed=1)
    add_whale(field, int(first_call(whale) * RATE), RATE, whale, paths)
    flow = [np.mean(field.pressure * part) for part in (field.east, field.north)]
    source = np.rad2deg(np.arctan2(-flow[0], -flow[1])) % 360.0
    assert np.std(field.pressure) > 0.003
    assert source == pytest.approx(285.0, abs=0.1)


def test_level_of_a_fin_whale(paths):
    whale = Whale("fin", at(0.0, 3000.0), source_level_db=190.0, depth_m=18.0)
    field = Field.silence(int(60 * RATE))
    add_whale(field, int(first_call(whale) * RATE), RATE, whale, paths)
    arrival = paths.arrival(0, np.array([3000.0]))
    dipole = 2 * np.sin(2 * np.pi * 20.5 * paths.dipole_delay(18.0, arrival.slowness)[0])
    peak = np.sqrt(2) * 1e-6 * 10 ** (190.0 / 20) * abs(arrival.pressure[0]) * abs(dipole)
    assert np.abs(field.pressure).max() == pytest.approx(peak, rel=0.05)


def test_calls_come_at_their_interval_in_bouts():
    calls = Whale("fin", seed=4).calls(START, START + 3600.0)
    steps = np.diff(calls)
    assert np.median(steps) == pytest.approx(13.0, abs=0.3)
    assert np.sum(steps > 60.0) >= 2
    np.testing.assert_array_equal(
        Whale("fin", seed=4).calls(START + 1000.0, START + 2000.0),
        calls[(calls >= START + 1000) & (calls < START + 2000)],
    )


def test_a_whale_sings_at_its_own_pitch_pace_and_length(paths):
    usual = Whale("fin", at(0.0, 3000.0), seed=3)
    other = replace(usual, pitch=0.8, pace=1.5, length=0.5)
    steps = [np.median(np.diff(whale.calls(START, START + 3600.0))) for whale in (usual, other)]
    assert steps[1] / steps[0] == pytest.approx(1.5, abs=0.05)
    middles, lengths = [], []
    for whale in (usual, other):
        field = Field.silence(int(5 * RATE))
        add_whale(field, int(first_call(whale) * RATE), RATE, whale, paths)
        power = np.abs(np.fft.rfft(field.pressure)) ** 2
        middles.append(np.sum(np.fft.rfftfreq(field.pressure.size, 1 / RATE) * power) / np.sum(power))
        lengths.append(np.sum(np.abs(field.pressure) > 0.1 * np.abs(field.pressure).max()))
    assert middles[1] / middles[0] == pytest.approx(0.8, abs=0.02)
    assert lengths[1] / lengths[0] == pytest.approx(0.5, abs=0.12)


def test_calls_of_a_whale_differ_in_level_by_as_much_as_is_said(paths):
    def peaks(spread: float) -> np.ndarray:
        whale = Whale("fin", at(0.0, 3000.0), seed=3, level_spread_db=spread)
        found = []
        for call in whale.calls(START, START + 600.0):
            field = Field.silence(int(4 * RATE))
            add_whale(field, int((call + 2.0) * RATE), RATE, replace(whale, span=(call - 1, call + 1)), paths)
            found.append(20 * np.log10(np.abs(field.pressure).max()))
        return np.array(found)

    assert np.std(peaks(0.0)) < 0.05
    assert np.std(peaks(4.0)) == pytest.approx(4.0, abs=1.5)


@pytest.mark.parametrize("kind", ["whale", "earthquakes", "tremor"])
def test_any_part_equals_the_cut_from_the_whole(paths, kind):
    def add(field, first):
        if kind == "whale":
            singer = Whale("blue_z", at(10.0, 8000.0), seed=1, pace=0.7, level_spread_db=3.0)
            add_whale(field, first, RATE, singer, paths)
        elif kind == "earthquakes":
            add_earthquakes(field, first, RATE, Earthquakes(per_day=300.0, seed=1))
        else:
            add_tremor(field, first, RATE, Tremor(duty=1.0, seed=1))

    whole, part = Field.silence(90_000), Field.silence(30_000)
    add(whole, FIRST)
    add(part, FIRST + 40_000)
    for name in ("pressure", "east", "north", "down"):
        expected = getattr(whole, name)[40_000:70_000]
        np.testing.assert_allclose(getattr(part, name), expected, atol=2e-3 * max(np.std(expected), 1e-30))


def test_whales_and_earthquakes_were_there_before_1970():
    calls = Whale("fin", seed=4).calls(-86400.0, 3600.0)
    assert calls[0] < -86000.0 and calls[-1] > 3000.0
    assert np.median(np.diff(calls)) == pytest.approx(13.0, abs=0.3)
    events = Earthquakes(per_day=300.0, seed=1).events(-3 * 86400.0, 0.0)
    assert len(events) == pytest.approx(900, abs=5 * np.sqrt(900))
    field = Field.silence(30_000)
    add_earthquakes(field, -60_000, RATE, Earthquakes(per_day=300.0, seed=1))
    assert np.abs(field.pressure).max() > 0.0


def test_earthquakes_come_at_their_rate_on_every_component():
    events = Earthquakes(per_day=12.0, seed=3).events(START, START + 60 * 86400.0)
    assert len(events) == pytest.approx(720, abs=5 * np.sqrt(720))
    field = Field.silence(int(600 * RATE))
    first = int((events[0][0] - 20.0) * RATE)
    add_earthquakes(field, first, RATE, Earthquakes(per_day=12.0, seed=3))
    for values in (field.pressure, field.east, field.north, field.down):
        assert np.abs(values[: int(19 * RATE)]).max() == 0.0
        assert np.abs(values[int(20 * RATE) :]).max() > 0.0


def test_t_phases_are_as_strong_and_as_long_as_asked():
    usual = Earthquakes(per_day=12.0, seed=3)
    time = usual.events(START, START + 10 * 86400.0)[1][0]

    def late(earthquakes: Earthquakes) -> float:
        field = Field.silence(int(390 * RATE))
        add_earthquakes(field, round(time * RATE), RATE, earthquakes)
        return float(np.std(field.pressure[int(200 * RATE) :]))

    assert late(replace(usual, t_gain=0.0)) < 0.1 * late(usual)
    assert late(replace(usual, t_gain=3.0)) == pytest.approx(3.0 * late(usual), rel=0.1)
    assert late(replace(usual, t_stretch=2.0)) > 2.0 * late(usual)


def test_p_wave_comes_from_below():
    earthquakes = Earthquakes(per_day=12.0, seed=3)
    down = []
    for time, _ in earthquakes.events(START, START + 10 * 86400.0)[:20]:
        field = Field.silence(int(3 * RATE))
        add_earthquakes(field, round(time * RATE), RATE, earthquakes)
        down.append(np.corrcoef(field.pressure, field.down)[0, 1])
    assert np.median(down) < -0.9


def test_tremor_shakes_the_seismometer_along_its_axis_and_not_the_water():
    field = Field.silence(int(3600 * RATE))
    tremor = Tremor(rate_hz=1.3, azimuth_deg=35.0, duty=1.0, spread=0.0, level_db=45.0, seed=2)
    add_tremor(field, FIRST, RATE, tremor)
    assert np.all(field.pressure == 0.0)
    axis = np.rad2deg(np.arctan2(np.std(field.east), np.std(field.north)))
    assert axis == pytest.approx(35.0, abs=1e-6)
    spectrum = np.abs(np.fft.rfft(field.north))
    hertz = np.fft.rfftfreq(field.north.size, 1 / RATE)
    for k in (1, 2, 3):
        band = np.abs(hertz - 1.3 * k) < 0.3
        assert hertz[band][np.argmax(spectrum[band])] == pytest.approx(1.3 * k, abs=0.01)


def test_tremor_sounds_for_its_share_of_the_time():
    sounding = []
    for hour in range(0, 24 * 40, 8):
        field = Field.silence(int(2 * RATE))
        add_tremor(field, FIRST + int(hour * 3600 * RATE), RATE, Tremor(duty=0.3, seed=7))
        sounding.append(np.any(field.east != 0))
    assert np.mean(sounding) == pytest.approx(0.3, abs=0.15)


def test_bad_sources_are_refused():
    with pytest.raises(
        ConfigError, match="species must be one of fin, blue_z, pygmy_blue, blue_d, found 'dolphin'"
    ):
        Whale("dolphin")
    with pytest.raises(ConfigError, match="per_day must be 0 or more"):
        Earthquakes(per_day=-1.0)
    with pytest.raises(ConfigError, match="a tremor needs rate_hz > 0"):
        Tremor(rate_hz=0.0)
    with pytest.raises(ConfigError, match="depth must be positive"):
        Whale(depth_m=0.0)
