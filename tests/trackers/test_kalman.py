import numpy as np
import pytest

from obsnet.trackers.kalman import constant_velocity, predict, smooth, update


def run(values, times, noise, prior, intensity):
    """Filter scalar positions: lists of filtered and predicted moments, transitions, log likelihood."""
    mean, covariance = prior
    rows, total = [], 0.0
    for k, value in enumerate(values):
        step = times[k] - times[k - 1] if k else 0.0
        transition, drift = constant_velocity(step, 1, intensity)
        before = predict(mean, covariance, transition, drift)
        innovation = np.array([value - before[0][0]])
        mean, covariance, log_likelihood = update(
            *before, innovation, np.array([[1.0, 0.0]]), np.array([[noise]])
        )
        total += float(log_likelihood)
        rows.append((mean, covariance, *before, transition))
    return [np.array(column) for column in zip(*rows, strict=True)], total


def dense(values, times, noise, prior, intensity):
    """Joint Gaussian of all states, conditioned on all measurements at once; and their log density."""
    mean, covariance = prior
    count = len(values)
    means, blocks = [mean], [[covariance]]
    for k in range(1, count):
        transition, drift = constant_velocity(times[k] - times[k - 1], 1, intensity)
        means.append(transition @ means[-1])
        row = [transition @ block for block in blocks[-1]]
        blocks.append([*row, row[-1] @ transition.T + drift])
    joint = np.zeros((2 * count, 2 * count))
    for i in range(count):
        for j in range(i + 1):
            joint[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = blocks[i][j]
            joint[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = blocks[i][j].T
    observe = np.kron(np.eye(count), [[1.0, 0.0]])
    spread = observe @ joint @ observe.T + noise * np.eye(count)
    residual = np.asarray(values) - observe @ np.concatenate(means)
    gain = joint @ observe.T @ np.linalg.inv(spread)
    log_density = -0.5 * (
        residual @ np.linalg.solve(spread, residual) + np.linalg.slogdet(2 * np.pi * spread)[1]
    )
    return np.concatenate(means) + gain @ residual, joint - gain @ observe @ joint, log_density


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.2, 2.0, 12))
    return (
        rng.normal(0.0, 3.0, 12),
        times,
        0.7,
        (np.array([0.5, -0.2]), np.array([[2.0, 0.3], [0.3, 1.0]])),
        0.4,
    )


def test_filter_and_smoother_are_the_conditional_gaussian(problem):
    (mean, covariance, *before), total = run(*problem)
    expected, spread, log_density = dense(*problem)
    smoothed, narrowed = smooth(mean, covariance, *before)
    np.testing.assert_allclose(smoothed.ravel(), expected, atol=1e-10)
    for k in range(len(smoothed)):
        np.testing.assert_allclose(narrowed[k], spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], atol=1e-10)
    np.testing.assert_allclose(mean[-1], expected[-2:], atol=1e-10)
    assert total == pytest.approx(log_density, abs=1e-9)


def test_one_scalar_update_is_bayes_rule_for_two_normals():
    mean, covariance, log_likelihood = update(
        np.array([1.0]), np.array([[4.0]]), np.array([2.0]), np.array([[1.0]]), np.array([[1.0]])
    )
    assert mean[0] == pytest.approx(1.0 + 2.0 * 4.0 / 5.0)
    assert covariance[0, 0] == pytest.approx(1.0 / (1.0 / 4.0 + 1.0))
    assert float(log_likelihood) == pytest.approx(-0.5 * (4.0 / 5.0 + np.log(2 * np.pi * 5.0)))


def test_a_missing_channel_is_no_channel_and_batches_agree_with_single_steps():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 4, 4))
    mean, covariance = rng.normal(size=(5, 4)), root @ np.swapaxes(root, 1, 2) + np.eye(4)
    observation, noise = rng.normal(size=(5, 3, 4)), np.diag([1.0, 2.0, 3.0]) + 0.2
    innovation = rng.normal(size=(5, 3))
    innovation[2, 1] = np.nan
    batch = update(mean, covariance, innovation, observation, noise)
    for k in range(5):
        keep = np.isfinite(innovation[k])
        one = update(
            mean[k], covariance[k], innovation[k, keep], observation[k][keep], noise[np.ix_(keep, keep)]
        )
        for together, alone in zip(batch, one, strict=True):
            np.testing.assert_allclose(together[k], alone, atol=1e-12)


def test_process_noise_adds_up_over_steps():
    half, drift = constant_velocity(0.75, 2, np.array([0.3, 0.5]))
    whole, expected = constant_velocity(1.5, 2, np.array([0.3, 0.5]))
    np.testing.assert_allclose(half @ half, whole)
    np.testing.assert_allclose(half @ drift @ half.T + drift, expected)
    assert expected[0, 0] == pytest.approx(0.3 * 1.5**3 / 3.0)
