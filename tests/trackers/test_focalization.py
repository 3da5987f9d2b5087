from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from obsnet.errors import ConfigError, FilterError, LayoutError
from obsnet.trackers.focalization import FocalizationConfig, FocalizationFilter
from obsnet.trackers.tdoa_association import association_log_likelihood
from obsnet.trackers.waveguide import ImageModel

INF = np.inf
PAPER = FocalizationConfig(
    detection_probability=(0.35,),
    tdoa_std_s=(5e-4,),
    false_alarms=1.0,
    false_alarm_memory_s=INF,
    false_alarm_resolution_s=0.0,
    min_tdoa_s=0.0,
    max_tdoa_s=0.1,
    max_range_m=5000.0,
    range_prior="uniform",
    rate_prior="normal",
    rate_scale_mps=5.0,
    acceleration_std_mps2=np.sqrt(0.05),
    range_diffusion_m=0.0,
    survival_s=INF,
    birth_s=INF,
    jump_s=INF,
)


class Linear:
    """One pair whose delay is proportional to range: a problem with a closed form."""

    pairs = ("a,b",)
    slope = 1e-3

    def tdoas(self, range_m, depth_m, receiver_depth_m):
        return self.slope * np.asarray(range_m)[:, None]

    def visibility(self, range_m, receiver_depth_m):
        return np.ones((1, 1))


CERTAIN = replace(
    PAPER,
    detection_probability=(1.0,),
    tdoa_std_s=(0.05,),
    false_alarms=1e-9,
    max_tdoa_s=5.0,
    acceleration_std_mps2=0.3,
    particles=40_000,
)


def kalman(measured, interval, std, rate_std, acceleration_std):
    """Range and rate from one certain, unlabelled-by-necessity measurement per scan; flat prior in range."""
    variance = std**2
    mean, covariance = np.array([measured[0], 0.0]), np.diag([variance, rate_std**2])
    step = np.array([[1.0, interval], [0.0, 1.0]])
    drive = np.array([interval**2 / 2, interval]) * acceleration_std
    yield mean, covariance
    for value in measured[1:]:
        mean, covariance = step @ mean, step @ covariance @ step.T + np.outer(drive, drive)
        gain = covariance[:, 0] / (covariance[0, 0] + variance)
        mean = mean + gain * (value - mean[0])
        covariance = covariance - np.outer(gain, covariance[0])
        yield mean, covariance


def test_one_certain_pair_without_clutter_is_the_kalman_filter():
    rng = np.random.default_rng(0)
    truth = 2000.0 + 4.0 * 3.0 * np.arange(25)
    measured = 1e-3 * truth + 0.05 * rng.standard_normal(25)
    particle = FocalizationFilter(Linear(), CERTAIN)
    oracle = kalman(measured / 1e-3, 3.0, 50.0, 5.0, 0.3)
    for i, (mean, covariance) in enumerate(oracle):
        scan = particle.step(measured[i : i + 1], 3.0 if i else 0.0)
        std = np.sqrt(np.diag(covariance))
        assert abs(scan.range_m - mean[0]) < 0.12 * std[0]
        assert abs(scan.range_rate_mps - mean[1]) < 0.12 * std[1]
        assert scan.range_std_m == pytest.approx(std[0], rel=0.1)
        assert scan.range_rate_std_mps == pytest.approx(std[1], rel=0.1)


def test_evidence_of_a_certain_detection_is_the_ratio_of_densities():
    # ∫ N(z; kr, σ) dr / r_max against the density of false alarms: (1 / k r_max) / (μ / window).
    scan = FocalizationFilter(Linear(), CERTAIN).step(np.array([2.5]), 0.0)
    expected = np.log(1.0 / (1e-3 * 5000.0)) - np.log(1e-9 / 5.0)
    assert scan.log_evidence == pytest.approx(expected, abs=0.02)
    assert scan.expected_detections == pytest.approx(1.0)


