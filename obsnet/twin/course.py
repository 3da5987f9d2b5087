"""Where a ship goes: straight, turning, or through AIS positions; metres east and north of the station
against time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from pyproj import Proj
from scipy.interpolate import PchipInterpolator

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse


class Course(Protocol):
    """Anything that says where a ship is at a time; where it has a `span`, the ship fades out beyond it."""

    def position(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] of the ship relative to the station at `time` [s since 1970]."""
        ...


@dataclass(frozen=True)
class TurningCourse:
    """A straight course that turns once, on a circle, from `course_deg` by `turn_deg` (positive to
    starboard).

    Parameters
    ----------
    before : StraightCourse
        The course up to `turn_time`.
    turn_time : float
        Start of the turn, s since 1970.
    turn_deg : float
        Change of course.
    radius_m : float
        Radius of the turn.
    """

    before: StraightCourse
    turn_time: float
    turn_deg: float
    radius_m: float = 1500.0

    def __post_init__(self) -> None:
        if not (self.radius_m > 0 and self.before.speed_mps > 0):
            raise ConfigError(
                f"a turn needs radius and speed > 0, found {self.radius_m} m, {self.before.speed_mps} m/s"
            )

    def position(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] at `time` [s since 1970]."""
        time = np.asarray(time, float)
        speed, side = self.before.speed_mps, np.sign(self.turn_deg)
        duration = np.deg2rad(abs(self.turn_deg)) * self.radius_m / speed
        elapsed = np.clip(time - self.turn_time, 0.0, duration)
        start, angle = np.deg2rad(self.before.course_deg), elapsed * speed / self.radius_m
        heading = start + side * angle
        after = np.maximum(time - self.turn_time - duration, 0.0) * speed
        east, north = self.before.position(np.minimum(time, self.turn_time))
        east = east + side * self.radius_m * (np.cos(start) - np.cos(heading)) + after * np.sin(heading)
        north = north + side * self.radius_m * (np.sin(heading) - np.sin(start)) + after * np.cos(heading)
        return east, north


@dataclass(frozen=True, eq=False)
class WaypointCourse:
    """Through given positions, at constant velocity between them, or smoothly (monotone cubics); straight on
    beyond them.

    Parameters
    ----------
    time : array, s since 1970, increasing.
    east, north : arrays, m from the station.
    smooth : bool
        Interpolate smoothly.
    """

    time: np.ndarray
    east: np.ndarray
    north: np.ndarray
    smooth: bool = False
    span: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        time, east, north = (np.asarray(values, float) for values in (self.time, self.east, self.north))
        if time.ndim != 1 or time.size < 2 or east.shape != time.shape or north.shape != time.shape:
            raise ConfigError(
                f"a waypoint course needs two positions at least, one per time, found {time.size} times"
            )
        if np.any(np.diff(time) <= 0) or not np.all(np.isfinite([time, east, north])):
            raise ConfigError(
                "a waypoint course needs finite positions at increasing times; sort them and drop repeats"
            )
        for name, value in (("time", time), ("east", east), ("north", north)):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "span", (float(time[0]), float(time[-1])))

    @classmethod
    def from_ais(
        cls,
        time: np.ndarray,
        longitude: np.ndarray,
        latitude: np.ndarray,
        station: tuple[float, float],
        smooth: bool = True,
    ) -> WaypointCourse:
        """Course of AIS positions [deg, WGS 84] around a station at (latitude, longitude), azimuthal
        equidistant.

        Repeated times are dropped.
        """
        seconds, unique = np.unique(np.asarray(time, float), return_index=True)
        east, north = local_projection(*station)(
            np.asarray(longitude, float)[unique], np.asarray(latitude, float)[unique]
        )
        return cls(seconds, np.asarray(east), np.asarray(north), smooth)

    def position(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] at `time` [s since 1970]."""
        time = np.asarray(time, float)
        return self._axis(time, self.east), self._axis(time, self.north)

    def _axis(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        knots = self.time
        inside = np.clip(time, knots[0], knots[-1])
        inner = PchipInterpolator(knots, values)(inside) if self.smooth else np.interp(inside, knots, values)
        first = (values[1] - values[0]) / (knots[1] - knots[0])
        last = (values[-1] - values[-2]) / (knots[-1] - knots[-2])
        return inner + np.minimum(time - knots[0], 0.0) * first + np.maximum(time - knots[-1], 0.0) * last


def presence(course: Course, time: np.ndarray, fade_s: float = 600.0) -> np.ndarray:
    """Amplitude factor of a ship at `time`: 1 within its course's span, fading to 0 over `fade_s` beyond
    either end.
    """
    span = getattr(course, "span", None)
    if span is None:
        return np.ones(np.shape(time))
    outside = np.maximum(np.maximum(span[0] - np.asarray(time), np.asarray(time) - span[1]), 0.0)
    return 0.5 * (1 + np.cos(np.pi * np.clip(outside / fade_s, 0.0, 1.0)))


def local_projection(latitude: float, longitude: float) -> Proj:
    """Azimuthal equidistant projection around a station: east and north [m] of longitude and latitude
    [deg].
    """
    return Proj(proj="aeqd", lat_0=latitude, lon_0=longitude, ellps="WGS84")
