"""The posterior around a best hypothesis: exact where the model is, honest where neighbouring tiles err together."""

import numpy as np
import pytest

from obsnet.trackers.posterior import posterior

TILES = 60
STD = 4.0
SEEN = np.ones(4, bool)


def linear_problem(rng, block_std):
    """Tiles that each measure a linear function of the course, their errors partly shared by blocks of five."""
    design = rng.standard_normal((TILES, 4)) * np.array([1 / 60.0, 1 / 500.0, 1 / 3.0, 1 / 0.3])
    truth = np.array([100.0, 5000.0, 40.0, 8.0])
    error = STD * rng.standard_normal(TILES) + np.repeat(block_std * rng.standard_normal(TILES // 5), 5)
    measured = design @ truth + error

    def log_likelihood(points):
        per_tile = -0.5 * ((measured[:, None] - design @ points.T) / STD) ** 2
        return per_tile.sum(axis=0), per_tile

    precision = design.T @ design / STD**2
    return truth, np.linalg.solve(precision, design.T @ measured / STD**2), precision, log_likelihood


def found(rng, block_std):
    truth, mean, precision, log_likelihood = linear_problem(rng, block_std)
    result = posterior(mean, log_likelihood, lambda points: np.ones(len(points), bool), SEEN)
    return truth, mean, precision, result, log_likelihood


def test_mean_and_evidence_of_a_linear_problem_are_exact():
    _, mean, precision, result, log_likelihood = found(np.random.default_rng(0), 0.0)
    exact = np.linalg.inv(precision)
    assert (abs(result.mean - mean) < 0.1 * np.sqrt(np.diag(exact))).all()
    peak = log_likelihood(mean[None])[0][0]
    evidence = peak + 2 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1]
    assert result.log_evidence == pytest.approx(evidence, abs=0.1)
    ratio = np.diag(result.covariance) / np.diag(exact)
    assert (ratio > 0.9).all() and (ratio < 4.0).all()


@pytest.mark.parametrize("block_std", [0.0, 8.0])
def test_regions_hold_the_truth_as_often_as_they_say(block_std):
    """Mahalanobis distances of the truth against χ² of four degrees of freedom, errors independent or shared."""
    inside = []
    for seed in range(40):
        truth, _, _, result, _ = found(np.random.default_rng(seed), block_std)
        off = result.mean - truth
        inside.append(off @ np.linalg.solve(result.covariance, off) < 7.78)  # 90 %
    assert np.mean(inside) > 0.75


def test_shared_errors_widen_the_covariance():
    alone, shared = (
        np.mean([np.diag(found(np.random.default_rng(seed), std)[3].covariance)[1] for seed in range(10)])
        for std in (0.0, 8.0)
    )
    assert shared > 4.0 * alone
