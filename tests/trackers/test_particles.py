import numpy as np
import pytest

from obsnet.errors import FilterError
from obsnet.trackers import particles


def test_normalised_weights_sum_to_one_far_below_the_smallest_float():
    log_weights = np.array([-5000.0, -5001.0, -np.inf])
    normalised, total = particles.normalise(log_weights)
    assert np.exp(normalised).sum() == pytest.approx(1.0)
    assert total == pytest.approx(-5000.0 + np.log1p(np.exp(-1.0)))
    assert normalised[2] == -np.inf


@pytest.mark.parametrize(
    ("log_weights", "message"),
    [
        (np.full(7, -np.inf), "all 7 particle weights are zero"),
        (np.array([0.0, np.nan]), "1 of 2 particle weights are NaN"),
        (np.array([0.0, np.inf]), "weight is infinite"),
        (np.array([]), "no particle at all"),
    ],
)
def test_dead_or_broken_weights_fail_loudly(log_weights, message):
    with pytest.raises(FilterError, match=message):
        particles.normalise(log_weights)
    with pytest.raises(FilterError, match=message):
        particles.systematic_resampling(log_weights, np.random.default_rng(0))


def test_effective_sample_size_counts_equal_particles_and_ignores_scale():
    log_weights = np.where(np.arange(100) < 25, -700.0, -np.inf)
    assert particles.effective_sample_size(log_weights) == pytest.approx(25.0)


def test_systematic_resampling_draws_each_particle_its_share_rounded_up_or_down():
    rng = np.random.default_rng(1)
    for _ in range(50):
        weights = rng.dirichlet(np.full(13, 0.5))
        drawn = np.bincount(particles.systematic_resampling(np.log(weights), rng, 200), minlength=13)
        assert drawn.sum() == 200
        assert (np.abs(drawn - 200 * weights) < 1.0).all()


def test_systematic_resampling_is_unbiased():
    rng = np.random.default_rng(2)
    weights = np.array([0.07, 0.61, 0.32])
    drawn = sum(
        np.bincount(particles.systematic_resampling(np.log(weights), rng, 4), minlength=3)
        for _ in range(4000)
    )
    np.testing.assert_allclose(drawn / drawn.sum(), weights, atol=0.005)


def test_systematic_resampling_never_draws_a_dead_particle():
    rng = np.random.default_rng(3)
    log_weights = np.array([-np.inf, 0.0, -np.inf, 0.0, -np.inf])
    for _ in range(200):
        assert set(particles.systematic_resampling(log_weights, rng, 9)) <= {1, 3}


def test_weighted_mean_and_covariance_agree_with_numpy():
    rng = np.random.default_rng(4)
    values, weights = rng.normal(size=(60, 3)), rng.dirichlet(np.ones(60))
    mean, covariance = particles.weighted_mean(values, np.log(weights) + 11.0)
    np.testing.assert_allclose(mean, np.average(values, axis=0, weights=weights))
    np.testing.assert_allclose(covariance, np.cov(values.T, aweights=weights, ddof=0))


def test_circular_mean_of_a_wrapped_normal_across_north():
    angles = np.random.default_rng(5).normal(2.0, 20.0, 200_000)
    mean, spread = particles.circular_mean(angles % 360.0, np.zeros(len(angles)))
    assert (mean + 180.0) % 360.0 - 180.0 == pytest.approx(2.0, abs=0.2)
    assert spread == pytest.approx(20.0, abs=0.2)
