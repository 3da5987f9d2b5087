"""What was found, and AIS, drawn over the maps as the station hears it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from obsnet.kinematics import emission
from obsnet.layout import to_posix
from obsnet.ocean.rays import travel_time
from obsnet.plots import style
from obsnet.run import Run
from obsnet.trackers.track import Track

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack

Kind = Literal["azimuth", "range"]
NUMBERED = 12
"""With more tracks than this in a picture, numbers would hide it."""
CROWDED = 1500
"""With more detections than this in a panel, each mark is small."""
SPARSE = 40
"""With more AIS reports than this in a picture, the course is known everywhere."""
APPROACH, DEPARTURE, UNKNOWN = style.PURPLE, style.ORANGE, "#999999"


@dataclass(frozen=True)
class Curve:
    """Azimuth [deg], range [m] and range rate [m/s] against the time [s since 1970] at which they are heard."""

    time: np.ndarray
    azimuth: np.ndarray
    range_m: np.ndarray
    range_rate: np.ndarray

    def on(self, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
        """Time on a picture's axis, and azimuth [deg] or range [km]; an azimuth is cut where it passes north."""
        if kind == "range":
            return style.days(self.time), self.range_m / 1e3
        cut = np.flatnonzero(np.abs(np.diff(self.azimuth)) > 180.0) + 1
        return style.days(np.insert(self.time, cut, np.nan)), np.insert(self.azimuth, cut, np.nan)


def heard(track: Track, delay: Callable, step_s: float = 60.0) -> Curve:
    """A track as the station hears it: what is heard at t left the ship at e, e + delay(range(e)) = t.

    The range rate is that of the range heard, the ship's own over 1 + (ddelay/drange) rate. The azimuth is NaN
    where the course was not observed.
    """
    count = int(np.clip((track.end - track.start) / step_s, 2, 400))
    time = np.linspace(track.start, track.end, count)
    azimuth, distance, rate = track.motion.observables(emission(track.motion, time, delay))
    if not np.isfinite(track.std[2]):
        azimuth = np.full_like(azimuth, np.nan)
    slowness = (np.asarray(delay(distance + 50.0)) - np.asarray(delay(distance - 50.0))) / 100.0
    return Curve(time, azimuth, distance, rate / (1.0 + slowness * rate))


def reference_heard(ship: ReferenceTrack, delay: Callable, start: float, end: float) -> Curve | None:
    """An AIS track as the station hears it within `start` … `end`, or none where it is outside."""
    first, last = max(start, ship.starttime), min(end, ship.endtime)
    if first >= last:
        return None
    time = np.linspace(first, last, 400)
    return Curve(time, *ship.heard(time, delay))


def detections(ax: Axes, run: Run, kind: Kind, start: float, end: float, size: float | None = None) -> None:
    """Each minute's azimuth or range, in marks of `size` points: smaller ones where there are many."""
    time, values, _ = _detected(run, kind, start, end)
    size = size or (2.8 if len(time) < CROWDED else 1.4)
    ax.plot(time, values, "o", ms=size, mfc="white", mec="black", mew=0.4, ls="", zorder=3)


def detections_by_rate(ax: Axes, run: Run, start: float, end: float, size: float = 12.0) -> Any:
    """Each minute's range, coloured by range rate: ▼ approaching, ▲ leaving. Returns what a colour bar takes."""
    time, values, rate = _detected(run, "range", start, end)
    drawn = None
    for marker, which in (("v", rate <= 0), ("^", rate > 0)):
        drawn = ax.scatter(
            time[which], values[which], s=size, c=rate[which], marker=marker, cmap=style.DIVERGING,
            vmin=-12.0, vmax=12.0, linewidths=0.3, edgecolors="black", zorder=6,
        )  # fmt: skip
    return drawn


