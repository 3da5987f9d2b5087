"""A compact array: hydrophone positions in, delays of a plane wave between them out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from obsnet.config import build, read_yaml
from obsnet.errors import ConfigError


@dataclass(frozen=True)
class CompactArray:
    """Where the hydrophones of an array are, close enough together for a plane wave.

    Attributes
    ----------
    east_m, north_m : one value a hydrophone, m from any common origin.
    depth_m : one value a hydrophone, m below the sea surface, positive down.
    sound_speed_mps : sound speed at the array, m/s.
    position_std_m : how well the positions are known, standard deviation of each coordinate, m.

    Raises
    ------
    ConfigError
        Fewer than 3 hydrophones, lists of unequal length, hydrophones in one line, or a value out of range.
    """

    east_m: tuple[float, ...]
    north_m: tuple[float, ...]
    depth_m: tuple[float, ...]
    sound_speed_mps: float = 1500.0
    position_std_m: float = 0.0

    def __post_init__(self) -> None:
        counts = (len(self.east_m), len(self.north_m), len(self.depth_m))
        if len(set(counts)) > 1:
            raise ConfigError(
                f"east_m, north_m and depth_m must have one value a hydrophone, found {counts} values"
            )
        if counts[0] < 3:
            raise ConfigError(f"a direction takes at least 3 hydrophones, found {counts[0]}")
        if not np.isfinite(self.positions).all():
            raise ConfigError(
                "hydrophone positions must be finite numbers; remove the hydrophone that has none"
            )
        if not 300.0 <= self.sound_speed_mps <= 6000.0:
            raise ConfigError(f"sound_speed_mps must lie in 300–6000 m/s, found {self.sound_speed_mps!r}")
        if not (np.isfinite(self.position_std_m) and self.position_std_m >= 0):
            raise ConfigError(f"position_std_m must be at least 0 m, found {self.position_std_m!r}")
        if self.dimension < 2:
            raise ConfigError(
                "the hydrophones lie in one line, which cannot tell azimuths apart; add one beside it"
            )

    @classmethod
    def of(cls, geometry: CompactArray | str | Path | np.ndarray) -> CompactArray:
        """An array as it is, from its YAML file, or from positions (hydrophone, (east, north, depth)) in
        m.
        """
        if isinstance(geometry, cls):
            return geometry
        if isinstance(geometry, (str, Path)):
            return cls.read(geometry)
        try:
            positions = np.asarray(geometry, float)
        except (TypeError, ValueError):
            positions = np.empty(0)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ConfigError(
                "an array's geometry is a CompactArray, a YAML file or positions with dims "
                f"(hydrophone, (east, north, depth)), found {type(geometry).__name__} of shape {positions.shape}"
            )
        east, north, depth = positions.T.tolist()
        return cls(tuple(east), tuple(north), tuple(depth))

    @classmethod
    def read(cls, path: str | Path) -> CompactArray:
        """Array described by a YAML file whose keys are this class's attributes."""
        return build(cls, read_yaml(path), str(path))

    @classmethod
    def tetrahedron(
        cls, edge_m: float = 1.0, depth_m: float = 2000.0, sound_speed_mps: float = 1500.0
    ) -> CompactArray:
        """Regular tetrahedron on its base, its first hydrophone due north, its last one at the top.

        `depth_m` is the depth of the base. The paper's station has this shape, with edges of about 1 m.
        """
        radius = edge_m / np.sqrt(3.0)
        corner = np.deg2rad([0.0, 120.0, 240.0])
        return cls(
            east_m=(*(float(radius * value) for value in np.sin(corner)), 0.0),
            north_m=(*(float(radius * value) for value in np.cos(corner)), 0.0),
            depth_m=(depth_m, depth_m, depth_m, float(depth_m - edge_m * np.sqrt(2.0 / 3.0))),
            sound_speed_mps=sound_speed_mps,
        )

    @property
    def count(self) -> int:
        """Number of hydrophones."""
        return len(self.east_m)

    @property
    def positions(self) -> np.ndarray:
        """Positions, dims (hydrophone, (east, north, down)), m."""
        return np.array([self.east_m, self.north_m, self.depth_m], float).T

    @property
    def dimension(self) -> int:
        """Dimensions that the hydrophones span: 3, 2 where they lie in a plane, 1 in a line."""
        spread = self.positions - self.positions.mean(axis=0)
        values = np.linalg.svd(spread, compute_uv=False)
        return int((values > 1e-3 * max(values[0], 1e-12)).sum())

    @property
    def mean_depth_m(self) -> float:
        """Depth of the array's centre, m."""
        return float(np.mean(self.depth_m))

    @property
    def aperture_s(self) -> float:
        """Longest time that sound takes between two hydrophones, s."""
        return float(np.abs(self.travel(self.pairs())).max())

    def pairs(self, every: bool = True) -> np.ndarray:
        """Pairs (i, j) of hydrophones counted from 0, dims (pair, 2): all with i < j, or those with the first
        one.
        """
        first, second = np.triu_indices(self.count, 1)
        chosen = np.stack([first, second], axis=1)
        return chosen if every else chosen[chosen[:, 0] == 0]

    def baselines(self, pairs: np.ndarray) -> np.ndarray:
        """Vectors from hydrophone i to hydrophone j of each pair, dims (pair, (east, north, down)), m."""
        pairs = np.asarray(pairs)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.min() < 0 or pairs.max() >= self.count:
            raise ConfigError(f"pairs must be two hydrophone numbers each, 0 to {self.count - 1}")
        return self.positions[pairs[:, 1]] - self.positions[pairs[:, 0]]

    def travel(self, pairs: np.ndarray) -> np.ndarray:
        """Time that sound takes along each pair's baseline, dims (pair,), s: the largest TDOA there is."""
        return np.linalg.norm(self.baselines(pairs), axis=1) / self.sound_speed_mps

    def tdoa(self, azimuth_deg: np.ndarray, elevation_deg: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """TDOA t_i − t_j [s] of a plane wave, dims (..., pair): c (t_i − t_j) = ω·(H_j − H_i) (paper's eq.
        2).
        """
        return unit_vector(azimuth_deg, elevation_deg) @ self.baselines(pairs).T / self.sound_speed_mps

    def tdoa_gradient(
        self, azimuth_deg: np.ndarray, elevation_deg: np.ndarray, pairs: np.ndarray
    ) -> np.ndarray:
        """Derivatives of `tdoa` by azimuth and elevation, dims (..., pair, 2), s/deg."""
        east, rise = tangent_vectors(azimuth_deg, elevation_deg)
        by_azimuth = east * np.cos(np.deg2rad(elevation_deg))[..., None]
        slopes = np.stack([by_azimuth, rise], axis=-2) @ self.baselines(pairs).T
        return np.swapaxes(slopes, -1, -2) * (np.pi / 180.0 / self.sound_speed_mps)

    def tdoa_covariance(self, pairs: np.ndarray, timing_std_s: float, pair_std_s: float = 0.0) -> np.ndarray:
        """Covariance of TDOAs, dims (pair, pair), s².

        Arrival times that err by `timing_std_s` at each hydrophone (and by the positions' spread over the
        sound speed) are shared by the pairs that share a hydrophone; `pair_std_s` is each pair's own, as
        rounding to samples is.
        """
        pairs = np.asarray(pairs)
        difference = np.zeros((len(pairs), self.count))
        difference[np.arange(len(pairs)), pairs[:, 0]] = 1.0
        difference[np.arange(len(pairs)), pairs[:, 1]] = -1.0
        shared = timing_std_s**2 + (self.position_std_m / self.sound_speed_mps) ** 2
        return shared * difference @ difference.T + pair_std_s**2 * np.eye(len(pairs))


def unit_vector(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
    """Unit vector ω towards a source, dims (..., (east, north, down)); elevation positive above the
    horizontal.

    The paper's eq. 3 with the project's axes: azimuth clockwise from north, z down.

    >>> unit_vector(90.0, 0.0).round(6).tolist()
    [1.0, 0.0, -0.0]
    """
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    level = np.cos(elevation)
    return np.stack([np.sin(azimuth) * level, np.cos(azimuth) * level, -np.sin(elevation)], axis=-1)


def tangent_vectors(azimuth_deg: np.ndarray, elevation_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of growing azimuth and of growing elevation at a direction, dims (..., (east, north,
    down)).
    """
    azimuth, elevation = np.broadcast_arrays(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg))
    clockwise = np.stack([np.cos(azimuth), -np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    up = np.stack(
        [-np.sin(azimuth) * np.sin(elevation), -np.cos(azimuth) * np.sin(elevation), -np.cos(elevation)],
        axis=-1,
    )
    return clockwise, up


def angles(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth [0, 360) and elevation [deg] of vectors with dims (..., (east, north, down)), of any length."""
    azimuth = np.rad2deg(np.arctan2(vector[..., 0], vector[..., 1])) % 360.0
    elevation = np.rad2deg(np.arctan2(-vector[..., 2], np.hypot(vector[..., 0], vector[..., 1])))
    return azimuth, elevation
