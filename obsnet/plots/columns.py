"""Minutes in, the equal time columns of a picture out: thinned to what can be seen, gaps left blank."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.detectors.maps import range_rate_marginal
from obsnet.layout import to_posix

_SLICE = 2048
_CELLS = 4_000_000


@dataclass(frozen=True)
class Columns:
    """Equal columns over a stretch of time.

    Attributes
    ----------
    start, end : s since 1970, the outer edges.
    count : number of columns.
    column : array (n_minutes), the column of each minute, increasing.
    """

    start: float
    end: float
    count: int
    column: np.ndarray

    @classmethod
    def over(cls, time: np.ndarray, most: int) -> Columns:
        """Columns over minutes at `time` (`datetime64`, increasing), at most `most` of them."""
        seconds = to_posix(time)
        step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 60.0
        start, end = float(seconds[0]) - step / 2, float(seconds[-1]) + step / 2
        count = max(1, min(most, round((end - start) / step)))
        column = np.floor((seconds - start) / (end - start) * count + 1e-6).astype(int)
        return cls(start, end, count, np.clip(column, 0, count - 1))

    def mean(self, values: xr.DataArray) -> np.ndarray:
        """Mean of `values` (time, cell) over each column's minutes with data, (column, cell); NaN where there are none.

        Read slice by slice, so that a month need not fit into memory.
        """
        values = values.transpose("time", ...)
        total: np.ndarray | None = None
        number = np.zeros(self.count)
        for rows in _slices(values.sizes["time"]):
            part = np.asarray(values[rows].values)
            if total is None:
                total = np.zeros((self.count, *part.shape[1:]), np.result_type(part.dtype, np.float32))
            valid = ~np.isnan(part).any(axis=1)
            part = np.where(valid[:, None], part, 0)
            columns, first = np.unique(self.column[rows], return_index=True)
            total[columns] += np.add.reduceat(part, first, axis=0)
            number[columns] += np.add.reduceat(valid, first, dtype=float)
        if total is None:
            return np.full((self.count, 1), np.nan)
        total[number == 0] = np.nan
        return total / np.maximum(number, 1.0).astype(np.float32)[:, None]

    def strongest(self, weight: np.ndarray) -> np.ndarray:
        """The minute of greatest weight in each column, −1 where no minute has a weight."""
        chosen = np.full(self.count, -1)
        order = np.argsort(np.where(np.isnan(weight), -np.inf, weight), kind="stable")
        order = order[~np.isnan(weight[order])]
        chosen[self.column[order]] = order
        return chosen


def range_marginal(maps: xr.Dataset, columns: Columns, weight: np.ndarray) -> np.ndarray:
    """Log-likelihood ratio against range, range rate marginalised, (column, range); NaN without data.

    A column shows its minute of greatest weight; only these are read, a few at a time.
    """
    llr = maps["range_llr"]
    out = np.full((columns.count, llr.sizes["range"]), np.nan, np.float32)
    chosen = columns.strongest(weight)
    shown = np.flatnonzero(chosen >= 0)
    at_once = max(1, _CELLS // max(llr.sizes["range"] * llr.sizes["range_rate"], 1))
    for first in range(0, len(shown), at_once):
        part = shown[first : first + at_once]
        rows = chosen[part]
        wanted = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
        block = llr.isel(time=wanted).transpose("time", "range", "range_rate").values
        out[part] = range_rate_marginal(block.astype(np.float32, copy=False))
    return out


def azimuth_columns(maps: xr.Dataset, columns: Columns, weight: np.ndarray) -> np.ndarray:
    """Azimuth log-likelihood ratios (column, azimuth) of each column's minute of greatest weight."""
    llr = maps["azimuth_llr"].transpose("time", "azimuth")
    chosen = columns.strongest(weight)
    out = np.full((columns.count, llr.sizes["azimuth"]), np.nan, np.float32)
    shown = np.flatnonzero(chosen >= 0)
    if len(shown):
        out[shown] = llr.isel(time=chosen[shown]).values
    return out


def _slices(count: int) -> Iterator[slice]:
    for first in range(0, count, _SLICE):
        yield slice(first, first + _SLICE)
