"""The core paper's figures 3, 5, 6, 7 and 8, from any run's folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from obsnet.ais import ReferenceTrack, read, reference_tracks
from obsnet.errors import ConfigError
from obsnet.ocean.rays import parse_pair, tdoa
from obsnet.plots import overlay, panels, style
from obsnet.plots.columns import Columns
from obsnet.plots.envelope import FARTHEST_M, RANGE_STEP_M, modelled_envelope, observed_envelope
from obsnet.plots.plan import plan_view
from obsnet.run import Run, read_run

MOST_COLUMNS = 2000
DAY_ROWS = 8
"""Rows of figure 7; a longer run has several days in a row."""
MOST_TRACKS = 12
"""Tracks of figure 8, the strongest."""
_DAY = 86400.0
Reference = list[ReferenceTrack]


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
        place = run.station.latitude, run.station.longitude
        reference = reference_tracks(read(ais, near=place, within_m=500e3), run.station)
    return [style.save(figure(run, n, reference), Path(folder) / f"figure-{n}.png") for n in figures]


def figure(run: Run, number: int, reference: Reference | None = None) -> Figure:
    """One of `FIGURES` of a run in memory, AIS tracks laid over it."""
    columns = Columns.over(run.maps["time"].values, MOST_COLUMNS)
    if columns is None:
        made = style.figure(9.0, 3.0)
        style.say(style.box(made, 0.5, 0.5, 8.0, 1.9), "no minute of data")
        _title(made, f"{run.station.code}: no minute of data")
        return made
    reference = [s for s in reference or [] if s.endtime > columns.start and s.starttime < columns.end]
    return _DRAWN[number](run, columns, reference)


def _azimuth_detection(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 3: spectrogram, azigram, azimuth likelihood with detections."""
    rows = ((panels.spectrogram, 2.0), (panels.azigram, 2.0), (panels.azimuth_map, 3.0))
    made, axes = _stack(run, columns, [height for _, height in rows])
    for ax, (draw_panel, _), letter in zip(axes, rows, "abc", strict=True):
        draw_panel(ax, run, columns)
        style.name(ax, f"({letter}) {draw_panel.__name__.replace('_map', ' likelihood')}")
    _over(axes[-1], run, columns, reference, "azimuth")
    _title(made, f"{run.station.code}, azimuth detection, {style.span(columns.start, columns.end)}")
    return made


def _range_detection(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 6: cepstrogram, range likelihood, detections coloured by range rate."""
    made, (above, middle, below) = _stack(run, columns, [2.5, 2.5, 2.5])
    panels.cepstrogram(above, run, columns)
    panels.range_map(middle, run, columns)
    _rate_panel(below, run, columns, reference)
    for ax, text in zip(
        (above, middle, below), ("cepstrogram", "range likelihood", "range detections"), strict=True
    ):
        style.name(ax, f"({'abc'[(above, middle, below).index(ax)]}) {text}")
    _title(made, f"{run.station.code}, range detection, {style.span(columns.start, columns.end)}")
    return made


def _rate_panel(ax: Axes, run: Run, columns: Columns, reference: Reference, bar: bool = True) -> None:
    farthest = run.maps["range"].values[-1] / 1e3 if "range" in run.maps else 50.0
    style.y_axis(ax, "range [km]", 0.0, farthest)
    if "range_llr" not in run.maps:
        return style.say(ax, panels.NO_RANGE)
    ax.grid(color="#DDDDDD", lw=0.6)
    drawn = overlay.detections_by_rate(ax, run, columns.start, columns.end)
    overlay.curves(ax, run, reference, "range", columns.start, columns.end)
    if bar:
        style.bar(ax, drawn, "range rate [m/s]")


def _envelope(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 5: the cepstrum's envelope against range, observed and modelled."""
    made = style.figure(12.4, 5.2)
    _title(
        made, f"{run.station.code}, cepstral envelope against range, {style.span(columns.start, columns.end)}"
    )
    grid = np.arange(0.0, FARTHEST_M + 1.0, RANGE_STEP_M)
    observed = observed_envelope(run, reference, grid)
    left, right = (style.box(made, 0.75 + 6.0 * i, 0.7, 4.6, 3.9) for i in (0, 1))
    source = "along AIS" if reference else "along the tracks found"
    if observed is None:
        why = (
            "no cepstrogram"
            if "cepstrogram" not in run.features
            else "neither AIS nor a track: no range to stack at"
        )
        panels.without(left, "quefrency [s]", why)
        quefrency = np.arange(0.0, panels.longest_quefrency(run) + 0.5, 0.02)
    else:
        quefrency = observed["quefrency"].values
        panels.against_range(left, run, observed, "envelope (root mean square)")
        source += ", delays of the path pairs dashed"
    panels.against_range(right, run, modelled_envelope(run, quefrency), "modelled envelope")
    for ax, text in ((left, f"(a) observed {source}"), (right, "(b) modelled")):
        _pairs(ax, run, dashed=ax is left and observed is not None)
        ax.set_title(text, fontsize=10, loc="left")
        ticks = style.nice_ticks(0.0, FARTHEST_M / 1e3)
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=8)
        ax.set_xlim(0.0, FARTHEST_M / 1e3)
        ax.set_xlabel("range [km]", fontsize=9)
    return made


def _pairs(ax: Axes, run: Run, dashed: bool) -> None:
    """Delays of the detector's path pairs, named."""
    known = set(run.table["path"].values.tolist())
    for i, pair in enumerate(run.config.range.pairs):
        if not set(parse_pair(pair)) <= known:
            continue
        delay, range_km = tdoa(run.table, pair).values, run.table["range"].values / 1e3
        if dashed:
            ax.plot(range_km, delay, color="white", lw=1.0, ls=(0, (4, 4)))
        inside = np.flatnonzero(np.isfinite(delay) & (range_km < FARTHEST_M / 1e3) & (range_km > 1.0))
        if len(inside):
            at = inside[int(len(inside) * (0.35 + 0.15 * i))]
            ax.annotate(
                pair, (range_km[at], delay[at]), (4, 4), textcoords="offset points", color="white", fontsize=9
            )


