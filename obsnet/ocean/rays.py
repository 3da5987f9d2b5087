"""Propagation table: each path's delay, pressure and slowness from a surface ship to a flat sea floor.

Path k crosses the water column k = 1, 3, 5, … times: before it arrives it has met the sea floor
(k − 1)/2 times and the surface (k − 1)/2 times.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import PROPAGATION, require
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.sound_speed import OceanConfig, SoundSpeed
from obsnet.output import aside

PATHS = (1, 3, 5, 7, 9, 11)
STEEP_RAYS, GRAZING_RAYS = 1200, 300


@dataclass(frozen=True, eq=False)
class Crossing:
    """A fan of rays that cross the water column once, by increasing range.

    Parameters
    ----------
    slowness, slowness_slope : horizontal slowness p [s/m] and dp/dr [s/m²].
    range_m, delay : horizontal range [m] and travel time [s].
    intensity : squared pressure [1/m²] for unit pressure at 1 m from the source.
    """

    slowness: np.ndarray
    slowness_slope: np.ndarray
    range_m: np.ndarray
    delay: np.ndarray
    intensity: np.ndarray

    @classmethod
    def trace(cls, depths: np.ndarray, speeds: np.ndarray) -> Crossing:
        """Cross layers of constant gradient between nodes: depths [m], speeds [m/s].

        With s = √(1 − p²c²) at a layer's top (1) and bottom (2) and Δz its thickness, the textbook forms are

            Δr     = p (c₁ + c₂) Δz / (s₁ + s₂),        dΔr/dp = (c₁ + c₂) Δz / (s₁ s₂ (s₁ + s₂)),
            Δt     = Δz [2 A(u)/(c₁ + c₂) + 2p² (c₁ + c₂) A(w) / ((s₁ + s₂)(2 + s₁ + s₂))],
            A(y) = artanh(y)/y,    u = (c₂ − c₁)/(c₂ + c₁),    w = p² (c₂² − c₁²) / ((s₁ + s₂)(2 + s₁ + s₂)),

        free of cancellation for any gradient, zero included. The energy in a ray tube, |P|²/c · 2πr cos θ dr,
        is that radiated into 2π sin θ₀ dθ₀: |P|² = (p/r)(dp/dr) c_top c_bottom / (s_top s_bottom).

        dr/dp > 0 in every layer: a ray that crosses the column meets no caustic, and one ray reaches each
        range. Rays cross while p < 1/max(c); where the fastest water is a single depth, that limits the
        range.

        Source: Jensen et al. 2011, Computational Ocean Acoustics, §3.3 and §3.5.
        """
        edge = np.pi / 2 / STEEP_RAYS
        steep = np.linspace(np.pi / 2, edge, STEEP_RAYS)
        grazing = np.concatenate((steep, np.geomspace(edge, 1e-6, GRAZING_RAYS)[1:]))
        slowness = np.cos(grazing) / speeds.max()
        slowness[0] = 0.0
        square, ratio = slowness[:, None] ** 2, speeds / speeds.max()
        s = np.sqrt((1.0 - ratio) * (1.0 + ratio) + (ratio * np.sin(grazing)[:, None]) ** 2)
        total, contrast, thickness = speeds[:-1] + speeds[1:], np.diff(speeds), np.diff(depths)
        both, product = s[:, :-1] + s[:, 1:], s[:, :-1] * s[:, 1:]
        reach = total * thickness / both
        bend = square * total / (both * (2.0 + both))
        vertical = np.sum(2.0 * thickness / total * _artanh_ratio(contrast / total))
        oblique = np.sum(2.0 * thickness * bend * _artanh_ratio(bend * contrast), axis=1)
        chord = reach.sum(axis=1)
        slope = 1.0 / np.sum(reach / product, axis=1)
        spread = speeds[0] * speeds[-1] / (s[:, 0] * s[:, -1])
        fan = (slowness, slope, slowness * chord, vertical + oblique, slope / chord * spread)
        distinct = np.concatenate(([True], np.diff(fan[2]) > 0))
        return cls(*(values[distinct] for values in fan))

    def at(self, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Delay [s], slowness [s/m] and intensity [1/m²] at ranges [m]; NaN beyond the last ray.

        The delay's slope is the slowness itself and the slowness's is known, so both are cubic between rays.
        """
        delay = _hermite(range_m, self.range_m, self.delay, self.slowness)
        slowness = _hermite(range_m, self.range_m, self.slowness, self.slowness_slope)
        return delay, slowness, np.interp(range_m, self.range_m, self.intensity, right=np.nan)