def curves(ax: Axes, run: Run, reference: list[ReferenceTrack], kind: Kind, start: float, end: float) -> None:
    """Tracks and AIS as heard; nothing where the run has no map to lay them over."""
    if f"{kind}_llr" not in run.maps:
        return
    delay = travel_time(run.table)
    here = [(n, track) for n, track in enumerate(run.tracks) if track.end > start and track.start < end]
    for number, track in here:
        time, values = heard(track, delay).on(kind)
        ax.plot(time, values, lw=1.3 if len(here) <= NUMBERED else 0.8, zorder=4, **style.track_style(number))
        if len(run.tracks) > 1 and len(here) <= NUMBERED:
            low, high = ax.get_ylim()
            inside = (
                (time >= style.days(start)) & (time <= style.days(end)) & (values > low) & (values < high)
            )
            if inside.any():
                at = np.flatnonzero(inside)[inside.sum() // 5]
                style.number(ax, number, time[at], values[at])
    for ship in reference:
        curve = reference_heard(ship, delay, start, end)
        if curve is not None:
            draw_reference(ax, *curve.on(kind))


def reports(
    ax: Axes, run: Run, reference: list[ReferenceTrack], kind: Kind, start: float, end: float
) -> None:
    """AIS reports themselves where they are sparse, at the time at which the ship there is heard."""
    if f"{kind}_llr" not in run.maps:
        return
    delay = travel_time(run.table)
    for ship in reference:
        azimuth, distance, rate = ship.observables(ship.time)
        time = ship.time + np.asarray(delay(distance), float)
        shown = (time >= start) & (time <= end) & (ship.time >= ship.starttime) & (ship.time <= ship.endtime)
        if shown.sum() > SPARSE:
            continue
        curve = Curve(time[shown], azimuth[shown], distance[shown], rate[shown])
        ax.plot(*curve.on(kind), "s", ms=2.4, mfc="black", mec="white", mew=0.3, ls="", zorder=5)


def draw_reference(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """An AIS curve: black dashes edged with white, to be seen on any ground."""
    edge = [withStroke(linewidth=2.0, foreground="white", alpha=0.8)]
    ax.plot(x, y, color="black", lw=1.0, ls=style.REFERENCE_DASHES, path_effects=edge, zorder=5)


def shade_segments(ax: Axes, run: Run, start: float, end: float) -> None:
    """Segments behind a panel: approach and departure each in a colour, dotted edges, CPA dashed."""
    for segment in run.segments:
        if segment.end < start or segment.start > end:
            continue
        cpa = segment.cpa
        parts = [(segment.start, segment.end, UNKNOWN)]
        if cpa is not None:
            parts = [(segment.start, cpa, APPROACH), (cpa, segment.end, DEPARTURE)]
            ax.axvline(style.days(cpa), color="black", lw=0.8, ls="--", zorder=1)
        for begin, stop, colour in parts:
            ax.axvspan(style.days(begin), style.days(stop), color=colour, alpha=0.18, lw=0, zorder=0)
        for edge in (segment.start, segment.end):
            ax.axvline(style.days(edge), color="black", lw=0.8, ls=":", zorder=1)


def handles(run: Run, reference: list[ReferenceTrack], by_rate: bool = False) -> list[Any]:
    """Legend entries of what overlays draw."""
    mark: dict[str, Any] = {"mec": "black", "mew": 0.5, "ls": ""}
    made: list[Any] = [Line2D([], [], marker="o", ms=4, mfc="white", label="detection", **mark)]
    if by_rate:
        made.append(Line2D([], [], marker="v", ms=4, mfc="#8073AC", label="approaching", **mark))
        made.append(Line2D([], [], marker="^", ms=4, mfc="#E08214", label="leaving", **mark))
    if run.tracks:
        made.append(Line2D([], [], color=style.track_style(0)["color"], lw=1.8, label="track"))
    if reference:
        text = f"AIS ({len(reference)} ship{'s' if len(reference) > 1 else ''})"
        made.append(Line2D([], [], color="black", ls=style.REFERENCE_DASHES, lw=1.1, label=text))
    return made


def legend(
    made: Figure, run: Run, reference: list[ReferenceTrack], by_rate: bool = False, segments: bool = False
) -> None:
    """One line of legend below the title."""
    entries = handles(run, reference, by_rate)
    if segments and run.segments:
        both = ((APPROACH, "approach"), (DEPARTURE, "departure"))
        entries += [Patch(fc=colour, alpha=0.18, ec="black", ls=":", label=text) for colour, text in both]
    width, height = made.get_size_inches()
    made.legend(
        handles=entries, loc="center left", bbox_to_anchor=(0.65 / width, 1.0 - 0.47 / height), ncols=len(entries),
        fontsize=8.5, frameon=False, columnspacing=1.4, handlelength=1.8,
    )  # fmt: skip


def _detected(run: Run, kind: Kind, start: float, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times on a picture's axis, azimuths [deg] or ranges [km], and range rates [m/s] of the detections."""
    found = run.detections
    column, scale = ("azimuth_deg", 1.0) if kind == "azimuth" else ("range_m", 1e-3)
    values, seconds = found[column].to_numpy(float) * scale, to_posix(found["time"].to_numpy())
    shown = np.isfinite(values) & (seconds >= start) & (seconds <= end)
    return style.days(seconds[shown]), values[shown], found["range_rate_mps"].to_numpy(float)[shown]
