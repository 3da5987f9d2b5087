"""Clicks with their angles of arrival in, an azimuth map out: the form in which any tracker takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import from_posix, to_posix


@dataclass(frozen=True)
class ClickMapConfig:
    """What an animal's clicks are held against in an azimuth map.

    Attributes
    ----------
    window_s : length of the window around each time, s.
    click_rates_hz : rates of detected clicks between which the animal's is not known, 1/s.
    clutter_rate_hz : rate of other detections from anywhere, 1/s.
    motion_deg : how far an animal's azimuth wanders within a window, standard deviation.
    """

    window_s: float = 60.0
    click_rates_hz: tuple[float, ...] = (0.05, 0.2, 0.5, 1.0, 2.0)
    clutter_rate_hz: float = 0.05
    motion_deg: float = 1.0

    def __post_init__(self) -> None:
        for name in ("window_s", "clutter_rate_hz", "motion_deg"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name} must be positive, found {value!r}")
        if not self.click_rates_hz or min(self.click_rates_hz) <= 0:
            raise ConfigError(
                f"click_rates_hz must be one or more positive rates, found {self.click_rates_hz!r}"
            )


def azimuth_map(
    detections: pd.DataFrame,
    times: np.ndarray,
    azimuth: np.ndarray | None = None,
    config: ClickMapConfig | None = None,
    span: tuple[float, float] | None = None,
    gaps: np.ndarray | None = None,
) -> xr.Dataset:
    """Log-likelihood ratio of an animal clicking at each azimuth against clutter alone.

    Detections are a Poisson process: clutter at rate κ, uniform over azimuth, and an animal at azimuth α and
    rate r, spread by each detection's error. In a window of length T with detections α_i the ratio is, for a
    given rate,

        ln L(α | r) = −r T + Σ_i ln(1 + (r / κ) · 360° · N(α_i − α; 0, σ_i² + motion²))

    with N wrapped, averaged (as L) over the rates of the configuration. Silence counts against an animal,
    other animals' clicks do not.

    Parameters
    ----------
    detections : DataFrame with columns time [s since 1970 or datetime64], azimuth_deg, azimuth_std_deg; NaN
        azimuths are left out.
    times : centres of the windows, datetime64 or s since 1970.
    azimuth : grid, deg; every degree by default.
    span : start and end of the recording, s since 1970, for the coverage; unknown it counts as complete.
    gaps : array (gap, (start, end)), s since 1970, within the recording.

    Returns
    -------
    LikelihoodMaps: Dataset with ``azimuth_llr`` (time, azimuth) float32, natural log, NaN where nothing was
    recorded, and ``azimuth_coverage`` (time), the recorded share of each window.

    Raises
    ------
    LayoutError
        A column is missing, or the grid is no list of azimuths.
    """
    config = config or ClickMapConfig()
    grid = np.arange(360.0) if azimuth is None else np.asarray(azimuth, float)
    if grid.ndim != 1 or not len(grid) or not np.isfinite(grid).all():
        raise LayoutError("the azimuth grid must be a list of finite azimuths in degrees")
    missing = [name for name in ("time", "azimuth_deg", "azimuth_std_deg") if name not in detections]
    if missing:
        raise LayoutError(
            f"click detections lack {', '.join(missing)}; they hold {', '.join(map(str, detections))}"
        )
    centre, heard = _posix(times), _posix(detections["time"].to_numpy())
    bearing = detections["azimuth_deg"].to_numpy(float)
    spread = np.hypot(detections["azimuth_std_deg"].to_numpy(float), config.motion_deg)
    known = np.isfinite(bearing) & np.isfinite(spread)
    order = np.flatnonzero(known)[np.argsort(heard[known], kind="stable")]
    heard, ratio = heard[order], _wrapped_ratio(bearing[order], np.minimum(spread[order], 180.0), grid)
    coverage = np.ones(len(centre)) if span is None else _coverage(centre, config.window_s, span, gaps)
    first = np.searchsorted(heard, centre - config.window_s / 2.0)
    last = np.searchsorted(heard, centre + config.window_s / 2.0)
    rates = np.asarray(config.click_rates_hz)
    llr = np.full((len(centre), len(grid)), np.nan, np.float32)
    for k in np.flatnonzero(coverage > 0):
        gain = np.log1p(rates[:, None, None] / config.clutter_rate_hz * ratio[first[k] : last[k]]).sum(axis=1)
        per_rate = gain - (rates * config.window_s * coverage[k])[:, None]
        llr[k] = np.logaddexp.reduce(per_rate, axis=0) - np.log(len(rates))
    return xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), llr, {"units": "1", "long_name": "log-likelihood ratio"}),
            "azimuth_coverage": ("time", coverage.astype(np.float32), {"units": "1"}),
        },
        {"time": from_posix(centre), "azimuth": ("azimuth", grid, {"units": "deg"})},
        {"detector": "clicks", "window_s": config.window_s},
    )


def _posix(times: np.ndarray) -> np.ndarray:
    times = np.atleast_1d(np.asarray(times))
    return to_posix(times) if np.issubdtype(times.dtype, np.datetime64) else times.astype(float)


def _wrapped_ratio(bearing: np.ndarray, spread: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Wrapped normal density over the uniform one, dims (detection, azimuth)."""
    apart = (grid[None, :] - bearing[:, None] + 180.0) % 360.0 - 180.0
    turns = np.array([-720.0, -360.0, 0.0, 360.0, 720.0])
    squared = ((apart[..., None] + turns) / spread[:, None, None]) ** 2
    return 360.0 * np.exp(-0.5 * squared).sum(axis=-1) / (np.sqrt(2.0 * np.pi) * spread[:, None])


def _coverage(
    centre: np.ndarray, window_s: float, span: tuple[float, float], gaps: np.ndarray | None
) -> np.ndarray:
    """Share of each window that was recorded."""
    recorded = _overlap(centre, window_s, *span)
    for begin, end in np.zeros((0, 2)) if gaps is None else gaps:
        recorded = recorded - _overlap(centre, window_s, max(begin, span[0]), min(end, span[1]))
    return np.clip(recorded / window_s, 0.0, 1.0)


def _overlap(centre: np.ndarray, window_s: float, begin: float, end: float) -> np.ndarray:
    first, last = np.maximum(centre - window_s / 2.0, begin), np.minimum(centre + window_s / 2.0, end)
    return np.maximum(last - first, 0.0)
