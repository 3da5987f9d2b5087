"""Colours, axes of time and files that all pictures share.

Sequential maps grow evenly in lightness (readable in grey), the map of azimuth is cyclic, and categories take the
colours of Okabe and Ito, each with a marker or a line style of its own. Missing data are white.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imsave

from obsnet.errors import OutputError
from obsnet.layout import iso

ORANGE, SKY, GREEN = "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
SEQUENTIAL, CYCLIC, DIVERGING = "cividis", "twilight", "PuOr_r"
REFERENCE_DASHES = (0, (3.5, 2.5))
DPI = 100
_DAY = 86400.0
_STEPS = (60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200)
_STEPS_DAYS = (1, 2, 5, 10, 30, 60, 180, 365)


def track_style(number: int) -> dict[str, Any]:
    """Colour and line style of track `number` (from 0)."""
    colours = (VERMILLION, SKY, PURPLE, ORANGE, GREEN)
    dashes = ("-", "-.", ":")
    return {
        "color": colours[number % len(colours)],
        "ls": dashes[number // len(colours) % len(dashes)],
    }


def figure(width: float, height: float) -> Figure:
    """An empty figure [inch] without a window or global state."""
    made = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(made)
    return made


def box(made: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes at a place of the page, in inches from its lower left corner."""
    page = made.get_size_inches()
    return made.add_axes((left / page[0], bottom / page[1], width / page[0], height / page[1]))


def days(seconds: Any) -> Any:
    """Times on the axis of time (days since 1970) of s since 1970."""
    return np.asarray(seconds, float) / _DAY


def time_axis(ax: Axes, start: float, end: float, labelled: bool = True, most: int = 9) -> None:
    """UTC ticks, at most `most`, over `start` … `end` (s since 1970); dates under the first and each midnight."""
    ticks = _time_ticks(start, end, most)
    labels = []
    for i, tick in enumerate(ticks):
        stamp = iso(float(tick))
        text = "" if _whole_days(ticks) else stamp[11:16]
        dated = i == 0 or tick % _DAY == 0
        labels.append(f"{text}\n{stamp[:10]}".strip() if dated else text)
    if not labelled:
        labels = [""] * len(ticks)
    ax.set_xticks(days(ticks), labels, fontsize=8)
    ax.set_xlim(days(start), days(end))
    if labelled:
        ax.set_xlabel("time (UTC)", fontsize=9)


def _time_ticks(start: float, end: float, most: int) -> np.ndarray:
    span = end - start
    steps = [*_STEPS, *(_DAY * n for n in _STEPS_DAYS)]
    step = next((s for s in steps if span / s <= most), _DAY * 365 * np.ceil(span / most / _DAY / 365))
    return step * np.arange(np.ceil(start / step), np.floor(end / step) + 1)


def _whole_days(ticks: np.ndarray) -> bool:
    return bool(len(ticks) > 1 and ((ticks[1] - ticks[0]) % _DAY == 0))


def azimuth_axis(ax: Axes) -> None:
    """Azimuth from 0° to 360°, a tick at each cardinal point."""
    ax.set_ylim(0.0, 360.0)
    ax.set_yticks([0, 90, 180, 270, 360], ["N 0", "E 90", "S 180", "W 270", "N 360"], fontsize=8)
    ax.set_ylabel("azimuth [°]", fontsize=9)


def y_axis(ax: Axes, label: str, low: float, high: float, most: int = 6) -> None:
    """Limits, at most so many ticks, and the name of a vertical axis."""
    ax.set_ylim(low, high)
    ax.set_yticks(ticks := nice_ticks(low, high, most), [f"{tick:g}" for tick in ticks], fontsize=8)
    ax.set_ylabel(label, fontsize=9)


def nice_ticks(low: float, high: float, most: int = 6) -> np.ndarray:
    """Multiples of 1, 2 or 5 times a power of ten within the limits."""
    decade = 10.0 ** np.floor(np.log10((high - low) / most))
    step = next(decade * m for m in (1, 2, 5, 10) if (high - low) / (decade * m) <= most)
    return np.round(step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1), 9) + 0.0


