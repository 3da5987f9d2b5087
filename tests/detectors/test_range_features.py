import numpy as np
import pytest
import xarray as xr

from obsnet.detectors.range_features import CONTEXT, RangeFeatures, RangeFeaturesConfig, analytic_cepstrum
from obsnet.errors import ConfigError
from obsnet.layout import from_posix
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import phase_difference, propagation, tdoa
from obsnet.ocean.sound_speed import SoundSpeed
from obsnet.signals.cepstrogram import noise_std

START = 1_369_130_400.0
QUEFRENCY = np.arange(513) * 0.02
RANGE_M, RATE = 12_000.0, 8.0


@pytest.fixture(scope="module")
def table():
    return propagation(SoundSpeed.constant(1500.0), 4000.0, Bottom(), np.arange(0.0, 60e3, 70.0))


@pytest.fixture(scope="module")
def ridge(table):
    """Ten minutes of cepstra, in the middle of which a ship passes RANGE_M at RATE, in noise."""
    times = START + 10.24 * np.arange(60)
    middle = START + 300.0
    distance = RANGE_M + RATE * (times - middle)
    values = np.random.default_rng(1).standard_normal((513, 60)) * noise_std(QUEFRENCY, 1024)[:, None]
    for pair, strength in (("1-3", 0.1), ("3-5", 0.08)):
        delay = tdoa(table, pair, distance).values
        phase = np.deg2rad(phase_difference(table, pair, distance).values)
        lag = QUEFRENCY[:, None] - delay
        values += strength * np.cos(2 * np.pi * 15.0 * lag + phase) * np.exp(-(lag**2) / (2 * 0.05**2))
    return cepstra(values, times), middle


def cepstra(values, times):
    coords = {"quefrency": QUEFRENCY, "time": from_posix(times)}
    return xr.DataArray(values.astype("f4"), dims=("quefrency", "time"), coords=coords, attrs={"nfft": 1024})


def everything(front, cepstrogram, minutes, range_m, rate):
    look = front.look(cepstrogram, minutes)
    index = np.zeros(len(range_m), int)
    return look.energy, look.score, front.features(look, index, np.array(range_m), np.array(rate))


def test_noise_has_unit_variance_in_the_analytic_cepstrum():
    noise = np.random.default_rng(0).standard_normal((100, 513)) * noise_std(QUEFRENCY, 1024)
    values = analytic_cepstrum(noise.astype("f4"), QUEFRENCY, 1024, (3.0, 7.0, 20.0, 24.0))
    assert np.mean(np.abs(values[:, 200:-200]) ** 2) == pytest.approx(1.0, abs=0.03)
    assert not values[:, -1].any()


def test_analytic_cepstrum_goes_through_the_cepstrum_it_is_made_of():
    lag = QUEFRENCY - 3.0
    pulse = (np.cos(2 * np.pi * 14.0 * lag) * np.exp(-(lag**2) / (2 * 0.1**2)))[None]
    values = analytic_cepstrum(pulse.astype("f4"), QUEFRENCY, 1024, (3.0, 7.0, 20.0, 24.0))
    scaled = pulse[0] / noise_std(QUEFRENCY, 1024)
    gain = values[0, :-1:4].real[150] / scaled[150]
    np.testing.assert_allclose(
        values[0, :-1:4].real[130:170], gain * scaled[130:170], atol=0.02 * gain * scaled.max()
    )


def test_cheap_score_peaks_at_the_ship(table, ridge):
    front = RangeFeatures(table)
    energy, score, _ = everything(front, ridge[0], np.array([ridge[1]]), [RANGE_M], [RATE])
    rate, place = np.unravel_index(score[0].argmax(), score[0].shape)
    assert abs(front.config.range_m[place] - RANGE_M) <= 200.0
    assert abs(front.config.range_rate[rate] - RATE) <= 2.0
    assert energy[0, 0].max() > 30.0
    assert np.median(energy[0, 0][energy[0, 0] > 0]) < 1.5


