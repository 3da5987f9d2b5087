"""Angle of arrival: TDOAs between hydrophones in, azimuth, elevation, their covariance and a χ² gate out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from obsnet.arrays.compact import CompactArray, angles, tangent_vectors, unit_vector
from obsnet.errors import ConfigError, LayoutError

ITERATIONS = 60
TOLERANCE_DEG = 1e-8


@dataclass(frozen=True)
class Directions:
    """Angles of arrival of n events.

    Attributes
    ----------
    azimuth_deg, elevation_deg : arrays (n,), deg; NaN where the TDOAs do not determine a direction.
    covariance : array (n, 2, 2) of (azimuth, elevation), deg².
    chi_squared : array (n,), weighted sum of squared residuals.
    degrees_of_freedom : array (n,), TDOAs less the two angles.
    accepted : bool array (n,), residual below the gate.
    mirrored : bool array (n,), a mirror image across the hydrophones' plane fits equally well.
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    covariance: np.ndarray
    chi_squared: np.ndarray
    degrees_of_freedom: np.ndarray
    accepted: np.ndarray
    mirrored: np.ndarray


def directions(
    tdoa: np.ndarray,
    array: CompactArray,
    pairs: np.ndarray,
    covariance: np.ndarray,
    false_rejection: float = 0.01,
) -> Directions:
    """Angles of arrival by weighted least squares (Levenberg–Marquardt), with the paper's χ² gate.

    The steps are taken in the plane tangent to the unit sphere, so the zenith is a direction like any other.
    The paper gives its gate N_c − 3 degrees of freedom "for (x, y, z)"; an angle of arrival has two unknowns,
    hence N_c − 2. A gate without a degree of freedom (three hydrophones) accepts what lies on the unit sphere
    within its error, since TDOAs longer than the array fit no direction.

    Parameters
    ----------
    tdoa : array (n, pair), t_i − t_j in s; NaN where a pair has none.
    array : CompactArray
    pairs : int array (pair, 2)
    covariance : array (pair, pair) or (n, pair, pair), s²; regular.
    false_rejection : share of right TDOAs that the gate may refuse.

    Raises
    ------
    LayoutError
        Shapes that do not belong together. ConfigError: the covariance is not positive definite.

    Source: Bénard-Caudal et al. 2010, Appl. Acoust. 71, §3.2.
    """
    tdoa = np.atleast_2d(np.asarray(tdoa, float))
    pairs = np.asarray(pairs)
    if tdoa.ndim != 2 or tdoa.shape[1] != len(pairs):
        raise LayoutError(
            f"tdoa must have dims (event, pair) with {len(pairs)} pairs, found shape {tdoa.shape}"
        )
    if not 0.0 < false_rejection < 1.0:
        raise ConfigError(f"false_rejection must lie between 0 and 1, found {false_rejection!r}")
    valid = np.isfinite(tdoa)
    whitening = _whitening(covariance, valid)
    slopes = whitening @ (array.baselines(pairs) / array.sound_speed_mps)
    target = np.einsum("npq,nq->np", whitening, np.where(valid, tdoa, 0.0))
    start, rank = _start(slopes, target)
    vector = _descend(slopes, target, start)
    azimuth, elevation = angles(vector)
    chi_squared = _cost(slopes, target, vector)
    freedom = valid.sum(axis=1) - 2
    spread = _angle_covariance(slopes, azimuth, elevation)
    gate = chi2.isf(false_rejection, np.maximum(freedom, 1))
    known = rank >= 2
    return Directions(
        azimuth_deg=np.where(known, azimuth, np.nan),
        elevation_deg=np.where(known, elevation, np.nan),
        covariance=np.where(known[:, None, None], spread, np.nan),
        chi_squared=np.where(known, chi_squared, np.nan),
        degrees_of_freedom=freedom,
        accepted=known & (chi_squared <= gate),
        mirrored=rank == 2,
    )


