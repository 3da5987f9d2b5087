"""Detections and tracks out, as the text of the files that people use: CSV and GeoJSON; tracks in again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import iso, to_posix
from obsnet.signals.station import Station
from obsnet.trackers.track import Track

DETECTION_COLUMNS = [
    "time",
    "coverage",
    "azimuth_deg",
    "azimuth_llr",
    "range_m",
    "range_rate_mps",
    "range_llr",
]
DETECTION_DIGITS = {
    "coverage": 3, "azimuth_deg": 2, "azimuth_llr": 3, "range_m": 1, "range_rate_mps": 2, "range_llr": 3,
}  # fmt: skip
TRACK_COLUMNS = [
    "track", "start", "end", "cpa_time", "cpa_distance_m", "cpa_azimuth_deg", "course_deg", "speed_mps", "cpa_time_std_s",
    "cpa_distance_std_m", "course_std_deg", "speed_std_mps", "log_bayes_factor",
]  # fmt: skip


def detections_csv(detections: pd.DataFrame) -> str:
    """Text of detections.csv: ISO times, empty cells where there is no estimate."""
    table = detections.reindex(columns=DETECTION_COLUMNS).copy()
    stamps = table["time"].to_numpy("datetime64[s]")
    table["time"] = np.char.add(np.datetime_as_string(stamps), "Z") if len(stamps) else table["time"]
    return table.round(DETECTION_DIGITS).to_csv(index=False)


def tracks_csv(rows: pd.DataFrame) -> str:
    """Text of tracks.csv."""
    return rows.to_csv(index=False, float_format="%.6g")


def geojson(tracks: list[Track], station: Station) -> dict[str, Any]:
    """Tracks as timed lines in WGS 84 (a FeatureCollection, RFC 7946): LineStrings, and MultiLineStrings where they cross the
    antimeridian, which cuts them; `times` are nested as the positions are.
    """
    from pyproj import Proj

    local = Proj(proj="aeqd", lat_0=station.latitude, lon_0=station.longitude, datum="WGS84")
    features = []
    for number, found in enumerate(tracks, 1):
        if not np.isfinite(found.std[2]):
            continue
        times, east, north = found.positions(300.0)
        longitude, latitude = local(east, north, inverse=True)
        properties = {key: None if value != value else value for key, value in found.row(number).items()}
        parts = _cut(np.column_stack([longitude, latitude, (times - times[0]).astype(float)]))
        stamps = [
            [iso(times[0] + np.timedelta64(round(ns), "ns"), milliseconds=True) for ns in part[:, 2]]
            for part in parts
        ]
        lines = [[[round(x, 6), round(y, 6)] for x, y in part[:, :2].tolist()] for part in parts]
        whole = len(parts) == 1
        properties["times"] = stamps[0] if whole else stamps
        properties["method"] = found.method
        line = {
            "type": "LineString" if whole else "MultiLineString",
            "coordinates": lines[0] if whole else lines,
        }
        features.append({"type": "Feature", "geometry": line, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def track_of_row(row: pd.Series) -> Track:
    """The track of a row of tracks.csv, with variances only: infinite where the row is empty."""
    start, end, cpa = (seconds(row[key]) for key in ("start", "end", "cpa_time"))
    starboard = wrap180(row["cpa_azimuth_deg"] - row["course_deg"]) < 0
    distance = -row["cpa_distance_m"] if starboard else row["cpa_distance_m"]
    std = row[["cpa_time_std_s", "cpa_distance_std_m", "course_std_deg", "speed_std_mps"]].astype(float)
    course = 0.0 if np.isnan(row["course_deg"]) else float(row["course_deg"])
    motion = StraightCourse(cpa, float(distance), course, float(row["speed_mps"]))
    return Track(start, end, motion, np.diag(std.fillna(np.inf) ** 2), float(row["log_bayes_factor"]))


def seconds(text: str) -> float:
    """Seconds since 1970 of a time in these files."""
    return float(to_posix(np.datetime64(text.removesuffix("Z"))))


def _cut(line: np.ndarray) -> list[np.ndarray]:
    """Parts of a line of (longitude [deg], latitude [deg], time [ns]) between antimeridians, longitudes within ±180°."""
    line = np.column_stack([np.unwrap(line[:, 0], period=360.0), line[:, 1:]])
    turns = np.floor((line[:, 0] + 180.0) / 360.0)
    parts, points = [], [line[0]]
    for one, other, before, after in zip(line[:-1], line[1:], turns[:-1], turns[1:], strict=True):
        if before != after:
            edge = 360.0 * max(before, after) - 180.0
            crossing = one + (edge - one[0]) / (other[0] - one[0]) * (other - one)
            parts.append(np.array([*points, crossing]) - [360.0 * before, 0.0, 0.0])
            points = [crossing]
        points.append(other)
    return [*parts, np.array(points) - [360.0 * turns[-1], 0.0, 0.0]]
