"""Sound speed against depth, by Munk's form, a table or a constant; the ocean's configuration."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from obsnet.errors import ConfigError
from obsnet.ocean.bottom import Bottom

MOST_NODES, MOST_RANGES = 100_000, 1_000_000
PRESSURE_GRADIENT = 0.0163
"""Growth of sound speed with depth in water of one temperature and salinity, (m/s)/m."""


@dataclass(frozen=True)
class Munk:
    """Munk's canonical profile c(z) = c₁ (1 + ε (ζ − 1 + e^−ζ)), ζ = 2(z − z₁)/B, under a mixed layer.

    The defaults describe the south-western Indian Ocean: fitted to the delays of the table that the core
    paper's authors published for station RR03, they give its delays within 0.2 ms and its largest range of
    the direct path within 2 %. In the mixed layer the speed grows with pressure alone.

    Source: Munk 1974, JASA 55, 220, doi:10.1121/1.1914492, eq. (2).
    """

    axis_speed_mps: float = 1487.842
    axis_depth_m: float = 1232.0
    scale_m: float = 1166.0
    epsilon: float = 0.00655
    mixed_layer_m: float = 10.0

    def __post_init__(self) -> None:
        for name in ("axis_speed_mps", "axis_depth_m", "scale_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} of the Munk profile must be > 0, found {getattr(self, name)}")
        for name in ("epsilon", "mixed_layer_m"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} of the Munk profile must be >= 0, found {getattr(self, name)}")

    def speed(self, depth_m: np.ndarray) -> np.ndarray:
        """Sound speed [m/s] at depths [m].

        >>> round(float(Munk(1500.0, 1300.0, 1300.0, 0.00737, 0.0).speed(0.0)), 1)
        1548.5
        """
        depth = np.asarray(depth_m, float)
        below = np.maximum(depth, self.mixed_layer_m)
        zeta = 2.0 * (below - self.axis_depth_m) / self.scale_m
        speed = self.axis_speed_mps * (1.0 + self.epsilon * (zeta - 1.0 + np.exp(-zeta)))
        return speed - PRESSURE_GRADIENT * (below - depth)

    def nodes(self, depth_m: float, error_mps: float = 0.001) -> np.ndarray:
        """Depths [m] down to `depth_m` between which a straight line misses the curve by `error_mps`."""
        curvature = 4.0 * self.axis_speed_mps * self.epsilon / self.scale_m**2
        top = min(self.mixed_layer_m, depth_m)

        def scale(z: float) -> float:
            return self.scale_m * np.exp(-(z - self.axis_depth_m) / self.scale_m)

        # Steps of √(8·error/c″), c″ ∝ e^−ζ: equal steps of e^(−ζ/2).
        step = np.sqrt(8.0 * error_mps / max(curvature, 1e-12))
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.ceil((scale(top) - scale(depth_m)) / step)
        if not steps < MOST_NODES or scale(depth_m) == 0.0:
            raise ConfigError(f"no ocean has the sound speeds of {self}; correct its numbers")
        levels = np.linspace(scale(top), scale(depth_m), max(int(steps) + 1, 2))
        depths = self.axis_depth_m - self.scale_m * np.log(levels / self.scale_m)
        depths[0], depths[-1] = top, depth_m
        return np.unique(np.concatenate(([0.0], depths)))


@dataclass(frozen=True, eq=False)
class SoundSpeed:
    """A sound-speed profile, linear between nodes.

    Parameters
    ----------
    name : of the profile, for tables and reports.
    depth_m : nodes, m, increasing from the surface.
    speed_mps : at the nodes, m/s.

    Raises
    ------
    ConfigError
        Fewer than two nodes, depths that do not increase, or speeds that are not those of sea water in m/s.
    """

    name: str
    depth_m: np.ndarray
    speed_mps: np.ndarray

    def __post_init__(self) -> None:
        depth, speed = np.atleast_1d(self.depth_m).astype(float), np.atleast_1d(self.speed_mps).astype(float)
        object.__setattr__(self, "depth_m", depth)
        object.__setattr__(self, "speed_mps", speed)
        where = f"sound-speed profile {self.name}"
        if depth.ndim != 1 or depth.shape != speed.shape or depth.size < 2:
            raise ConfigError(
                f"{where} must have two nodes or more, as many depths as speeds; found {depth.size} depths "
                f"and {speed.size} speeds"
            )
        if not np.all(np.isfinite(depth)) or depth[0] < 0 or np.any(np.diff(depth) <= 0):
            raise ConfigError(
                f"depths of {where} must increase from 0 m or more downwards; found {depth[:5]}"
            )
        if not np.all((speed > 1300.0) & (speed < 1800.0)):
            raise ConfigError(
                f"speeds of {where} must lie between 1300 and 1800 m/s, found {np.min(speed):g} to "
                f"{np.max(speed):g}; give them in m/s"
            )

    @classmethod
    def constant(cls, speed_mps: float) -> SoundSpeed:
        """Build a profile of one speed everywhere."""
        return cls("constant", np.array([0.0, 12000.0]), np.array([speed_mps, speed_mps]))

    @classmethod
    def munk(cls, parameters: Munk | None = None, depth_m: float = 12000.0) -> SoundSpeed:
        """Munk's profile down to `depth_m`, within 1 mm/s of the curve."""
        parameters = parameters or Munk()
        nodes = parameters.nodes(depth_m)
        return cls("munk", nodes, parameters.speed(nodes))

    @classmethod
    def read(cls, path: str | Path) -> SoundSpeed:
        """Read a table of depth [m] and speed [m/s]: two columns, any of comma, semicolon and blanks, `#`
        comments.

        One line of column names is allowed.

        Raises
        ------
        ConfigError
            The file cannot be read, or a row is not two numbers (its line is named).
        """
        try:
            lines = Path(path).read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise ConfigError(f"cannot read the sound-speed table {path}: {reason}") from None
        rows: list[list[float]] = []
        named = False
        for number, line in enumerate(lines, 1):
            fields = [part for part in re.split(r"[,;\s]+", line.split("#")[0].strip()) if part]
            if not fields:
                continue
            try:
                depth, speed = (float(part) for part in fields)
            except ValueError:
                if rows or named:
                    raise ConfigError(
                        f"line {number} of the sound-speed table {path} must hold a depth in m and "
                        f"a speed in m/s, found {line.strip()!r}"
                    ) from None
                named = True
                continue
            rows.append([depth, speed])
        if len(rows) < 2:
            raise ConfigError(
                f"the sound-speed table {path} must hold two rows of depth and speed, found {len(rows)}"
            )
        depths, speeds = np.array(rows).T
        return cls(Path(path).stem, depths, speeds)

    def speed(self, depth_m: np.ndarray | float) -> np.ndarray:
        """Sound speed [m/s] at depths [m]; below the last node it grows by the pressure's gradient."""
        depth = np.asarray(depth_m, float)
        below = np.maximum(depth - self.depth_m[-1], 0.0)
        return np.interp(depth, self.depth_m, self.speed_mps) + PRESSURE_GRADIENT * below

    def column(self, depth_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Nodes [m] and speeds [m/s] of the water column from the surface to `depth_m`.

        Raises
        ------
        ConfigError
            The depth is not positive, or the profile covers less than half of it.
        """
        if not (np.isfinite(depth_m) and depth_m > 0):
            raise ConfigError(
                f"the station must lie below the surface, its depth is {depth_m} m; correct its elevation"
            )
        if self.depth_m[-1] < 0.5 * depth_m:
            raise ConfigError(
                f"sound-speed profile {self.name} ends at {self.depth_m[-1]:g} m, less than half the "
                f"station's depth of {depth_m:g} m; extend it"
            )
        inner = self.depth_m[(self.depth_m > 0) & (self.depth_m < depth_m)]
        nodes = np.concatenate(([0.0], inner, [depth_m]))
        return nodes, self.speed(nodes)


@dataclass(frozen=True)
class OceanConfig:
    """The ocean around a station, and the grid of its propagation table.

    Parameters
    ----------
    profile : "munk" (parameters in `munk`), "constant" (`sound_speed_mps`) or "table" (`table_file`: depth,
        speed).
    propagation_file : netCDF propagation table of the user's own, instead of the ray tracer.
    bottom : elastic properties of the sea floor.
    echo_delay_s : by how much its echo is late at vertical incidence, as from below a soft sediment (see
        `delay_echoes`); ``obsnet calibrate`` finds it.
    max_range_m, range_step_m : of the table, m.
    paths : numbers of water-column crossings, odd.
    """

    profile: Literal["munk", "constant", "table"] = "munk"
    sound_speed_mps: float = 1505.0
    table_file: str | None = None
    propagation_file: str | None = None
    munk: Munk = field(default_factory=Munk)
    bottom: Bottom = field(default_factory=Bottom)
    echo_delay_s: float = 0.0
    max_range_m: float = 100_000.0
    range_step_m: float = 70.0
    paths: tuple[int, ...] = (1, 3, 5, 7, 9, 11)

    def __post_init__(self) -> None:
        if self.profile not in ("munk", "constant", "table"):
            raise ConfigError(f"profile must be one of munk, constant, table, found {self.profile!r}")
        if self.profile == "table" and not self.table_file:
            raise ConfigError("profile 'table' needs table_file, a file of depth in m and sound speed in m/s")
        if not 1300.0 < self.sound_speed_mps < 1800.0:
            raise ConfigError(
                f"sound_speed_mps must lie between 1300 and 1800, found {self.sound_speed_mps:g}"
            )
        if not 0 < self.range_step_m < self.max_range_m:
            raise ConfigError(
                f"range_step_m must be > 0 and below max_range_m ({self.max_range_m:g}), "
                f"found {self.range_step_m:g}"
            )
        if not self.max_range_m / self.range_step_m <= MOST_RANGES:
            raise ConfigError(
                f"range_step_m must make at most {MOST_RANGES} ranges up to max_range_m ({self.max_range_m:g}), "
                f"found {self.range_step_m:g}"
            )
        if not -1.0 <= self.echo_delay_s <= 1.0:
            raise ConfigError(f"echo_delay_s must lie in [-1, 1] s, found {self.echo_delay_s:g}")
        if self.table_file and self.profile != "table":
            raise ConfigError(f"table_file is for profile 'table', found profile {self.profile!r}")

    def sound_speed(self) -> SoundSpeed:
        """Build the profile that this configuration names."""
        if self.profile == "constant":
            return SoundSpeed.constant(self.sound_speed_mps)
        if self.profile == "table":
            return SoundSpeed.read(str(self.table_file))
        return SoundSpeed.munk(self.munk)

    def ranges(self) -> np.ndarray:
        """Ranges [m] of the table, from 0 up to `max_range_m`."""
        return np.arange(0.0, self.max_range_m + 0.5 * self.range_step_m, self.range_step_m)
