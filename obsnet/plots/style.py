"""Colours, axes of time and files that all pictures share.

Sequential maps grow evenly in lightness (readable in grey), the map of azimuth is cyclic, and categories take the colours of
Okabe and Ito with a marker or a line style of their own.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from obsnet.errors import OutputError

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
TRACK_COLOURS = (VERMILLION, SKY, PURPLE, ORANGE, GREEN, BLUE)
LLR, LEVEL, CEPSTRUM, RANGE_RATE = "cividis", "cividis", "Greys", "PuOr_r"
AZIMUTH = "twilight"
NO_DATA = "#B0B0B0"
DPI = 100
_DAY = 86400.0


def colormap(name: str) -> Any:
    """A colour map whose missing values are grey."""
    found = colormaps[name].copy()
    found.set_bad(NO_DATA)
    return found


def figure(width: float, height: float) -> Figure:
    """An empty figure [inch] without a window or global state."""
    made = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(made)
    return made


def days(seconds: Any) -> Any:
    """Times on a matplotlib date axis (days since 1970) of s since 1970."""
    return np.asarray(seconds, float) / _DAY


def time_axis(ax: Axes, start: float, end: float, labelled: bool = True) -> None:
    """UTC ticks over `start` … `end` (s since 1970)."""
    locator = AutoDateLocator(minticks=3, maxticks=9)
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    ax.set_xlim(days(start), days(end))
    ax.tick_params(axis="x", labelbottom=labelled)
    if labelled:
        ax.set_xlabel("time (UTC)")
    else:
        ax.xaxis.get_offset_text().set_visible(False)


def azimuth_axis(ax: Axes) -> None:
    """Azimuth from 0° to 360°, a tick at each cardinal point."""
    ax.set_ylim(0.0, 360.0)
    ax.set_yticks([0, 90, 180, 270, 360], ["N 0", "E 90", "S 180", "W 270", "N 360"])
    ax.set_ylabel("azimuth [°]")


def say(ax: Axes, text: str) -> None:
    """Write into an empty panel why it is empty."""
    ax.set_facecolor("#F2F2F2")
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color="#404040")


def label(ax: Axes, text: str) -> None:
    """Name a panel in its upper left corner."""
    box = {"boxstyle": "square,pad=0.25", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    ax.text(0.006, 0.96, text, transform=ax.transAxes, ha="left", va="top", fontsize=8.5, bbox=box, zorder=9)


def save(made: Figure, path: str | Path) -> Path:
    """Write a figure as PNG, aside first and then in place.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        made.savefig(partial, format="png", dpi=DPI, pil_kwargs={"compress_level": 3})
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from None
    return path
