"""What was found, and AIS, drawn over the maps as the station hears it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from obsnet.ais import ReferenceTrack
from obsnet.layout import to_posix
from obsnet.plots import style
from obsnet.run import Run, travel_time
from obsnet.trackers.track import Track

Kind = Literal["azimuth", "range"]
NUMBERED = 12
"""With more tracks than this in a picture, numbers would hide it."""


@dataclass(frozen=True)
class Curve:
    """Azimuth [deg], range [m] and range rate [m/s] against the time [s since 1970] at which they are heard."""

    time: np.ndarray
    azimuth: np.ndarray
    range_m: np.ndarray
    range_rate: np.ndarray

    def on(self, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
        """Time and azimuth [deg] or range [km]; an azimuth curve is cut where it passes north."""
        if kind == "range":
            return self.time, self.range_m / 1e3
        cut = np.flatnonzero(np.abs(np.diff(self.azimuth)) > 180.0) + 1
        return np.insert(self.time, cut, np.nan), np.insert(self.azimuth, cut, np.nan)


def heard(track: Track, delay: Callable, step_s: float = 60.0) -> Curve:
    """A track as the station hears it: what is heard at t left the ship at e, e + delay(range(e)) = t.

    The range rate is that of the range heard, the ship's own over 1 + (ddelay/drange) rate. The azimuth is NaN where the
    course was not observed.
    """
    time = np.linspace(track.start, track.end, int(np.clip((track.end - track.start) / step_s, 2, 400)))
    emitted = time
    for _ in range(6):
        emitted = time - np.asarray(delay(track.motion.observables(emitted)[1]), float)
    azimuth, distance, rate = track.motion.observables(emitted)
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


def detections(ax: Axes, run: Run, kind: Kind, start: float, end: float, size: float = 2.8) -> None:
    """Each minute's azimuth or range."""
    found = run.detections
    values = _detected(run, kind)
    seconds = to_posix(found["time"].to_numpy())
    shown = np.isfinite(values) & (seconds >= start) & (seconds <= end)
    mark = {"mfc": "white", "mec": "black", "mew": 0.4, "ls": "", "zorder": 3}
    ax.plot(style.days(seconds[shown]), values[shown], "o", ms=size, **mark)


def detections_by_rate(ax: Axes, run: Run, start: float, end: float, size: float = 9.0) -> Any:
    """Each minute's range, coloured by range rate: ▼ approaching, ▲ leaving."""
    seconds, values = to_posix(run.detections["time"].to_numpy()), _detected(run, "range")
    rate = run.detections["range_rate_mps"].to_numpy(float)
    inside = np.isfinite(values) & (seconds >= start) & (seconds <= end)
    drawn = None
    for marker, which in (("v", rate <= 0), ("^", rate > 0)):
        shown = inside & which
        drawn = ax.scatter(
            style.days(seconds[shown]), values[shown], s=size, c=rate[shown], marker=marker, cmap=style.DIVERGING,
            vmin=-12.0, vmax=12.0, linewidths=0.25, edgecolors="black", zorder=3,
        )  # fmt: skip
    return drawn


def curves(
    ax: Axes,
    run: Run,
    reference: list[ReferenceTrack],
    kind: Kind,
    start: float,
    end: float,
    tracks: bool = True,
) -> None:
    """Tracks and AIS as heard."""
    delay = travel_time(run.table)
    here = [
        (n, track) for n, track in enumerate(run.tracks) if track.end > start and track.start < end and tracks
    ]
    for number, track in here:
        time, values = heard(track, delay).on(kind)
        ax.plot(style.days(time), values, lw=1.3, zorder=4, **style.track_style(number))
        if len(here) > 1 and len(here) <= NUMBERED:
            _number(ax, number, time, values)
    for ship in reference:
        curve = reference_heard(ship, delay, start, end)
        if curve is not None:
            draw_reference(ax, *_on_days(curve.on(kind)))


def draw_reference(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """An AIS curve: black dashes edged with white, to be seen on any ground."""
    edge = [withStroke(linewidth=2.0, foreground="white", alpha=0.8)]
    ax.plot(x, y, color="black", lw=1.0, ls=style.REFERENCE_DASHES, path_effects=edge, zorder=5)


def shade_segments(ax: Axes, run: Run, start: float, end: float) -> None:
    """Segments behind a panel: approach blue, departure orange, unknown grey; dotted edges, dashed CPA."""
    for segment in run.segments:
        if segment.end < start or segment.start > end:
            continue
        cpa = segment.cpa
        parts = [(segment.start, segment.end, "#999999")]
        if cpa is not None:
            parts = [(segment.start, cpa, style.PURPLE), (cpa, segment.end, style.ORANGE)]
            ax.axvline(style.days(cpa), color="black", lw=0.8, ls="--", zorder=1)
        for begin, stop, colour in parts:
            ax.axvspan(style.days(begin), style.days(stop), color=colour, alpha=0.18, lw=0, zorder=0)
        for edge in (segment.start, segment.end):
            ax.axvline(style.days(edge), color="black", lw=0.8, ls=":", zorder=1)


def _detected(run: Run, kind: Kind) -> np.ndarray:
    if kind == "azimuth":
        return run.detections["azimuth_deg"].to_numpy(float)
    return run.detections["range_m"].to_numpy(float) / 1e3


def _on_days(curve: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return style.days(curve[0]), curve[1]


def _number(ax: Axes, number: int, time: np.ndarray, values: np.ndarray) -> None:
    middle = len(time) // 2
    if np.isfinite(values[middle]):
        frame = {
            "boxstyle": "circle,pad=0.15",
            "fc": "white",
            "ec": style.track_style(number)["color"],
            "lw": 1.0,
        }
        ax.text(style.days(time[middle]), values[middle], str(number + 1), fontsize=7, ha="center", va="center",
                bbox=frame, clip_on=True, zorder=7)  # fmt: skip
