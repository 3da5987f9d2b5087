"""The plan view: the station, tracks with their uncertainty, AIS, and range circles."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from obsnet.ais import ReferenceTrack
from obsnet.plots import style
from obsnet.run import Run
from obsnet.trackers.track import Track

NINETY_PERCENT = 4.605
"""90 % quantile of χ² with two degrees of freedom."""


def plan_view(ax: Axes, run: Run, reference: list[ReferenceTrack], start: float, end: float) -> None:
    """Draw a run around its station, in km east and north."""
    reach = reach_km(run.tracks, reference, start, end)
    ax.set_aspect("equal")
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_xlabel("east of the station [km]")
    ax.set_ylabel("north of the station [km]")
    _circles(ax, reach)
    _detections(ax, run)
    for ship in reference:
        _reference(ax, ship, start, end)
    for number, track in enumerate(run.tracks):
        _track(ax, track, number)
    ax.plot(0, 0, "*", ms=13, mfc=style.YELLOW, mec="black", mew=0.8, zorder=6)


def reach_km(tracks: list[Track], reference: list[ReferenceTrack], start: float, end: float) -> float:
    """Half-width of the view: what holds all tracks, else all AIS, at most 100 km."""
    farthest = [np.hypot(*track.positions(300.0)[1:]).max() for track in tracks]
    if not farthest:
        farthest = [np.nanmax(np.hypot(*ship.at(np.linspace(start, end, 50))[:2]), initial=0.0) for ship in reference]
    return float(np.clip(1.08 * max(farthest, default=46e3) / 1e3, 5.0, 100.0))


def ellipse(track: Track, count: int = 73) -> tuple[np.ndarray, np.ndarray]:
    """East and north [m] of the 90 % ellipse of the ship's position at its estimated CPA time.

    A later CPA puts the ship back along its course by speed times the delay; a turned course carries it along by range
    times the turn.
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
    turn = np.linspace(0.0, 2.0 * np.pi, count)
    axes = vectors * np.sqrt(NINETY_PERCENT * np.maximum(values, 0.0))
    east, north = motion.position(np.asarray(motion.cpa_time))
    around = axes @ np.stack([np.cos(turn), np.sin(turn)])
    return east + around[0], north + around[1]


def _circles(ax: Axes, reach: float) -> None:
    spacing = next(step for step in (1, 2, 5, 10, 20, 25, 50) if reach / step < 4.5)
    turn = np.linspace(0.0, 2.0 * np.pi, 121)
    for radius in np.arange(spacing, reach, spacing):
        ax.plot(radius * np.cos(turn), radius * np.sin(turn), color="#BBBBBB", lw=0.7, zorder=0)
        ax.text(0, -radius, f"{radius:g} km", fontsize=7, color="#666666", ha="center", va="top", zorder=0)


def _detections(ax: Axes, run: Run) -> None:
    found = run.detections
    both = found["azimuth_deg"].notna() & found["range_m"].notna()
    azimuth = np.deg2rad(found["azimuth_deg"].to_numpy(float)[both])
    distance = found["range_m"].to_numpy(float)[both] / 1e3
    ax.plot(distance * np.sin(azimuth), distance * np.cos(azimuth), ".", ms=2, color="#888888", zorder=1)


def _reference(ax: Axes, ship: ReferenceTrack, start: float, end: float) -> None:
    time = np.linspace(max(start, ship.time[0]), min(end, ship.time[-1]), 200)
    if time[-1] <= time[0]:
        return
    east, north, _ = ship.at(time)
    ax.plot(east / 1e3, north / 1e3, color="black", lw=1.3, ls=(0, (4, 3)), zorder=4)


def _track(ax: Axes, track: Track, number: int) -> None:
    colour = style.TRACK_COLOURS[number % len(style.TRACK_COLOURS)]
    if not np.isfinite(track.std[2]):
        turn = np.linspace(0.0, 2.0 * np.pi, 121)
        radius = abs(track.motion.cpa_range_m) / 1e3
        ax.plot(radius * np.cos(turn), radius * np.sin(turn), color=colour, lw=1.6, ls=":", zorder=3)
        return
    _, east, north = track.positions(120.0)
    ax.plot(east / 1e3, north / 1e3, color=colour, lw=1.8, zorder=3)
    step = max(len(east) // 12, 1)
    ax.annotate("", (east[-1] / 1e3, north[-1] / 1e3), (east[-1 - step] / 1e3, north[-1 - step] / 1e3),
                arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8}, annotation_clip=True)  # fmt: skip
    around = ellipse(track)
    ax.fill(around[0] / 1e3, around[1] / 1e3, fc=colour, ec="black", lw=0.8, alpha=0.6, zorder=5)
