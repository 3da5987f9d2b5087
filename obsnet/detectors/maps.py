"""Likelihood maps: what a detector says, minute by minute, about a ship at each azimuth, range and range rate.

A `LikelihoodMaps` is an `xr.Dataset` of natural-log likelihood ratios ("a ship here" against "no ship", float32):

- ``azimuth_llr`` (time, azimuth [deg]) and ``azimuth_coverage`` (time),
- ``range_llr`` (time, range [m], range_rate [m/s]) and ``range_coverage`` (time).

Either pair may be absent. Cells of minutes without data are NaN, their coverage is 0.
"""

from __future__ import annotations

from typing import Protocol, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.errors import LayoutError
from obsnet.layout import to_posix

LikelihoodMaps: TypeAlias = xr.Dataset

_MINUTES = 4
"""Minutes of range maps at a time: what fits a core's cache."""


class Detector(Protocol):
    """Anything that turns a stretch of representations into likelihood maps."""

    window_s: float
    name: str

    def maps(self, representation: xr.DataArray, minutes: np.ndarray) -> xr.Dataset:
        """Log-likelihood ratios and coverage at `minutes` (s since 1970) from an azigram or a cepstrogram."""
        ...


TIE = np.float32(1e-3)
"""Nats by which cells of a map do not differ: of such the first is read off, however the record was cut."""
MARGINAL = "range_marginal_llr"
"""Name, among the features of a run, of the ratio against range alone (time, range)."""


def joined(parts: list[xr.Dataset]) -> xr.Dataset:
    """Datasets of consecutive minutes in one; none give one without minutes."""
    if not parts:
        return xr.Dataset(coords={"time": np.empty(0, "datetime64[ns]")})
    if len(parts) == 1:
        return parts[0]
    return xr.concat(parts, "time", data_vars="minimal", coords="minimal", compat="override", join="override")


def filled_up(maps: LikelihoodMaps, axes: LikelihoodMaps) -> LikelihoodMaps:
    """Azimuth maps whose minutes without data are those of others, by polarisation."""
    fill = (maps["azimuth_coverage"].values == 0) & (axes["azimuth_coverage"].values > 0)
    return maps.assign(
        azimuth_llr=maps["azimuth_llr"].copy(
            data=np.where(fill[:, None], axes["azimuth_llr"].values, maps["azimuth_llr"].values)
        ),
        azimuth_coverage=maps["azimuth_coverage"].copy(
            data=np.where(fill, axes["azimuth_coverage"].values, maps["azimuth_coverage"].values)
        ),
    )


def two_sided(azimuth_llr: np.ndarray) -> np.ndarray:
    """Minutes whose azimuths are known up to 180° alone (polarisation): their ratios say the same of opposite sides.

    Parameters
    ----------
    azimuth_llr : (time, azimuth), the azimuths evenly around the circle; of an odd number, none has an opposite.
    """
    half, odd = divmod(azimuth_llr.shape[1], 2)
    if odd:
        return np.zeros(len(azimuth_llr), bool)
    one, other = azimuth_llr[:, :half], azimuth_llr[:, half:]
    says = one.max(axis=1) - one.min(axis=1) > TIE
    return says & (abs(one - other) <= TIE).all(axis=1)


def known_sides(azimuth_llr: np.ndarray) -> np.ndarray:
    """The maps (time, azimuth) for who follows full azimuths: NaN where they are known up to 180° alone."""
    return np.where(two_sided(azimuth_llr)[:, None], np.nan, azimuth_llr)


