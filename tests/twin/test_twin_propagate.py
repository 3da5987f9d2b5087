"""Propagation is tested against the closed form of an ocean of one sound speed, solved anew here for
each sample.
"""

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import brentq
from scipy.signal import hilbert

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse
from obsnet.ocean.bottom import Bottom
from obsnet.twin.course import WaypointCourse
from obsnet.twin.noise import below_nyquist, gaussian_noise
from obsnet.twin.propagate import (
    INTERPOLATOR,
    OVERSAMPLING,
    Field,
    Paths,
    Sediment,
    add_moving_source,
    sample_at,
)

SPEED, DEPTH, DENSITY, RATE = 1500.0, 4000.0, 1030.0, 50.0
START = 1369130400


def table(gains: dict[int, complex], max_range: float = 30e3) -> xr.Dataset:
    """Straight rays: path k as if the station lay k depths down, pressure `gain` over the slant range."""
    ranges = np.arange(0.0, max_range + 1, 70.0)
    paths = np.array(list(gains))
    slant = np.hypot(ranges, paths[:, None] * DEPTH)
    dims = ("path", "range")
    return xr.Dataset(
        {
            "delay": (dims, slant / SPEED),
            "pressure": (dims, np.array(list(gains.values()), complex)[:, None] / slant),
            "slowness": (dims, ranges / slant / SPEED),
        },
        {"path": paths, "range": ranges},
        {"surface_speed_mps": SPEED, "seafloor_speed_mps": SPEED, "water_density_kgm3": DENSITY},
    )


class Tone:
    def __init__(self, frequency: float):
        self.frequency = frequency

    def samples(self, first: int, count: int) -> np.ndarray:
        time = (first - START * RATE * OVERSAMPLING + np.arange(count)) / (RATE * OVERSAMPLING)
        return np.exp(2j * np.pi * self.frequency * time).astype(np.complex64)


class Noise:
    def samples(self, first: int, count: int) -> np.ndarray:
        def colour(frequency, z):
            return z * below_nyquist(frequency, RATE).astype(np.float32)

        return gaussian_noise((5,), first, count, RATE * OVERSAMPLING, colour, analytic=True)[0]


class Pulse:
    """An 80 ms Gaussian pulse of 12 Hz, at 30 s."""

    def samples(self, first: int, count: int) -> np.ndarray:
        time = (first - START * RATE * OVERSAMPLING + np.arange(count)) / (RATE * OVERSAMPLING) - 30.0
        return (np.exp(-0.5 * (time / 0.08) ** 2) * np.exp(2j * np.pi * 12.0 * time)).astype(np.complex64)


def heard(course, emission, gains, seconds=60, depth=5.0, sediment=None, first=None):
    field = Field.silence(int(seconds * RATE))
    first = int(START * RATE) if first is None else first
    add_moving_source(field, first, RATE, course, depth, emission, Paths(table(gains), sediment))
    return field


def emission_time(course, path: int, t: float) -> float:
    def late(te):
        return te + np.hypot(np.hypot(*course.position(START + te)), path * DEPTH) / SPEED - t

    return brentq(late, t - 60.0, t, xtol=1e-10)


@pytest.mark.parametrize(("path", "depth"), [(1, 6.0), (3, 6.0), (1, 900.0)])
def test_tone_from_a_fast_ship_matches_the_exact_solution(path, depth):
    course = StraightCourse(START + 30.0, 2000.0, 70.0, 15.0)
    frequency = 21.0
    field = heard(course, Tone(frequency), {path: 0.8 * np.exp(0.7j)}, depth=depth)
    times = np.arange(field.pressure.size) / RATE
    emitted = np.array([emission_time(course, path, t) for t in times[::7]])
    distance = np.hypot(*course.position(START + emitted))
    slant = np.hypot(distance, path * DEPTH)
    image = depth * path * DEPTH / slant / SPEED
    dipole = 2j * np.sin(2 * np.pi * frequency * image)
    exact = (0.8 * np.exp(0.7j) / slant * dipole * np.exp(2j * np.pi * frequency * emitted)).real
    np.testing.assert_allclose(field.pressure[::7], exact, atol=2e-3 * np.abs(exact).max())