def test_posterior_and_evidence_are_those_of_a_grid_of_straight_tracks():
    """Without driving noise a track is its start and its rate, and Bayes' rule a product on a grid."""
    rng = np.random.default_rng(4)
    model = ImageModel(65.0, 1508.0)
    config = replace(
        PAPER,
        detection_probability=(0.8, 0.6, 0.7),
        tdoa_std_s=(4e-3, 3e-3, 5e-3),
        false_alarms=2.0,
        acceleration_std_mps2=0.0,
        max_range_m=1500.0,
        particles=60_000,
    )
    truth = 220.0 + 3.0 * 3.0 * np.arange(6)
    starts, rates = np.linspace(0.25, 1499.75, 3000), np.linspace(-20, 20, 81)
    posterior = np.broadcast_to(norm.pdf(rates, 0, 5.0), (3000, 81)).copy()
    posterior /= posterior.sum()
    particle, total = FocalizationFilter(model, config), 0.0
    for i, distance in enumerate(truth):
        delays = model.tdoas(np.array([distance]), np.zeros(1), 20.0)[0]
        heard = delays + np.array([4e-3, 3e-3, 5e-3]) * rng.standard_normal(3)
        measured = np.concatenate([heard[rng.random(3) < 0.7], rng.uniform(0, 0.1, rng.poisson(2.0))])
        measured = measured[(measured >= 0) & (measured < 0.1)]
        scan = particle.step(measured, 3.0 if i else 0.0, 20.0)
        total += scan.log_evidence
        ranges = starts[:, None] + 3.0 * i * rates
        inside = np.abs(ranges) < 1500.0
        predicted = model.tdoas(np.abs(ranges).ravel(), np.zeros(ranges.size), 20.0)
        llr, _ = association_log_likelihood(
            predicted, measured, np.array([0.8, 0.6, 0.7]), np.array([4e-3, 3e-3, 5e-3]), 20.0, (0.0, 0.1)
        )
        posterior = posterior * inside * np.exp(llr).reshape(ranges.shape)
        weights = posterior / posterior.sum()
        mean = (weights * np.abs(ranges)).sum()
        std = np.sqrt((weights * (np.abs(ranges) - mean) ** 2).sum())
        assert abs(scan.range_m - mean) < 0.06 * std
        assert scan.range_std_m == pytest.approx(std, rel=0.05)
    assert total == pytest.approx(np.log(posterior.sum()), abs=0.1)


def test_depth_is_found_where_the_paths_tell_it():
    model = ImageModel(65.0, 1508.0, ("direct", "surface", "bottom", "bottom-surface"))
    config = replace(
        PAPER,
        detection_probability=(0.9,),
        max_source_depth_m=60.0,
        depth_rate_std_mps=0.05,
        max_range_m=600.0,
        acceleration_std_mps2=0.02,
        particles=10_000,
    )
    rng = np.random.default_rng(1)
    particle = FocalizationFilter(model, config)
    for i in range(30):
        distance = 300.0 - 6.0 * i
        delays = model.tdoas(np.array([distance]), np.array([18.0]), 30.0)[0]
        measured = (delays + 5e-4 * rng.standard_normal(6))[rng.random(6) < 0.9]
        scan = particle.step(measured, 3.0 if i else 0.0, 30.0)
    assert scan.depth_m == pytest.approx(18.0, abs=2.0)
    assert scan.range_m == pytest.approx(distance, abs=10.0)


def test_existence_without_detections_is_the_bernoulli_recursion():
    config = replace(
        PAPER, detection_probability=(0.3,), max_tdoa_s=1e4, max_range_m=1e6, rate_scale_mps=1e-3
    )
    config = replace(config, range_prior="area", survival_s=3000.0, birth_s=9000.0, jump_s=5000.0)
    particle = FocalizationFilter(Linear(), replace(config, acceleration_std_mps2=0.0))
    q = 3000.0 / 12000.0
    for i in range(8):
        elapsed = 60.0 if i else 0.0
        q = q * np.exp(-elapsed / 3000.0) + (1 - q) * (1 - np.exp(-elapsed / 9000.0))
        q = 0.7 * q / (1 - q + 0.7 * q)
        scan = particle.step(np.array([]), elapsed)
        assert scan.log_evidence == pytest.approx(np.log(0.7), abs=1e-3)
        assert scan.existence_llr == pytest.approx(np.log(q / (1 - q)), abs=3e-3)


def test_a_gap_only_predicts():
    particle = FocalizationFilter(Linear(), CERTAIN)
    first = particle.step(np.array([2.0]), 0.0)
    gap = particle.step(None, 30.0)
    assert gap.log_evidence == 0.0
    spread = np.hypot(first.range_std_m, np.hypot(5.0 * 30.0, 0.3 * 30.0**2 / 2))
    assert gap.range_std_m == pytest.approx(spread, rel=0.02)


def test_range_is_reflected_at_zero():
    config = replace(PAPER, acceleration_std_mps2=0.0, particles=10)
    particle = FocalizationFilter(ImageModel(65.0, 1508.0), config)
    state = particle.state_dict()
    state["particles"] = np.tile([10.0, 0.0, -5.0], (10, 1))
    particle.load_state_dict(state)
    scan = particle.step(None, 4.0)
    assert (scan.range_m, scan.range_rate_mps) == pytest.approx((10.0, 5.0))