def bar(ax: Axes, picture: AxesImage, label: str) -> None:
    """Colour bar of an image, beside its axes; light, where matplotlib's own is slow."""
    made: Any = ax.figure
    place = ax.get_position()
    width = 0.11 / made.get_size_inches()[0]
    cax = made.add_axes((place.x1 + 0.6 * width, place.y0, width, place.height))
    low, high = (float(limit) for limit in picture.get_clim())  # type: ignore[arg-type]
    shades = np.linspace(low, high, 128)[:, None]
    extent = (0.0, 1.0, low, high)
    cax.imshow(shades, origin="lower", aspect="auto", extent=extent, cmap=picture.cmap, vmin=low, vmax=high)
    cax.yaxis.tick_right()
    cax.yaxis.set_label_position("right")
    cax.set_xticks([])
    if label == "azimuth":
        cax.set_yticks([0, 90, 180, 270, 360], ["N", "E", "S", "W", "N"], fontsize=7.5)
    else:
        ticks = nice_ticks(low, high, 5)
        cax.set_yticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=7.5)
    cax.set_ylabel(label, fontsize=8)


def say(ax: Axes, text: str) -> None:
    """Write into an empty panel why it is empty."""
    ax.set_facecolor("#F2F2F2")
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color="#404040")


def name(ax: Axes, text: str) -> None:
    """Name a panel in its upper left corner."""
    frame = {"boxstyle": "square,pad=0.25", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    ax.annotate(text, (0, 1), (5, -5), xycoords="axes fraction", textcoords="offset points", ha="left", va="top",
                fontsize=8.5, bbox=frame, zorder=9)  # fmt: skip


def number(ax: Axes, index: int, x: float, y: float) -> None:
    """The number of track `index` (from 0) in a circle of its colour."""
    frame = {"boxstyle": "circle,pad=0.15", "fc": "white", "ec": track_style(index)["color"], "lw": 1.0}
    ax.text(x, y, str(index + 1), fontsize=7, ha="center", va="center", bbox=frame, clip_on=True, zorder=8)


def title(made: Figure, text: str) -> None:
    """What a page shows, at its upper left."""
    width, height = made.get_size_inches()
    made.text(0.75 / width, 1.0 - 0.22 / height, text, ha="left", va="center", fontsize=12)


def span(start: float, end: float) -> str:
    """A stretch of time, to the minute, the date once where it is the same."""
    first, last = (iso(float(np.rint(t / 60.0) * 60.0))[:16].replace("T", " ") for t in (start, end))
    return f"{first} to {last[11:] if last[:10] == first[:10] else last} UTC"


class Painting:
    """A figure painted as far as it is made, to which more is added later: what is there is not painted again.

    What is added lies above what was there, whatever its `zorder`.

    Parameters
    ----------
    made : figure of `figure`.
    """

    def __init__(self, made: Figure) -> None:
        self._figure, self._canvas = made, FigureCanvasAgg(made)
        self._canvas.draw()
        self._axes = list(made.axes)
        self._painted = set(map(id, self._artists()))

    def _artists(self) -> list[Artist]:
        """What a later addition may be: children of the figure and of its axes at the time of the first painting."""
        return [*self._figure.get_children(), *(child for ax in self._axes for child in ax.get_children())]

    def save(self, path: str | Path) -> Path:
        """Paint what was added and write the figure as PNG; errors as for `save`."""
        new = [artist for artist in self._artists() if id(artist) not in self._painted]
        for artist in sorted(new, key=lambda artist: artist.get_zorder()):
            artist.draw(self._canvas.get_renderer())
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        return _write(path, lambda file, **how: imsave(file, pixels, format="png", dpi=DPI, **how))


def save(made: Figure, path: str | Path) -> Path:
    """Write a figure as PNG, aside first and then in place.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    return _write(path, lambda file, **how: made.savefig(file, format="png", dpi=DPI, **how))


def _write(path: str | Path, write: Callable[..., Any]) -> Path:
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        write(partial, pil_kwargs={"compress_level": 1})
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from None
    return path