def test_received_frequency_is_the_doppler_formula():
    course, frequency = StraightCourse(START + 1500.0, 3000.0, 10.0, 15.0), 20.0
    pressure = heard(course, Tone(frequency), {1: 1.0}, seconds=120).pressure
    phase = np.unwrap(np.angle(hilbert(pressure)))[1000:-1000:500]
    measured = np.diff(phase) / 2 / np.pi / 10.0
    emitted = np.array([emission_time(course, 1, t) for t in np.arange(25.0, 95.0, 10.0)])
    _, distance, rate = course.observables(START + emitted)
    expected = frequency / (1 + rate * distance / np.hypot(distance, DEPTH) / SPEED)
    assert abs(expected.mean() - frequency) > 0.15
    np.testing.assert_allclose(measured, expected[: measured.size], atol=1e-4)


def test_pulse_is_heard_after_its_travel_time_with_its_image_reversed():
    course = StraightCourse(START, 5000.0, 0.0, 0.0)
    pressure = heard(course, Pulse(), {1: 1.0}, depth=40.0).pressure
    slant = np.hypot(5000.0, DEPTH)
    image = 40.0 * DEPTH / slant / SPEED
    time = np.arange(pressure.size) / RATE - 30.0 - slant / SPEED

    def pulse(t):
        return np.exp(-0.5 * (t / 0.08) ** 2) * np.cos(2 * np.pi * 12.0 * t) / slant

    exact = pulse(time + image) - pulse(time - image)
    np.testing.assert_allclose(pressure, exact, atol=1e-3 * exact.max())


