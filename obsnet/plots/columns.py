"""Minutes in, the equal time columns of a picture out: thinned to what can be seen, gaps left blank."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from obsnet.detectors.maps import MARGINAL, range_rate_marginal
from obsnet.layout import to_posix

_ROWS_AT_ONCE = 2048
_CELLS_AT_ONCE = 2_000_000


@dataclass(frozen=True)
class Columns:
    """Equal columns over a stretch of a run.

    Attributes
    ----------
    start, end : s since 1970, the outer edges.
    count : number of columns.
    first : the run's minute that `column` begins with.
    column : array (n_minutes), the column of each minute from `first` on, increasing.
    """

    start: float
    end: float
    count: int
    first: int
    column: np.ndarray

    @classmethod
    def over(cls, time: np.ndarray, most: int, start: float = -np.inf, end: float = np.inf) -> Columns | None:
        """At most `most` columns over the minutes at `time` that lie in [start, end], or none without a minute.

        Parameters
        ----------
        time : array of `datetime64`, increasing.
        """
        seconds = to_posix(time)
        first, last = np.searchsorted(seconds, start), np.searchsorted(seconds, end, side="right")
        if first >= last:
            return None
        step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 60.0
        seconds = seconds[first:last]
        begin, stop = float(seconds[0]) - step / 2, float(seconds[-1]) + step / 2
        count = max(1, min(most, round((stop - begin) / step)))
        column = np.floor((seconds - begin) / (stop - begin) * count + 1e-6).astype(int)
        return cls(begin, stop, count, int(first), np.clip(column, 0, count - 1))

    @property
    def centres(self) -> np.ndarray:
        """Middle of each column, s since 1970."""
        return self.start + (np.arange(self.count) + 0.5) * (self.end - self.start) / self.count

    def mean(
        self, values: xr.DataArray, transform: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> np.ndarray:
        """Mean over each column's minutes with data, (column, cell); NaN where there are none.

        Parameters
        ----------
        values : DataArray of the whole run, dims time and another; read slice by slice.
        transform : of a slice (minute, cell), before the mean.
        """
        values = values.transpose("time", ...)
        total: Any = None
        number = np.zeros((self.count, 1), np.float32)
        for rows in _slices(len(self.column)):
            part = values.isel(time=slice(self.first + rows.start, self.first + rows.stop)).values
            valid = ~np.isnan(part).any(axis=1)
            part = np.where(valid[:, None], part, 0)
            part = part if transform is None else transform(part) * valid[:, None]
            if total is None:
                total = np.zeros((self.count, part.shape[1]), part.dtype)
            columns, begins = np.unique(self.column[rows], return_index=True)
            total[columns] += np.add.reduceat(part, begins, axis=0)
            number[columns, 0] += np.add.reduceat(valid, begins, dtype=np.float32)
        return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)

    def strongest(self, weight: np.ndarray) -> np.ndarray:
        """The run's minute of greatest `weight` (one of each minute of the run) in each column, −1 without any."""
        part = weight[self.first : self.first + len(self.column)]
        order = np.argsort(np.nan_to_num(part, nan=-np.inf), kind="stable")
        order = order[~np.isnan(part[order])]
        chosen = np.full(self.count, -1)
        chosen[self.column[order]] = order + self.first
        return chosen


def azimuth_columns(maps: xr.Dataset, columns: Columns, weight: np.ndarray) -> np.ndarray:
    """Log-likelihood ratios (column, azimuth), of each column's minute of greatest weight; NaN without data."""
    return _chosen(maps["azimuth_llr"].transpose("time", "azimuth"), columns, weight)


def range_columns(maps: xr.Dataset, features: xr.Dataset, columns: Columns, weight: np.ndarray) -> np.ndarray:
    """Log-likelihood ratios (column, range), range rate marginalised, of each column's minute of greatest weight; NaN without data."""
    if MARGINAL in features:
        return _chosen(features[MARGINAL].transpose("time", "range"), columns, weight)
    llr = maps["range_llr"].transpose("time", "range", "range_rate")
    return _chosen(llr, columns, weight, range_rate_marginal)


def _chosen(
    values: xr.DataArray,
    columns: Columns,
    weight: np.ndarray,
    transform: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> np.ndarray:
    """Each column's minute of greatest weight, read and transformed a few at a time: (column, cell)."""
    chosen = columns.strongest(weight)
    shown = np.flatnonzero(chosen >= 0)
    out = np.full((columns.count, values.shape[1]), np.nan, np.float32)
    at_once = max(1, _CELLS_AT_ONCE // int(np.prod(values.shape[1:])))
    for begin in range(0, len(shown), at_once):
        part = shown[begin : begin + at_once]
        out[part] = transform(values.isel(time=chosen[part]).values)
    return out


def _slices(count: int) -> Iterator[slice]:
    for begin in range(0, count, _ROWS_AT_ONCE):
        yield slice(begin, min(begin + _ROWS_AT_ONCE, count))
