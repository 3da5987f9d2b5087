"""The panels that pictures are made of: representations, likelihood maps, and what was found drawn over them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from obsnet.ais import ReferenceTrack
from obsnet.layout import to_posix
from obsnet.plots import style
from obsnet.plots.columns import Columns, azimuth_columns, range_marginal
from obsnet.run import Run
from obsnet.trackers.track import Track

Delay = Callable[[np.ndarray], np.ndarray]
HANN_NOISE_BINS = 1.5
"""Equivalent noise bandwidth of a Hann window in bins of 1 / its length."""


def image(
    ax: Axes, values: np.ndarray, columns: Columns, axis: np.ndarray, cmap: str, low: float, high: float
) -> Any:
    """Values (column, cell) against time and a regular axis."""
    half = (axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5
    extent = (style.days(columns.start), style.days(columns.end), axis[0] - half, axis[-1] + half)
    norm = Normalize(low, high if high > low else low + 1.0)
    return ax.imshow(
        values.T,
        origin="lower",
        aspect="auto",
        extent=extent,
        cmap=style.colormap(cmap),
        norm=norm,
        interpolation="nearest",
    )


def spectrogram(ax: Axes, features: xr.Dataset, columns: Columns, window_s: float) -> Any:
    """Power spectral density [dB] of the pressure, or of the ground's motion without a hydrophone."""
    if "power" not in features:
        return style.say(ax, "no spectrogram")
    power = features["power"]
    density = columns.mean(power) * (window_s / HANN_NOISE_BINS / 2.0)
    level, unit = 10.0 * np.log10(np.maximum(density, 1e-30)), "dB"
    if power.attrs.get("units") == "Pa²":
        level, unit = level + 120.0, "dB re 1 µPa²/Hz"
    elif power.attrs.get("units") == "m²/s²":
        level, unit = level + 180.0, "dB re 1 nm²/s²/Hz"
    frequency = features["spectrogram_frequency"].values
    shown = _finite(level[:, frequency >= 4.0])
    picture = image(ax, level, columns, frequency, style.LEVEL, *np.percentile(shown, [2, 99.7]))
    ax.set_ylim(frequency[0], frequency[-1])
    ax.set_ylabel("frequency [Hz]")
    return picture, unit


def azigram(ax: Axes, features: xr.Dataset, columns: Columns) -> Any:
    """Azimuth of the sound in each time and frequency cell, in cyclic colours."""
    if "azigram" not in features:
        return style.say(ax, "no two horizontals: no azimuth")
    direction = columns.mean(features["azigram"])
    azimuth = np.where(np.isnan(direction), np.nan, np.rad2deg(np.angle(direction)) % 360.0)
    picture = image(ax, azimuth, columns, features["frequency"].values, style.AZIMUTH, 0.0, 360.0)
    ax.set_ylabel("frequency [Hz]")
    return picture, "azimuth [°]"


def cepstrogram(ax: Axes, features: xr.Dataset, columns: Columns, longest_s: float) -> Any:
    """Cepstrum against time, up to a quefrency of `longest_s`."""
    if "cepstrogram" not in features:
        return style.say(ax, "no hydrophone: no cepstrum")
    part = features["cepstrogram"].sel(quefrency=slice(0.0, longest_s))
    values = np.abs(columns.mean(part))
    quefrency = part["quefrency"].values
    high = np.percentile(_finite(values[:, quefrency > 0.5]), 99.7)
    picture = image(ax, values, columns, quefrency, style.CEPSTRUM, 0.0, float(high))
    ax.set_ylabel("quefrency [s]")
    return picture, "|cepstrum|"


def azimuth_map(ax: Axes, run: Run, columns: Columns) -> Any:
    """Log-likelihood ratio of a ship at each azimuth."""
    if "azimuth_llr" not in run.maps:
        style.azimuth_axis(ax)
        return style.say(ax, "no two horizontals: no azimuth")
    weight = run.detections["azimuth_llr"].to_numpy(float)
    values = azimuth_columns(run.maps, columns, weight)
    high = np.clip(np.percentile(_finite(values), 99.9), 10.0, 60.0)
    picture = image(ax, values, columns, run.maps["azimuth"].values, style.LLR, -high, high)
    style.azimuth_axis(ax)
    return picture, "log-likelihood ratio"


