"""What the twin knows: where each ship was when it emitted what is heard, its closest approach, and its AIS
messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from obsnet.kinematics import StraightCourse, fit_straight_course
from obsnet.layout import from_posix
from obsnet.twin.course import Course, local_projection, presence
from obsnet.twin.propagate import Paths

if TYPE_CHECKING:
    from obsnet.twin.station import Scenario

KNOT = 1852.0 / 3600.0
AIS_INTERVAL_S = 300.0


@dataclass(frozen=True)
class Truth:
    """Attributes.

    minutes : DataFrame, one row a minute and ship while it is within the propagation table: `time` (heard),
    `mmsi`,
        `emitted` (when the ship emitted what is heard then along its strongest path), `azimuth_deg`,
        `range_m`, `range_rate_mps`, `delay_s`, of the ship at `emitted`.
    passages : DataFrame, one row a ship: `mmsi`, `cpa_time` (the ship's own), `cpa_range_m` (signed),
    `cpa_azimuth_deg`,
        `course_deg`, `speed_mps`, `source_level_db`.
    """

    minutes: pd.DataFrame
    passages: pd.DataFrame


def truth_of(scenario: Scenario, paths: Paths) -> Truth:
    """Truth of a scenario's ships."""
    minutes = np.arange(np.ceil(scenario.start / 60) * 60, scenario.end, 60.0)
    heard = [_heard(p.ship.mmsi, p.course, minutes, paths) for p in scenario.passages]
    rows = [_passage(p, scenario.start, scenario.end) for p in scenario.passages]
    empty = _heard(0, StraightCourse(0, 0, 0, 1), minutes[:0], paths)
    columns = list(_passage_row(0, StraightCourse(0.0, 0.0, 0.0, 1.0), 0.0))
    return Truth(pd.concat([empty, *heard], ignore_index=True), pd.DataFrame(rows, columns=columns))


def heard_position(
    course: Course, heard: np.ndarray, paths: Paths
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Emission time [s since 1970], range [m] and delay [s] of what is heard at `heard` along the strongest
    path.
    """
    emitted = np.array(heard, float)
    for _ in range(5):
        distance = np.hypot(*course.position(emitted))
        delay = paths.strongest_delay(distance)
        emitted = heard - np.where(np.isfinite(delay), delay, distance / 1500.0)
    return emitted, distance, delay


def _heard(mmsi: int, course: Course, heard: np.ndarray, paths: Paths) -> pd.DataFrame:
    emitted, distance, delay = heard_position(course, heard, paths) if heard.size else (heard, heard, heard)
    east, north = course.position(emitted)
    later, sooner = (np.hypot(*course.position(emitted + step)) for step in (5.0, -5.0))
    frame = pd.DataFrame(
        {
            "time": from_posix(heard),
            "mmsi": np.full(heard.size, mmsi, np.int64),
            "emitted": from_posix(emitted),
            "azimuth_deg": np.rad2deg(np.arctan2(east, north)) % 360.0,
            "range_m": distance,
            "range_rate_mps": (later - sooner) / 10.0,
            "delay_s": delay,
        }
    )
    return frame[np.isfinite(delay) & (presence(course, emitted) > 0)]


def closest_approach(course: Course, start: float, end: float) -> StraightCourse:
    """Straight course at the closest approach between `start` and `end`: exact for a straight one, else
    fitted ±15 min.
    """
    if isinstance(course, StraightCourse):
        return course
    low, high = getattr(course, "span", (start, end))
    time = np.arange(max(start, low), max(min(end, high), max(start, low) + 20.0), 10.0)
    nearest = time[np.argmin(np.hypot(*course.position(time)))]
    around = nearest + np.linspace(-900.0, 900.0, 61)
    return fit_straight_course(around, *course.position(around))


def _passage(passage: Any, start: float, end: float) -> dict[str, Any]:
    straight = closest_approach(passage.course, start - 3600.0, end + 3600.0)
    return _passage_row(passage.ship.mmsi, straight, passage.ship.source_level_db)


def _passage_row(mmsi: int, straight: StraightCourse, level: float) -> dict[str, Any]:
    return {
        "mmsi": mmsi,
        "cpa_time": from_posix(straight.cpa_time),
        "cpa_range_m": straight.cpa_range_m,
        "cpa_azimuth_deg": straight.cpa_azimuth_deg,
        "course_deg": straight.course_deg,
        "speed_mps": straight.speed_mps,
        "source_level_db": level,
    }


def ais_of(scenario: Scenario, interval_s: float = AIS_INTERVAL_S) -> pd.DataFrame:
    """AIS messages of a scenario's ships, one about every `interval_s`, from an hour before the record to an
    hour after.

    Columns mmsi, time, lon, lat, sog [knots], cog [deg]: obsnet's plain dialect.
    """
    inverse = local_projection(scenario.recorder.latitude, scenario.recorder.longitude)
    frames = []
    for passage in scenario.passages:
        low, high = getattr(passage.course, "span", (-np.inf, np.inf))
        begin, end = max(scenario.start - 3600.0, low), min(scenario.end + 3600.0, high)
        count = max(int((end - begin) / interval_s) + 1, 2)
        jitter = np.random.default_rng([passage.ship.mmsi, 5]).uniform(-0.3, 0.3, count) * interval_s
        time = np.unique(np.rint(np.clip(begin + np.arange(count) * interval_s + jitter, begin, end)))
        east, north = passage.course.position(time)
        (x1, y1), (x0, y0) = passage.course.position(time + 1.0), passage.course.position(time - 1.0)
        lon, lat = inverse(east, north, inverse=True)
        frames.append(
            pd.DataFrame(
                {
                    "mmsi": passage.ship.mmsi,
                    "time": from_posix(time),
                    "lon": np.round(lon, 6),
                    "lat": np.round(lat, 6),
                    "sog": np.round(np.hypot(x1 - x0, y1 - y0) / 2.0 / KNOT, 1),
                    "cog": np.round(np.rad2deg(np.arctan2(x1 - x0, y1 - y0)) % 360.0, 1) % 360.0,
                }
            )
        )
    none = np.empty(0)
    empty = {
        "mmsi": none.astype(int),
        "time": from_posix(none),
        "lon": none,
        "lat": none,
        "sog": none,
        "cog": none,
    }
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(empty)
