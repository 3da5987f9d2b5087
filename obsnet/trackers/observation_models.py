"""How an animal's direction moves, what it would measure, and where a new one may be: models behind
`association`.

States are in degrees and degrees per second: (α, φ, α̇, φ̇) from TDOAs, (α, α̇) from azimuths alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from obsnet.arrays.arrival import directions
from obsnet.arrays.compact import CompactArray
from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import wrap180
from obsnet.trackers.kalman import constant_velocity

SCREEN = 1e-6
"""Share of right combinations that the screens for new animals may refuse; their evidence decides on the
rest."""


class ObservationModel(Protocol):
    """How states move, what they measure, and where a new one may be."""

    @property
    def channels(self) -> int:
        """Number of channels."""
        ...

    @property
    def dimensions(self) -> int:
        """Angles in the state, which holds as many rates."""
        ...

    @property
    def noise(self) -> np.ndarray:
        """Covariance (channel, channel) of measurements."""
        ...

    def dynamics(self, interval_s: float, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transition (2d, 2d) and process noise (..., 2d, 2d) from states with dims (..., 2d)."""
        ...

    def observe(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicted measurement (..., channel) and its Jacobian (..., channel, 2d)."""
        ...

    def innovation(self, value: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Measurement minus prediction, (..., channel)."""
        ...

    def feasible(self, channel: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Measurements that any animal could cause, bool (m,)."""
        ...

    def born(self, value: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, covariances and log evidence of new animals that cause `value` (n, channel)."""
        ...


@dataclass(frozen=True)
class TdoaModel:
    """TDOAs of an animal at azimuth α and elevation φ that turns slowly: state (α, φ, α̇, φ̇), paper's eqs
    11–12.

    Attributes
    ----------
    array : CompactArray; pairs : int array (pair, 2).
    noise : array (pair, pair), covariance of the TDOAs, s².
    turn_std : random change of the angular rate in one second, on the sphere, deg/s per √s.
    rate_std_dps : spread of a new animal's angular rate, deg/s.
    """

    array: CompactArray
    pairs: np.ndarray
    noise: np.ndarray
    turn_std: float = 0.003
    rate_std_dps: float = 0.3
    dimensions: int = 2

    def __post_init__(self) -> None:
        if not (self.turn_std > 0 and self.rate_std_dps > 0):
            raise ConfigError(
                f"turn_std and rate_std_dps must be positive, found {self.turn_std!r}, {self.rate_std_dps!r}"
            )
        if np.shape(self.noise) != (len(self.pairs), len(self.pairs)):
            raise LayoutError(
                f"noise must be a matrix over {len(self.pairs)} pairs, found {np.shape(self.noise)}"
            )

    @property
    def channels(self) -> int:
        """Number of pairs."""
        return len(self.pairs)

    def dynamics(self, interval_s: float, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Constant angular rates; an azimuth near the zenith turns faster by 1/cos φ."""
        level = np.maximum(np.abs(np.cos(np.deg2rad(mean[..., 1]))), 0.05)
        intensity = self.turn_std**2 * np.stack([1.0 / level**2, np.ones_like(level)], axis=-1)
        return constant_velocity(interval_s, 2, intensity)

    def observe(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """TDOAs (..., pair) and their derivatives (..., pair, 4)."""
        azimuth, elevation = mean[..., 0], mean[..., 1]
        by_angle = self.array.tdoa_gradient(azimuth, elevation, self.pairs)
        jacobian = np.concatenate([by_angle, np.zeros_like(by_angle)], axis=-1)
        return self.array.tdoa(azimuth, elevation, self.pairs), jacobian

    def innovation(self, value: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Difference of TDOAs."""
        return value - predicted

    def feasible(self, channel: np.ndarray, value: np.ndarray) -> np.ndarray:
        """TDOAs no longer than the pair's baseline."""
        reach = self.array.travel(self.pairs) + 4.0 * np.sqrt(np.diag(self.noise))
        return np.abs(value) <= reach[channel]

    def born(self, value: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """New animals anywhere on the sphere: least squares, and Laplace's approximation of the evidence.

        ∫ N(y; h(α, φ), R) p(α, φ) dα dφ ≈ N(y; h(α̂, φ̂), R) p(α̂, φ̂) 2π |P|^½ with p = cos φ / 4π.
        """
        likely = self._linear_misfit(value, noise) < chi2.isf(SCREEN, max(self.channels - 2, 1))
        mean, spread = np.zeros((len(value), 4)), np.broadcast_to(np.eye(4), (len(value), 4, 4)).copy()
        evidence = np.full(len(value), -np.inf)
        if not likely.any():
            return mean, spread, evidence
        fit = directions(value[likely], self.array, self.pairs, noise, false_rejection=SCREEN)
        level = np.maximum(np.cos(np.deg2rad(fit.elevation_deg)), 1e-3)
        prior = np.log(level / (4.0 * np.pi) * np.deg2rad(1.0) ** 2)
        width = np.where(np.isfinite(fit.covariance), fit.covariance, np.eye(2))
        volume = np.linalg.slogdet(2.0 * np.pi * width)[1] - _log_volume(value[likely], noise)
        fitted = prior + 0.5 * (volume - fit.chi_squared)
        evidence[likely] = np.where(fit.accepted, fitted, -np.inf)
        mean[likely, 0], mean[likely, 1] = np.nan_to_num(fit.azimuth_deg), np.nan_to_num(fit.elevation_deg)
        spread[likely, :2, :2] = np.nan_to_num(fit.covariance, nan=1.0)
        level = np.maximum(np.cos(np.deg2rad(mean[:, 1])), 0.05)
        spread[:, 2, 2] = (self.rate_std_dps / level) ** 2
        spread[:, 3, 3] = self.rate_std_dps**2
        return mean, spread, evidence

    def _linear_misfit(self, value: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Cheap screen for `born`: misfit of complete TDOAs to a vector, and of its length to one."""
        slopes = self.array.baselines(self.pairs) / self.array.sound_speed_mps
        complete = np.isfinite(value).all(axis=1)
        if self.array.dimension < 3 or not complete.all():
            return np.zeros(len(value))
        inverse = np.linalg.inv(noise)
        spread = np.linalg.pinv(slopes.T @ inverse @ slopes)
        vector = value @ (spread @ slopes.T @ inverse).T
        residual = value - vector @ slopes.T
        length = np.maximum(np.linalg.norm(vector, axis=1), 1e-9)
        along = vector / length[:, None]
        variance = np.einsum("na,ab,nb->n", along, spread, along)
        return np.einsum("na,ab,nb->n", residual, inverse, residual) + (length - 1.0) ** 2 / variance


@dataclass(frozen=True)
class AzimuthModel:
    """Azimuths alone, as any detector's map gives them: state (α, α̇).

    Attributes
    ----------
    azimuth_std_deg : error of a measured azimuth, deg.
    turn_std : deg/s per √s. rate_std_dps : spread of a new source's rate, deg/s.
    """

    azimuth_std_deg: float = 3.0
    turn_std: float = 5e-4
    rate_std_dps: float = 0.05
    channels: int = 1
    dimensions: int = 1

    def __post_init__(self) -> None:
        for name in ("azimuth_std_deg", "turn_std", "rate_std_dps"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)!r}")

    @property
    def noise(self) -> np.ndarray:
        """Covariance (1, 1), deg²."""
        return np.array([[self.azimuth_std_deg**2]])

    def dynamics(self, interval_s: float, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Constant angular rate."""
        return constant_velocity(interval_s, 1, np.full((*mean.shape[:-1], 1), self.turn_std**2))

    def observe(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The azimuth itself."""
        return mean[..., :1], np.broadcast_to([[1.0, 0.0]], (*mean.shape[:-1], 1, 2))

    def innovation(self, value: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Difference of azimuths, the short way round."""
        return wrap180(value - predicted)

    def feasible(self, channel: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Any azimuth."""
        return np.isfinite(value)

    def born(self, value: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """New sources anywhere around, evidence 1/360°."""
        mean = np.concatenate([value, np.zeros_like(value)], axis=1)
        spread = np.broadcast_to(np.diag([noise[0, 0], self.rate_std_dps**2]), (len(value), 2, 2)).copy()
        return mean, spread, np.full(len(value), -np.log(360.0))


def _log_volume(value: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Log |2πR| over the channels present."""
    present = np.isfinite(value)
    both = present[:, :, None] & present[:, None, :]
    return np.linalg.slogdet(np.where(both, 2.0 * np.pi * noise, np.eye(value.shape[1])))[1]
