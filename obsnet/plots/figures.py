"""The core paper's figures 3, 5, 6, 7 and 8, from any run's folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from obsnet.errors import ConfigError
from obsnet.plots import overlay, panels, style
from obsnet.plots.columns import Columns
from obsnet.plots.envelope import envelope_figure
from obsnet.plots.plan import plan_view
from obsnet.run import Run, read_run

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack

MOST_COLUMNS = 2000
DAY_ROWS = 8
"""Rows of figure 7; a longer run has several days in a row."""
MOST_TRACKS = 12
"""Tracks of figure 8, the strongest."""
_DAY = 86400.0
_MARGIN_S = 1800.0
Reference: TypeAlias = "list[ReferenceTrack]"


def draw(folder: str | Path, figures: Sequence[int], ais: str | Path | None = None) -> list[Path]:
    """Draw figures of the core paper from the folder of a run, into it.

    Parameters
    ----------
    folder : folder of ``obsnet track``.
    figures : numbers among `FIGURES`.
    ais : AIS file, to compare with.

    Returns
    -------
    list of Path : folder/figure-N.png.

    Raises
    ------
    ConfigError
        There is no such figure.
    LayoutError, AISError, OutputError
        The folder is not one of a run, the AIS file cannot serve, the pictures cannot be written.
    """
    unknown = [number for number in figures if number not in FIGURES]
    if unknown:
        raise ConfigError(f"no figure {unknown[0]}; choose among {', '.join(map(str, FIGURES))}")
    run = read_run(folder)
    reference: Reference = []
    if ais is not None:
        from obsnet.ais import read, reference_tracks

        place = run.station.latitude, run.station.longitude
        reference = reference_tracks(read(ais, near=place, within_m=500e3), run.station)
    return [style.save(figure(run, n, reference), Path(folder) / f"figure-{n}.png") for n in figures]


def figure(run: Run, number: int, reference: Reference | None = None) -> Figure:
    """One of `FIGURES` of a run, AIS tracks laid over it."""
    columns = Columns.over(run.maps["time"].values, MOST_COLUMNS)
    if columns is None:
        made = style.figure(9.0, 3.0)
        style.say(style.box(made, 0.5, 0.5, 8.0, 1.9), "no minute of data")
        style.title(made, f"{run.station.code}: no minute of data")
        return made
    reference = [s for s in reference or [] if s.endtime > columns.start and s.starttime < columns.end]
    return _DRAWN[number](run, columns, reference)


def _azimuth_detection(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 3: spectrogram, azigram, azimuth likelihood with what was found."""
    made, (above, middle, below) = _stack(run, columns, [2.0, 2.0, 3.0])
    panels.spectrogram(above, run, columns)
    panels.azigram(middle, run, columns)
    panels.azimuth_map(below, run, columns)
    _over(below, run, columns, reference, "azimuth")
    _letters(["spectrogram", "azigram", "azimuth likelihood"], [above, middle, below])
    style.title(made, _title(run, columns, "azimuth"))
    overlay.legend(made, run, reference)
    return made


