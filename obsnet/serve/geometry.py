"""Tracks in, what a map draws of them out: the course, the band of its uncertainty, the ellipse of its CPA; in km."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsnet.ais import ReferenceTrack
from obsnet.plots.plan import ellipse
from obsnet.trackers.track import Track

NINETY_PERCENT = 1.645
"""Standard deviations either side that hold 90 %."""
STEP_S = 300.0


def track_shape(track: Track) -> dict[str, Any]:
    """Course, band and ellipse of a track, lists of numbers; times in s since 1970, places in km from the station.

    The band holds the ship with 90 % across its course. Without a course (no azimuths) there is only the range against time.
    """
    count = max(int((track.end - track.start) // STEP_S), 1)
    time = np.linspace(track.start, track.end, count + 1)
    azimuth, distance, _ = track.motion.observables(time)
    shape: dict[str, Any] = {"time": time.tolist(), "range_km": _km(distance)}
    if not np.isfinite(track.std[2]):
        return shape
    east, north = track.motion.position(time)
    shape |= {"azimuth_deg": np.round(azimuth, 2).tolist(), "east_km": _km(east), "north_km": _km(north)}
    if np.isfinite(track.std).all():
        half = NINETY_PERCENT * across_std(track, time)
        course = np.deg2rad(track.motion.course_deg)
        aside = half * np.cos(course), -half * np.sin(course)
        edges = [
            np.concatenate([way + off, (way - off)[::-1]])
            for way, off in zip((east, north), aside, strict=True)
        ]
        shape["band"] = [_km(edge) for edge in edges]
        shape["ellipse"] = [_km(outline) for outline in ellipse(track)]
    return shape


def across_std(track: Track, time: np.ndarray) -> np.ndarray:
    """Standard deviation [m] of a track's position across its course at `time` (s since 1970).

    A course that is wrong by δ puts the ship aside by its way since CPA times δ; the CPA range adds its own error.
    """
    way = track.motion.speed_mps * (np.asarray(time, float) - track.motion.cpa_time)
    slope = np.stack([np.ones_like(way), np.deg2rad(way)])
    return np.sqrt(np.einsum("it,ij,jt->t", slope, track.covariance[1:3, 1:3], slope))


def circle(
    distance_m: float, distance_std_m: float, azimuth_deg: float, azimuth_std_deg: float
) -> list[list[float]]:
    """Outline of the 90 % ellipse of a place known by range and azimuth, east and north in km."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    scale = np.sqrt(4.605)
    radial = scale * distance_std_m * np.cos(turn)
    aside = scale * np.deg2rad(azimuth_std_deg) * distance_m * np.sin(turn)
    azimuth = np.deg2rad(azimuth_deg)
    out = distance_m + radial
    east = out * np.sin(azimuth) + aside * np.cos(azimuth)
    north = out * np.cos(azimuth) - aside * np.sin(azimuth)
    return [_km(east), _km(north)]


def ship_shape(ship: ReferenceTrack, start: float, end: float) -> dict[str, Any] | None:
    """The part of an AIS track within a span of time, every five minutes; none outside."""
    first, last = max(start, float(ship.time[0])), min(end, float(ship.time[-1]))
    if not first < last:
        return None
    time = np.linspace(first, last, max(int((last - first) // STEP_S), 1) + 1)
    east, north, _ = ship.at(time)
    azimuth, distance, _ = ship.observables(time)
    return {
        "mmsi": ship.mmsi,
        "name": ship.name,
        "time": time.tolist(),
        "east_km": _km(east),
        "north_km": _km(north),
        "azimuth_deg": np.round(azimuth, 2).tolist(),
        "range_km": _km(distance),
    }


def _km(metres: np.ndarray) -> list[float]:
    return np.round(np.asarray(metres, float) / 1e3, 4).tolist()
