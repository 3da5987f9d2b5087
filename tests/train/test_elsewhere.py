"""The second generator against closed forms: delays of the image paths, direction of intensity, Doppler, polarity, truth."""

import numpy as np
import pandas as pd
import pytest
from elsewhere import kinds, paths, ships, station
from elsewhere.kinds import KINDS, compose
from elsewhere.paths import Sea, Source
from elsewhere.ships import Bent
from scipy.integrate import quad

from obsnet.layout import to_posix
from obsnet.signals.azigram import azigram
from obsnet.signals.spectra import spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms

RATE = 100.0


def heard(waveform, sea, course, seconds=60.0, rate=50.0, depth=5.0):
    return paths.receive(waveform, RATE, -200.0, sea, Source(course, depth), 0.0, int(seconds * rate), rate)


def click(at):
    t = np.arange(-200.0, 100.0, 1.0 / RATE)
    x = t - at
    return (np.exp(-0.5 * (x / 0.02) ** 2) * np.cos(2 * np.pi * 12.0 * x)).astype(np.float32)


@pytest.mark.parametrize("gradient", [0.004, 0.015])
def test_delay_and_slowness_are_those_of_the_ray_integral(gradient):
    sea = Sea(4000.0, 1490.0, gradient)
    p = np.cos(np.deg2rad(20.0)) / sea.bottom_mps

    def speed(z):
        return sea.surface_mps + gradient * z

    def root(z):
        return np.sqrt(1.0 - (p * speed(z)) ** 2)

    range_m = quad(lambda z: p * speed(z) / root(z), 0.0, 4000.0)[0]
    delay = quad(lambda z: 1.0 / (speed(z) * root(z)), 0.0, 4000.0)[0]
    assert sea.delay(3, 3 * range_m) == pytest.approx(3 * delay, rel=1e-9)
    assert sea.slowness(3, 3 * range_m) == pytest.approx(p, rel=1e-9)


def test_a_path_ends_where_its_arc_grazes_the_bottom():
    sea = Sea(4000.0, 1490.0, 0.016)
    assert sea.slowness(1, sea.reach(1)) == pytest.approx(1.0 / sea.bottom_mps, rel=1e-6)
    assert sea.reach(5) == pytest.approx(5 * sea.reach(1))


def test_echoes_of_a_click_arrive_where_the_images_say():
    sea = Sea(3000.0, 1500.0, 0.0, speed_ratio=3.0, loss_db_per_bounce=0.0, scatter=0.0)
    still = Bent(0.0, 6000.0, 0.0, 1e-6, yaw_deg=0.0)
    p = heard(click(10.0), sea, still)[0]
    envelope = np.abs(p)
    for crossings in (1, 3, 5):
        expected = 10.0 + np.hypot(6000.0, crossings * 3000.0) / 1500.0
        near = np.arange(int((expected - 0.3) * 50), int((expected + 0.3) * 50))
        assert near[envelope[near].argmax()] / 50.0 == pytest.approx(expected, abs=0.08)
        assert envelope[near].max() > 20 * np.median(envelope)


def test_the_bottom_reflects_all_below_its_critical_angle_and_never_more_than_all():
    sea = Sea(speed_ratio=1.5, loss=0.0)
    sines = np.linspace(0.01, 0.99, 50)
    reflection = np.abs(sea.reflection(sines))
    total = np.sqrt(1.0 - sines**2) > 1.0 / 1.5
    assert np.allclose(reflection[total], 1.0)
    assert np.all(reflection[~total] < 1.0)
    normal = (1.7 * 1.5 - 1.0) / (1.7 * 1.5 + 1.0)
    assert sea.reflection(np.array([1.0]))[0] == pytest.approx(normal)


def test_the_surface_makes_a_dipole_of_a_shallow_source():
    sea = Sea(4000.0, 1500.0, 0.0, loss_db_per_bounce=0.0, scatter=0.0)
    t = np.arange(-200.0, 100.0, 1.0 / RATE)
    tone = np.cos(2 * np.pi * 10.0 * t).astype(np.float32)
    above = Bent(0.0, 1.0, 0.0, 1e-6, yaw_deg=0.0)
    direct = [heard(tone, sea, above, 2.5, depth=depth)[0].std() for depth in (4.0, 8.0)]
    ratio = np.sin(2 * np.pi * 10.0 * 8.0 / 1500.0) / np.sin(2 * np.pi * 10.0 * 4.0 / 1500.0)
    assert direct[1] / direct[0] == pytest.approx(ratio, rel=0.02)


@pytest.mark.parametrize("azimuth", [30.0, 200.0, 310.0])
def test_intensity_points_away_from_the_source(azimuth):
    noise = np.random.default_rng(1).standard_normal(30000).astype(np.float32)
    still = Bent(0.0, 9000.0, azimuth - 90.0, 1e-6, yaw_deg=0.0)
    p, east, north, up = heard(noise, Sea(4000.0), still)
    toward = np.rad2deg(np.arctan2(-np.sum(p * east), -np.sum(p * north)))
    assert (toward - azimuth + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.5)
    assert np.sum(p * up) < 0, "what comes from above moves down under compression"