def propagation(
    profile: SoundSpeed,
    depth_m: float,
    bottom: Bottom,
    ranges_m: np.ndarray,
    paths: Sequence[int] = PATHS,
) -> xr.Dataset:
    """Delay, pressure and slowness of each path against range, for a receiver on the sea floor.

    The pressure is that of incident and reflected waves together, for unit pressure at 1 m from a source just
    below the surface but without the surface's mirror image (the source's dipole), fields exp(+iωt):

        P_k = √intensity (−R)^((k − 1)/2) (1 + R),

    R the bottom's reflection coefficient and −1 the surface's.

    Parameters
    ----------
    profile : sound speed.
    depth_m : of the station, m.
    bottom : elastic properties of the sea floor.
    ranges_m : horizontal ranges, m, increasing from 0 or more.
    paths : numbers of crossings, odd and increasing.

    Returns
    -------
    Dataset, dims (path, range): delay [s], pressure complex128 [1/m], slowness [s/m] (dτ/dr), reflection
    complex128 (R at the station's side of the path). NaN beyond the limiting range of a path.

    Raises
    ------
    ConfigError
        Ranges or paths out of order, a depth that is not positive, a profile too short.
    """
    ranges = _checked_ranges(ranges_m)
    numbers = _checked_paths(paths)
    nodes, speeds = profile.column(depth_m)
    single = ranges / numbers[:, None]
    delay, slowness, intensity = Crossing.trace(nodes, speeds).at(single)
    reflection = bottom.reflection(slowness, speeds[-1])
    bounces = (numbers[:, None] - 1) // 2
    pressure = np.sqrt(intensity) / numbers[:, None] * (-reflection) ** bounces * (1.0 + reflection)
    attrs = {
        "depth_m": float(depth_m),
        "profile": profile.name,
        "surface_speed_mps": float(speeds[0]),
        "seafloor_speed_mps": float(speeds[-1]),
        "bottom": bottom.describe(),
        "water_density_kgm3": bottom.water_density_kgm3,
        "convention": "exp(+iωt)",
    }
    return _dataset(numbers, ranges, numbers[:, None] * delay, pressure, slowness, reflection, attrs)


def propagation_table(config: OceanConfig, depth_m: float, kept: Path | None = None) -> xr.Dataset:
    """Propagation table of a station: the user's own file where one is named, else by ray tracing.

    Echoes are as late as `config.echo_delay_s` says. `kept` is the file of a table that was used as it is.
    """
    if kept is not None:
        return read_propagation(kept)
    if config.propagation_file:
        table = read_propagation(config.propagation_file)
        table.attrs.setdefault("depth_m", float(depth_m))
    else:
        table = propagation(config.sound_speed(), depth_m, config.bottom, config.ranges(), config.paths)
    return delay_echoes(table, config.echo_delay_s) if config.echo_delay_s else table


def delay_echoes(table: xr.Dataset, echo_delay_s: float) -> xr.Dataset:
    """Propagation table of a sea floor whose echo comes later than that of the water's edge.

    What a soft sediment lets through returns from a harder layer below it. With T the two-way vertical time
    [s] to that layer and sound there as fast as in the water above (c), each of the (k − 1)/2 echoes of path
    k adds T √(1 − p²c²), p being its slowness. Pressures are left as they are.
    """
    require(table, PROPAGATION)
    speed = float(table.attrs.get("seafloor_speed_mps", 1500.0))
    table = table.transpose("path", "range", ...)
    echoes = (table["path"].values[:, None] - 1) // 2
    steepness = np.sqrt(np.clip(1.0 - (table["slowness"].values * speed) ** 2, 0.0, None))
    later = float(echo_delay_s) * echoes * steepness
    slower = np.full(later.shape, np.nan)
    for row, exists in enumerate(np.isfinite(later)):
        if exists.sum() > 1:
            slower[row, exists] = np.gradient(later[row, exists], table["range"].values[exists])
    delays = {"delay": later, "slowness": slower}
    moved = {
        name: (table[name].dims, table[name].values + more, table[name].attrs)
        for name, more in delays.items()
    }
    return table.assign(moved).assign_attrs(
        echo_delay_s=table.attrs.get("echo_delay_s", 0.0) + float(echo_delay_s)
    )


