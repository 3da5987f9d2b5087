"""Likelihood maps of a segment in, what the grid search reads: tiles, score maps at one smoothing, maps without a known ship."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter1d

from obsnet import netcdf
from obsnet.layout import to_posix
from obsnet.trackers.track import Segment


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


def tiles(
    maps: xr.Dataset, segment: Segment, tile_s: float
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None] | None:
    """Tile times and the maps there, read from disk no further than that; none if there are fewer than three."""
    times = to_posix(maps["time"].values)
    inside = (times >= segment.start - 1e-6) & (times <= segment.end + 1e-6)
    inside &= np.abs(times / tile_s - np.round(times / tile_s)) * tile_s < 0.5
    chosen = np.flatnonzero(inside)
    if len(chosen) < 3:
        return None

    def llr(name: str) -> np.ndarray | None:
        return netcdf.rows(maps[name], chosen) if name in maps else None

    return times[chosen], llr("azimuth_llr"), llr("range_llr")


def azimuth_scores(llr: np.ndarray, std_bins: float, bound: float, probability: float) -> np.ndarray:
    """Log mixture (1 − Pd) + Pd·ratio of azimuth maps (n_tiles, n_azimuth), the ratio smoothed around the circle."""
    ratio, top = _bounded(llr, bound)
    return _mixed(gaussian_filter1d(ratio, std_bins, axis=1, mode="wrap"), top, probability)


def range_scores(
    llr: np.ndarray, pool: int, std_bins: tuple[float, float], bound: float, probability: float
) -> np.ndarray:
    """The same of range maps (n_tiles, n_range, n_rate), means of `pool` ranges smoothed in range and range rate."""
    ratio, top = _bounded(llr, bound)
    if pool > 1:
        bins = ratio.shape[1] // pool
        ratio = ratio[:, : bins * pool].reshape(len(ratio), bins, pool, -1).mean(axis=2)
    for axis, std in enumerate(std_bins, 1):
        ratio = gaussian_filter1d(ratio, std, axis=axis, mode="nearest", truncate=3.0)
    return _mixed(ratio, top, probability)


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
    """Azimuth rows laid out so that the courses of one hypothesis are neighbours in memory."""
    if course_step < step:
        finer = round(step / course_step)
        count = rows.shape[1]
        position = np.arange(count * finer) / finer
        low = np.floor(position).astype(int)
        mu = (position - low).astype(np.float32)
        rows = (1 - mu) * rows[:, low] + mu * rows[:, (low + 1) % count]
        step = step / finer
    phases = max(1, round(course_step / step))
    bins = rows.shape[1]
    if bins % phases:
        phases = 1 if courses == 1 else phases
    wrapped = np.concatenate([rows, rows[:, np.arange(courses * phases) % bins]], axis=1)
    length = wrapped.shape[1] // phases
    laid = wrapped[:, : length * phases].reshape(len(rows), length, phases).transpose(0, 2, 1)
    return np.ascontiguousarray(laid, dtype=np.float32), step


def _bounded(llr: np.ndarray, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """exp(llr − max) and the log at which the maximum counts, at most `bound`; tiles without data are 1 and NaN."""
    top = llr.max(axis=tuple(range(1, llr.ndim)), keepdims=True)
    ratio = np.exp(llr - top)
    return np.nan_to_num(ratio, nan=1.0), np.minimum(top, bound)


def _mixed(ratio: np.ndarray, top: np.ndarray, probability: float) -> np.ndarray:
    """Log of (1 − Pd) + Pd·ratio·exp(top) (see `segmentation.mixture`); 0 where there is no data."""
    share = np.float32(probability) * np.exp(np.nan_to_num(top)).astype(np.float32)
    mixed = np.log(ratio * share + np.float32(1.0 - probability))
    return np.where(np.isnan(top), np.float32(0.0), mixed)
