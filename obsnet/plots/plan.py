"""The plan view: the station, tracks with their uncertainty, AIS, and range circles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from obsnet.layout import to_posix
from obsnet.plots import style
from obsnet.plots.overlay import NUMBERED, draw_reference
from obsnet.run import Run
from obsnet.trackers.track import Track

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack

NINETY_PERCENT = 4.605
"""90 % quantile of χ² with two degrees of freedom."""
_TURN = np.linspace(0.0, 2.0 * np.pi, 121)


def plan_view(
    ax: Axes, run: Run, reference: list[ReferenceTrack], start: float, end: float, only: int | None = None
) -> None:
    """Draw what a run found between `start` and `end` around its station, in km east and north.

    Parameters
    ----------
    only : number (from 0) of the one track to draw.
    """
    numbered = [(n, track) for n, track in enumerate(run.tracks) if only is None or n == only]
    reach = reach_km([track for _, track in numbered], reference, start, end)
    ax.set_aspect("equal")
    ax.set_xlim(-reach, reach)
    ticks = style.nice_ticks(-reach, reach, 5)
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=8)
    ax.set_xlabel("east [km]", fontsize=9)
    style.y_axis(ax, "north [km]", -reach, reach)
    _circles(ax, reach)
    _detections(ax, run, start, end)
    for number, track in numbered:
        _track(ax, track, number, label=1 < len(numbered) <= NUMBERED)
    for ship in reference:
        _reference(ax, ship, start, end)
    ax.plot(0, 0, "*", ms=13, mfc=style.YELLOW, mec="black", mew=0.8, zorder=6)


def close_up(ax: Axes, track: Track, number: int, reference: list[ReferenceTrack]) -> None:
    """The closest approach of a track at the scale of its uncertainty, with the AIS tracks that pass there."""
    outline = np.stack(ellipse(track)) / 1e3
    centre = outline[:, :-1].mean(axis=1)
    reach = 2.2 * float(np.abs(outline - centre[:, None]).max()) + 0.05
    ax.set_aspect("equal")
    ax.set_xlim(centre[0] - reach, centre[0] + reach)
    ticks = style.nice_ticks(centre[0] - reach, centre[0] + reach, 3)
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=7)
    style.y_axis(ax, "", centre[1] - reach, centre[1] + reach, most=3)
    motion = track.motion
    _draw_track(
        ax, track, number, motion.cpa_time + 2e3 * reach / max(motion.speed_mps, 0.1) * np.array([-1.0, 1.0])
    )
    ax.plot(*centre, "o", ms=4, mfc="white", mec="black", zorder=6)
    for ship in reference:
        _reference(ax, ship, motion.cpa_time - 7200.0, motion.cpa_time + 7200.0)
        east, north, _ = ship.at(motion.cpa_time)
        ax.plot(east / 1e3, north / 1e3, "x", ms=5, color="black", mew=1.2, zorder=6)
    ax.set_title(f"CPA of track {number + 1} [km]", fontsize=8, pad=3)


def reach_km(tracks: list[Track], reference: list[ReferenceTrack], start: float, end: float) -> float:
    """Half-width of the view: what holds all tracks, or all AIS without any; 5 to 100 km."""
    farthest = [
        float(np.hypot(*track.positions(300.0)[1:]).max())
        if np.isfinite(track.std[2])
        else 2.0 * abs(track.motion.cpa_range_m)
        for track in tracks
    ]
    if not farthest:
        time = np.linspace(start, end, 200)
        away = [np.hypot(*ship.at(time)[:2]) for ship in reference]
        farthest = [float(np.nanmax(distance)) for distance in away if np.isfinite(distance).any()]
    return float(np.clip(1.08 * max(farthest, default=46e3) / 1e3, 5.0, 100.0))


def ellipse(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """East and north [m] of the 90 % ellipse of the ship's position at its estimated CPA time.

    Passing later by δt puts the ship back along its course by speed δt; turning the course by δ carries it back along it
    by range δ.
    """
    motion = track.motion
    course = np.deg2rad(motion.course_deg)
    across = np.array([np.cos(course), -np.sin(course)])
    along = np.array([np.sin(course), np.cos(course)])
    slope = np.zeros((2, 4))
    slope[:, 0] = -motion.speed_mps * along
    slope[:, 1] = across
    slope[:, 2] = -np.deg2rad(1.0) * motion.cpa_range_m * along
    values, vectors = np.linalg.eigh(slope @ track.covariance @ slope.T)
    axes = vectors * np.sqrt(NINETY_PERCENT * np.maximum(values, 0.0))
    east, north = motion.position(np.asarray(motion.cpa_time))
    around = axes @ np.stack([np.cos(_TURN), np.sin(_TURN)])
    return east + around[0], north + around[1]


def _circles(ax: Axes, reach: float) -> None:
    spacing = next(step for step in (1, 2, 5, 10, 20, 25, 50) if reach / step < 4.5)
    frame = {"boxstyle": "square,pad=0.1", "fc": "white", "ec": "none"}
    for radius in np.arange(spacing, 1.4 * reach, spacing):
        ax.plot(radius * np.cos(_TURN), radius * np.sin(_TURN), color="#BBBBBB", lw=0.7, zorder=0)
        if radius < 0.95 * reach:
            ax.text(0, -radius, f"{radius:g} km", fontsize=7, color="#555555", ha="center", va="center", bbox=frame,
                    zorder=0.5)  # fmt: skip


def _detections(ax: Axes, run: Run, start: float, end: float) -> None:
    found, seconds = run.detections, to_posix(run.detections["time"].to_numpy())
    azimuth, distance = (
        np.deg2rad(found["azimuth_deg"].to_numpy(float)),
        found["range_m"].to_numpy(float) / 1e3,
    )
    both = np.isfinite(azimuth * distance) & (seconds >= start) & (seconds <= end)
    east, north = (distance * np.sin(azimuth))[both], (distance * np.cos(azimuth))[both]
    ax.plot(east, north, ".", ms=2.2, color="#888888", zorder=1)


def _reference(ax: Axes, ship: ReferenceTrack, start: float, end: float) -> None:
    first, last = max(start, ship.time[0]), min(end, ship.time[-1])
    if first < last:
        east, north, _ = ship.at(np.linspace(first, last, 200))
        draw_reference(ax, east / 1e3, north / 1e3)


def _track(ax: Axes, track: Track, number: int, label: bool) -> None:
    look = style.track_style(number)
    if not np.isfinite(track.std[2]):
        radius = abs(track.motion.cpa_range_m) / 1e3
        ax.plot(radius * np.cos(_TURN), radius * np.sin(_TURN), color=look["color"], lw=1.6, ls=":", zorder=3)
        return
    time = np.linspace(track.start, track.end, 60)
    east, north = _draw_track(ax, track, number, time)
    ax.annotate("", (east[-1], north[-1]), (east[-6], north[-6]), zorder=3.5,
                arrowprops={"arrowstyle": "-|>", "color": look["color"], "lw": 1.8})  # fmt: skip
    if label:
        style.number(ax, number, east[-8], north[-8])


def _draw_track(ax: Axes, track: Track, number: int, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Its course over `time` and its 90 % ellipse; east and north [km] of the course."""
    look = style.track_style(number)
    east, north = (along / 1e3 for along in track.motion.position(time))
    ax.plot(east, north, lw=1.8, zorder=3, **look)
    if np.isfinite(track.std).all():
        outline = ellipse(track)
        ax.fill(
            outline[0] / 1e3, outline[1] / 1e3, fc=look["color"], ec="black", lw=0.8, alpha=0.55, zorder=5.5
        )
    return east, north
