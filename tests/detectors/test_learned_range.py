from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from obsnet.detectors import range_kernels as kernels
from obsnet.detectors.analytic import AnalyticRangeDetector, RangeDetectorConfig
from obsnet.detectors.learned_range import LearnedRangeDetector, RangeCalibration, presence_ratio
from obsnet.detectors.range_features import CONTEXT, RangeFeaturesConfig
from obsnet.errors import ConfigError, ModelError
from obsnet.layout import from_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation, tdoa
from obsnet.ocean.sound_speed import SoundSpeed
from obsnet.signals.cepstrogram import noise_std

START = 1_369_130_400.0
QUEFRENCY = np.arange(513) * 0.02
MINUTES = START + 60.0 * np.arange(2, 12)
RANGE_M, RATE = 15_000.0, -6.0
FEATURES = RangeFeaturesConfig()


def energies(features):
    """Stands for a network: the pairs' energies, over what noise has."""
    at = np.prod(FEATURES.patch_shape) + np.arange(5) * len(CONTEXT) + CONTEXT.index("energy")
    return (0.3 * (features[:, at] ** 2).sum(axis=1) - 5.0).astype(np.float32)


@pytest.fixture(scope="module")
def table():
    return propagation(SoundSpeed.constant(1500.0), 4000.0, Bottom(), np.arange(0.0, 60e3, 70.0))


@pytest.fixture(scope="module")
def cepstra(table):
    times = START + 10.24 * np.arange(80)
    distance = RANGE_M + RATE * (times - START)
    values = np.random.default_rng(1).standard_normal((513, 80)) * noise_std(QUEFRENCY, 1024)[:, None]
    for pair in ("1-3", "3-5", "5-7"):
        lag = QUEFRENCY[:, None] - tdoa(table, pair, distance).values
        values += 0.1 * np.cos(2 * np.pi * 15.0 * lag) * np.exp(-(lag**2) / (2 * 0.05**2))
    coords = {"quefrency": QUEFRENCY, "time": from_posix(times)}
    return xr.DataArray(values.astype("f4"), dims=("quefrency", "time"), coords=coords, attrs={"nfft": 1024})


def test_the_map_peaks_at_the_ship(table, cepstra):
    maps = LearnedRangeDetector(table, energies).maps(cepstra, MINUTES)
    llr = maps["range_llr"].values
    assert llr.dtype == np.float32
    grids = RangeDetectorConfig()
    assert llr.shape == (10, len(grids.range_m), len(grids.range_rate))
    for minute, values in zip(MINUTES, llr, strict=True):
        place, _ = np.unravel_index(values.argmax(), values.shape)
        assert abs(maps["range"].values[place] - RANGE_M - RATE * (minute - START)) < 500.0
    assert (maps["range_coverage"].values > 0.9).all()


def test_the_map_does_not_depend_on_how_the_record_is_cut(table, cepstra):
    detector = LearnedRangeDetector(table, energies)
    whole = detector.maps(cepstra, MINUTES)["range_llr"].values
    one = detector.maps(cepstra[:, 10:40], MINUTES[2:4])["range_llr"].values
    np.testing.assert_allclose(whole[2:4], one, atol=1e-4)


def test_ratios_are_calibrated_and_bounded(table, cepstra):
    plain = LearnedRangeDetector(table, energies, RangeCalibration(lowest=-100.0, highest=100.0))
    said, cheap = plain.scores(cepstra, MINUTES)
    looked = np.isfinite(said)
    assert 0.005 < looked.mean() < 0.2
    calibration = RangeCalibration(
        slope=0.5, offset=-1.0, cheap_slope=0.2, cheap_offset=-3.0, cheap_bound=-0.5, lowest=-2.0, highest=3.0
    )
    ratio = LearnedRangeDetector(table, energies, calibration).ratios(cepstra, MINUTES)
    np.testing.assert_allclose(ratio[looked], np.clip(0.5 * said[looked] - 1.0, -2.0, 3.0), rtol=1e-5)
    np.testing.assert_allclose(ratio[~looked], np.clip(0.2 * cheap[~looked] - 3.0, -2.0, -0.5), rtol=1e-5)


def test_the_network_looks_at_all_rates_of_a_range_or_at_none(table, cepstra):
    said, _ = LearnedRangeDetector(table, energies).scores(cepstra, MINUTES)
    looked = np.isfinite(said)
    assert (looked.all(axis=1) == looked.any(axis=1)).all()


def test_gaps_are_missing_and_cost_themselves_alone(table, cepstra):
    holed = cepstra.copy()
    holed.values[:, :30] = np.nan
    maps = LearnedRangeDetector(table, energies).maps(holed, MINUTES)
    covered = maps["range_coverage"].values
    assert (covered[:1] == 0).all()
    assert np.isnan(maps["range_llr"].values[covered == 0]).all()
    assert np.isfinite(maps["range_llr"].values[covered > 0]).all()
    full = LearnedRangeDetector(table, energies).maps(cepstra, MINUTES)
    same = covered == full["range_coverage"].values
    assert same.sum() >= 3
    np.testing.assert_allclose(maps["range_llr"].values[same], full["range_llr"].values[same], atol=1e-4)


