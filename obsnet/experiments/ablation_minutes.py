"""Likelihood maps and the truth in, one row a minute out: what a detector says, how far off it is, what it costs in nats."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr
from scipy.special import logsumexp

from obsnet.detectors.maps import azimuth_presence, range_presence, two_sided
from obsnet.kinematics import wrap180
from obsnet.layout import to_posix

CELL_PRIOR = 0.02
"""Prior odds of a ship in an azimuth cell against none anywhere, for the negative log likelihood of a cell."""
CELL_DEG = 5.0
RANGE_LIMIT_M = 50e3
SAMPLE_EVERY = 6
"""Of a validation record's minutes, one in so many is kept with its whole range map to recalibrate on."""


def truth_at(truth: pd.DataFrame, times: np.ndarray) -> np.ndarray:
    """Azimuth [deg], range [m], range rate [m/s] of each ship as heard at `times`, (ship, 3, time); NaN where unknown."""
    ships = []
    for _, rows in truth.groupby("mmsi"):
        at = to_posix(
            pd.to_datetime(rows["time"], utc=True, format="ISO8601").dt.tz_localize(None).to_numpy()
        )
        order = np.argsort(at)
        columns = rows[["azimuth_deg", "range_m", "range_rate_mps"]].to_numpy(float)[order]
        columns[:, 0] = np.rad2deg(np.unwrap(np.deg2rad(columns[:, 0])))
        ship = [np.interp(times, at[order], column, left=np.nan, right=np.nan) for column in columns.T]
        ships.append(ship)
    made = np.array(ships).reshape(len(ships), 3, len(times))
    made[:, 0] %= 360.0
    return made


def minute_table(maps: xr.Dataset, truth: pd.DataFrame) -> pd.DataFrame:
    """One row a minute.

    Returns
    -------
    DataFrame of time (s since 1970), covered, range_true_m (of the nearest ship), and for azimuth and range each: `_llr` (log presence
    ratio), `_error` of the most likely cell against the ship that it fits best (NaN without ship), `_right`, `_nll`.
    """
    times = to_posix(maps["time"].values)
    ships = truth_at(truth, times)
    nearest = (
        np.full(len(times), np.inf)
        if not len(ships)
        else np.nanmin(np.where(np.isnan(ships[:, 1]), np.inf, ships[:, 1]), axis=0)
    )
    table: dict[str, np.ndarray] = {
        "time": times,
        "range_true_m": np.where(np.isinf(nearest), np.nan, nearest),
    }
    covered = np.zeros(len(times), bool)
    for sensor, add in (("azimuth", _azimuth), ("range", _range)):
        if f"{sensor}_llr" in maps:
            covered |= maps[f"{sensor}_coverage"].values > 0
            with np.errstate(invalid="ignore", divide="ignore"):
                table |= add(maps, ships)
    return pd.DataFrame(table | {"covered": covered.astype(int)})


def _azimuth(maps: xr.Dataset, ships: np.ndarray) -> dict[str, np.ndarray]:
    llr, grid = maps["azimuth_llr"].values.astype(float), maps["azimuth"].values
    best = grid[np.nan_to_num(llr, nan=-np.inf).argmax(axis=1)]
    period = np.where(two_sided(llr), 180.0, float(maps["azimuth"].attrs.get("ambiguity_deg", 360)))
    error = _least(wrap180((best - ships[:, 0]) * 360.0 / period) * period / 360.0, llr.shape[0])
    cells, holds = azimuth_cells(maps, ships)
    return {
        "azimuth_llr": azimuth_presence(llr), "azimuth_deg": best, "azimuth_error": error,
        "azimuth_right": (abs(error) <= 10.0).astype(int), "azimuth_nll": azimuth_nll(cells, holds),
    }  # fmt: skip


