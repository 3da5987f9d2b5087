"""The sea floor as an elastic half-space: its plane-wave reflection against horizontal slowness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError


@dataclass(frozen=True)
class Bottom:
    """Semi-infinite elastic bottom under water; the defaults are the core paper's (P 2000 m/s, S 500 m/s).

    Parameters
    ----------
    p_speed_mps, s_speed_mps : speeds of compressional and shear waves, m/s; shear 0 for a fluid.
    density_kgm3, water_density_kgm3 : densities, kg/m³. The paper prints none; the ratio
        of 2 is that of the propagation table which its authors published.
    """

    p_speed_mps: float = 2000.0
    s_speed_mps: float = 500.0
    density_kgm3: float = 2060.0
    water_density_kgm3: float = 1030.0

    def __post_init__(self) -> None:
        for name in ("p_speed_mps", "density_kgm3", "water_density_kgm3"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name} of the bottom must be > 0, found {value}")
        if not 0 <= self.s_speed_mps < self.p_speed_mps / np.sqrt(4 / 3):
            raise ConfigError(
                f"s_speed_mps of the bottom must be >= 0 and below 0.866 p_speed_mps ({self.p_speed_mps:g}), "
                f"found {self.s_speed_mps:g}; use 0 for a fluid sediment"
            )

    def reflection(self, slowness: np.ndarray, water_speed_mps: float) -> np.ndarray:
        """Plane-wave pressure reflection coefficient R for fields exp(+iωt).

        With horizontal slowness p and vertical slownesses q = √(1/c² − p²) of the water, q_α and q_β of the
        bottom's P and S waves, continuity of pressure and vertical velocity and zero shear stress give

            R = (Z − ρ_w/q) / (Z + ρ_w/q),    Z = ρ [(1 − 2β²p²)² / q_α + 4β⁴p² q_β].

        A wave exp(iω(t − px − qz)) that goes down must decay where p exceeds 1/α, so q_α = −i√(p² − 1/α²)
        there: total reflection advances the phase, up to π at grazing, and displaces a beam forward
        by d(arg R)/d(ωp).

        Parameters
        ----------
        slowness : array, s/m, from 0 to 1/water_speed_mps; NaN gives NaN.
        water_speed_mps : sound speed just above the sea floor, m/s.

        Returns
        -------
        complex128 array like `slowness`; |R| ≤ 1. The pressure on the sea floor is (1 + R) times the incident
        one.

        Source: Jensen et al. 2011, Computational Ocean Acoustics, §1.6 (there with exp(−iωt)).
        """
        p = np.asarray(slowness, float)
        water = _vertical(p, water_speed_mps)
        compressional = _vertical(p, self.p_speed_mps)
        shear = 2.0 * self.s_speed_mps**2 * p**2
        # Times q·q_α: no division by a vertical slowness that vanishes at a critical angle or at grazing.
        solid = self.density_kgm3 * (1.0 - shear) ** 2 * water
        if self.s_speed_mps > 0:
            coupling = 4.0 * self.s_speed_mps**4 * p**2 * _vertical(p, self.s_speed_mps)
            solid = solid + self.density_kgm3 * coupling * compressional * water
        fluid = self.water_density_kgm3 * compressional
        with np.errstate(invalid="ignore"):
            return (solid - fluid) / (solid + fluid)

    def describe(self) -> str:
        """Describe the bottom in one line, for reports."""
        speeds = f"P {self.p_speed_mps:g} m/s, S {self.s_speed_mps:g} m/s"
        return f"{speeds}, {self.density_kgm3:g} kg/m³ under water of {self.water_density_kgm3:g}"


def _vertical(slowness: np.ndarray, speed: float) -> np.ndarray:
    square = 1.0 / speed**2 - slowness**2
    root = np.sqrt(np.abs(square))
    return np.where(square >= 0, root, -1j * root)
