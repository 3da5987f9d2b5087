"""A ship's azimuth along a straight course, its derivatives, and how well bearings fix position and course.

Urazghildiiev & Hannay, "Using a stationary compact array of acoustic sensors to estimate the motion
parameters of sources". A ship at (x0, y0) at time zero on course γ at speed v is seen at azimuth

    α(t) = atan2(x0 + v t sin γ, y0 + v t cos γ)        (1, 4)

Everything here is over θ = (x0 [m], y0 [m], γ [deg]) and, as a fourth parameter, the speed [m/s].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.stats import norm

from obsnet.errors import LayoutError


def azimuths(theta: np.ndarray, time: np.ndarray, speed_mps: float | np.ndarray) -> np.ndarray:
    """Azimuth of the ship along its course (eqs 1, 4).

    Parameters
    ----------
    theta : array (..., 3)
        East and north at time zero [m] and course [deg].
    time : array (K,), s after time zero
    speed_mps : float or array (...)

    Returns
    -------
    array (..., K), deg in [0, 360)
    """
    east, north, _, _ = _path(theta, time, speed_mps)
    return np.rad2deg(np.arctan2(east, north)) % 360.0


def derivatives(theta: np.ndarray, time: np.ndarray, speed_mps: float | np.ndarray) -> np.ndarray:
    """Derivatives of the azimuth with respect to x0, y0, course and speed.

    With d² = x² + y² at each time (eqs 26, 27, with the sign that the print lost in 26b):
    ∂α/∂x0 = y/d², ∂α/∂y0 = -x/d², ∂α/∂γ = v t (y cos γ + x sin γ)/d², ∂α/∂v = t (y sin γ - x cos γ)/d².

    Returns
    -------
    array (..., K, 4), deg/m, deg/m, deg/deg, deg/(m/s)
    """
    time = np.asarray(time, float)
    east, north, sin, cos = _path(theta, time, speed_mps)
    squared = np.maximum(east**2 + north**2, 1e-12)
    along = np.asarray(speed_mps, float)[..., None] * time
    turn = along * (north * cos + east * sin) / squared
    scale = time * (north * sin - east * cos) / squared
    return np.stack(
        [np.rad2deg(north / squared), np.rad2deg(-east / squared), turn, np.rad2deg(scale)], axis=-1
    )


def _path(
    theta: np.ndarray, time: np.ndarray, speed_mps: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    x0, y0, course = np.moveaxis(np.asarray(theta, float)[..., None], -2, 0)
    sin, cos = np.sin(np.deg2rad(course)), np.cos(np.deg2rad(course))
    along = np.asarray(speed_mps, float)[..., None] * np.asarray(time, float)
    return x0 + along * sin, y0 + along * cos, sin, cos


@dataclass(frozen=True)
class Bounds:
    """Covariances over (x0 [m], y0 [m], course [deg], speed [m/s]) that no unbiased estimator can beat.

    Parameters
    ----------
    theta : array (3,)
        East, north [m] at time zero and course [deg] at which the bound holds.
    speed_mps : float
    full : array (4, 4)
        Inverse of the whole Fisher matrix, the speed's prior included; zero row and column for a known speed.
    block : array (2, 2), m²
        What the paper's eq. 28 gives for the position: the inverse of the position block alone, as if the
        course were known.
    """

    theta: np.ndarray
    speed_mps: float
    full: np.ndarray
    block: np.ndarray

    @property
    def course_std_deg(self) -> float:
        """Bound on the course [deg]."""
        return float(np.sqrt(self.full[2, 2]))

    @property
    def cpa_range_std_m(self) -> float:
        """Bound on the range at CPA [m], from the whole matrix."""
        gradient = cpa_jacobian(self.theta, self.speed_mps)[1]
        return float(np.sqrt(gradient @ self.full @ gradient))

    @property
    def block_cpa_range_std_m(self) -> float:
        """Bound on the range at CPA [m] from the position block alone (eqs 28a, b)."""
        gradient = cpa_jacobian(self.theta, self.speed_mps)[1, :2]
        return float(np.sqrt(gradient @ self.block @ gradient))

    @property
    def curved_cpa_range_rmse_m(self) -> float:
        """Error of the CPA range [m] that this covariance leads to where the bound alone promises too much.

        The estimates of (ω, ρ) are close to Gaussian, those of range are not: D = v |ω| / (ω² + ρ²) bends
        over the spread of a far ship. This is the root mean square error of D over that Gaussian, by
        quadrature to ±5 standard deviations.
        """
        rates, slopes = _rates(self.theta, self.speed_mps)
        spread = slopes @ self.full @ slopes.T
        node = np.linspace(-5.0, 5.0, 101)
        weight = np.exp(-0.5 * (node[:, None] ** 2 + node**2))
        grid = np.stack(np.meshgrid(node, node, indexing="ij"))
        turn, opening = rates[:, None, None] + np.tensordot(np.linalg.cholesky(spread), grid, axes=1)
        distance = self.speed_mps * np.abs(turn) / (turn**2 + opening**2)
        true = self.speed_mps * abs(rates[0]) / (rates @ rates)
        variance = np.sum(weight * (distance - true) ** 2) / weight.sum()
        return float(np.sqrt(variance + self.full[3, 3] * (true / self.speed_mps) ** 2))

    @property
    def position_std_m(self) -> float:
        """Bound on the position at time zero, root of the summed variances [m], from the whole matrix."""
        return float(np.sqrt(self.full[0, 0] + self.full[1, 1]))

    @property
    def block_position_std_m(self) -> float:
        """The same from the position block alone."""
        return float(np.sqrt(np.trace(self.block)))


def cramer_rao(
    theta: np.ndarray, time: np.ndarray, covariance: np.ndarray, speed_mps: float, speed_std_mps: float = 0.0
) -> Bounds:
    """Cramér-Rao bounds of position and course, with a known speed or one with a Gaussian prior (eqs 23, 24,
    28).

    Parameters
    ----------
    theta : array (3,), m, m, deg
    time : array (K,), s after time zero
    covariance : array (K, K), deg²
        Covariance of the bearing errors.
    speed_mps, speed_std_mps : float
        Mean and standard deviation of the speed's prior; zero for a known speed.

    Raises
    ------
    LayoutError
        The bearings do not determine the parameters (fewer than three, or all at one azimuth).
    """
    theta = np.asarray(theta, float)
    jacobian = derivatives(theta, time, speed_mps)
    white = whitener(covariance) @ jacobian
    fisher = white.T @ white
    block = _inverse(fisher[:2, :2])
    full = np.zeros((4, 4))
    if speed_std_mps > 0:
        fisher[3, 3] += speed_std_mps**-2
        full[:] = _inverse(fisher)
    else:
        full[:3, :3] = _inverse(fisher[:3, :3])
    return Bounds(theta, float(speed_mps), full, block)


def mismatched_covariance(
    theta: np.ndarray,
    time: np.ndarray,
    assumed: np.ndarray,
    true: np.ndarray,
    speed_mps: float,
    speed_std_mps: float = 0.0,
) -> Bounds:
    """Covariance that the estimator has when it weights with the `assumed` errors while the `true` ones are
    others.

    To first order the estimate is G ε with G = (Jᵀ A⁻¹ J)⁻¹ Jᵀ A⁻¹, so its covariance is G C Gᵀ: what
    ignoring the correlation costs (A diagonal) and what a wrong model of it costs. A spread of the speed adds
    θ θᵀ (σ_v / v)² over (x0, y0).
    """
    theta = np.asarray(theta, float)
    jacobian = derivatives(theta, time, speed_mps)[:, :3]
    weighted = np.linalg.solve(assumed, jacobian)
    gain = _inverse(jacobian.T @ weighted) @ weighted.T
    full = np.zeros((4, 4))
    full[:3, :3] = gain @ true @ gain.T
    inverse = _inverse(jacobian[:, :2].T @ weighted[:, :2]) @ weighted[:, :2].T
    scale = np.array([theta[0], theta[1], 0.0, speed_mps]) / speed_mps
    full += speed_std_mps**2 * np.outer(scale, scale)
    return Bounds(theta, float(speed_mps), full, inverse @ true @ inverse.T)


def cpa_jacobian(theta: np.ndarray, speed_mps: float) -> np.ndarray:
    """Derivatives of (CPA time, signed CPA range, course, speed) with respect to (x0, y0, course, speed).

    Returns
    -------
    array (4, 4)
        s, m, deg and m/s per m, m, deg and m/s.
    """
    x0, y0, course = np.asarray(theta, float)
    sin, cos = np.sin(np.deg2rad(course)), np.cos(np.deg2rad(course))
    along, across = x0 * sin + y0 * cos, x0 * cos - y0 * sin
    degree = np.deg2rad(1.0)
    return np.array(
        [
            [-sin / speed_mps, -cos / speed_mps, -across * degree / speed_mps, along / speed_mps**2],
            [cos, -sin, -along * degree, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _rates(theta: np.ndarray, speed_mps: float) -> tuple[np.ndarray, np.ndarray]:
    """(ω, ρ) [1/s] at time zero and their derivatives over x0, y0 [m], course [deg], speed [m/s]."""
    x, y, course = theta
    vx, vy = speed_mps * np.sin(np.deg2rad(course)), speed_mps * np.cos(np.deg2rad(course))
    squared = x**2 + y**2
    turn, opening = (vx * y - vy * x) / squared, (vx * x + vy * y) / squared
    slopes = np.array(
        [
            [
                (-vy - 2 * x * turn) / squared,
                (vx - 2 * y * turn) / squared,
                np.deg2rad(opening),
                turn / speed_mps,
            ],
            [
                (vx - 2 * x * opening) / squared,
                (vy - 2 * y * opening) / squared,
                -np.deg2rad(turn),
                opening / speed_mps,
            ],
        ]
    )
    return np.array([turn, opening]), slopes


def speed_scale_variance(mean_mps: float, std_mps: float, minimum_mps: float | None = None) -> float:
    """Variance σ_k² = E(v̄/v - 1)² of the range scale for ships whose speeds are normal about `mean_mps` (eqs
    20, 22).

    The expectation does not exist for an untruncated normal; speeds below `minimum_mps` (a quarter of the
    mean by default) are left out.
    """
    if std_mps <= 0:
        return 0.0
    low = mean_mps / 4 if minimum_mps is None else minimum_mps
    speed = np.linspace(low, mean_mps + 6 * std_mps, 4001)
    density = norm.pdf(speed, mean_mps, std_mps)
    return float(np.sum(density * (mean_mps / speed - 1) ** 2) / density.sum())


def whitener(covariance: np.ndarray) -> np.ndarray:
    """Inverse Cholesky factor W, W C Wᵀ = I."""
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise LayoutError(
            "the covariance of bearing errors is singular; give the error model a white share (nugget)"
        ) from None
    return dtrtri(root, lower=1)[0]


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a positive matrix whose rows have different units."""
    scale = np.sqrt(np.diag(matrix))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise LayoutError(
            "these bearings do not determine position and course: the ship must change its azimuth"
        )
    unit = matrix / np.outer(scale, scale)
    if np.linalg.cond(unit) > 1e13:
        raise LayoutError(
            "these bearings do not determine position and course: the ship must change its azimuth"
        )
    return np.linalg.inv(unit) / np.outer(scale, scale)