def test_a_tone_is_heard_shifted_by_its_range_rate():
    t = np.arange(-200.0, 100.0, 1.0 / RATE)
    tone = np.cos(2 * np.pi * 15.0 * t).astype(np.float32)
    coming = Bent(4000.0, 10.0, 90.0, 10.0, yaw_deg=0.0)
    sea = Sea(2000.0, 1500.0, 0.0, speed_ratio=0.99, density_ratio=1.03, scatter=0.0)
    p = heard(tone, sea, coming)[0]
    spectrum = np.abs(np.fft.rfft(p * np.hanning(p.size), 1 << 20))
    frequency = np.fft.rfftfreq(1 << 20, 0.02)[spectrum.argmax()]
    distance = 10.0 * 4000.0
    rate = -10.0 * distance / np.hypot(distance, 2000.0)
    assert frequency == pytest.approx(15.0 / (1.0 + rate / 1500.0), abs=2e-3)


def test_loss_grows_with_every_bounce():
    noise = np.random.default_rng(2).standard_normal(4096).astype(np.float32)
    noise -= noise.mean() + np.tile([1, -1], 2048) * np.mean(noise * np.tile([1, -1], 2048))
    signals = paths.lossy(noise, RATE, 2, 3.0)
    assert np.allclose(signals[0].real, noise, atol=1e-4)
    at20 = [np.abs(np.fft.fft(s)[round(20.0 / RATE * 4096)]) for s in signals]
    assert 20 * np.log10(at20[0] / at20[1]) == pytest.approx(3.0, abs=0.05)
    assert 20 * np.log10(at20[1] / at20[2]) == pytest.approx(3.0, abs=0.05)


def test_noise_has_the_density_it_is_asked_for():
    from scipy.signal import welch

    x = ships.shaped(np.random.default_rng(3), 200_000, 50.0, lambda f: 6.0 - 10.0 * np.log10(f / 10.0))
    frequency, density = welch(x, 50.0, nperseg=1024)
    for at in (5.0, 10.0, 20.0):
        near = np.abs(frequency - at) < 0.5
        assert 10 * np.log10(density[near].mean()) == pytest.approx(6.0 - 10.0 * np.log10(at / 10.0), abs=0.3)


@pytest.mark.parametrize("polarity", [1, -1])
def test_metadata_undo_orientation_polarity_and_response(polarity):
    rng = np.random.default_rng(4)
    p = rng.standard_normal(15000) * 0.3
    azimuth = np.deg2rad(77.0)
    motion = np.stack([p, -p * np.sin(azimuth) / 1.5e6, -p * np.cos(azimuth) / 1.5e6, 0 * p]).astype(
        np.float32
    )
    recorder = station.Recorder(4000.0, orientation_deg=213.0, polarity=polarity)
    stream = station.record(recorder, motion, 1.6e9 + 0.3)
    made = Station.from_stationxml(station.inventory(recorder))
    found = azigram(spectra(stream, made))
    mean = np.nanmean(found.values)
    assert np.rad2deg(np.angle(mean)) == pytest.approx(77.0, abs=0.5)
    assert np.abs(mean) > 0.99


def test_gaps_are_left_out_of_the_stream():
    recorder = station.Recorder(4000.0, gaps=((10.0, 20.0), (50.0, 55.0)))
    stream = station.record(recorder, np.ones((4, 5000), np.float32) * 1e-3, 0.0)
    pieces = stream.select(channel="BDH")
    assert [piece.stats.npts for piece in pieces] == [500, 1500, 2250]
    assert stream.get_gaps()[0][6] == pytest.approx(10.0, abs=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_drawn_again_from_its_seed(kind):
    first, again, other = compose(kind, 1), compose(kind, 1), compose(kind, 2)
    assert first.sea == again.sea and first.around == again.around and first.vessels == again.vessels
    assert first.recorder != other.recorder
    assert len(first.vessels) == {"no_ship": 0, "two_ships": 2}.get(kind, 1)


def test_truth_is_where_the_ship_was_when_it_made_what_is_heard():
    made = compose("ordinary", 5, 1.0)
    truth = kinds.truth(made)
    time = to_posix(pd.to_datetime(truth["time"]).dt.tz_localize(None).to_numpy("datetime64[ns]"))
    azimuth = np.deg2rad(truth["azimuth_deg"].to_numpy())
    for t, a, r in zip(time[::17], azimuth[::17], truth["range_m"].to_numpy()[::17], strict=True):
        emitted = t - float(kinds._travel(made.sea, np.array(r)))
        east, north = made.vessels[0].course(np.array([emitted]))
        assert np.hypot(east[0] - r * np.sin(a), north[0] - r * np.cos(a)) < 1.0


def test_a_record_is_what_a_user_hands_in(tmp_path):
    from obsnet.ais import read, reference_tracks

    made = compose("another_rate", 1, 0.2)
    kinds.write(made, tmp_path)
    here = Station.from_stationxml(tmp_path / "station.xml")
    source = open_waveforms(tmp_path / "waveforms.mseed", here)
    assert {c.kind for c in here.channels} == {"pressure", "motion"}
    assert source.end_ns - source.begin_ns == pytest.approx(720e9, rel=0.02)
    (track,) = reference_tracks(read(tmp_path / "ais.csv"), here, max_range_m=150e3)
    (passage,) = kinds.describe(made)["passages"]
    assert track.cpa().time == pytest.approx(passage["cpa_time"], abs=40.0)