def _days(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 7: day by day, azimuth detections above, range detections below, segments shaded."""
    rows, length = day_rows(columns.start, columns.end)
    height = 1.75 if len(rows) > 1 else 3.0
    made = style.figure(13.0, 0.9 + len(rows) * (2 * height + 0.5))
    top = made.get_size_inches()[1] - 0.45
    for start in rows:
        end = start + length
        above, below = (style.box(made, 0.7, top - height * (i + 1), 11.3, height) for i in (0, 1))
        top -= 2 * height + 0.5
        part = Columns(start, end, 1, 0, np.zeros(1, int))
        style.azimuth_axis(above)
        if "azimuth_llr" in run.maps:
            overlay.detections(above, run, "azimuth", start, end)
            overlay.curves(above, run, reference, "azimuth", start, end, tracks=False)
        else:
            style.say(above, panels.NO_AZIMUTH)
        _rate_panel(below, run, part, reference, bar="range_llr" in run.maps)
        for ax in (above, below):
            overlay.shade_segments(ax, run, start, end)
            style.time_axis(ax, start, end, labelled=ax is below, most=13)
            ax.set_xlabel("")
    _title(made, f"{run.station.code}, detections and segments, {style.span(columns.start, columns.end)}")
    return made


def day_rows(start: float, end: float) -> tuple[list[float], float]:
    """Starts of figure 7's rows and their common length [s]: whole UTC days, at most `DAY_ROWS` rows.

    A run that fits into one day has one row of its own length.
    """
    if end - start <= _DAY:
        return [start], end - start
    first = np.floor(start / _DAY) * _DAY
    length = _DAY * np.ceil(np.ceil((end - first) / _DAY) / DAY_ROWS)
    return [float(t) for t in np.arange(first, end, length)], float(length)


def _tracks(run: Run, columns: Columns, reference: Reference) -> Figure:
    """Figure 8: for each track the azimuth map, the range map and the plan view, against AIS."""
    strongest = sorted(range(len(run.tracks)), key=lambda n: -run.tracks[n].log_bayes_factor)[:MOST_TRACKS]
    shown = sorted(strongest)
    rows = max(1, -(-len(shown) // 2))
    made = style.figure(15.0 if len(shown) > 1 else 8.0, 0.7 + 3.7 * rows)
    many = "" if len(shown) == len(run.tracks) else f", the {len(shown)} strongest of {len(run.tracks)}"
    _title(made, f"{run.station.code}, tracks{many}, {style.span(columns.start, columns.end)}")
    if not shown:
        style.say(style.box(made, 0.5, 0.5, 7.0, 3.2), "no ship found")
    for place, number in enumerate(shown):
        left = 0.6 + 7.3 * (place % 2)
        bottom = 0.7 + 3.7 * (rows - 1 - place // 2)
        _one_track(made, left, bottom, run, number, reference)
    return made


def _one_track(made: Figure, left: float, bottom: float, run: Run, number: int, reference: Reference) -> None:
    track = run.tracks[number]
    margin = 1800.0
    window = Columns.over(run.maps["time"].values, 400, track.start - margin, track.end + margin)
    if window is None:
        return
    above, below = (style.box(made, left, bottom + 1.45 * i, 3.1, 1.35) for i in (1, 0))
    for ax, draw_panel, kind in ((above, panels.azimuth_map, "azimuth"), (below, panels.range_map, "range")):
        draw_panel(ax, run, window, bar=False)
        _over(ax, run, window, reference, kind)  # type: ignore[arg-type]
        style.time_axis(ax, window.start, window.end, labelled=ax is below, most=5)
    ax = style.box(made, left + 3.75, bottom, 2.8, 2.8)
    plan_view(ax, run, reference, window.start, window.end, only=number)
    row = track.row(number + 1)
    distance = f"{row['cpa_distance_m'] / 1e3:.1f} ± {row['cpa_distance_std_m'] / 1e3:.1f} km"
    above.set_title(
        f"track {number + 1}: {row['cpa_time'][:16].replace('T', ' ')}, {distance}", fontsize=9, loc="left"
    )


def _over(ax: Axes, run: Run, columns: Columns, reference: Reference, kind: overlay.Kind) -> None:
    overlay.curves(ax, run, reference, kind, columns.start, columns.end)
    overlay.detections(ax, run, kind, columns.start, columns.end)


def _stack(run: Run, columns: Columns, heights: list[float]) -> tuple[Figure, list[Axes]]:
    """Panels over one axis of time, first on top."""
    made = style.figure(11.0, sum(heights) + 0.12 * len(heights) + 1.15)
    top, axes = made.get_size_inches()[1] - 0.45, []
    for height in heights:
        axes.append(style.box(made, 0.75, top - height, 9.3, height))
        top -= height + 0.12
    for ax in axes:
        style.time_axis(ax, columns.start, columns.end, labelled=ax is axes[-1])
    return made, axes


def _title(made: Figure, text: str) -> None:
    width, height = made.get_size_inches()
    made.text(0.6 / width, 1.0 - 0.22 / height, text, ha="left", va="center", fontsize=12)


_DRAWN: dict[int, Callable[[Run, Columns, Reference], Figure]] = {
    3: _azimuth_detection,
    5: _envelope,
    6: _range_detection,
    7: _days,
    8: _tracks,
}
FIGURES = tuple(_DRAWN)