def window_bounds(
    frame_time: np.ndarray, minutes: np.ndarray, window_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """First and one-past-last frame whose centre lies in [minute − window/2, minute + window/2)."""
    start = np.searchsorted(frame_time, minutes - window_s / 2 - 1e-6)
    stop = np.searchsorted(frame_time, minutes + window_s / 2 - 1e-6)
    return start, stop


def hop(frame_time: np.ndarray) -> float:
    """Time from one frame to the next [s]; 1 where there is but one."""
    return float(np.median(np.diff(frame_time))) if len(frame_time) > 1 else 1.0


def range_axis(max_range_m: float, step_m: float) -> np.ndarray:
    """Range grid [m], from 0."""
    return np.arange(int(max_range_m / step_m) + 1) * step_m


def range_rate_axis(max_range_rate_mps: float, step_mps: float) -> np.ndarray:
    """Range rate grid [m/s], symmetric about 0."""
    half = round(max_range_rate_mps / step_mps)
    return np.arange(-half, half + 1) * step_mps


def coverage(valid: np.ndarray, frame_time: np.ndarray, minutes: np.ndarray, window_s: float) -> np.ndarray:
    """Share of the frames that a window should hold and does, 0 to 1 (float32).

    Parameters
    ----------
    valid : bool array (n_frames), frames with data.
    frame_time : s since 1970; frames lie on multiples of the hop plus a constant, those without data may be left out.
    minutes : s since 1970. window_s : s; windows as of `window_bounds`.
    """
    if not len(frame_time):
        return np.zeros(len(minutes), np.float32)
    start, stop = window_bounds(frame_time, minutes, window_s)
    total = np.concatenate([[0], np.cumsum(valid)])
    # In whole microseconds, so that frames on a window's edge count alike wherever the record begins.
    step, edges = round(1e6 * hop(frame_time)), np.array([-0.5, 0.5])[:, None] * window_s
    beyond = np.rint(1e6 * (minutes + edges)).astype(np.int64) - round(1e6 * float(frame_time[0])) - 1
    low, high = -(-beyond // step)
    return np.minimum((total[stop] - total[start]) / np.maximum(high - low, 1), 1.0).astype(np.float32)


def log_mean_exp(
    values: np.ndarray, axis: int | tuple[int, ...], weights: np.ndarray | None = None
) -> np.ndarray:
    """Logarithm of the (weighted) mean of exp(values); NaN only where all of a slice is NaN."""
    top = np.max(values, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    mean = np.exp(values - top).mean(axis=axis)
    with np.errstate(divide="ignore"):
        return np.log(mean) + np.squeeze(top, axis=axis)


def azimuth_presence(azimuth_llr: np.ndarray) -> np.ndarray:
    """Log marginal posterior ratio of presence, uniform prior over azimuth (paper's eq. 12)."""
    return log_mean_exp(azimuth_llr, axis=-1)


def range_rate_marginal(range_llr: np.ndarray) -> np.ndarray:
    """Log-likelihood ratio against range alone: range rate marginalised over its uniform prior."""
    return log_mean_exp(range_llr, axis=-1)


def range_presence(
    range_llr: np.ndarray, range_m: np.ndarray, range_rate: np.ndarray, marginal: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Log marginal posterior ratios of presence: of any ship, of an `approaching` and of a `leaving` one.

    The prior is proportional to range and uniform in range rate (paper's eqs 20, 22); for a closing or an opening ship it is
    the same over half of the range rates (eq. 25).

    Parameters
    ----------
    range_llr : (n_minutes, n_range, n_rate) float32. range_m, range_rate : m, m/s.
    marginal : array (n_minutes, n_range) to take the ratio against range alone, as `range_rate_marginal` but not less than
        85 nats below a minute's greatest ratio.
    """
    prior = (np.maximum(range_m, 0.0) / np.maximum(range_m, 0.0).sum()).astype(np.float32)
    even = np.full(len(range_rate), 1.0 / len(range_rate), np.float32)
    top = np.empty(len(range_llr), np.float32)
    per_rate = np.empty((len(range_llr), len(range_rate)), np.float32)
    for first in range(0, len(range_llr), _MINUTES):
        part = slice(first, first + _MINUTES)
        best = np.max(range_llr[part], axis=(1, 2))
        # Lifted, so that no term or product falls where float32 holds it only denormally, which takes ten times as long.
        top[part] = np.where(np.isfinite(best), best, np.float32(0.0)) - np.float32(40.0)
        raised = range_llr[part] - top[part, None, None]
        np.exp(np.maximum(raised, np.float32(-45.0), out=raised), out=raised)
        np.matmul(prior, raised, out=per_rate[part])
        if marginal is not None:
            np.log(raised @ even, out=marginal[part])
            marginal[part] += top[part, None]
    with np.errstate(divide="ignore"):
        return {
            name: np.log(per_rate[:, chosen].mean(axis=1)) + top
            for name, chosen in (
                ("range", slice(None)),
                ("approaching", range_rate <= 0),
                ("leaving", range_rate >= 0),
            )
        }


def presence(maps: LikelihoodMaps, marginal: np.ndarray | None = None) -> pd.DataFrame:
    """Log presence ratios of the maps, as the segmentation takes them: indexed by s since 1970, NaN without coverage.

    `marginal` is taken as by `range_presence`.

    Raises
    ------
    LayoutError : the maps hold neither azimuth_llr nor range_llr.
    """
    if "azimuth_llr" not in maps and "range_llr" not in maps:
        raise LayoutError(
            f"likelihood maps hold azimuth_llr or range_llr, found {', '.join(map(str, maps)) or 'nothing'}"
        )
    columns: dict[str, np.ndarray] = {}
    if "azimuth_llr" in maps:
        columns["azimuth"] = azimuth_presence(maps["azimuth_llr"].values)
    if "range_llr" in maps:
        columns |= range_presence(
            maps["range_llr"].values, maps["range"].values, maps["range_rate"].values, marginal
        )
    table = pd.DataFrame(columns, index=to_posix(maps["time"].values))
    for name in ("azimuth", "range"):
        if f"{name}_llr" in maps:
            silent = maps[f"{name}_coverage"].values == 0
            table.loc[silent, [c for c in columns if (c == "azimuth") == (name == "azimuth")]] = np.nan
    return table


def detections(maps: LikelihoodMaps, ratios: pd.DataFrame | None = None) -> pd.DataFrame:
    """One row a minute: what the maps say, read off at their posterior's maximum (paper's eqs 13 and 23).

    Parameters
    ----------
    maps : LikelihoodMaps with dims time and azimuth and/or range and range_rate.
    ratios : DataFrame of `presence`, if it is there already.

    Returns
    -------
    DataFrame with columns time, coverage, azimuth_deg, azimuth_llr, range_m, range_rate_mps, range_llr. The `_llr` columns
    are log marginal posterior ratios of presence, filled where there is coverage; estimates are NaN where they are ≤ 0, and
    the azimuth where it is known up to 180° alone while the record's others are known.
    """
    ratios = presence(maps) if ratios is None else ratios
    empty = np.full(maps.sizes["time"], np.nan)
    table = {
        name: empty.copy()
        for name in ("azimuth_deg", "azimuth_llr", "range_m", "range_rate_mps", "range_llr")
    }
    covered = np.zeros(maps.sizes["time"])
    if "azimuth_llr" in maps:
        covered = np.maximum(covered, maps["azimuth_coverage"].values)
        table["azimuth_llr"] = ratios["azimuth"].to_numpy()
        found = table["azimuth_llr"] > 0
        if maps["azimuth"].attrs.get("ambiguity_deg", 360) == 360:
            found &= ~two_sided(maps["azimuth_llr"].values)
        table["azimuth_deg"][found] = _peak_azimuth(maps["azimuth_llr"].values[found], maps["azimuth"].values)
    if "range_llr" in maps:
        covered = np.maximum(covered, maps["range_coverage"].values)
        range_m, rate = maps["range"].values, maps["range_rate"].values
        table["range_llr"] = ratios["range"].to_numpy()
        ranged = np.flatnonzero(table["range_llr"] > 0)
        with np.errstate(divide="ignore"):
            log_prior = np.log(np.maximum(range_m, 0.0)).astype(np.float32)[:, None]
        for minute in ranged:
            score = maps["range_llr"].values[minute] + log_prior
            best = int((score >= score.max() - TIE).argmax())
            table["range_m"][minute] = range_m[best // len(rate)]
            table["range_rate_mps"][minute] = rate[best % len(rate)]
    return pd.DataFrame({"time": maps["time"].values, "coverage": covered, **table})


def _peak_azimuth(llr: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Azimuth of the maximum, refined between grid points by a parabola through the peak and its neighbours."""
    if not len(llr):
        return np.empty(0)
    best = llr.argmax(axis=1)
    rows = np.arange(len(llr))
    before, top, after = (llr[rows, (best + shift) % len(azimuth)] for shift in (-1, 0, 1))
    bend = before - 2.0 * top + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1.0), 0.0)
    return (azimuth[best] + np.clip(shift, -0.5, 0.5) * (azimuth[1] - azimuth[0])) % 360.0