def azimuth_cells(maps: xr.Dataset, ships: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratios of cells of `CELL_DEG`, and whether a ship is in them, (minute, cell)."""
    grid = maps["azimuth"].values
    step = max(round(CELL_DEG / float(grid[1] - grid[0])), 1)
    at = grid[::step]
    holds = np.zeros((maps.sizes["time"], len(at)), bool)
    for ship in ships[:, 0]:
        with np.errstate(invalid="ignore"):
            holds |= abs(wrap180(at[None, :] - ship[:, None])) <= CELL_DEG / 2
    return maps["azimuth_llr"].values[:, ::step].astype(float), holds


def azimuth_nll(cells: np.ndarray, holds: np.ndarray) -> np.ndarray:
    """Mean negative log likelihood of a minute's cells, nats, at their posterior probability.

    A ratio tells a ship in this cell from no ship at all, so a cell's posterior knows the others:
    p(c) = π e^l(c) / (1 + Σ π e^l), with π of `CELL_PRIOR`. NaN where the minute has no data.
    """
    score = np.log(CELL_PRIOR) + cells
    log_sum = np.logaddexp(0.0, logsumexp(score, axis=1, keepdims=True))
    log_p = score - log_sum
    log_not = np.log(np.maximum(-np.expm1(log_p), 1e-16))
    return -np.where(holds, log_p, log_not).mean(axis=1)


def _range(maps: xr.Dataset, ships: np.ndarray) -> dict[str, np.ndarray]:
    llr, grid, rates = maps["range_llr"].values, maps["range"].values, maps["range_rate"].values
    weighted = np.nan_to_num(llr, nan=-np.inf) + np.log(np.maximum(grid, 1e-3))[None, :, None]
    best = weighted.reshape(len(llr), -1).argmax(axis=1) // len(rates)
    found = grid[best]
    error = _least(found - ships[:, 1], len(llr))
    holds, near = range_cells(maps, ships)
    fits = np.zeros(len(llr), bool)
    for ship in ships[:, 1]:
        fits |= abs(found - ship) <= _tolerance_m(ship)
    return {
        "range_llr": range_presence(llr, grid, rates)["range"], "range_m": found, "range_error": error,
        "range_right": fits.astype(int), "range_nll": range_nll(llr, grid, holds, near), "near": near.astype(int),
    }  # fmt: skip


def _tolerance_m(distance: np.ndarray) -> np.ndarray:
    return np.maximum(500.0, 0.03 * distance)


def range_cells(maps: xr.Dataset, ships: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which ranges are right (minute, range), and whether a ship is within `RANGE_LIMIT_M` (minute)."""
    grid, count = maps["range"].values, maps.sizes["time"]
    holds, near = np.zeros((count, len(grid)), bool), np.zeros(count, bool)
    for ship in ships[:, 1]:
        with np.errstate(invalid="ignore"):
            holds |= abs(grid[None, :] - ship[:, None]) <= _tolerance_m(ship)[:, None]
            near |= ship <= RANGE_LIMIT_M
    return holds, near


def range_nll(llr: np.ndarray, grid: np.ndarray, holds: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Negative log posterior, nats, of the right ranges, or of no ship where none is near; ranges' prior in proportion to them."""
    top = np.nan_to_num(llr, nan=-np.inf).reshape(len(llr), -1).max(axis=1)
    top = np.where(np.isfinite(top), top, 0.0)
    per_range = np.exp(llr - top[:, None, None]).mean(axis=2) * (grid / grid.sum())
    none = np.exp(-np.clip(top, -600.0, 600.0))
    mass = np.where(near, (per_range * holds).sum(axis=1), none)
    return -np.log(np.maximum(mass, 1e-300) / (none + per_range.sum(axis=1)))


def _least(errors: np.ndarray, count: int) -> np.ndarray:
    """The error of least size over the ships, NaN without one."""
    if not len(errors):
        return np.full(count, np.nan)
    size = np.where(np.isnan(errors), np.inf, abs(errors))
    return errors[size.argmin(axis=0), np.arange(count)]


def samples(maps: xr.Dataset, truth: pd.DataFrame) -> dict[str, np.ndarray]:
    """What recalibration needs of a record: azimuth_llr, azimuth_holds (minute, cell); of one minute in `SAMPLE_EVERY` range_llr
    (minute, range, range_rate), range_holds (minute, range), range_near (minute); range (range). Minutes without data left out.
    """
    ships = truth_at(truth, to_posix(maps["time"].values))
    made: dict[str, np.ndarray] = {}
    if "azimuth_llr" in maps:
        cells, holds = azimuth_cells(maps, ships)
        there = np.isfinite(cells).all(axis=1)
        made |= {"azimuth_llr": cells[there].astype(np.float32), "azimuth_holds": holds[there]}
    if "range_llr" in maps:
        holds, near = range_cells(maps, ships)
        kept = np.flatnonzero(np.isfinite(maps["range_llr"].values).all(axis=(1, 2)))[::SAMPLE_EVERY]
        made |= {
            "range_llr": maps["range_llr"].values[kept].astype(np.float16), "range_holds": holds[kept],
            "range_near": near[kept], "range": maps["range"].values,
        }  # fmt: skip
    return made
