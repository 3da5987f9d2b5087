"""Likelihood maps of a segment in, what the grid search reads: tiles, score maps at one smoothing, maps without a known ship."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import xarray as xr

from obsnet.layout import to_posix
from obsnet.trackers.track import Segment

_SILENT = np.float32(-60.0)
"""Log ratio to the best of a map that counts as nothing; what float32 holds only denormally makes sums ten times as slow."""

_ROWS, _TILES = 64, 4
"""Ranges smoothed by one matrix product, and tiles at a time: what fits a core's cache."""


@dataclass(frozen=True)
class ScoreMaps:
    """Score maps of the tiles: smoothed, mixed with the chance of a miss, ready for the kernels.

    Attributes
    ----------
    range_score : float32 (n_tiles, n_range, n_rate). geometry : range origin and step [m], rate origin and step [m/s].
    azimuth_score : float32 (n_tiles, n_azimuth). azimuth_step : deg.
    jointly : range speaks for a hypothesis only in tiles where azimuth does too.
    """

    range_score: np.ndarray
    geometry: np.ndarray
    azimuth_score: np.ndarray
    azimuth_step: float
    jointly: bool

    @cached_property
    def flat(self) -> np.ndarray:
        """Range scores flattened, (n_tiles, n_range · n_rate and a corner of zeros for what lies off the grid)."""
        n_tiles, _, n_rate = self.range_score.shape
        return np.pad(self.range_score.reshape(n_tiles, -1), ((0, 0), (0, n_rate + 2)))

    @cached_property
    def best_corner(self) -> np.ndarray:
        """The greatest of the four grid points around each point of `flat`."""
        n_rate = self.range_score.shape[2]
        ahead = np.maximum(self.flat[:, :-1], self.flat[:, 1:])
        return np.maximum(ahead[:, :-n_rate], ahead[:, n_rate:])

    def without_range(self) -> ScoreMaps:
        """The same with range maps that say nothing."""
        return replace(self, range_score=np.zeros_like(self.range_score))

    def part(self, tiles: slice) -> ScoreMaps:
        """Those of some of the tiles."""
        return replace(self, range_score=self.range_score[tiles], azimuth_score=self.azimuth_score[tiles])

    def corner(self, range_m: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Index into `flat` of the grid point below in range and rate, and how far right and up of it, in grid steps."""
        _, n_range, n_rate = self.range_score.shape
        first, step, first_rate, rate_step = self.geometry.tolist()
        x, y = (range_m - first) / step, (rate - first_rate) / rate_step
        inside = (x >= 0) & (x < n_range - 1) & (y >= 0) & (y < n_rate - 1)
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
        a, b = x.astype(np.int64), y.astype(np.int64)
        right, up = x - a.astype(x.dtype), y - b.astype(y.dtype)
        return np.where(inside, a * n_rate + b, n_range * n_rate), right, up


def tiles(
    maps: xr.Dataset, segment: Segment, tile_s: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None] | None:
    """Tile times, and azimuth, range and levels of lines there, read from disk no further than that; none if there are fewer than three.

    Maps of which no tile has data are None, as those that are not there.
    """
    times = to_posix(maps["time"].values)
    inside = (times >= segment.start - 1e-6) & (times <= segment.end + 1e-6)
    inside &= np.abs(times / tile_s - np.round(times / tile_s)) * tile_s < 0.5
    chosen = np.flatnonzero(inside)
    if len(chosen) < 3:
        return None

    def there(name: str) -> np.ndarray | None:
        rows = maps[name].isel(time=chosen).values if name in maps else None
        return None if rows is None or np.isnan(rows).all() else rows.astype(np.float32, copy=False)

    return times[chosen], there("azimuth_llr"), there("range_llr"), there("line_level")


def azimuth_scores(llr: np.ndarray, std_bins: float, bound: float, probability: float) -> np.ndarray:
    """Log mixture (1 − Pd) + Pd·ratio of azimuth maps (n_tiles, n_azimuth), the ratio smoothed around the circle."""
    ratio, top = _bounded(llr, bound)
    return _mixed(ratio @ _gaussian(ratio.shape[1], std_bins, 4.0, "wrap"), top, probability)


def range_scores(
    llr: np.ndarray, pool: int, std_bins: tuple[float, float], bound: float, probability: float
) -> np.ndarray:
    """The same of range maps (n_tiles, n_range, n_rate), means of `pool` ranges smoothed in range and range rate."""
    across, along = (
        _gaussian(n, std, 3.0, "clip")
        for n, std in zip((llr.shape[1] // pool, llr.shape[2]), std_bins, strict=True)
    )
    bands = []
    for first in range(0, len(across), _ROWS):
        reach = np.flatnonzero(across[:, first : first + _ROWS].any(axis=1))
        near = slice(int(reach[0]), int(reach[-1]) + 1)
        bands.append((slice(first, first + _ROWS), near, across[near, first : first + _ROWS].T))
    out = np.empty((len(llr), len(across), len(along)), np.float32)
    for first in range(0, len(llr), _TILES):
        part = slice(first, first + _TILES)
        ratio, top = _bounded(llr[part], bound)
        if pool > 1:
            ratio = ratio[:, : len(across) * pool].reshape(len(ratio), len(across), pool, -1).mean(axis=2)
        ratio = ratio @ along
        for rows, near, weight in bands:
            np.matmul(weight, ratio[:, near], out=out[part, rows])
        out[part] = _mixed(out[part], top, probability)
    return out


def lobe(
    llr: np.ndarray, azimuth: np.ndarray, centre: np.ndarray, reach: float, core: float = 10.0
) -> np.ndarray:
    """The part of each azimuth row that a ship at `centre` explains: on both sides down to the first valley.

    A valley is where the map says no ship, or 3 nats under what follows it. `core` [deg] about the centre always belongs to
    the lobe, nothing beyond `reach` does.
    """
    step = float(azimuth[1] - azimuth[0])
    count = len(azimuth)
    out = np.zeros(llr.shape, bool)
    rows = np.arange(len(llr))[:, None]
    first = np.round((centre - azimuth[0]) / step).astype(int)
    start, far = round(core / step), round(reach / step)
    for side in (1, -1):
        column = (first[:, None] + side * np.arange(far + 1)) % count
        value = llr[rows, column]
        lowest = np.minimum.accumulate(value, axis=1)
        beyond = (value <= 0.0) | (value > lowest + 3.0)
        beyond[:, : start + 1] = False
        out[rows, column] |= np.cumsum(beyond, axis=1) == 0
    return out


def above_floor(
    llr: np.ndarray, explained: np.ndarray, share: float = 0.2, margin: float = 3.0
) -> np.ndarray:
    """Azimuth rows without the floor that a known ship leaves beyond its lobe, for the search of the next ship.

    A loud ship lifts a learned map everywhere a little: each azimuth alone is then likelier than no ship at all, which says nothing
    of a second one. Off comes what all but `share` of the unexplained azimuths reach and `margin` nats, where that is above 0.
    """
    ordered = np.sort(np.where(explained, np.inf, llr), axis=1)
    count = np.sum(~explained, axis=1)
    rank = np.clip(np.round((1.0 - share) * count).astype(int), 0, np.maximum(count - 1, 0))
    floor = np.where(count > 0, ordered[np.arange(len(llr)), rank], 0.0)
    lowered = llr - np.maximum(np.nan_to_num(floor + margin, posinf=0.0), 0.0)[:, None]
    return np.where(explained, llr, lowered).astype(llr.dtype)


def polyphase(rows: np.ndarray, step: float, course_step: float, courses: int) -> tuple[np.ndarray, float]:
    """Azimuth rows laid out so that the courses of one hypothesis are neighbours in memory, and their step, deg.

    Rows whose step does not divide that of the courses are read at the nearest finer one that does.
    """
    phases = max(1, math.ceil(course_step / step - 1e-6))
    count = rows.shape[1]
    bins = round(360.0 * phases / course_step)
    if bins != count:
        position = np.arange(bins) * (count / bins)
        low = position.astype(int)
        mu = (position - low).astype(np.float32)
        rows = (1 - mu) * rows[:, low] + mu * rows[:, (low + 1) % count]
    wrapped = np.concatenate([rows, rows[:, np.arange(courses * phases) % bins]], axis=1)
    length = wrapped.shape[1] // phases
    laid = wrapped[:, : length * phases].reshape(len(rows), length, phases).transpose(0, 2, 1)
    return np.ascontiguousarray(laid, dtype=np.float32), course_step / phases


def _gaussian(count: int, std_bins: float, truncate: float, ends: Literal["wrap", "clip"]) -> np.ndarray:
    """Matrix (count, count) float32 by which a row is smoothed: around the circle, or with its ends held beyond them."""
    radius = int(truncate * std_bins + 0.5)
    lag = np.arange(-radius, radius + 1)
    weight = np.exp(-0.5 * (lag / std_bins) ** 2) if radius else np.ones(1)
    source = np.take(np.arange(count), np.arange(count)[:, None] + lag, mode=ends)
    matrix = np.zeros((count, count))
    np.add.at(matrix, (source, np.arange(count)[:, None]), weight / weight.sum())
    return matrix.astype(np.float32)


def _bounded(llr: np.ndarray, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """exp(llr − max) and the log at which the maximum counts, at most `bound`; tiles without data are 1 and NaN."""
    top = llr.max(axis=tuple(range(1, llr.ndim)), keepdims=True)
    ratio = np.exp(np.maximum(llr - top, _SILENT))
    return np.nan_to_num(ratio, nan=1.0), np.minimum(top, bound)


def _mixed(ratio: np.ndarray, top: np.ndarray, probability: float) -> np.ndarray:
    """Log of (1 − Pd) + Pd·ratio·exp(top) (see `segmentation.mixture`); 0 where there is no data."""
    share = np.float32(probability) * np.exp(np.nan_to_num(top)).astype(np.float32)
    mixed = np.log(ratio * share + np.float32(1.0 - probability))
    return np.where(np.isnan(top), np.float32(0.0), mixed)