def confidence_ellipse(
    covariance: np.ndarray, probability: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Semi-axes and tilt of the ellipse that holds the truth with `probability`.

    Parameters
    ----------
    covariance : array (..., 2, 2) of (azimuth, elevation), deg².

    Returns
    -------
    major, minor : deg; tilt : angle of the major axis from the azimuth axis towards growing elevation, [0,
        180) deg.

    >>> major, minor, tilt = confidence_ellipse(np.diag([1.0, 4.0]), 0.95)
    >>> round(float(major), 3), round(float(minor), 3), float(tilt)
    (4.895, 2.448, 90.0)
    """
    if not 0.0 < probability < 1.0:
        raise ConfigError(
            f"a confidence ellipse's probability must lie between 0 and 1, found {probability!r}"
        )
    values, vectors = np.linalg.eigh(np.asarray(covariance, float))
    radius = np.sqrt(np.maximum(values, 0.0) * chi2.ppf(probability, 2))
    tilt = np.rad2deg(np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1])) % 180.0
    return radius[..., 1], radius[..., 0], tilt


def _whitening(covariance: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Matrices W with WᵀW the inverse covariance of the valid TDOAs, their other rows and columns zero."""
    count, size = valid.shape
    covariance = np.asarray(covariance, float)
    if covariance.shape not in ((size, size), (count, size, size)):
        raise LayoutError(
            f"covariance must be ({size}, {size}) or ({count}, {size}, {size}), found {covariance.shape}"
        )
    both = valid[:, :, None] & valid[:, None, :]
    scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1)).mean()) if covariance.size else 1.0
    scale = scale if scale > 0 else 1.0
    filled = np.where(both, covariance / scale**2, np.eye(size))
    try:
        factor = np.linalg.cholesky(filled)
    except np.linalg.LinAlgError:
        raise ConfigError(
            "the TDOAs' covariance is not positive definite; give each pair an error of its own "
            "or use the pairs with the first hydrophone only"
        ) from None
    inverse = np.linalg.solve(factor, np.broadcast_to(np.eye(size), filled.shape))
    return np.where(both, inverse, 0.0) / scale


def _start(slopes: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to descend from, and the dimensions that the valid pairs span.

    The vector is that of linear least squares, lifted to the sphere.

    Hydrophones in a plane leave the component across it free: of the two directions the upper one is taken.
    """
    left, values, axes = np.linalg.svd(slopes, full_matrices=False)
    rank = (values > 1e-3 * np.maximum(values[:, :1], 1e-300)).sum(axis=1)
    kept = np.arange(values.shape[1]) < rank[:, None]
    gain = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    linear = np.einsum("nk,nkc->nc", gain * np.einsum("npk,np->nk", left, target), axes)
    if axes.shape[1] == 3:
        normal = axes[:, 2] * np.where(axes[:, 2, 2:] > 0, -1.0, 1.0)
    else:
        normal = np.cross(axes[:, 0], axes[:, 1])
        normal *= np.where(normal[:, 2:] > 0, -1.0, 1.0)
    missing = np.sqrt(np.maximum(1.0 - (linear**2).sum(axis=1), 1e-4))
    lifted = linear + np.where(rank == 2, missing, 0.0)[:, None] * normal
    length = np.linalg.norm(lifted, axis=1, keepdims=True)
    return np.where(length > 1e-12, lifted / np.maximum(length, 1e-12), np.array([0.0, 1.0, 0.0])), rank


def _cost(slopes: np.ndarray, target: np.ndarray, vector: np.ndarray) -> np.ndarray:
    residual = target - np.einsum("npc,nc->np", slopes, vector)
    return (residual**2).sum(axis=1)


def _descend(slopes: np.ndarray, target: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Levenberg–Marquardt on the unit sphere, all events at once."""
    damping = np.full(len(vector), 1e-6)
    cost = _cost(slopes, target, vector)
    for _ in range(ITERATIONS):
        tangent = np.stack(tangent_vectors(*angles(vector)), axis=-1)
        jacobian = slopes @ tangent
        residual = target - np.einsum("npc,nc->np", slopes, vector)
        gradient = np.einsum("npk,np->nk", jacobian, residual)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        load = damping * np.trace(normal, axis1=1, axis2=2) + 1e-30
        step = np.linalg.solve(normal + load[:, None, None] * np.eye(2), gradient[..., None])[..., 0]
        moved = vector + np.einsum("nck,nk->nc", tangent, step)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        trial = _cost(slopes, target, moved)
        better = trial <= cost
        vector = np.where(better[:, None], moved, vector)
        cost = np.where(better, trial, cost)
        damping = np.clip(np.where(better, damping / 10.0, damping * 10.0), 1e-12, 1e6)
        if not np.any(np.abs(step) > np.deg2rad(TOLERANCE_DEG)):
            break
    return vector


def _angle_covariance(slopes: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Inverse Fisher information of (azimuth, elevation), deg²; an azimuth at the zenith has no bound."""
    tangent = np.stack(tangent_vectors(azimuth, elevation), axis=-1)
    jacobian = slopes @ tangent
    information = np.swapaxes(jacobian, 1, 2) @ jacobian
    spread = np.linalg.pinv(information, hermitian=True)
    level = np.maximum(np.cos(np.deg2rad(elevation)), 1e-3)
    stretch = np.stack([1.0 / level, np.ones_like(level)], axis=-1)
    return spread * stretch[:, :, None] * stretch[:, None, :] * (180.0 / np.pi) ** 2


__all__ = ["Directions", "confidence_ellipse", "directions", "unit_vector"]
