"""Linear-Gaussian steps that filters share: prediction, update with missing channels, Rauch–Tung–Striebel
smoothing.

All take leading dimensions (several states at once). Angles are the caller's business: these steps see
innovations, not measurements.
"""

from __future__ import annotations

import numpy as np


def constant_velocity(
    interval_s: float, dimensions: int, intensity: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Transition and process noise of positions that move at a constant rate, disturbed by white
    acceleration.

    Parameters
    ----------
    interval_s : time step, s.
    dimensions : number d of positions; the state is d positions followed by d rates.
    intensity : array (..., d) or number, spectral density of the acceleration, unit²/s³.

    Returns
    -------
    transition : array (2d, 2d). noise : array (..., 2d, 2d).
    """
    one = np.eye(dimensions)
    zero = np.zeros((dimensions, dimensions))
    transition = np.block([[one, interval_s * one], [zero, one]])
    shape = np.array([[interval_s**3 / 3.0, interval_s**2 / 2.0], [interval_s**2 / 2.0, interval_s]])
    density = np.asarray(intensity, float)[..., None] * one if np.ndim(intensity) else intensity * one
    noise = np.einsum("ab,...ij->...aibj", shape, density)
    return transition, noise.reshape(*density.shape[:-2], 2 * dimensions, 2 * dimensions)


def predict(
    mean: np.ndarray, covariance: np.ndarray, transition: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (..., n) and covariance (..., n, n) one step later: F m, F P Fᵀ + Q."""
    moved = (transition @ mean[..., None])[..., 0]
    return moved, transition @ covariance @ np.swapaxes(transition, -1, -2) + noise


def update(
    mean: np.ndarray,
    covariance: np.ndarray,
    innovation: np.ndarray,
    observation: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kalman update; the extended one where `observation` is the Jacobian at `mean`.

    Parameters
    ----------
    mean, covariance : arrays (..., n) and (..., n, n).
    innovation : array (..., m), measurement minus prediction; NaN in a channel that measured nothing.
    observation : array (..., m, n). noise : array (..., m, m).

    Returns
    -------
    mean, covariance : as given, updated (Joseph's form). log_likelihood : array (...), of the channels
        present.
    """
    present = np.isfinite(innovation)
    both = present[..., :, None] & present[..., None, :]
    observation = np.where(present[..., None], observation, 0.0)
    noise = np.where(both, noise, np.eye(innovation.shape[-1]))
    innovation = np.where(present, innovation, 0.0)
    transposed = np.swapaxes(observation, -1, -2)
    spread = observation @ covariance @ transposed + noise
    gain = np.swapaxes(np.linalg.solve(spread, observation @ covariance), -1, -2)
    kept = np.eye(mean.shape[-1]) - gain @ observation
    updated = mean + (gain @ innovation[..., None])[..., 0]
    narrowed = kept @ covariance @ np.swapaxes(kept, -1, -2) + gain @ noise @ np.swapaxes(gain, -1, -2)
    distance = (innovation * np.linalg.solve(spread, innovation[..., None])[..., 0]).sum(axis=-1)
    volume = np.linalg.slogdet(spread)[1] + np.log(2.0 * np.pi) * present.sum(axis=-1)
    return updated, narrowed, -0.5 * (distance + volume)


def smooth(
    means: np.ndarray,
    covariances: np.ndarray,
    predicted_means: np.ndarray,
    predicted_covariances: np.ndarray,
    transitions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Rauch–Tung–Striebel smoother: each step's state given all measurements, earlier and later.

    Parameters
    ----------
    means, covariances : arrays (time, n), (time, n, n), filtered.
    predicted_means, predicted_covariances : the same before each step's update.
    transitions : array (time, n, n), from the step before to each step; the first is not used.

    Returns
    -------
    means, covariances : smoothed.

    Source: Rauch, Tung & Striebel 1965, AIAA J. 3(8).
    """
    means, covariances = np.array(means, float), np.array(covariances, float)
    for k in range(len(means) - 2, -1, -1):
        forward = transitions[k + 1] @ covariances[k]
        gain = np.linalg.solve(predicted_covariances[k + 1], forward).T
        change = covariances[k + 1] - predicted_covariances[k + 1]
        means[k] = means[k] + gain @ (means[k + 1] - predicted_means[k + 1])
        covariances[k] = covariances[k] + gain @ change @ gain.T
    return means, covariances
