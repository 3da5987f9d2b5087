import numpy as np
import pytest

from obsnet.arrays.click_detector import (
    Arrival,
    DetectorConfig,
    arrivals,
    coincidences,
    exceedances,
    octave_energies,
)
from obsnet.arrays.recording import Recording
from obsnet.errors import ConfigError

RATE = 48_000.0


def noise(seconds, seed=0, hydrophones=1):
    return np.random.default_rng(seed).normal(0.0, 1.0, (hydrophones, int(seconds * RATE)))


def add_tone(samples, start_s, length_s, amplitude, frequency=6400.0):
    first, count = int(start_s * RATE), int(length_s * RATE)
    samples[:, first : first + count] += amplitude * np.sin(2 * np.pi * frequency * np.arange(count) / RATE)


def over(samples, config):
    energy, freedom = octave_energies(Recording.of((RATE, samples)), config)
    return exceedances(energy[:, 0], freedom, config.hop_s, config)


def test_octaves_are_centred_and_end_at_the_nyquist_frequency():
    octaves = DetectorConfig().octaves(96_000.0)
    assert [round(np.sqrt(low * high)) for low, high in octaves[:3]] == [100, 200, 400]
    assert octaves[-1][1] <= 48_000.0 and octaves[-1][0] < 48_000.0
    assert all(octaves[k][1] == pytest.approx(octaves[k + 1][0]) for k in range(len(octaves) - 1))


def test_energy_is_the_sum_of_squares_of_the_windowed_samples():
    samples = noise(0.5)
    config = DetectorConfig(window_s=0.02, hop_s=0.005, first_octave_hz=100.0)
    energy, _ = octave_energies(Recording.of((RATE, samples)), config)
    size, hop = 960, 240
    taper = np.hanning(size + 1)[:-1]
    low, high = config.octaves(RATE)[0][0], config.octaves(RATE)[-1][1]
    for k in (0, 7):
        spectrum = np.fft.rfft(taper * samples[0, k * hop : k * hop + size])
        frequency = np.fft.rfftfreq(size, 1 / RATE)
        inside = (frequency >= low) & (frequency < high)
        assert energy[k, 0].sum() == pytest.approx((np.abs(spectrum[inside]) ** 2).sum(), rel=1e-4)


def test_noise_exceeds_the_threshold_as_often_as_asked():
    config = DetectorConfig(false_alarm=0.01, hop_s=0.02)
    rates = over(noise(120.0), config)[0].mean(axis=0)
    assert rates.min() > 0.003 and rates.max() < 0.03
    assert rates.mean() == pytest.approx(0.01, rel=0.4)


def test_noise_energy_follows_the_chi_square_of_its_freedom():
    energy, freedom = octave_energies(Recording.of((RATE, noise(60.0))), DetectorConfig(hop_s=0.02))
    scatter = energy[:, 0].var(axis=0) / energy[:, 0].mean(axis=0) ** 2
    np.testing.assert_allclose(scatter, 2.0 / freedom, rtol=0.2)


def test_the_threshold_is_frozen_during_a_detection():
    config = DetectorConfig(memory_s=0.5, longest_s=2.0)
    samples = noise(8.0)
    add_tone(samples, 4.0, 1.0, 10.0)
    exceeded, background = over(samples, config)
    active = exceeded.any(axis=1)
    time = np.arange(len(active)) * config.hop_s
    during = (time > 4.0) & (time < 4.95)
    assert active[during].all()
    assert np.ptp(background[during], axis=0).max() == 0.0
    quiet = (time > 2.0) & (time < 3.9)
    assert np.ptp(background[quiet], axis=0).min() > 0.0


def test_a_new_level_is_learned_instead_of_detected_for_ever():
    config = DetectorConfig(memory_s=0.5, longest_s=0.5)
    samples = noise(8.0)
    samples[:, int(3.0 * RATE) :] *= 10.0
    active = over(samples, config)[0].any(axis=1)
    time = np.arange(len(active)) * config.hop_s
    assert active[(time > 3.02) & (time < 3.4)].all()
    assert active[time > 5.0].mean() < 0.1