def _range_detection(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 6: cepstrogram, range likelihood, detections coloured by range rate."""
    made, (above, middle, below) = _stack(run, columns, [2.5, 2.5, 2.5])
    panels.cepstrogram(above, run, columns)
    panels.range_map(middle, run, columns)
    _rate_panel(below, run, columns.start, columns.end, reference)
    _letters(["cepstrogram", "range likelihood", "range detections"], [above, middle, below])
    style.title(made, _title(run, columns, "range"))
    overlay.legend(made, run, reference, by_rate=True)
    return made


def _envelope(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 5: the cepstrum's envelope against range, observed and modelled."""
    return envelope_figure(run, reference, _title(run, columns, "cepstral envelope against range"))


def _days(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 7: day by day, azimuth detections above, range detections below, segments shaded."""
    rows, length = day_rows(columns.start, columns.end)
    height = 1.6 if len(rows) > 1 else 2.8
    made = style.figure(13.0, 0.85 + len(rows) * (2 * height + 0.68))
    top = made.get_size_inches()[1] - 0.7
    for start in rows:
        end = start + length
        above, below = (
            style.box(made, 0.75, top - height * (i + 1) - 0.13 * i, 11.3, height) for i in (0, 1)
        )
        top -= 2 * height + 0.68
        if "azimuth_llr" in run.maps:
            style.azimuth_axis(above)
            overlay.detections(above, run, "azimuth", start, end)
            overlay.curves(above, run, reference, "azimuth", start, end)
        else:
            panels.without(above, "azimuth [°]", panels.NO_AZIMUTH)
        _rate_panel(below, run, start, end, reference, bar=start == rows[0])
        for ax in (above, below):
            overlay.shade_segments(ax, run, start, end)
            style.time_axis(ax, start, end, labelled=ax is below, most=13)
        if start != rows[-1]:
            below.set_xlabel("")
    style.title(made, _title(run, columns, "detections and segments"))
    overlay.legend(made, run, reference, by_rate=True, segments=True)
    return made


def day_rows(start: float, end: float) -> tuple[list[float], float]:
    """Starts of figure 7's rows and their common length [s]: whole UTC days, at most `DAY_ROWS` rows.

    A run that is no longer than a day has one row of its own length.

    >>> day_rows(86400.0 * 10 + 60.0, 86400.0 * 12)
    ([864000.0, 950400.0], 86400.0)
    """
    if end - start <= _DAY:
        return [start], end - start
    first = np.floor(start / _DAY) * _DAY
    length = _DAY * np.ceil(np.ceil((end - first) / _DAY) / DAY_ROWS)
    return np.arange(first, end, length).tolist(), float(length)


def _tracks(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 8: of each track the azimuth map, the range map and the plan view, against AIS."""
    strongest = sorted(range(len(run.tracks)), key=lambda n: -run.tracks[n].log_bayes_factor)[:MOST_TRACKS]
    rows = max(1, -(-len(strongest) // 2))
    made = style.figure(15.2 if len(strongest) > 1 else 7.9, 0.85 + 3.6 * rows)
    many = f"the {MOST_TRACKS} strongest of {len(run.tracks)} tracks"
    style.title(made, _title(run, columns, "tracks" if len(strongest) == len(run.tracks) else many))
    if not strongest:
        style.say(style.box(made, 0.5, 0.5, 7.0, 3.2), "no ship found")
    for place, number in enumerate(sorted(strongest)):
        corner = 0.85 + 7.5 * (place % 2), 0.65 + 3.6 * (rows - 1 - place // 2)
        _one_track(made, corner, run, number, reference)
    overlay.legend(made, run, reference)
    return made


def _one_track(
    made: Figure, corner: tuple[float, float], run: Run, number: int, reference: Reference
) -> None:
    track, (left, bottom) = run.tracks[number], corner
    window = Columns.over(run.maps["time"].values, 400, track.start - _MARGIN_S, track.end + _MARGIN_S)
    if window is None:
        return
    above, below = (style.box(made, left, bottom + 1.45 * i, 3.0, 1.35) for i in (1, 0))
    kinds: tuple[overlay.Kind, ...] = ("azimuth", "range")
    for ax, draw_panel, kind in zip(
        (above, below), (panels.azimuth_map, panels.range_map), kinds, strict=True
    ):
        draw_panel(ax, run, window, bar=False)
        _over(ax, run, window, reference, kind, size=1.6)
        overlay.reports(ax, run, reference, kind, window.start, window.end)
        style.time_axis(ax, window.start, window.end, labelled=ax is below, most=5)
    plan = style.box(made, left + 3.8, bottom, 2.8, 2.8)
    plan_view(plan, run, reference, window.start, window.end, only=number)
    row = track.row(number + 1)
    distance = f"{row['cpa_distance_m'] / 1e3:.1f} ± {row['cpa_distance_std_m'] / 1e3:.1f} km"
    text = f"track {number + 1}: {row['cpa_time'][:16].replace('T', ' ')}, {distance}"
    above.set_title(text, fontsize=9, loc="left", pad=3)


def _rate_panel(ax: Axes, run: Run, start: float, end: float, reference: Reference, bar: bool = True) -> None:
    """Range detections coloured by range rate."""
    if "range_llr" not in run.maps:
        panels.without(ax, "range [km]", panels.NO_RANGE)
        return
    style.y_axis(ax, "range [km]", 0.0, panels.farthest_km(run))
    overlay.curves(ax, run, reference, "range", start, end)
    drawn = overlay.detections_by_rate(ax, run, start, end)
    if bar:
        style.bar(ax, drawn, "range rate [m/s]")


def _over(
    ax: Axes, run: Run, columns: Columns, reference: Reference, kind: overlay.Kind, size: float | None = None
) -> None:
    overlay.curves(ax, run, reference, kind, columns.start, columns.end)
    overlay.detections(ax, run, kind, columns.start, columns.end, size)


def _stack(run: Run, columns: Columns, heights: list[float]) -> tuple[Figure, list[Axes]]:
    """Panels over one axis of time, first on top."""
    made = style.figure(11.0, sum(heights) + 0.13 * len(heights) + 1.25)
    top, axes = made.get_size_inches()[1] - 0.7, []
    for height in heights:
        axes.append(style.box(made, 0.75, top - height, 9.4, height))
        top -= height + 0.13
    for ax in axes:
        style.time_axis(ax, columns.start, columns.end, labelled=ax is axes[-1])
    return made, axes


def _letters(names: list[str], axes: list[Axes]) -> None:
    for letter, name, ax in zip("abc", names, axes, strict=True):
        style.name(ax, f"({letter}) {name}")


def _title(run: Run, columns: Columns, what: str) -> str:
    return f"{run.station.code}, {what}, {style.span(columns.start, columns.end)}"


_DRAWN: dict[int, Callable[[Run, Columns, Reference], Figure]] = {
    3: _azimuth_detection,
    5: _envelope,
    6: _range_detection,
    7: _days,
    8: _tracks,
}
FIGURES = tuple(_DRAWN)
"""Numbers of the core paper's figures that can be drawn from a run."""
