"""report.png: all that a run heard and found, on one page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from obsnet.ais import ReferenceTrack
from obsnet.layout import iso, to_posix
from obsnet.plots import panels, style
from obsnet.plots.columns import Columns
from obsnet.plots.plan import plan_view
from obsnet.run import Run

_COLUMNS = 760
_LEFT, _WIDTH, _BAR = 0.065, 0.545, 0.008


def report(
    run: Run, path: str | Path | None = None, reference: list[ReferenceTrack] | None = None
) -> Figure:
    """The report of a run: spectrogram, azigram, cepstrogram, both maps with what was found, and a plan view.

    Parameters
    ----------
    run : Run, in memory or from a folder.
    path : PNG file to write, if any.
    reference : AIS tracks to lay over it.

    Returns
    -------
    matplotlib Figure.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    made = style.figure(14.0, 9.6)
    time = run.maps["time"].values
    if len(time):
        _fill(made, run, reference or [], Columns.over(time, _COLUMNS))
    else:
        style.say(made.add_axes((0.06, 0.06, 0.9, 0.86)), "no minute of data")
    made.suptitle(_title(run, time), x=_LEFT, y=0.985, ha="left", fontsize=13)
    if path is not None:
        style.save(made, path)
    return made


def _fill(made: Figure, run: Run, reference: list[ReferenceTrack], columns: Columns) -> None:
    start, end = columns.start, columns.end
    reference = [ship for ship in reference if ship.time[-1] > start and ship.time[0] < end]
    features = run.features
    boxes = _rows([0.13, 0.13, 0.15, 0.205, 0.205], bottom=0.065, top=0.945, gap=0.014)
    axes = [made.add_axes((_LEFT, low, _WIDTH, height)) for low, height in boxes]
    longest = 1.15 * _longest_tdoa(run)
    drawn = [
        panels.spectrogram(axes[0], features, columns, run.config.spectra.window_s),
        panels.azigram(axes[1], features, columns),
        panels.cepstrogram(axes[2], features, columns, longest),
        panels.azimuth_map(axes[3], run, columns),
        panels.range_map(axes[4], run, columns),
    ]
    names = ("spectrogram", "azigram", "cepstrogram", "azimuth likelihood", "range likelihood")
    for ax, what, name, (low, height) in zip(axes, drawn, names, boxes, strict=True):
        style.time_axis(ax, start, end, labelled=ax is axes[-1])
        if what is None:
            continue
        style.label(ax, name)
        cax = made.add_axes((_LEFT + _WIDTH + 0.006, low, _BAR, height))
        bar = made.colorbar(what[0], cax=cax)
        bar.set_label(what[1], fontsize=8)
        cax.tick_params(labelsize=7.5)
        if what[1].startswith("azimuth"):
            bar.set_ticks([0, 90, 180, 270, 360], labels=["N", "E", "S", "W", "N"])
    for ax, kind in ((axes[3], "azimuth"), (axes[4], "range")):
        panels.overlay(ax, run, reference, kind, start, end)
    plan = made.add_axes((0.725, 0.49, 0.262, 0.382 * 1.19))
    plan_view(plan, run, reference, start, end)
    _legend(made.add_axes((0.69, 0.05, 0.3, 0.37)), run, reference)


def _longest_tdoa(run: Run) -> float:
    """The longest delay between the first two paths that the ranges in reach can show [s]."""
    delay = run.table["delay"]
    between = np.nanmax(delay.sel(path=3).values - delay.sel(path=1).values)
    return float(np.clip(between, 1.0, 10.0)) if np.isfinite(between) else 5.0


def _rows(heights: list[float], bottom: float, top: float, gap: float) -> list[tuple[float, float]]:
    """Bottom and height of stacked panels, first on top, scaled to fill the page."""
    scale = (top - bottom - gap * (len(heights) - 1)) / sum(heights)
    rows, edge = [], top
    for height in heights:
        edge -= height * scale
        rows.append((edge, height * scale))
        edge -= gap
    return rows


def _legend(ax: Axes, run: Run, reference: list[ReferenceTrack]) -> None:
    ax.set_axis_off()
    handles: list = [
        Line2D([], [], marker="o", ms=4, mfc="white", mec="black", ls="", label="detection, one a minute")
    ]
    if reference:
        handles.append(Line2D([], [], color="black", ls=(0, (4, 3)), label=f"AIS ({len(reference)} tracks)"))
    if run.tracks:
        handles.append(Patch(fc=style.VERMILLION, ec="black", label="90 % at closest approach"))
    handles.append(Line2D([], [], marker="*", ms=10, mfc=style.YELLOW, mec="black", ls="", label="station"))
    ax.legend(handles=handles, loc="upper left", ncols=2, fontsize=8.5, frameon=False, borderaxespad=0)
    lines = _track_lines(run)
    for row, (text, colour) in enumerate(lines):
        ax.text(0.0, 0.80 - 0.058 * row, text, color=colour, fontsize=8.5, va="top", family="monospace")


def _track_lines(run: Run, most: int = 12) -> list[tuple[str, str]]:
    lines = [("no ship found", "black")] if not run.tracks else []
    for number, track in enumerate(run.tracks[:most]):
        row = track.row(number + 1)
        side = "" if np.isnan(row["course_deg"]) else f", course {row['course_deg']:.0f}°"
        text = (
            f"{number + 1}: CPA {row['cpa_time'][:16].replace('T', ' ')}, {row['cpa_distance_m'] / 1e3:.1f} km"
            f"{side}, {row['speed_mps']:.1f} m/s"
        )
        lines.append((text, "black"))
    if len(run.tracks) > most:
        lines.append((f"and {len(run.tracks) - most} more in tracks.csv", "black"))
    return lines


def _title(run: Run, time: np.ndarray) -> str:
    if not len(time):
        return f"{run.station.code}: no minute of data"
    first, last = (iso(float(to_posix(t)))[:16].replace("T", " ") for t in (time[0], time[-1]))
    count = len(run.tracks)
    ships = "no ship" if not count else f"{count} ship{'s' if count > 1 else ''}"
    return f"{run.station.code}: {first} to {last} UTC, {ships}"
