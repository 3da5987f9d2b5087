"""The analytic detectors against an independent slow implementation, cell by cell, and against closed forms."""

import numpy as np
import pytest
import xarray as xr

from obsnet.detectors.analytic import (
    AnalyticAzimuthDetector,
    AnalyticRangeDetector,
    AzimuthDetectorConfig,
    RangeDetectorConfig,
    cepstral_model,
)
from obsnet.detectors.maps import coverage
from obsnet.errors import ConfigError
from obsnet.layout import from_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import propagation
from obsnet.ocean.sound_speed import OceanConfig, SoundSpeed
from obsnet.signals.cepstrogram import noise_std

HOP = 10.24
T0 = 1_369_123_200.0


def random_azigram(rng, frames=60, frequencies=5, azimuth=None, spread=0.0):
    angle = rng.uniform(0, 2 * np.pi, (frequencies, frames))
    if azimuth is not None:
        angle[2] = np.deg2rad(azimuth) + spread * rng.standard_cauchy(frames)
    time = np.ceil(T0 / HOP) * HOP + HOP * np.arange(frames)
    return xr.DataArray(
        np.exp(1j * angle).astype(np.complex64),
        dims=("frequency", "time"),
        coords={"frequency": 11.0 + np.arange(frequencies), "time": from_posix(time)},
        attrs={"ambiguity_deg": 360},
    ), time


def slow_tonal(azigram, times, minutes, grid, concentration):
    """Equations (7)–(11) as printed, one cell at a time, in logs."""
    out = np.empty((len(minutes), len(grid)))
    for w, minute in enumerate(minutes):
        inside = (times >= minute - 90) & (times < minute + 90)
        for i, azimuth in enumerate(grid):
            per_frequency = []
            for f in range(azigram.sizes["frequency"]):
                y = np.angle(azigram.values[f, inside])
                y = y[~np.isnan(y)]
                density = (1 - concentration**2) / (
                    1 + concentration**2 - 2 * concentration * np.cos(y - np.deg2rad(azimuth))
                )
                per_frequency.append(np.log(density).sum())
            out[w, i] = np.logaddexp.reduce(per_frequency) - np.log(len(per_frequency))
    return out


def test_tonal_equals_the_slow_implementation_cell_by_cell():
    azigram, times = random_azigram(np.random.default_rng(1), azimuth=217.0, spread=0.01)
    azigram.values[:, 20:23] = np.nan
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(9)
    config = AzimuthDetectorConfig(null="uniform")
    maps = AnalyticAzimuthDetector(config).maps(azigram, minutes)
    expected = slow_tonal(azigram, times, minutes, config.azimuth, 0.99)
    np.testing.assert_allclose(maps["azimuth_llr"].values, expected, rtol=2e-4, atol=2e-3)


def test_tonal_agrees_with_obsea_where_it_is_right():
    """obsea's windows hold both ends and its real axis is east; inside its grid the densities are the same."""
    obsea = pytest.importorskip("obsea")
    azigram, times = random_azigram(np.random.default_rng(2), azimuth=40.0, spread=0.01)
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(2, 7)
    u = xr.DataArray(
        1j * np.conj(azigram.values),
        dims=azigram.dims,
        coords={"frequency": azigram["frequency"], "time": times},
    )
    theirs = obsea.tonal_detection(u, 361, 0.0, 0.99, 180.0, endpoint=True, t=minutes)
    ours = AnalyticAzimuthDetector(AzimuthDetectorConfig(null="uniform")).maps(azigram, minutes)
    np.testing.assert_allclose(
        ours["azimuth_llr"].values, np.log(theirs.values[:, :360]), rtol=1e-3, atol=5e-3
    )


def test_turning_the_station_turns_the_map():
    azigram, times = random_azigram(np.random.default_rng(3), azimuth=100.0, spread=0.02)
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(2, 6)
    detector = AnalyticAzimuthDetector(AzimuthDetectorConfig(null="uniform"))
    turned = azigram * np.exp(1j * np.deg2rad(37.0)).astype(np.complex64)
    turned.attrs = azigram.attrs
    before = detector.maps(azigram, minutes)["azimuth_llr"].values
    after = detector.maps(turned, minutes)["azimuth_llr"].values
    np.testing.assert_allclose(after, np.roll(before, 37, axis=1), rtol=1e-3, atol=1e-2)


def test_doubled_angles_say_nothing_of_the_side():
    azigram, times = random_azigram(np.random.default_rng(3), azimuth=2 * 70.0, spread=0.01)
    azigram.attrs["ambiguity_deg"] = 180
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(2, 6)
    llr = (
        AnalyticAzimuthDetector(AzimuthDetectorConfig(null="uniform"))
        .maps(azigram, minutes)["azimuth_llr"]
        .values
    )
    np.testing.assert_allclose(llr[:, :180], llr[:, 180:], rtol=1e-4, atol=1e-3)
    assert np.all(abs(llr[:, :180].argmax(axis=1) - 70) <= 1)