def range_map(ax: Axes, run: Run, columns: Columns) -> Any:
    """Log-likelihood ratio of a ship at each range [km], range rate marginalised."""
    if "range_llr" not in run.maps:
        ax.set_ylabel("range [km]")
        return style.say(ax, "no hydrophone: no range")
    weight = run.detections["range_llr"].to_numpy(float)
    values = range_marginal(run.maps, columns, weight)
    high = np.clip(np.percentile(_finite(values), 99.9), 10.0, 60.0)
    picture = image(ax, values, columns, run.maps["range"].values / 1e3, style.LLR, -high, high)
    ax.set_ylim(0.0, run.maps["range"].values[-1] / 1e3)
    ax.set_ylabel("range [km]")
    return picture, "log-likelihood ratio"


def heard(track: Track, delay: Delay, step_s: float = 120.0) -> tuple[np.ndarray, ...]:
    """Times [s since 1970], azimuth [deg], range [m] and range rate [m/s] of a track as the station hears it.

    What is heard at t left the ship at e, e + delay(range(e)) = t.
    """
    time = np.linspace(track.start, track.end, max(int((track.end - track.start) / step_s), 1) + 1)
    emitted = time
    for _ in range(6):
        emitted = time - np.asarray(delay(track.motion.observables(emitted)[1]), float)
    azimuth, distance, rate = track.motion.observables(emitted)
    if not np.isfinite(track.std[2]):
        azimuth = np.full_like(azimuth, np.nan)
    return time, azimuth, distance, rate


def reference_heard(reference: ReferenceTrack, delay: Delay, start: float, end: float) -> tuple[np.ndarray, ...]:
    """As `heard`, of an AIS track within `start` … `end`; empty where it is outside."""
    first, last = max(start, reference.starttime), min(end, reference.endtime + 120.0)
    time = np.linspace(first, last, 400) if last > first else np.empty(0)
    if not len(time):
        return (time,) * 4
    return time, *reference.heard(time, delay)


def without_jumps(time: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An azimuth curve cut where it passes north, so that no line crosses the panel."""
    cut = np.flatnonzero(np.abs(np.diff(azimuth)) > 180.0) + 1
    return np.insert(time, cut, np.nan), np.insert(azimuth, cut, np.nan)


def _finite(values: np.ndarray) -> np.ndarray:
    found = values[np.isfinite(values)]
    return found if found.size else np.array([0.0, 1.0])


def overlay(ax: Axes, run: Run, reference: list[ReferenceTrack], kind: str, start: float, end: float) -> None:
    """Detections, tracks and AIS as heard, on a map of `kind` azimuth or range."""
    found = run.detections
    column, scale = ("azimuth_deg", 1.0) if kind == "azimuth" else ("range_m", 1e-3)
    values = found[column].to_numpy(float) * scale
    shown = np.isfinite(values)
    seconds = to_posix(found["time"].to_numpy()[shown])
    ax.plot(style.days(seconds), values[shown], "o", ms=2.2, mfc="white", mec="black", mew=0.35, ls="")
    index = 0 if kind == "azimuth" else 1
    for ship in reference:
        time, *curves = reference_heard(ship, run.delay, start, end)
        _curve(ax, kind, time, curves[index] * scale if len(time) else time, "white", "black", (0, (4, 3)))
    for number, track in enumerate(run.tracks):
        time, *curves = heard(track, run.delay)
        colour = style.TRACK_COLOURS[number % len(style.TRACK_COLOURS)]
        _curve(ax, kind, time, curves[index] * scale, "white", colour, "-")


def _curve(ax: Axes, kind: str, time, values, under: str, colour: str, line: Any) -> None:
    if kind == "azimuth":
        time, values = without_jumps(time, values)
    ax.plot(style.days(time), values, color=under, lw=2.6, alpha=0.8)
    ax.plot(style.days(time), values, color=colour, lw=1.4, ls=line)
