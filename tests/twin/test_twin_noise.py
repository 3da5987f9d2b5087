import numpy as np
import pytest
from scipy.signal import welch

from obsnet.twin.noise import Wander, below_nyquist, gaussian_noise, sample_index

FIRST = 68_456_520_123


def white(level: float = 1.0):
    def colour(_frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
        return z * np.float32(np.sqrt(level))

    return colour


def test_psd_and_gaussianity_of_white_noise():
    noise = gaussian_noise((1,), FIRST, 400_000, 50.0, white(4.0))[0].astype(float)
    _frequency, psd = welch(noise, 50.0, nperseg=1024)
    assert np.mean(psd[5:-5]) == pytest.approx(4.0, rel=0.01)
    assert np.mean(noise**4) / np.mean(noise**2) ** 2 == pytest.approx(3.0, abs=0.05)


def test_variance_is_stationary_across_block_joins():
    joins, inside = [], []
    for seed in range(40):
        noise = gaussian_noise((seed,), 0, 4500 * 4, 4.0, white())[0]
        for block in range(1, 10):
            joins.append(noise[block * 1800 : block * 1800 + 200])
            inside.append(noise[block * 1800 + 600 : block * 1800 + 800])
    ratio = np.var(np.concatenate(joins)) / np.var(np.concatenate(inside))
    assert ratio == pytest.approx(1.0, abs=0.025)  # 72 000 samples each: standard error 0.5 %


def test_any_part_equals_the_cut_from_the_whole():
    whole = gaussian_noise((7, 1), FIRST, 100_000, 50.0, white())
    part = gaussian_noise((7, 1), FIRST + 31_234, 40_000, 50.0, white())
    np.testing.assert_array_equal(part, whole[:, 31_234:71_234])


def test_streams_and_seeds_are_independent():
    one = gaussian_noise((7, 1), 0, 50_000, 50.0, white())[0]
    for seed in ((7, 2), (8, 1)):
        other = gaussian_noise(seed, 0, 50_000, 50.0, white())[0]
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.03


def test_two_rates_give_the_same_waveform_below_the_lower_nyquist():
    def low_pass(frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
        return z * (frequency < 20.0)

    slow = gaussian_noise((3,), 50 * 10_000, 50 * 600, 50.0, low_pass)[0]
    fast = gaussian_noise((3,), 125 * 10_000, 125 * 600, 125.0, low_pass)[0]
    np.testing.assert_allclose(fast[::5], slow[::2], atol=1e-4 * slow.std())


def test_analytic_signal_has_the_noise_as_its_real_part_and_no_negative_frequency():
    real = gaussian_noise((3,), 500, 20_000, 50.0, white())[0]
    analytic = gaussian_noise((3,), 500, 20_000, 50.0, white(), analytic=True)[0]
    np.testing.assert_allclose(analytic.real, real, atol=1e-4 * real.std())
    power = np.abs(np.fft.fft(analytic * np.hanning(20_000))) ** 2
    assert power[10_010:-10].sum() < 1e-4 * power.sum()


def test_sample_index_is_the_first_sample_not_before():
    assert sample_index(10.0, 62.5) == 625
    assert sample_index(10.001, 62.5) == 626


def test_anti_alias_gain():
    np.testing.assert_allclose(
        below_nyquist(np.array([0.0, 22.9, 24.8, 25.0]), 50.0), [1, 1, 0, 0], atol=1e-9
    )


def test_wander_has_its_spread_and_its_integral():
    wander = Wander(np.random.default_rng(1), 2.0, 60.0, 3600.0)
    time = 1.4e9 + np.arange(0.0, 40 * 86400.0, 20.0)
    assert np.std(wander(time)) == pytest.approx(2.0, rel=0.05)
    near = 1.4e9 + np.linspace(0.0, 50.0, 5001)
    slope = np.gradient(wander.integral(near), near)
    np.testing.assert_allclose(slope[1:-1], wander(near)[1:-1], atol=1e-3)
