import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t

from obsnet.arrays.beamforming import Beamformer, HydrophoneArray
from obsnet.arrays.likelihood import GAUSSIAN, BeamLikelihood, beam_llr
from obsnet.errors import ConfigError

N, M = 6, 3
BEAMS = Beamformer(HydrophoneArray.line(M, 0.93), 375.0, N, np.arange(-60.0, 61.0, 10.0), 750.0)


def batch(seed):
    return np.random.default_rng(seed).standard_t(4, size=N * M)


@pytest.mark.parametrize("snr_db", [-20.0, -9.0, 0.0, 12.0])
@pytest.mark.parametrize("nu", [2.5, 3.0, 12.0])
@pytest.mark.parametrize("azimuth", [-37.0, 12.0])
def test_the_ratio_is_that_of_the_dense_multivariate_t_densities(azimuth, nu, snr_db):
    matrix = BEAMS.matrix(azimuth)
    z = batch(1)
    noise = np.eye(N * M) * (nu - 2) / nu
    source = 10 ** (snr_db / 10) * matrix @ matrix.T * (nu - 2) / nu
    dense = multivariate_t(shape=noise + source, df=nu).logpdf(z) - multivariate_t(shape=noise, df=nu).logpdf(
        z
    )
    power = np.sum((matrix.T @ z) ** 2)
    assert beam_llr(power, z @ z, snr_db, N, M, nu) == pytest.approx(dense, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("snr_db", [-20.0, 0.0, 12.0])
def test_the_gaussian_ratio_is_that_of_the_dense_densities_and_the_limit_of_the_other(snr_db):
    matrix = BEAMS.matrix(20.0)
    z = batch(2)
    covariance = np.eye(N * M) + 10 ** (snr_db / 10) * matrix @ matrix.T
    dense = multivariate_normal(cov=covariance).logpdf(z) - multivariate_normal(cov=np.eye(N * M)).logpdf(z)
    power = np.sum((matrix.T @ z) ** 2)
    assert beam_llr(power, z @ z, snr_db, N, M) == pytest.approx(dense, rel=1e-9)
    assert beam_llr(power, z @ z, snr_db, N, M, 1e9) == pytest.approx(dense, rel=1e-5)


def test_the_ratio_has_mean_one_without_a_source():
    rng = np.random.default_rng(3)
    nu = 12.0
    z = rng.normal(size=(40_000, N * M)) * np.sqrt((nu - 2) / rng.chisquare(nu, 40_000))[:, None]
    power = np.sum((z @ BEAMS.matrix(5.0)) ** 2, axis=1)
    ratio = np.exp(beam_llr(power, (z**2).sum(axis=1), -12.0, N, M, nu))
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / 200)


def test_a_loud_batch_convinces_the_gaussian_but_not_the_heavy_tailed():
    loud = 9.0 * N * M
    assert beam_llr(loud, loud, 0.0, N, M, GAUSSIAN) > 5.0
    assert beam_llr(loud, loud, 0.0, N, M, 3.0) < 0.0


@pytest.mark.parametrize("nu", [3.0, GAUSSIAN])
def test_between_beams_the_power_is_interpolated_and_beyond_them_nothing_is_possible(nu):
    rng = np.random.default_rng(4)
    power, energy = rng.uniform(10, 30, 13), 40.0
    likelihood = BeamLikelihood(-60.0, 10.0, N, M, nu)
    azimuth = np.array([-60.0, -55.0, 3.0, 60.0])
    snr = np.array([-10.0, -5.0, 0.0, 5.0])
    expected = beam_llr(np.interp(azimuth, BEAMS.azimuth_deg, power), energy, snr, N, M, nu)
    np.testing.assert_allclose(likelihood(power, energy, azimuth, snr), expected)
    outside = likelihood(power, energy, np.array([-60.1, 61.0, np.nan]), np.zeros(3))
    assert (outside == -np.inf).all()


def test_noise_without_variance_is_refused():
    with pytest.raises(ConfigError, match="more than 2 degrees of freedom"):
        beam_llr(1.0, 1.0, 0.0, N, M, 2.0)
    with pytest.raises(ConfigError, match="exceed 2"):
        BeamLikelihood(0.0, 1.0, N, M, 1.0)