def test_directional_null_forgives_background_but_not_a_ship():
    rng = np.random.default_rng(5)
    azigram, times = random_azigram(rng, frames=120, frequencies=20)
    weak = np.exp(1j * (np.deg2rad(90) + 1.0 * rng.standard_cauchy(azigram.shape)))
    azigram.values[:] = weak
    azigram.values[7, 60:] = np.exp(1j * (np.deg2rad(200) + 0.01 * rng.standard_cauchy(60)))
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(2, 18)
    background = np.full(azigram.shape, np.exp(-1.0) * 1j)
    detector = AnalyticAzimuthDetector()
    uniform = detector.maps(azigram, minutes)["azimuth_llr"].values
    aware = detector.maps(azigram, minutes, background)["azimuth_llr"].values
    noise, ship = minutes < times[60] - 90, minutes > times[60] + 90
    assert aware[noise, 80:100].mean() < uniform[noise, 80:100].mean() - 3.0
    assert np.all(abs(aware[ship].argmax(axis=1) - 200) <= 1)


def test_impulsive_equals_the_slow_implementation():
    azigram, times = random_azigram(np.random.default_rng(6), frames=40)
    azigram.values[:, 17] = np.exp(1j * np.deg2rad(300.0))
    azigram.values[:, 25] = np.nan
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(1, 5)
    config = AzimuthDetectorConfig(mode="impulsive", null="uniform")
    ours = AnalyticAzimuthDetector(config).maps(azigram, minutes)["azimuth_llr"].values
    y = np.angle(azigram.values)
    grid = np.deg2rad(config.azimuth)
    log_density = np.log((1 - 0.99**2) / (1 + 0.99**2 - 1.98 * np.cos(y[..., None] - grid)))
    per_frame = 0.5 * log_density.sum(axis=0)
    mixed = np.log(0.1 + 0.9 * np.exp(per_frame))
    for w, minute in enumerate(minutes):
        inside = (times >= minute - 90) & (times < minute + 90)
        np.testing.assert_allclose(ours[w], np.nansum(mixed[inside], axis=0), rtol=1e-4, atol=1e-3)
    assert ours[1].argmax() == 300


def test_gap_costs_coverage_not_zeros():
    azigram, times = random_azigram(np.random.default_rng(7), frames=120)
    azigram.values[:, 40:80] = np.nan
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(18)
    maps = AnalyticAzimuthDetector(AzimuthDetectorConfig(null="uniform")).maps(azigram, minutes)
    silent = (minutes - 90 > times[40]) & (minutes + 90 < times[79])
    covered = maps["azimuth_coverage"].values
    assert silent.any() and np.all(covered[silent] == 0)
    assert np.isnan(maps["azimuth_llr"].values[silent]).all()
    whole = (minutes - 90 >= times[0]) & (minutes + 90 <= times[39])
    assert np.all(covered[whole] == 1.0)


def test_window_that_a_product_cannot_hold_is_refused():
    azigram, _times = random_azigram(np.random.default_rng(8), frames=400)
    detector = AnalyticAzimuthDetector(AzimuthDetectorConfig(window_s=3600.0, mean_resultant_length=0.999))
    with pytest.raises(ConfigError, match="shorten the window"):
        detector.maps(azigram, np.array([T0 + 1800.0]))


def ocean_table(depth_m=4340.0):
    return propagation(
        SoundSpeed.constant(1500.0), depth_m, OceanConfig().bottom, np.arange(0.0, 60_001.0, 70.0)
    )