def test_the_papers_rule_is_ten_percent_above_the_last_quiet_window():
    energy = np.array([1.0, 1.0, 1.05, 1.16, 2.0, 1.14, 1.0, 1.11])[:, None]
    config = DetectorConfig(margin=0.1, memory_s=0.0)
    exceeded, background = exceedances(energy, np.array([100.0]), config.hop_s, config)
    assert exceeded[:, 0].tolist() == [False, False, False, True, True, False, False, True]
    assert background[3:6, 0].tolist() == [1.05, 1.05, 1.05]


def test_a_gap_is_no_click_and_does_not_move_the_threshold():
    samples = noise(4.0)
    samples[:, int(2.0 * RATE) : int(2.5 * RATE)] = np.nan
    exceeded, background = over(samples, DetectorConfig())
    time = np.arange(len(exceeded)) * 0.005
    inside = (time > 1.99) & (time < 2.49)
    assert not exceeded[inside].any()
    assert np.isfinite(background).all()


def test_clicks_are_placed_to_a_fraction_of_a_millisecond():
    samples = noise(5.0)
    true = np.array([1.0, 2.2345, 2.2545, 4.1])
    for time in true:
        add_tone(samples, time - 0.0002, 0.0004, 40.0, 8000.0)
    found = np.array(
        [
            arrival.time
            for arrival in arrivals(Recording.of((RATE, samples)), DetectorConfig(false_alarm=1e-6))
        ]
    )
    assert np.abs(found[:, None] - true).min(axis=0).max() < 4e-4


def test_a_loud_low_octave_does_not_move_a_click():
    samples = noise(5.0)
    add_tone(samples, 2.0, 0.0005, 40.0, 8000.0)
    add_tone(samples, 2.005, 0.03, 4.0, 200.0)
    found = [
        arrival.time for arrival in arrivals(Recording.of((RATE, samples)), DetectorConfig(false_alarm=1e-6))
    ]
    assert min(abs(time - 2.00025) for time in found) < 4e-4


@pytest.mark.parametrize("hydrophones", [3, 4, 7])
def test_coincidence_takes_one_arrival_a_hydrophone_within_five_milliseconds(hydrophones):
    rng = np.random.default_rng(hydrophones)
    clicks = np.arange(1.0, 20.0)
    octave = frozenset({3})
    found = [
        Arrival(t + rng.uniform(0.0, 0.004), h, octave, 10.0) for t in clicks for h in range(hydrophones)
    ]
    found += [Arrival(t + 0.5, 0, octave, 10.0) for t in clicks]
    found += [Arrival(t + 0.7 + 0.006 * h, h, octave, 10.0) for t in clicks for h in range(hydrophones)]
    found.sort(key=lambda arrival: arrival.time)
    groups = coincidences(found, 0.005, hydrophones)
    assert len(groups) == len(clicks)
    assert all(sorted(a.hydrophone for a in group) == list(range(hydrophones)) for group in groups)
    lone = [arrival for arrival in found if arrival.hydrophone != 1]
    assert coincidences(lone, 0.005, hydrophones) == []
    assert len(coincidences(lone, 0.005, hydrophones - 1)) == len(clicks)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"window_s": 0.0}, "window_s must be positive"),
        ({"hop_s": 0.03}, "hop_s must not exceed"),
        ({"false_alarm": 0.7}, "false_alarm must lie"),
        ({"margin": -0.1}, "margin must be positive"),
        ({"min_hydrophones": 1}, "min_hydrophones must be at least 2"),
        ({"memory_s": -1.0}, "memory_s must be at least 0"),
    ],
)
def test_parameters_out_of_range_are_named(values, message):
    with pytest.raises(ConfigError, match=message):
        DetectorConfig(**values)


def test_octaves_that_do_not_fit_the_recording_are_named():
    with pytest.raises(ConfigError, match="must start below"):
        DetectorConfig(first_octave_hz=5000.0).octaves(8000.0)
    with pytest.raises(ConfigError, match="cannot resolve the octave at 20 Hz"):
        DetectorConfig(first_octave_hz=20.0).octaves(8000.0)


def test_a_recording_shorter_than_a_window_has_no_arrival():
    assert arrivals(Recording.of((RATE, noise(0.01, hydrophones=4))), DetectorConfig()) == []
