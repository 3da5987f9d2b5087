"""report.png: all that a run heard and found, on one page."""

from __future__ import annotations

import textwrap
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from obsnet.plots import overlay, panels, style
from obsnet.plots.columns import Columns
from obsnet.plots.plan import close_up, plan_view
from obsnet.run import Run

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack

_COLUMNS = 740
_PAGE = (13.6, 9.4)
_LEFT, _WIDTH = 0.75, 7.2
_ROWS = (
    ("spectrogram", panels.spectrogram, 1.3),
    ("azigram", panels.azigram, 1.3),
    ("cepstrogram", panels.cepstrogram, 1.5),
    ("azimuth likelihood", panels.azimuth_map, 1.95),
    ("range likelihood", panels.range_map, 1.95),
)
_CLOSE_UPS, _SHORT = 3, 11
"""Close-ups of so many tracks, where the text has fewer lines than that."""


def report(run: Run, path: str | Path | None = None, reference: list[ReferenceTrack] | None = None) -> Figure:
    """The report of a run: spectrogram, azigram, cepstrogram, both maps with what was found, and a plan view.

    Detections, tracks and AIS lie on the maps as the station heard them, and on the plan where the ships were.

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
    page = Page(run)
    page.fill(run, reference or [])
    if path is not None:
        style.save(page.figure, path)
    return page.figure


def drawing(path: str | Path, reference: list[ReferenceTrack] | None = None) -> Generator[None, Any, None]:
    """The report in steps, as `obsnet.beside.Beside` takes them, the same picture as `report` makes.

    It is sent the run when all is heard, and paints that; then the run's segments, tracks and info, and paints those over it.
    """
    run: Run = yield
    page = Page(run)
    painting = style.Painting(page.figure)
    run.segments, run.tracks, run.info = yield
    page.fill(run, reference or [])
    painting.save(path)


class Page:
    """The report as it grows: first what was heard, then what was found in it.

    Attributes
    ----------
    figure : matplotlib Figure.
    """

    def __init__(self, run: Run) -> None:
        self.figure = style.figure(*_PAGE)
        self._columns = Columns.over(run.maps["time"].values, _COLUMNS)
        self._panels: list[Axes] = []
        if self._columns is None:
            place = style.box(self.figure, _LEFT, 0.6, _PAGE[0] - 2 * _LEFT, _PAGE[1] - 1.4)
            style.say(place, "no minute of data")
            return
        top = _PAGE[1] - 0.45
        for _, draw, height in _ROWS:
            ax = style.box(self.figure, _LEFT, top - height, _WIDTH, height)
            top -= height + 0.1
            draw(ax, run, self._columns)
            style.time_axis(ax, self._columns.start, self._columns.end, labelled=draw is panels.range_map)
            self._panels.append(ax)

    def fill(self, run: Run, reference: list[ReferenceTrack]) -> None:
        """Draw what was found, and AIS, over the panels and on a plan; say it in words."""
        if self._columns is None:
            style.title(self.figure, f"{run.station.code}: no minute of data")
            return
        start, end = self._columns.start, self._columns.end
        reference = [ship for ship in reference if ship.endtime > start and ship.starttime < end]
        for ax, (name, draw, _) in zip(self._panels, _ROWS, strict=True):
            if draw in (panels.azimuth_map, panels.range_map):
                kind: overlay.Kind = "azimuth" if draw is panels.azimuth_map else "range"
                overlay.curves(ax, run, reference, kind, start, end)
                overlay.detections(ax, run, kind, start, end)
            style.name(ax, name)
        _plan_and_words(self.figure, run, reference, start, end)
        style.title(self.figure, f"{run.station.code}, {style.span(start, end)}: {_found(run)}")


def _plan_and_words(
    made: Figure, run: Run, reference: list[ReferenceTrack], start: float, end: float
) -> None:
    plan_view(style.box(made, 9.25, 4.8, 4.15, 4.15), run, reference, start, end)
    words = style.box(made, 9.0, 2.0, 4.5, 2.25)
    words.set_axis_off()
    _legend(words, run, reference)
    text = _text(run)
    words.text(0.0, 0.70, text, fontsize=8, va="top", family="monospace", linespacing=1.4)
    located = [(n, track) for n, track in enumerate(run.tracks) if np.isfinite(track.std).all()]
    room = _CLOSE_UPS if text.count("\n") < _SHORT else 0
    for place, (number, track) in enumerate(located[:room]):
        close_up(style.box(made, 9.35 + 1.5 * place, 0.35, 1.2, 1.2), track, number, reference)


def _found(run: Run) -> str:
    count = len(run.tracks)
    if "track" not in run.info.get("seconds", {"track": 0.0}):
        return "detections only"
    return f"{count} ship{'s' if count > 1 else ''} found" if count else "no ship found"


def _legend(ax: Axes, run: Run, reference: list[ReferenceTrack]) -> None:
    handles = overlay.handles(run, reference)
    handles.insert(
        0, Line2D([], [], marker="*", ms=10, mfc=style.YELLOW, mec="black", ls="", label="station")
    )
    handles.append(Line2D([], [], marker=".", ms=5, color="#888888", ls="", label="detection on the plan"))
    colour = style.track_style(0)["color"]
    observed = [bool(np.isfinite(track.std[2])) for track in run.tracks]
    if any(observed):
        handles.append(Patch(fc=colour, ec="black", alpha=0.55, label="90 % at closest approach"))
    if not all(observed):
        handles.append(Line2D([], [], color=colour, ls=":", label="distance at CPA, course unknown"))
    ax.legend(handles=handles, loc="upper left", ncols=2, fontsize=8.5, frameon=False, borderaxespad=0)


def _text(run: Run, most: int = 12) -> str:
    lines = []
    if run.tracks:
        lines.append(" #  closest approach (UTC)     km      course °      m/s")
    for number, track in enumerate(run.tracks[:most], 1):
        row = track.row(number)
        lines.append(
            f"{number:2d}  {row['cpa_time'][5:19].replace('T', ' ')} ±{row['cpa_time_std_s']:3.0f} s  "
            f"{row['cpa_distance_m'] / 1e3:4.1f}±{row['cpa_distance_std_m'] / 1e3:<3.1f}  {_course(row)}  "
            f"{row['speed_mps']:5.2f}±{row['speed_std_mps']:.2f}"
        )
    if len(run.tracks) > most:
        lines.append(f"and {len(run.tracks) - most} more, in tracks.csv")
    found = run.detections
    heard = int((found["coverage"] > 0).sum())
    azimuths, ranges = (int(found[name].notna().sum()) for name in ("azimuth_deg", "range_m"))
    lines += [
        "",
        f"{heard} of {len(found)} minutes with data:",
        f"{azimuths} with an azimuth, {ranges} with a range",
    ]
    for note in run.info.get("notes", []):
        lines += textwrap.wrap(str(note), 60)
    return "\n".join(lines)


def _course(row: dict) -> str:
    return (
        "    -    "
        if np.isnan(row["course_deg"])
        else f"{row['course_deg']:5.1f}±{row['course_std_deg']:<3.1f}"
    )
