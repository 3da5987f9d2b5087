"""Strength of each path pair's interference against range: skew normals of the cepstrum's envelope."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from obsnet.errors import ConfigError
from obsnet.ocean.rays import parse_pair

TABLE_II_DEPTH_M = 4340.0

_erfc = np.vectorize(math.erfc, otypes=[float])
"""As scipy.special's, which takes longer to import than curves to make."""


@dataclass(frozen=True)
class SkewNormal:
    """Curve a(r) = k/ω · 2φ(x) Φ(αx), x = (r − ξ)/ω (paper's appendix D, eq. D1).

    Parameters
    ----------
    k : area under the curve, m (cepstral amplitude times range).
    alpha : shape; positive leans towards larger ranges.
    xi_m, omega_m : location and scale, m.
    """

    k: float
    alpha: float
    xi_m: float
    omega_m: float

    def __post_init__(self) -> None:
        values = (self.k, self.alpha, self.xi_m, self.omega_m)
        if not np.all(np.isfinite(values)) or self.omega_m <= 0 or self.k < 0:
            raise ConfigError(f"a skew normal needs finite parameters, k >= 0 and omega_m > 0, found {self}")

    def evaluate(self, range_m: np.ndarray) -> np.ndarray:
        """Cepstral amplitude at ranges [m]."""
        x = (np.asarray(range_m, float) - self.xi_m) / self.omega_m
        return (
            self.k
            / self.omega_m
            * np.exp(-0.5 * x**2)
            / np.sqrt(2.0 * np.pi)
            * _erfc(-self.alpha * x / np.sqrt(2.0))
        )


@dataclass(frozen=True)
class Amplitudes:
    """Cepstral amplitude of each path pair against range, and the station depth that it holds for.

    >>> peak = Amplitudes.table_ii().evaluate("1-3", np.arange(0.0, 50e3, 70.0)).max()
    >>> round(float(peak), 3)
    0.083
    """

    curves: Mapping[str, SkewNormal]
    depth_m: float = TABLE_II_DEPTH_M

    def __post_init__(self) -> None:
        for pair in self.curves:
            parse_pair(pair)
        if not self.curves:
            raise ConfigError("amplitudes need one path pair at least, found none")
        if not self.depth_m > 0:
            raise ConfigError(f"depth_m of amplitudes must be > 0, found {self.depth_m}")
        object.__setattr__(self, "curves", MappingProxyType(dict(self.curves)))

    @classmethod
    def table_ii(cls) -> Amplitudes:
        """Amplitudes at station RR03, 4340 m deep (paper's Table II)."""
        curves = {
            "1-3": SkewNormal(8.9e2, 4.0, 8.0e3, 7.5e3),
            "3-5": SkewNormal(1.6e3, 6.0, 14.0e3, 20.0e3),
            "5-7": SkewNormal(1.0e3, 4.0, 27.0e3, 20.0e3),
        }
        return cls(curves)

    @classmethod
    def default(cls) -> Amplitudes:
        """Table II, carried on to the pairs 7-9 and 9-11 that are heard beyond nine depths.

        The paper saw 7-9 faintly at the end of its 50 km and left it out; at a station half as deep the same pairs fill its
        range, and without them their branches are read as nearer ones. Places carry on the table's spacing, strengths its
        decrease: guesses, for a calibration to replace.
        """
        further = {
            "7-9": SkewNormal(0.9e3, 4.0, 40.0e3, 20.0e3),
            "9-11": SkewNormal(0.8e3, 4.0, 53.0e3, 20.0e3),
        }
        return cls({**cls.table_ii().curves, **further})

    @property
    def pairs(self) -> tuple[str, ...]:
        """The path pairs, as given."""
        return tuple(self.curves)

    @classmethod
    def broad(cls) -> Amplitudes:
        """Weak, wide curves for a station and a bottom that nobody has calibrated.

        Where a pair has amplitude a and the detector expects μ, a frame of noise σ is worth (2aμ − μ²)/2σ². Half of the true
        amplitude still earns three quarters of the most there is (μ = a), while an absent pair costs −μ²/2σ². How far a pair
        is heard goes with the bottom: a table fitted at one station reads the pair 1-3 of a near ship, which it does not
        expect inside two depths, as the pair 3-5 of one twice as far and twice as fast. So each curve begins where geometry lets its pair
        begin, lasts as long as a reflecting bottom may let it last, and expects about half.
        """
        curves = {
            "1-3": SkewNormal(0.90e3, 4.0, 3.5e3, 13.9e3),
            "3-5": SkewNormal(1.20e3, 4.0, 13.0e3, 26.0e3),
            "5-7": SkewNormal(0.93e3, 4.0, 23.9e3, 26.0e3),
            "7-9": SkewNormal(0.75e3, 4.0, 36.9e3, 26.0e3),
            "9-11": SkewNormal(0.56e3, 4.0, 49.9e3, 26.0e3),
        }
        return cls(curves)

    def evaluate(self, pair: str, range_m: np.ndarray) -> np.ndarray:
        """Cepstral amplitude of a pair at ranges [m].

        Raises
        ------
        ConfigError
            The pair is not among these amplitudes.
        """
        if pair not in self.curves:
            raise ConfigError(f"no amplitude for path pair {pair!r}; there are {', '.join(self.curves)}")
        return self.curves[pair].evaluate(range_m)

    def scaled_to(self, depth_m: float) -> Amplitudes:
        """Amplitudes at another depth of station: a pair's visibility goes with range over depth."""
        if not (np.isfinite(depth_m) and depth_m > 0):
            raise ConfigError(f"the station's depth must be > 0 m, found {depth_m}")
        s = depth_m / self.depth_m
        scaled = {
            pair: SkewNormal(curve.k * s, curve.alpha, curve.xi_m * s, curve.omega_m * s)
            for pair, curve in self.curves.items()
        }
        return Amplitudes(scaled, depth_m)

    def to_dict(self) -> dict[str, Any]:
        """Plain mapping, ready for YAML or JSON."""
        names = ("k", "alpha", "xi_m", "omega_m")
        curves = {pair: {name: float(getattr(c, name)) for name in names} for pair, c in self.curves.items()}
        return {"depth_m": float(self.depth_m), "pairs": curves}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Amplitudes:
        """Inverse of `to_dict`.

        Raises
        ------
        ConfigError
            A key is missing or a value is not a number.
        """
        try:
            curves = {
                str(pair): SkewNormal(**{key: float(value) for key, value in curve.items()})
                for pair, curve in values["pairs"].items()
            }
            return cls(curves, float(values["depth_m"]))
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(
                f"amplitudes need depth_m and pairs, each with k, alpha, xi_m, omega_m; found {values!r}"
            ) from None