def test_peaks_are_chosen_with_their_surroundings():
    score = np.zeros((1, 13, 50), np.float32)
    score[0, 6, 10], score[0, 0, 30], score[0, 12, 49] = 9.0, 8.0, 7.0
    chosen = kernels.choose(score, 2, 1, 5)[0]
    assert chosen.sum() == 2 * 3 * 5
    assert chosen[4:9, 9:12].all()
    assert chosen[0:5, 29:32].all()


def test_minutes_in_which_nothing_stands_out_are_not_looked_at():
    score = np.full((3, 13, 50), 1.0, np.float32)
    score[0, 6, 10], score[1, 6, 10] = 9.0, 10.0
    chosen = kernels.choose(score, 2, 1, 5, least=10.0)
    assert chosen.any(axis=(1, 2)).tolist() == [False, True, False]
    np.testing.assert_array_equal(chosen[1], kernels.choose(score, 2, 1, 5)[1])


def test_resampling_is_exact_at_the_grid_and_linear_between():
    coarse = np.random.default_rng(0).standard_normal((2, 4, 6)).astype(np.float32)
    halves = np.arange(11) / 2, np.arange(7) / 2
    below = [np.minimum(h.astype(np.int64), n - 2) for h, n in zip(halves, (6, 4), strict=True)]
    weight = [(h - b).astype(np.float32) for h, b in zip(halves, below, strict=True)]
    fine = kernels.resample(coarse, below[0], weight[0], below[1], weight[1])
    np.testing.assert_allclose(fine[:, ::2, ::2], coarse.transpose(0, 2, 1), rtol=1e-6)
    np.testing.assert_allclose(fine[:, 1, 0], (coarse[:, 0, 0] + coarse[:, 0, 1]) / 2, rtol=1e-5)


def test_the_grids_are_those_of_the_configuration(table, cepstra):
    config = RangeDetectorConfig(range_step_m=200.0, max_range_m=30_000.0, range_rate_step_mps=1.0)
    maps = LearnedRangeDetector(table, energies, config=config).maps(cepstra, MINUTES[:1])
    np.testing.assert_array_equal(maps["range"], config.range_m)
    np.testing.assert_array_equal(maps["range_rate"], config.range_rate)


@pytest.mark.parametrize("beyond", [{"max_range_m": 80e3}, {"max_range_rate_mps": 20.0}])
def test_a_grid_that_reaches_beyond_the_models_is_refused(table, beyond):
    config = RangeDetectorConfig(**beyond)
    with pytest.raises(ModelError, match="--detector analytic"):
        LearnedRangeDetector.from_model(table, None, config)


def test_calibrations_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="bounds about 0"):
        RangeCalibration(lowest=1.0)
    with pytest.raises(ConfigError, match="peaks"):
        RangeCalibration(peaks=0)


def test_presence_goes_through_its_knots(table, cepstra):
    plain = RangeCalibration(lowest=-100.0, highest=100.0)
    said = presence_ratio(LearnedRangeDetector(table, energies, plain).ratios(cepstra, MINUTES), FEATURES)
    low, high = float(said.min()), float(said.max())
    bent = replace(plain, presence_said=(low, high), presence_seen=(-1.0, 2.0))
    after = LearnedRangeDetector(table, energies, bent).ratios(cepstra, MINUTES)
    seen = presence_ratio(after, FEATURES)
    np.testing.assert_allclose(seen, -1.0 + 3.0 * (said - low) / (high - low), atol=1e-3)
    with pytest.raises(ConfigError, match="increasing knots"):
        replace(plain, presence_said=(1.0, 0.0))


def test_a_lobe_keeps_its_mass_and_takes_the_analytic_shape():
    llr = np.zeros((1, 60, 21), np.float32)
    llr[0, 25:36, 5:16] = 6.0
    shape = np.zeros((1, 60, 21), np.float32)
    shape[0, 28, 11] = 40.0
    shape[0, 50, 3] = 80.0
    before = np.exp(llr.astype(float)).sum()
    kernels.share_out(llr, shape.copy(), 0.15, 4, 4, np.ones(60))
    assert np.unravel_index(llr[0].argmax(), llr[0].shape) == (28, 11)
    assert np.exp(llr.astype(float)).sum() == pytest.approx(before, rel=1e-4)
    assert llr[0, 50, 3] < llr[0, 28, 11] - 3.0


def test_a_flat_shape_and_missing_minutes_change_nothing():
    llr = np.zeros((2, 12, 7), np.float32)
    llr[1] = np.nan
    kernels.share_out(llr, np.full((2, 12, 7), -3.0, np.float32), 0.15, 4, 2, np.ones(12))
    np.testing.assert_allclose(llr[0], 0.0, atol=1e-5)
    assert np.isnan(llr[1]).all()


def test_how_many_minutes_are_looked_at_together_changes_nothing(table, cepstra, monkeypatch):
    shape = AnalyticRangeDetector(table, Amplitudes.broad().scaled_to(4000.0))
    detector = LearnedRangeDetector(table, energies, shape=shape)
    together = detector.maps(cepstra, MINUTES)["range_llr"].values
    monkeypatch.setattr("obsnet.detectors.learned_range.STRETCH", 3)
    np.testing.assert_allclose(detector.maps(cepstra, MINUTES)["range_llr"].values, together, atol=1e-4)
