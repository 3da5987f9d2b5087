import numpy as np
import pytest

from obsnet.arrays.compact import CompactArray
from obsnet.arrays.joint_tdoa import joint_tdoa
from obsnet.arrays.tdoa import cross_correlations, highest_tdoa, quantised, tdoa_variance
from obsnet.errors import ConfigError, LayoutError

RATE = 96_000.0
LENGTH = 2048
FREQUENCY = np.fft.rfftfreq(LENGTH, 1.0 / RATE)
PAIR = np.array([[0, 1]])


def click(delay_s):
    """Band-limited click at 10 ms + `delay_s`, delayed exactly in the frequency domain."""
    shape = np.exp(-0.5 * ((FREQUENCY - 11e3) / 4.5e3) ** 2) * (FREQUENCY > 2e3) * (FREQUENCY < 20e3)
    return np.fft.irfft(shape * np.exp(-2j * np.pi * FREQUENCY * (0.010 + delay_s)), LENGTH)


def cross_correlation_tdoa(segments, rate, pairs, max_tdoa_s, band_hz=None, interpolation="upsampled"):
    """TDOA of each pair at the highest peak, and the coefficient there."""
    found = cross_correlations(segments, rate, pairs, max_tdoa_s, band_hz, interpolation)
    return highest_tdoa(*found, interpolation)


def biases(interpolation):
    """Errors [samples] over delays from 19 to 21 samples."""
    delays = np.linspace(19.0, 21.0, 41)
    found = [
        cross_correlation_tdoa(
            np.stack([click(d / RATE), click(0.0)]), RATE, PAIR, np.array([1e-3]), None, interpolation
        )
        for d in delays
    ]
    return np.array([tdoa[0] for tdoa, _ in found]) * RATE - delays


def test_the_stairs_disappear():
    stairs, parabola, upsampled = (np.abs(biases(name)).max() for name in ("none", "parabolic", "upsampled"))
    assert stairs == pytest.approx(0.5, abs=0.01)
    assert 1e-3 < parabola < 0.05
    assert upsampled < 1e-4


def test_stairs_scatter_as_rounding_does():
    assert biases("none").std() == pytest.approx(1.0 / np.sqrt(12.0), rel=0.1)
    delays = np.random.default_rng(0).uniform(-1e-3, 1e-3, 20_000)
    assert (quantised(delays, RATE) - delays).std() == pytest.approx(1.0 / (np.sqrt(12.0) * RATE), rel=0.02)


def test_sign_is_first_minus_second_and_gain_does_not_matter():
    late, early = click(30.25 / RATE), click(0.0)
    tdoa, coefficient = cross_correlation_tdoa(np.stack([late, 7.0 * early]), RATE, PAIR, np.array([1e-3]))
    assert tdoa[0] * RATE == pytest.approx(30.25, abs=1e-3)
    assert coefficient[0] == pytest.approx(1.0, abs=1e-3)
    swapped, _ = cross_correlation_tdoa(np.stack([7.0 * early, late]), RATE, PAIR, np.array([1e-3]))
    assert swapped[0] == pytest.approx(-tdoa[0], abs=1e-9)


@pytest.mark.parametrize("snr", [1.0, 10.0])
def test_errors_and_their_closure_scatter_as_stated(snr):
    rng = np.random.default_rng(1)
    band = [(5e3, 20e3)]
    inside = (FREQUENCY > 5e3) & (FREQUENCY < 20e3)
    delays = np.array([0.0, 3.3, -7.7]) / RATE
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    errors, stated = [], []
    for _ in range(250):
        signal = (
            np.fft.rfft(rng.normal(size=LENGTH)) * inside * np.exp(-2j * np.pi * FREQUENCY * delays[:, None])
        )
        noise = np.fft.rfft(rng.normal(size=(3, LENGTH)), axis=1) * inside
        segments = np.fft.irfft(np.sqrt(snr) * signal + noise, LENGTH, axis=1)[:, :960]
        tdoa, coefficient = cross_correlation_tdoa(segments, RATE, pairs, np.full(3, 2e-4), band)
        errors.append(tdoa - (delays[pairs[:, 0]] - delays[pairs[:, 1]]))
        stated.append(tdoa_variance(coefficient, 960 / RATE, band))
    errors, (shared, own) = np.array(errors), np.mean(stated, axis=0)
    closure = errors[:, 0] + errors[:, 2] - errors[:, 1]
    assert errors[:, 0].std() == pytest.approx(np.sqrt(2.0 * shared + own), rel=0.25)
    assert closure.std() == pytest.approx(np.sqrt(3.0 * own), rel=0.25)


def test_a_silent_or_broken_hydrophone_has_no_tdoa():
    segments = np.stack([click(0.0), np.zeros(LENGTH), np.full(LENGTH, np.nan)])
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    tdoa, coefficient = cross_correlation_tdoa(segments, RATE, pairs, np.full(3, 1e-3))
    assert np.isnan(tdoa).all() and np.isnan(coefficient).all()


def test_the_peak_is_sought_within_the_array_only():
    segments = np.stack([click(90.0 / RATE), click(0.0)])
    tdoa, coefficient = cross_correlation_tdoa(segments, RATE, PAIR, np.array([30.0 / RATE]))
    assert abs(tdoa[0]) * RATE <= 32.0 and coefficient[0] < 0.9


def test_bad_requests_are_named():
    with pytest.raises(ConfigError, match="interpolation must be none, parabolic or upsampled"):
        cross_correlation_tdoa(np.zeros((2, 64)), RATE, PAIR, np.array([1e-3]), None, "cubic")
    with pytest.raises(LayoutError, match="hydrophone, time"):
        cross_correlation_tdoa(np.zeros(64), RATE, PAIR, np.array([1e-3]))


def test_peaks_that_agree_on_a_direction_win_over_higher_ones():
    array = CompactArray.tetrahedron()
    pairs = array.pairs()
    truth = array.tdoa(123.0, 40.0, pairs)
    delays = -(array.tdoa(123.0, 40.0, np.array([[0, 1], [0, 2], [0, 3]])))
    segments = np.stack([click(0.0), *(click(delay) for delay in delays)])
    correlation, rate = cross_correlations(segments, RATE, pairs, array.travel(pairs) * 1.02)
    middle = correlation.shape[1] // 2
    lag = (np.arange(correlation.shape[1]) - middle) / rate
    correlation[2] += 1.3 * np.exp(-0.5 * ((lag - truth[2] + 91e-6) / 15e-6) ** 2)
    highest = lag[np.nanargmax(correlation[2])]
    assert abs(highest - truth[2]) > 60e-6
    tdoa, _ = joint_tdoa(correlation, rate, array, pairs, array.tdoa_covariance(pairs, 1e-6, 1e-6))
    np.testing.assert_allclose(np.delete(tdoa, 2), np.delete(truth, 2), atol=1e-7)
    assert abs(tdoa[2] - truth[2]) < 20e-6