def test_patch_of_the_truth_is_in_phase_and_centred(table, ridge):
    front = RangeFeatures(table)
    _, _, found = everything(front, ridge[0], np.array([ridge[1]]), [RANGE_M, 30e3], [RATE, 0.0])
    patch = found[:, : np.prod(front.config.patch_shape)].reshape(2, *front.config.patch_shape)
    heard = patch[0, 0].sum(axis=0)
    assert (heard**2).sum(axis=1).argmax() == front.config.lags // 2
    assert heard[front.config.lags // 2, 0] > 3 * abs(heard[front.config.lags // 2, 1])
    assert np.mean(patch[1, 0] ** 2) < 1.5


def test_a_wrong_rate_smears_the_patch(table, ridge):
    front = RangeFeatures(table)
    _, _, found = everything(front, ridge[0], np.array([ridge[1]]), [RANGE_M] * 2, [RATE, -RATE])
    energy = found[:, np.prod(front.config.patch_shape) + CONTEXT.index("energy")]
    assert energy[0] > energy[1] + 1.0


def test_a_ghost_knows_of_the_ship_that_explains_it(table, ridge):
    """At the range where pair 3-5 has the ship's delay of pair 1-3, another range explains more."""
    front = RangeFeatures(table)
    lag = float(tdoa(table, "1-3", np.array([RANGE_M])).values[0])
    grid = np.arange(5e3, 50e3, 50.0)
    delay = tdoa(table, "3-5", grid).values
    place = np.nanargmin(np.abs(delay - lag))
    drift = RATE * np.diff(tdoa(table, "1-3", RANGE_M + np.array([0.0, 50.0])).values)[0]
    rate = float(drift / np.diff(delay)[place])
    _, _, found = everything(
        front, ridge[0], np.array([ridge[1]]), [float(grid[place]), RANGE_M], [rate, RATE]
    )
    at = np.prod(front.config.patch_shape) + np.arange(5) * len(CONTEXT)
    energy, other = found[:, at + CONTEXT.index("energy")], found[:, at + CONTEXT.index("ghost")]
    assert energy[0, 1] > 2.5
    assert other[0, 1] > 2.5
    assert other[1, 0] < other[0, 1]


def test_features_do_not_depend_on_how_the_record_is_cut(table, ridge):
    front, minutes = RangeFeatures(table), np.array([ridge[1]])
    whole = everything(front, ridge[0], minutes, [RANGE_M, 20e3], [RATE, -3.0])
    part = everything(front, ridge[0][:, 15:45], minutes, [RANGE_M, 20e3], [RATE, -3.0])
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


def test_a_gap_costs_its_frames_alone(table, ridge):
    front, minutes = RangeFeatures(table), np.array([ridge[1]])
    holed = ridge[0].copy()
    holed.values[:, 25:33] = np.nan
    _, _, found = everything(front, holed, minutes, [RANGE_M], [RATE])
    before, centre, after = found[0, -5:-2]
    assert np.isfinite(found).all()
    assert centre < 0.5 < min(before, after)
    empty = ridge[0].copy()
    empty.values[:] = np.nan
    _, _, nothing = everything(front, empty, minutes, [RANGE_M], [RATE])
    assert np.isfinite(nothing).all()
    assert not nothing[0, : np.prod(front.config.patch_shape)].any()


def test_pairs_that_do_not_exist_say_nothing(ridge):
    short = propagation(
        SoundSpeed.constant(1500.0), 4000.0, Bottom(), np.arange(0.0, 60e3, 70.0), paths=(1, 3)
    )
    front = RangeFeatures(short)
    _, _, found = everything(front, ridge[0], np.array([ridge[1]]), [RANGE_M], [RATE])
    size = int(np.prod(front.config.patch_shape))
    assert not found[0, size // 5 : size].any()
    assert not found[0, size + len(CONTEXT) : size + 5 * len(CONTEXT)].any()


def test_bad_configurations_are_refused(table):
    with pytest.raises(ConfigError, match="lags must be odd"):
        RangeFeaturesConfig(lags=8)
    with pytest.raises(ConfigError, match="band_hz"):
        RangeFeaturesConfig(band_hz=(1.0, 0.5, 20.0, 24.0))
    with pytest.raises(ConfigError, match="multiple of 10 m"):
        RangeFeaturesConfig(range_step_m=77.0)
    with pytest.raises(ConfigError, match="depth_m"):
        RangeFeatures(table.assign_attrs(depth_m=np.nan)).look(
            cepstra(np.zeros((513, 3)), START + np.arange(3)), [START]
        )
