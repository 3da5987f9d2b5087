from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import median_filter

from obsnet.errors import ConfigError, LayoutError
from obsnet.trackers.tdoa_detections import TdoaDetectionConfig, detect_tdoas, running_median

HOP, NFFT = 10.24, 1024
QUEFRENCY = np.arange(513) * 0.02
TIMES = HOP * np.arange(130, 480)
CONFIG = TdoaDetectionConfig()


def noise(rng, frames=len(TIMES)):
    """Cepstra of noise (Trabattoni et al. 2023, eq. 15)."""
    std = (0.625 + 0.2 * np.cos(np.pi * QUEFRENCY / QUEFRENCY[-1])) / np.sqrt(NFFT)
    return std[:, None] * rng.standard_normal((len(QUEFRENCY), frames))


def ridge(delay, amplitude, phase, times=TIMES):
    """Simulated interference pulses at delay(time) (eq. 17)."""
    lag = QUEFRENCY[:, None] - np.broadcast_to(delay, times.shape)
    return amplitude * np.cos(2 * np.pi * 15.0 * lag + phase) * np.exp(-0.5 * (lag / 0.05) ** 2)


@pytest.mark.parametrize("phase", [0.0, 1.0, np.pi / 2, np.pi])
def test_a_drifting_ridge_is_found_at_its_delay_whatever_its_phase(phase):
    truth = 2.1 + 9e-4 * (TIMES - TIMES[0])
    values = noise(np.random.default_rng(0)) + ridge(truth, 0.07, phase)
    found = detect_tdoas(values, QUEFRENCY, TIMES, CONFIG)
    expected = np.interp(found.times_s, TIMES, truth)
    errors, hits, false = [], 0, 0
    for i in np.flatnonzero(found.valid):
        error = found.scan(i) - expected[i]
        near = np.abs(error) < 0.06
        errors += list(error[near])
        hits += near.any()
        false += (~near).sum()
    assert hits >= 0.95 * found.valid.sum()
    assert np.sqrt(np.mean(np.square(errors))) < 0.012 and abs(np.mean(errors)) < 0.003
    assert false < 0.3 * len(found.times_s)


def test_stacking_along_ridges_hears_what_single_frames_do_not():
    truth = 2.1 + 9e-4 * (TIMES - TIMES[0])
    values = noise(np.random.default_rng(3)) + ridge(truth, 0.03, 0.4)

    def share(config):
        found = detect_tdoas(values, QUEFRENCY, TIMES, config)
        expected = np.interp(found.times_s, TIMES, truth)
        return np.mean(
            [(np.abs(found.scan(i) - expected[i]) < 0.06).any() for i in np.flatnonzero(found.valid)]
        )

    single = replace(CONFIG, stack_s=0.0, threshold=2.2, background_time_s=180.0, cluster_time_s=45.0)
    assert share(CONFIG) > 0.9 > 0.45 > share(single)


def test_noise_alone_gives_few_detections():
    found = detect_tdoas(noise(np.random.default_rng(1)), QUEFRENCY, TIMES, CONFIG)
    assert len(found.tdoa_s) < 0.3 * len(found.times_s)


def test_a_peak_without_neighbours_is_dropped():
    values = np.abs(0.01 * np.random.default_rng(2).standard_normal((len(QUEFRENCY), 40)))
    values[120, 20] = 1.0
    values[200, 10:30] = 1.0
    paper = replace(CONFIG, envelope=False, threshold=20.0, cluster_time_s=25.0, cluster_tdoa_s=0.03)
    found = detect_tdoas(values, QUEFRENCY, TIMES[:40], paper)
    np.testing.assert_array_equal(found.scan_of, np.arange(10, 30))
    np.testing.assert_allclose(found.tdoa_s, 4.0, atol=2e-3)


def test_gaps_are_gaps_and_what_is_beyond_is_unchanged():
    values = noise(np.random.default_rng(0)) + ridge(2.5, 0.07, 0.0)
    whole = detect_tdoas(values, QUEFRENCY, TIMES, CONFIG)
    holed = values.copy()
    holed[:, 100:130] = np.nan
    found = detect_tdoas(holed, QUEFRENCY, TIMES, CONFIG)
    inside = (found.times_s > TIMES[105]) & (found.times_s < TIMES[124])
    assert inside.any() and not found.valid[inside].any()
    assert found.scan(int(np.flatnonzero(inside)[0])) is None
    far = np.flatnonzero(found.times_s > TIMES[129] + CONFIG.context_s)
    assert len(far) > 20
    for i in far:
        np.testing.assert_allclose(found.scan(i), whole.scan(i), atol=1e-9)


def test_a_part_with_its_context_gives_what_the_whole_gives():
    values = noise(np.random.default_rng(5)) + ridge(3.0 - 5e-4 * (TIMES - TIMES[0]), 0.05, 1.0)
    whole = detect_tdoas(values, QUEFRENCY, TIMES, CONFIG)
    part = detect_tdoas(values[:, 60:290], QUEFRENCY, TIMES[60:290], CONFIG)
    first, last = TIMES[60] + CONFIG.context_s, TIMES[289] - CONFIG.context_s
    compared = 0
    for i in np.flatnonzero((part.times_s >= first) & (part.times_s <= last)):
        j = int(np.argmin(np.abs(whole.times_s - part.times_s[i])))
        np.testing.assert_allclose(part.scan(i), whole.scan(j), atol=1e-9)
        compared += 1
    assert compared > 8


def test_running_median_is_the_two_dimensional_median_filter():
    values = np.random.default_rng(0).random((30, 25))
    times = np.arange(25.0)
    found = running_median(values, times, np.ones(25, bool), 1, 2.0, 0, 30)
    np.testing.assert_allclose(found[1:-1, 2:-2], median_filter(values, (3, 5))[1:-1, 2:-2])


def test_running_median_ignores_gaps():
    values = np.ones((9, 9))
    valid = np.ones(9, bool)
    valid[4:7] = False
    values[:, 4:7] = 100.0
    np.testing.assert_array_equal(running_median(values, np.arange(9.0), valid, 2, 2.0, 0, 9)[:, [3, 7]], 1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((5, 3)), np.arange(6) * 0.1, np.arange(3.0)), "must have dims"),
        ((np.zeros((5, 3)), np.array([0.0, 0.1, 0.3, 0.4, 0.5]), np.arange(3.0)), "must be uniform"),
        ((np.zeros((5, 3)), np.arange(5) * 0.1, np.array([0.0, 2.0, 1.0])), "times must increase"),
        ((np.zeros((5, 0)), np.arange(5) * 0.1, np.empty(0)), "holds no frame"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(LayoutError, match=message):
        detect_tdoas(*arguments)


def test_delays_off_the_quefrency_axis_are_refused():
    with pytest.raises(ConfigError, match="leave no peak"):
        detect_tdoas(np.zeros((20, 5)), np.arange(20) * 0.01, np.arange(5.0))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold", 0.0),
        ("max_tdoa_s", 0.1),
        ("cluster_points", 0),
        ("stack_s", -1.0),
        ("pulse_width_s", -0.1),
    ],
)
def test_bad_options_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        replace(CONFIG, **{name: value})