def noisy_cepstrogram(rng, frames, nfft=1024):
    quefrency = 0.02 * np.arange(nfft // 2 + 1)
    values = rng.standard_normal((len(quefrency), frames)) * noise_std(quefrency, nfft)[:, None]
    time = np.ceil(T0 / HOP) * HOP + HOP * np.arange(frames)
    array = xr.DataArray(
        values.astype(np.float32),
        dims=("quefrency", "time"),
        coords={"quefrency": quefrency, "time": from_posix(time)},
        attrs={"nfft": nfft},
    )
    return array, time


def test_range_equals_the_slow_implementation_cell_by_cell():
    config = RangeDetectorConfig(max_range_m=20_000.0, range_rate_step_mps=4.0, max_range_rate_mps=12.0)
    table, amplitudes = ocean_table(), Amplitudes.table_ii()
    cepstrogram, times = noisy_cepstrogram(np.random.default_rng(11), 40)
    cepstrogram.values[:, 11] = np.nan
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(1, 5)
    ours = AnalyticRangeDetector(table, amplitudes, config).maps(cepstrogram, minutes)["range_llr"].values

    pulses = cepstral_model(cepstrogram["quefrency"].values, table, amplitudes, config)
    variance = noise_std(cepstrogram["quefrency"].values, 1024) ** 2
    r, n = config.range_m, len(config.range_m)
    kernel = np.exp(-0.5 * (np.arange(-8, 9) / 2.0) ** 2)
    for w, minute in enumerate(minutes):
        frames = [t for t in range(40) if minute - 90 <= times[t] < minute + 90 and t != 11]
        for k, rate in enumerate(config.range_rate):
            total = np.zeros(n)
            for pulse in pulses:
                beam = np.zeros(n)
                for t in frames:
                    score = ((pulse / variance) * (cepstrogram.values[:, t] - pulse / 2)).sum(axis=1)
                    grid = np.concatenate([[r[0] - 70.0], r, [r[-1] + 70.0]])
                    padded = np.concatenate([[0.0], score, [0.0]])
                    beam += np.interp(r + rate * (times[t] - minute), grid, padded, left=0.0, right=0.0)
                raised = np.exp(beam)
                smooth = np.convolve(raised, kernel, "same") / np.convolve(np.ones(n), kernel, "same")
                total += np.log(smooth)
            np.testing.assert_allclose(ours[w, :, k], total, rtol=2e-3, atol=2e-2)


@pytest.mark.parametrize(("true_range", "true_rate"), [(9_000.0, -6.0), (16_000.0, 5.0), (30_000.0, 8.0)])
def test_range_peaks_at_the_simulated_ship(true_range, true_rate):
    config = RangeDetectorConfig()
    table, amplitudes = ocean_table(), Amplitudes.table_ii()
    cepstrogram, times = noisy_cepstrogram(np.random.default_rng(12), 40)
    minute = np.ceil(times[0] / 60) * 60 + 120.0
    pulses = cepstral_model(cepstrogram["quefrency"].values, table, amplitudes, config).sum(axis=0)
    for t, time in enumerate(times):
        here = true_range + true_rate * (time - minute)
        cepstrogram.values[:, t] += np.array([np.interp(here, config.range_m, column) for column in pulses.T])
    llr = (
        AnalyticRangeDetector(table, amplitudes, config)
        .maps(cepstrogram, np.array([minute]))["range_llr"]
        .values[0]
    )
    if true_range < 12_000.0:  # one branch alone: at twice the range pair 3-5 has the same delay and phase
        llr[config.range_m > 1.6 * true_range] = -np.inf
    i, k = np.unravel_index(llr.argmax(), llr.shape)
    assert abs(config.range_m[i] - true_range) < 200.0
    assert abs(config.range_rate[k] - true_rate) <= 1.0


def test_noise_alone_speaks_against_a_ship_on_average():
    cepstrogram, times = noisy_cepstrogram(np.random.default_rng(13), 200)
    minutes = np.ceil(times[0] / 60) * 60 + 60.0 * np.arange(2, 30)
    maps = AnalyticRangeDetector(ocean_table(), Amplitudes.table_ii()).maps(cepstrogram, minutes)
    near = maps["range_llr"].sel(range=slice(10_000, 30_000)).values
    assert near.mean() < -2.0
    assert np.all(maps["range_llr"].sel(range=slice(0, 3000)).values > -1.0)


def test_model_amplitude_follows_table_ii():
    quefrency = 0.02 * np.arange(513)
    model = cepstral_model(quefrency, ocean_table(), Amplitudes.table_ii())
    assert 0.05 < abs(model[0]).max() < 0.13
    assert abs(model[:, 0]).max() == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        {"window_s": 100.0},
        {"azimuth_step_deg": 7.0},
        {"azimuth_step_deg": 8.0},  # no azimuth has an opposite, by which those known up to 180° are told
        {"mean_resultant_length": 1.0},
    ],
)
def test_wrong_parameters_are_refused(arguments):
    with pytest.raises(ConfigError):
        AzimuthDetectorConfig(**arguments)


@pytest.mark.parametrize("begin", [0.0, 1.7e9, 1.7e9 + 4.96])
def test_a_window_without_a_gap_is_covered_in_full(begin):
    frame_time = begin + 10.24 * np.arange(2000)
    minutes = np.arange(np.ceil(begin / 60.0) + 2.0, (frame_time[-1] - 95.0) // 60.0) * 60.0
    valid = np.ones(len(frame_time), bool)
    assert (coverage(valid, frame_time, minutes, 180.0) == 1.0).all()
    valid[1000] = False
    held = np.abs(minutes - frame_time[1000]) < 90.0
    short = coverage(valid, frame_time, minutes, 180.0)
    assert (short[~held] == 1.0).all() and (abs(short[held] - 17 / 18) < 0.004).all()
    np.testing.assert_array_equal(coverage(valid[valid], frame_time[valid], minutes, 180.0), short)
    apart = [
        coverage(valid[part], frame_time[part], minutes[5:20], 180.0) for part in (slice(None), slice(3, 500))
    ]
    np.testing.assert_array_equal(*apart)
