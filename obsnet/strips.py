"""Maps and representations in, one column of bytes a minute out: what a page shows of them, and a station keeps of them.

A column is small (some 400 bytes a minute for azimuth, range and spectrum together), so that days of them can be kept and
sent. A byte of 0 is no data; 1 to 255 stand for equal steps from `low` to `high`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from obsnet.detectors.maps import MARGINAL, LikelihoodMaps, range_rate_marginal

LLR = (-30.0, 30.0)
"""Log-likelihood ratios shown, nats."""
LEVEL = (20.0, 150.0)
"""Power spectral densities shown, dB re 1 µPa²/Hz or 1 (nm/s)²/Hz."""
MOST_CELLS = 180
"""Cells of a column of a map."""
DENSITIES = {"Pa2": (120.0, "dB re 1 µPa²/Hz"), "m2 s-2": (180.0, "dB re 1 (nm/s)²/Hz")}
HANN_NOISE_BINS = 1.5
"""Equivalent noise bandwidth of a Hann window, in bins of 1 / its length."""


@dataclass(frozen=True)
class Axis:
    """Cells of a column: their first centre and spacing, in `unit`; and what its bytes span, in `of`."""

    first: float
    step: float
    count: int
    unit: str
    low: float
    high: float
    of: str


def columns(
    maps: LikelihoodMaps, features: xr.Dataset, window_s: float
) -> tuple[dict[str, np.ndarray], dict[str, Axis]]:
    """Bytes (minute, cell) and axes of `azimuth`, `range` and `spectrum`, those that there are.

    Parameters
    ----------
    maps, features : of a `Minutes` or of a run, the same minutes.
    window_s : length of a frame of the spectra, for the density of power.
    """
    made: dict[str, np.ndarray] = {}
    axes: dict[str, Axis] = {}
    if "azimuth_llr" in maps:
        values = maps["azimuth_llr"].transpose("time", "azimuth").values
        made["azimuth"], axes["azimuth"] = _pooled(values, maps["azimuth"].values, "degrees")
    if MARGINAL in features:
        values = features[MARGINAL].transpose("time", "range").values
        made["range"], axes["range"] = _pooled(values, features["range"].values, "m")
    elif "range_llr" in maps:
        llr = maps["range_llr"].transpose("time", "range", "range_rate").values
        values = range_rate_marginal(llr.astype(np.float32, copy=False))
        made["range"], axes["range"] = _pooled(values, maps["range"].values, "m")
    if "power" in features:
        power = features["power"].transpose("time", ...)
        offset, unit = DENSITIES.get(power.attrs.get("units", "Pa2"), (0.0, "dB"))
        density = power.values * window_s / (2.0 * HANN_NOISE_BINS)
        level = 10.0 * np.log10(np.maximum(density, np.finfo(np.float32).tiny)) + offset
        frequency = features["spectrogram_frequency"].values
        made["spectrum"] = to_bytes(level, *LEVEL)
        axes["spectrum"] = _axis(frequency, "Hz", LEVEL, unit)
    return made, axes


def to_bytes(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Values as bytes; NaN is 0."""
    scaled = 1.0 + 254.0 * (np.clip(values, low, high) - low) / (high - low)
    return np.where(np.isnan(scaled), 0.0, np.rint(scaled)).astype(np.uint8)


def plain(axes: dict[str, Axis]) -> dict[str, Any]:
    """Axes as plain values."""
    return {name: asdict(axis) for name, axis in axes.items()}


def _pooled(values: np.ndarray, axis: np.ndarray, unit: str) -> tuple[np.ndarray, Axis]:
    """The greatest value of neighbouring cells, so many together that at most `MOST_CELLS` are left."""
    size = -(-len(axis) // MOST_CELLS)
    count = len(axis) // size
    kept = values[:, : count * size].reshape(len(values), count, size)
    centres = axis[: count * size].reshape(count, size).mean(axis=1)
    return to_bytes(kept.max(axis=2), *LLR), _axis(centres, unit, LLR, "log-likelihood ratio")


def _axis(centres: np.ndarray, unit: str, span: tuple[float, float], of: str) -> Axis:
    step = float(centres[1] - centres[0]) if len(centres) > 1 else 1.0
    return Axis(float(centres[0]), step, len(centres), unit, *span, of)