def test_phase_of_a_reflection_advances_every_frequency():
    course = StraightCourse(START, 5000.0, 0.0, 0.0)
    plain = heard(course, Noise(), {1: 1.0}, seconds=200).pressure
    advanced = heard(course, Noise(), {1: 1j}, seconds=200).pressure
    window = np.hanning(plain.size)
    ratio = np.fft.rfft(advanced * window) / np.fft.rfft(plain * window)
    inner = ratio[plain.size // 20 : plain.size // 3]
    np.testing.assert_allclose(
        np.angle(np.median(inner.real) + 1j * np.median(inner.imag)), np.pi / 2, atol=0.01
    )


@pytest.mark.parametrize("azimuth", [20.0, 130.0, 250.0, 305.0])
def test_velocity_points_away_from_the_ship_and_is_pressure_times_slowness_over_density(azimuth):
    course = StraightCourse(START, 8000.0, azimuth - 90.0, 0.0)
    field = heard(course, Noise(), {1: 0.7 - 0.2j, 3: 0.5j})
    single = heard(course, Noise(), {1: 0.7 - 0.2j})
    slowness = 8000.0 / np.hypot(8000.0, DEPTH) / SPEED
    radial = single.east * np.sin(np.deg2rad(azimuth)) + single.north * np.cos(np.deg2rad(azimuth))
    np.testing.assert_allclose(radial, -single.pressure * slowness / DENSITY, rtol=1e-5, atol=1e-14)
    intensity = np.mean(field.pressure * field.east), np.mean(field.pressure * field.north)
    source = np.rad2deg(np.arctan2(-intensity[0], -intensity[1])) % 360.0
    assert source == pytest.approx(azimuth, abs=0.01)


def test_vertical_velocity_is_that_of_incident_and_reflected_wave():
    course = StraightCourse(START, 3000.0, 0.0, 0.0)
    slowness = 3000.0 / 5000.0 / SPEED
    reflection = Bottom().reflection(np.array([slowness]), SPEED)[0]
    field = heard(course, Tone(15.0), {1: 1 + reflection})
    incident = heard(course, Tone(15.0), {1: 1.0})
    reflected = heard(course, Tone(15.0), {1: reflection})
    vertical = np.sqrt(SPEED**-2.0 - slowness**2) / DENSITY
    expected = (incident.pressure - reflected.pressure) * vertical
    np.testing.assert_allclose(field.down, expected, atol=1e-3 * np.abs(expected).max())


def test_interpolation_is_exact_for_band_limited_signals():
    generator = np.random.default_rng(2)
    n = 4000
    spectrum = np.zeros(n, complex)
    spectrum[: n // 4] = generator.standard_normal(n // 4) + 1j * generator.standard_normal(n // 4)
    signal = np.fft.ifft(spectrum).astype(np.complex64)
    positions = generator.uniform(100, n - 100, 200)
    exact = np.exp(2j * np.pi * np.outer(positions, np.arange(n)) / n) @ spectrum / n
    found = np.array([complex(*sample_at(signal, x, INTERPOLATOR)) for x in positions])
    assert np.sqrt(np.mean(np.abs(found - exact) ** 2)) < 3e-4 * np.std(signal)


def test_blocks_join_without_a_seam():
    course = StraightCourse(START + 100.0, 1500.0, 70.0, 12.0)
    whole = heard(course, Noise(), {1: 1.0, 3: 0.5j}, seconds=120).pressure
    later = heard(course, Noise(), {1: 1.0, 3: 0.5j}, seconds=60, first=int(START * RATE) + 1723).pressure
    np.testing.assert_allclose(later, whole[1723 : 1723 + later.size], atol=2e-3 * whole.std())


def test_sediment_adds_a_later_echo_for_every_meeting_with_the_bottom():
    course = StraightCourse(START, 3000.0, 0.0, 0.0)
    sediment = Sediment(thickness_m=300.0, speed_mps=1700.0, reflection=0.2)
    echo = (
        heard(course, Pulse(), {3: 1.0}, sediment=sediment).pressure
        - heard(course, Pulse(), {3: 1.0}).pressure
    )
    plain = heard(course, Pulse(), {3: 1.0}).pressure
    lag = (np.argmax(np.correlate(echo, plain, "full")) - plain.size + 1) / RATE
    slowness = 3000.0 / np.hypot(3000.0, 3 * DEPTH) / SPEED
    assert lag == pytest.approx(600.0 * np.sqrt(1 / 1700.0**2 - slowness**2), abs=0.6 / RATE)
    assert np.std(echo) / np.std(plain) == pytest.approx(0.4, rel=0.02)


def test_a_path_is_silent_where_it_does_not_exist():
    gone = table({1: 1.0, 3: 0.5})
    for name in ("delay", "pressure", "slowness"):
        gone[name] = gone[name].where((gone["path"] == 3) | (gone["range"] < 4000.0))
    paths = Paths(gone)
    np.testing.assert_array_equal(
        np.abs(paths.arrival(0, np.array([3000.0, 5000.0])).pressure) > 0, [True, False]
    )
    np.testing.assert_allclose(
        paths.strongest_delay(np.array([3000.0, 5000.0, 40e3])),
        [5000.0 / SPEED, np.hypot(5000.0, 3 * DEPTH) / SPEED, np.nan],
        rtol=1e-6,
    )


def test_a_ship_fades_out_beyond_its_last_position():
    course = WaypointCourse(
        np.array([START - 900.0, START]), np.array([4000.0, 0.0]), np.array([3000.0, 3000.0])
    )
    loud = heard(course, Noise(), {1: 1.0}, seconds=20, first=int((START - 300) * RATE)).pressure
    gone = heard(course, Noise(), {1: 1.0}, seconds=20, first=int((START + 620) * RATE)).pressure
    assert np.std(loud) > 0 and np.all(gone == 0)


def test_a_table_without_any_path_is_refused():
    with pytest.raises(LayoutError, match="holds no path at any range"):
        Paths(table({1: 1.0}) * np.nan)
    with pytest.raises(ConfigError, match="reflection within"):
        Sediment(reflection=1.5)