def read_propagation(path: str | Path) -> xr.Dataset:
    """Read a propagation table from netCDF.

    Two forms are taken: obsnet's own (`write_propagation`: dims path and range, variables delay,
    pressure_real, pressure_imag, and slowness or none), and the core paper's authors' (dims path and
    distance, variables toa, amplitude_real, amplitude_imag, path n crossing the column 2n − 1 times).

    Raises
    ------
    LayoutError
        The file is not netCDF or holds neither form.
    ConfigError
        Its ranges or paths are out of order.
    """
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            table = file.load()
    except (OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise LayoutError(f"cannot read the propagation table {path} as netCDF 4: {reason}") from None
    if "toa" in table and "distance" in table.coords:
        table = table.rename(
            distance="range", toa="delay", amplitude_real="pressure_real", amplitude_imag="pressure_imag"
        )
        table = table.assign_coords(path=2 * table["path"] - 1)
    absent = [name for name in ("delay", "pressure_real", "pressure_imag") if name not in table]
    absent += [dim for dim in PROPAGATION.dims if dim not in table.dims or dim not in table.coords]
    if absent:
        raise LayoutError(
            f"propagation table {path} lacks {', '.join(absent)}; "
            f"it holds {', '.join(map(str, table.variables))}"
        )
    table = table.transpose("path", "range", ...)
    ranges, numbers = _checked_ranges(table["range"].values), _checked_paths(table["path"].values)
    delay = table["delay"].values.astype(float)
    pressure = table["pressure_real"].values + 1j * table["pressure_imag"].values
    if "slowness" in table:
        slowness = table["slowness"].values.astype(float)
    else:
        slowness = np.gradient(delay, ranges, axis=1)
    reflection = np.full(delay.shape, np.nan + 0j)
    if "reflection_real" in table and "reflection_imag" in table:
        reflection = table["reflection_real"].values + 1j * table["reflection_imag"].values
    attrs = {"profile": Path(path).name} | dict(table.attrs)
    return _dataset(numbers, ranges, delay, pressure, slowness, reflection, attrs)


def write_propagation(table: xr.Dataset, path: str | Path) -> None:
    """Write a propagation table as netCDF, complex values as pairs of real ones; `OutputError` where it cannot be."""
    require(table, PROPAGATION)
    plain = table.drop_vars([name for name in ("pressure", "reflection") if name in table])
    for name in ("pressure", "reflection"):
        if name in table:
            plain[f"{name}_real"], plain[f"{name}_imag"] = table[name].real, table[name].imag
    with aside(Path(path)) as partial:
        plain.to_netcdf(partial, engine="h5netcdf")


def interpolate(table: xr.Dataset, range_m: np.ndarray) -> xr.Dataset:
    """Propagation table at other ranges [m]: delays cubic, the rest linear; NaN outside the table."""
    require(table, PROPAGATION)
    wanted = np.atleast_1d(np.asarray(range_m, float))
    ranges = table["range"].values
    rows = [_interpolated_path(table.isel(path=i), ranges, wanted) for i in range(table.sizes["path"])]
    delay, pressure, slowness, reflection = (np.stack(values) for values in zip(*rows, strict=True))
    return _dataset(table["path"].values, wanted, delay, pressure, slowness, reflection, table.attrs)


def strongest_delay(table: xr.Dataset, range_m: np.ndarray | None = None) -> xr.DataArray:
    """Delay [s] of the path with the greatest pressure at each range; NaN where no path exists.

    This is the travel time by which what is heard left the ship earlier.
    """
    table = table if range_m is None else interpolate(table, range_m)
    require(table, PROPAGATION)
    strength = np.nan_to_num(np.abs(table["pressure"].transpose("path", "range").values), nan=-1.0)
    delay = table["delay"].transpose("path", "range").values
    strongest = np.take_along_axis(delay, strength.argmax(axis=0)[None], axis=0)[0]
    return xr.DataArray(strongest, {"range": table["range"]}, ("range",), "delay", {"units": "s"})


def travel_time(table: xr.Dataset) -> Callable[[np.ndarray], np.ndarray]:
    """Travel time [s] of the loudest path as a function of range [m], going on straight beyond the table.

    Raises
    ------
    LayoutError
        No path exists in the table at two ranges.
    """
    delay = strongest_delay(table)
    exists = np.isfinite(delay.values)
    grid, values = delay["range"].values[exists].astype(float), delay.values[exists]
    if grid.size < 2:
        raise LayoutError("no path exists in the propagation table; check its depth and ranges")
    slope = (values[-1] - values[-2]) / (grid[-1] - grid[-2])

    def at(range_m: np.ndarray) -> np.ndarray:
        distance = np.abs(np.asarray(range_m, float))
        return np.interp(distance, grid, values) + slope * np.maximum(distance - grid[-1], 0.0)

    return at


def tdoa(table: xr.Dataset, pair: str, range_m: np.ndarray | None = None) -> xr.DataArray:
    """Delay of a pair's second path after its first [s], dims (range); `pair` like "1-3"."""
    first, second = _pair(table, pair, range_m)
    values = second["delay"].values - first["delay"].values
    return xr.DataArray(
        values, {"range": second["range"]}, ("range",), "tdoa", {"units": "s", "path_pair": pair}
    )


def phase_difference(table: xr.Dataset, pair: str, range_m: np.ndarray | None = None) -> xr.DataArray:
    """Phase of a pair's second path minus its first's [deg], in [−180, 180), fields exp(+iωt)."""
    first, second = _pair(table, pair, range_m)
    values = np.rad2deg(np.angle(second["pressure"].values * first["pressure"].values.conj()))
    values = np.where(values >= 180.0, values - 360.0, values)
    attrs = {"units": "deg", "path_pair": pair}
    return xr.DataArray(values, {"range": second["range"]}, ("range",), "phase_difference", attrs)


def parse_pair(pair: str) -> tuple[int, int]:
    """Paths of a pair.

    >>> parse_pair("1-3")
    (1, 3)
    """
    try:
        first, second = (int(part) for part in pair.split("-"))
    except (ValueError, AttributeError):
        raise ConfigError(f"a path pair is written like '1-3', found {pair!r}") from None
    if first == second:
        raise ConfigError(f"a path pair takes two paths, found {pair!r}")
    return first, second


def _pair(table: xr.Dataset, pair: str, range_m: np.ndarray | None) -> tuple[xr.Dataset, xr.Dataset]:
    require(table, PROPAGATION)
    numbers = table["path"].values
    missing = [number for number in parse_pair(pair) if number not in numbers]
    if missing:
        raise ConfigError(
            f"path pair {pair} needs path {missing[0]}; the propagation table holds {numbers.tolist()}"
        )
    both = table.sel(path=list(parse_pair(pair)))
    both = both if range_m is None else interpolate(both, range_m)
    return both.isel(path=0), both.isel(path=1)


def _interpolated_path(path: xr.Dataset, ranges: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, ...]:
    exists = np.isfinite(path["delay"].values) & np.isfinite(path["slowness"].values)
    if exists.sum() < 2:
        empty = np.full(wanted.shape, np.nan)
        return empty, empty.astype(complex), empty, empty.astype(complex)
    known = ranges[exists]

    def linear(name: str) -> np.ndarray:
        return np.interp(wanted, known, path[name].values[exists], left=np.nan, right=np.nan)

    delay = _hermite(wanted, known, path["delay"].values[exists], path["slowness"].values[exists])
    reflection = linear("reflection") if "reflection" in path else np.full(wanted.shape, np.nan + 0j)
    return delay, linear("pressure"), linear("slowness"), reflection


def _hermite(x: np.ndarray, nodes: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, nodes.size - 2)
    width = nodes[i + 1] - nodes[i]
    t = (x - nodes[i]) / width
    rise = values[i + 1] - values[i]
    a = slopes[i] * width - rise
    b = rise - slopes[i + 1] * width
    inside = (x >= nodes[0]) & (x <= nodes[-1])
    return np.where(inside, values[i] + t * rise + t * (1.0 - t) * (a * (1.0 - t) + b * t), np.nan)


def _artanh_ratio(y: np.ndarray) -> np.ndarray:
    """artanh(y)/y: a series where y is small, as between near nodes."""
    square = y * y
    if square.max(initial=0.0) < 1e-4:
        return 1.0 + square * (1 / 3 + square * (1 / 5 + square / 7))
    safe = np.maximum(np.abs(y), 1e-4)
    return np.where(square < 1e-8, 1.0 + square / 3, np.arctanh(safe) / safe)


def _checked_ranges(ranges_m: np.ndarray) -> np.ndarray:
    ranges = np.atleast_1d(np.asarray(ranges_m, float))
    if ranges.ndim != 1 or ranges.size < 2 or not ranges[0] >= 0 or not np.all(np.diff(ranges) > 0):
        raise ConfigError(
            f"ranges of a propagation table must increase from 0 m or more, found {ranges.ravel()[:5]}"
        )
    return ranges


def _checked_paths(paths: Sequence[int] | np.ndarray) -> np.ndarray:
    numbers = np.asarray(paths)
    whole = numbers.ndim == 1 and numbers.size > 0 and np.issubdtype(numbers.dtype, np.integer)
    if not whole or numbers[0] < 1 or np.any(numbers % 2 == 0) or np.any(np.diff(numbers) <= 0):
        raise ConfigError(
            f"paths must be increasing odd numbers of crossings like (1, 3, 5), found {tuple(paths)}"
        )
    return numbers


def _dataset(
    numbers: np.ndarray,
    ranges: np.ndarray,
    delay: np.ndarray,
    pressure: np.ndarray,
    slowness: np.ndarray,
    reflection: np.ndarray,
    attrs: dict,
) -> xr.Dataset:
    dims = ("path", "range")
    return xr.Dataset(
        {
            "delay": (dims, delay, {"units": "s"}),
            "pressure": (dims, pressure, {"units": "1/m", "long_name": "pressure for unit pressure at 1 m"}),
            "slowness": (dims, slowness, {"units": "s/m"}),
            "reflection": (dims, reflection, {"units": "1"}),
        },
        {
            "path": ("path", numbers, {"long_name": "number of water-column crossings"}),
            "range": ("range", ranges, {"units": "m"}),
        },
        attrs,
    )
