import numpy as np
import pytest
import xarray as xr

from obsnet.ais import ReferenceTrack
from obsnet.calibration.passages import gather, heard_ships, vertex
from obsnet.errors import AISError, LayoutError
from obsnet.layout import from_posix
from obsnet.signals.cepstrogram import CepstrogramConfig

START = 1.37e9
SOUND = 1500.0


def sound_delay(range_m):
    return np.asarray(range_m) / SOUND


def straight(cpa_m, speed=10.0, number=1, every=60.0):
    """A ship going north past the station at x = cpa_m, abreast at START + 2 h."""
    time = START + np.arange(0.0, 4 * 3600.0 + 1.0, every)
    north = speed * (time - START - 7200.0)
    east = np.full(time.size, float(cpa_m))
    return ReferenceTrack(
        number, str(number), time, east, north, time[0], time[-1], max_interpolation_s=600.0
    )


def record(hours=2.0, seed=0, start=START + 3600.0):
    """Spectra of white Gaussian noise, with a quarter of it from azimuth 70° (v = −p u/ρc)."""
    generator = np.random.default_rng(seed)
    time = start + 10.24 * np.arange(int(hours * 3600 / 10.24))
    shape = (513, time.size)

    def noise():
        return generator.normal(size=shape) + 1j * generator.normal(size=shape)

    directed, impedance = 0.5 * noise(), 1.5e6
    p = np.sqrt(0.75) * noise() + directed
    east = 0.6 * noise() / impedance - directed * np.sin(np.deg2rad(70.0)) / impedance
    north = 0.6 * noise() / impedance - directed * np.cos(np.deg2rad(70.0)) / impedance
    down = 0.6 * noise() / impedance + 0.3 * p / impedance
    data = {"p": p, "east": east, "north": north, "down": down}
    coords = {"frequency": np.arange(513) / 20.48, "time": from_posix(time)}
    return xr.Dataset({k: (("frequency", "time"), v.astype(np.complex64)) for k, v in data.items()}, coords)


def gathered(blocks, tracks, **changes):
    settings = {"fmin_hz": 11.0, "fmax_hz": 24.0, "max_range_m": 30e3, "isolation": 2.0}
    return gather(blocks, tracks, sound_delay, **{**settings, "clutter": CepstrogramConfig(), **changes})


def test_what_is_heard_left_the_ship_earlier():
    times = np.array([START + 7200.0 + 900.0])
    heard, near = heard_ships(times, [straight(6000.0)], sound_delay, 30e3, 2.0)
    assert near.all()
    # Emission at t_e: t_e + r(t_e)/c = t, a quadratic for a straight course.
    elapsed = heard.north_m[0, 0] / 10.0
    distance = np.hypot(6000.0, heard.north_m[0, 0])
    assert elapsed + distance / SOUND == pytest.approx(900.0, abs=1e-3)
    assert elapsed < 900.0 - 5.0
    assert heard.east_mps[0] == pytest.approx(0.0, abs=1e-9)
    assert heard.north_mps[0] == pytest.approx(10.0)


def test_the_nearest_ship_comes_first_and_is_alone_only_where_the_next_is_far():
    times = START + np.array([3600.0, 7200.0, 10800.0])
    heard, _ = heard_ships(
        times, [straight(20e3, number=1), straight(4000.0, number=2)], sound_delay, 90e3, 2.0
    )
    np.testing.assert_array_equal(heard.passage, [1, 1, 1])
    np.testing.assert_array_equal(heard.alone, [False, True, False])
    azimuth, distance = heard.relative_to(0.0, 0.0)
    assert distance[1, :2] == pytest.approx([4000.0, 20e3], rel=2e-3)
    assert azimuth[1, 0] == pytest.approx(90.0, abs=0.5)
    shifted = heard.relative_to(1000.0, 0.0)[1]
    assert shifted[1, 0] == pytest.approx(3000.0, rel=2e-3)


def test_a_position_far_from_any_report_is_not_known():
    times = np.array([START + 7200.0])
    assert heard_ships(times, [straight(4000.0, every=600.0)], sound_delay, 30e3, 2.0)[1].all()
    assert not heard_ships(times, [straight(4000.0, every=4800.0)], sound_delay, 30e3, 2.0)[1].any()
    assert not heard_ships(times + 9000.0, [straight(4000.0)], sound_delay, 90e3, 2.0)[1].any()


def test_background_is_that_of_gaussian_noise():
    passages = gathered([record()], [straight(4000.0)])
    level = passages.background / 2.0  # E|P|² of the record: two unit variances
    assert level.mean() == pytest.approx(1.0, abs=0.06)
    assert level.std() < 0.2
    azimuth = np.rad2deg(np.angle(passages.background_intensity.mean())) % 360.0
    assert azimuth == pytest.approx(70.0, abs=5.0)


def test_any_split_of_the_record_gives_the_same():
    whole = record()
    parts = [whole.isel(time=slice(a, b)) for a, b in ((0, 100), (100, 101), (101, 500), (500, None))]
    one, many = (gathered(blocks, [straight(4000.0)]) for blocks in ([whole], parts))
    for name in ("power", "intensity", "cepstra", "background_intensity", "background"):
        np.testing.assert_allclose(
            getattr(one, name),
            getattr(many, name),
            rtol=1e-4,
            atol=1e-8 if name == "cepstra" else 1e-12,
            err_msg=name,
        )
    np.testing.assert_array_equal(one.heard.time, many.heard.time)


def test_gaps_stay_gaps():
    broken = record()
    broken["p"][:, 200:260] = np.nan
    passages = gathered([broken], [straight(4000.0)])
    assert np.isfinite(passages.background).all()
    assert np.isnan(passages.power).any() and np.isfinite(passages.power).any()


def test_a_record_without_ships_is_refused():
    with pytest.raises(
        AISError, match=r"none of 1 AIS tracks passes within 30 km .* give AIS of the record's own"
    ):
        gathered([record(0.2)], [straight(200e3)])
    with pytest.raises(AISError, match="none of 0 AIS tracks"):
        gathered([record(0.2)], [])


def test_a_record_without_hydrophone_is_refused():
    with pytest.raises(LayoutError, match="hydrophone"):
        gathered([record(0.2).drop_vars("p")], [straight(4000.0)])


def test_vertex_of_a_parabola():
    grid = np.arange(10.0)
    values = 3.0 - (grid - 4.3) ** 2
    assert vertex(values, 4) == pytest.approx(0.3)
    assert vertex(values, 0) == 0.0
