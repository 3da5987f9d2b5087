"""Likelihood maps and the truth in, one row a minute out: what a detector says, how far off it is, what it costs in nats."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.detectors.maps import azimuth_presence, range_presence
from obsnet.kinematics import wrap180
from obsnet.layout import to_posix

CELL_PRIOR = 0.02
"""Share of azimuth cells that hold a ship, for the negative log likelihood of a cell."""
CELL_DEG = 5.0
RANGE_LIMIT_M = 50e3
BOUND = 100.0


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
    period = float(maps["azimuth"].attrs.get("ambiguity_deg", 360))
    error = _least(wrap180((best - ships[:, 0]) * 360.0 / period) * period / 360.0, llr.shape[0])
    cells = llr[:, :: max(round(CELL_DEG / float(grid[1] - grid[0])), 1)]
    at = grid[:: max(round(CELL_DEG / float(grid[1] - grid[0])), 1)]
    holds = np.zeros(cells.shape, bool)
    for ship in ships[:, 0]:
        holds |= abs(wrap180(at[None, :] - ship[:, None])) <= CELL_DEG / 2
    logit = cells + np.log(CELL_PRIOR / (1.0 - CELL_PRIOR))
    nll = np.where(holds, np.logaddexp(0.0, -logit), np.logaddexp(0.0, logit)).mean(axis=1)
    return {
        "azimuth_llr": azimuth_presence(llr), "azimuth_deg": best, "azimuth_error": error,
        "azimuth_right": (abs(error) <= 10.0).astype(int), "azimuth_nll": nll,
    }  # fmt: skip


def _range(maps: xr.Dataset, ships: np.ndarray) -> dict[str, np.ndarray]:
    llr, grid, rates = maps["range_llr"].values, maps["range"].values, maps["range_rate"].values
    prior = grid / grid.sum()
    top = np.nan_to_num(llr, nan=-np.inf).reshape(len(llr), -1).max(axis=1)
    top = np.where(np.isfinite(top), top, 0.0)
    per_range = np.exp(llr - top[:, None, None]).mean(axis=2) * prior
    weighted = np.nan_to_num(llr, nan=-np.inf) + np.log(np.maximum(grid, 1e-3))[None, :, None]
    best = weighted.reshape(len(llr), -1).argmax(axis=1) // len(rates)
    found = grid[best]
    error = _least(found - ships[:, 1], len(llr))
    fits = np.zeros(len(llr), bool)
    holds = np.zeros(per_range.shape, bool)
    near = np.zeros(len(llr), bool)
    for ship in ships[:, 1]:
        tolerance = np.maximum(500.0, 0.03 * ship)
        fits |= abs(found - ship) <= tolerance
        holds |= abs(grid[None, :] - ship[:, None]) <= tolerance[:, None]
        near |= ship <= RANGE_LIMIT_M
    none = np.exp(-np.clip(top, -600.0, 600.0))
    mass = np.where(near, (per_range * holds).sum(axis=1), none)
    nll = -np.log(np.maximum(mass, 1e-300) / (none + per_range.sum(axis=1)))
    return {
        "range_llr": range_presence(llr, grid, rates)["range"], "range_m": found, "range_error": error,
        "range_right": fits.astype(int), "range_nll": nll, "near": near.astype(int),
    }  # fmt: skip


def _least(errors: np.ndarray, count: int) -> np.ndarray:
    """The error of least size over the ships, NaN without one."""
    if not len(errors):
        return np.full(count, np.nan)
    size = np.where(np.isnan(errors), np.inf, abs(errors))
    return errors[size.argmin(axis=0), np.arange(count)]


def histograms(maps: xr.Dataset, truth: pd.DataFrame) -> dict[str, np.ndarray]:
    """Counts of the cells' log-likelihood ratios, of cells with a ship and without, in bins of half a nat."""
    edges = np.arange(-BOUND, BOUND + 0.5, 0.5)
    made = {"centre": (edges[1:] + edges[:-1]) / 2, "files": np.array(1.0)}
    ships = truth_at(truth, to_posix(maps["time"].values))

    def count(values: np.ndarray) -> np.ndarray:
        kept = values[np.isfinite(values)]
        return np.histogram(np.clip(kept, -BOUND + 0.1, BOUND - 0.1), edges)[0].astype(float)

    if "azimuth_llr" in maps:
        at, llr = maps["azimuth"].values, maps["azimuth_llr"].values
        holds = np.zeros(llr.shape, bool)
        for ship in ships[:, 0]:
            holds |= abs(wrap180(at[None, :] - ship[:, None])) <= CELL_DEG / 2
        made |= {"azimuth_ship": count(llr[holds]), "azimuth_none": count(llr[~holds])}
    if "range_llr" in maps:
        llr, grid, rates = maps["range_llr"].values, maps["range"].values, maps["range_rate"].values
        holds = np.zeros(llr.shape, bool)
        for _, distance, rate in ships:
            near = abs(grid[None, :] - distance[:, None]) <= 140.0
            holds |= near[:, :, None] & (abs(rates[None, :] - rate[:, None]) <= 0.5)[:, None, :]
        made |= {"range_ship": count(llr[holds]), "range_none": count(llr[~holds])}
    return made