def test_a_restored_filter_goes_on_as_if_never_stopped():
    rng = np.random.default_rng(0)
    config = replace(
        PAPER, birth_s=600.0, survival_s=600.0, jump_s=600.0, particles=500, false_alarm_memory_s=60.0
    )
    first = FocalizationFilter(ImageModel(65.0, 1508.0), config)
    for _ in range(5):
        first.step(rng.uniform(0, 0.1, 3), 3.0, 20.0)
    second = FocalizationFilter(ImageModel(65.0, 1508.0), config)
    second.load_state_dict(first.state_dict())
    for _ in range(5):
        measured = rng.uniform(0, 0.1, 3)
        assert first.step(measured, 3.0, 20.0) == second.step(measured, 3.0, 20.0)
    with pytest.raises(ConfigError, match="holds 500 particles, the configuration asks for 400"):
        FocalizationFilter(Linear(), replace(config, particles=400)).load_state_dict(first.state_dict())


def test_jumps_get_the_filter_off_a_ghost():
    """The ghost explains one of two pairs' delays; a filter that sits on it does not move by itself."""

    class TwoPairs(Linear):
        pairs = ("a,b", "b,c")

        def tdoas(self, range_m, depth_m, receiver_depth_m):
            return np.stack([1e-3 * range_m, 0.5e-3 * range_m + 0.2], axis=1)

        def visibility(self, range_m, receiver_depth_m):
            return np.ones((1, 2))

    def final_range(jump_s):
        config = replace(PAPER, detection_probability=(0.5,), tdoa_std_s=(0.02,), max_tdoa_s=6.0)
        config = replace(config, acceleration_std_mps2=0.002, particles=3000, jump_s=jump_s)
        particle = FocalizationFilter(TwoPairs(), config)
        state = particle.state_dict()
        state["particles"] = np.tile([1950.0, 0.0, 0.0], (3000, 1))
        particle.load_state_dict(state)
        for _ in range(60):
            scan = particle.step(np.array([3.5, 1.95]), 30.0)
        return scan.range_m

    assert final_range(jump_s=3000.0) == pytest.approx(3500.0, abs=30.0)
    assert final_range(jump_s=INF) == pytest.approx(1950.0, abs=30.0)


def test_the_running_rate_of_false_alarms_is_learned():
    rng = np.random.default_rng(0)
    config = replace(PAPER, birth_s=1e4, survival_s=1e4, false_alarm_memory_s=200.0, particles=1000)
    particle = FocalizationFilter(ImageModel(65.0, 1508.0), config)
    learned = []
    for _ in range(600):
        particle.step(rng.uniform(0, 0.1, rng.poisson(6.0)), 3.0, 20.0)
        learned.append(particle.false_alarms)
    assert np.mean(learned[300:]) == pytest.approx(6.0, abs=0.5)


def test_dead_weights_fail_loudly():
    particle = FocalizationFilter(Linear(), replace(CERTAIN, particles=100))
    state = particle.state_dict()
    state["particles"] = np.tile([2000.0, 0.0, 0.0], (100, 1))
    particle.load_state_dict(state)
    with pytest.raises(FilterError, match="contradicts every particle"):
        particle.step(np.array([]), 0.0)


def test_a_source_that_has_left_fails_loudly_where_none_can_come():
    particle = FocalizationFilter(Linear(), replace(CERTAIN, particles=100))
    state = particle.state_dict()
    state["particles"] = np.tile([4990.0, 0.0, 20.0], (100, 1))
    particle.load_state_dict(state)
    with pytest.raises(FilterError, match=r"left the area of interest of 5000\.0 m"):
        particle.step(None, 10.0)


def test_bad_scans_are_refused():
    particle = FocalizationFilter(Linear(), replace(PAPER, particles=10))
    with pytest.raises(LayoutError, match="time order, found -1"):
        particle.step(np.array([]), -1.0)
    with pytest.raises(LayoutError, match="not finite"):
        particle.step(np.array([np.nan]), 1.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("detection_probability", (1.2,)),
        ("tdoa_std_s", (0.0,)),
        ("max_tdoa_s", 0.0),
        ("false_alarms", 0.0),
        ("max_range_m", -1.0),
        ("acceleration_std_mps2", -0.1),
        ("particles", 1),
        ("birth_share", 1.5),
    ],
)
def test_bad_options_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        replace(PAPER, **{name: value})


def test_options_per_pair_must_match_the_pairs():
    with pytest.raises(ConfigError, match="needs one value or one for each of"):
        FocalizationFilter(ImageModel(65.0, 1508.0), replace(PAPER, detection_probability=(0.5, 0.5)))
    with pytest.raises(ConfigError, match="leaves no birth"):
        replace(PAPER, birth_s=100.0, birth_share=0.0)
