"""A straight course at constant speed past a station, or one that bends a little; what the station's observables are along it.

Convention: x east, y north; azimuth from the station to the ship and course of the ship, degrees clockwise from north;
range horizontal in metres; range rate positive when opening.

The range at the closest point of approach (CPA) is signed: where it is positive the ship is at azimuth ``course + 90°`` at CPA
(the station lies to its port), where it is negative at ``course - 90°`` (the station lies to its starboard).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class StraightCourse:
    """Motion of one ship: CPA time [s since 1970], signed CPA range [m], course [deg], speed [m/s]."""

    cpa_time: float
    cpa_range_m: float
    course_deg: float
    speed_mps: float

    @property
    def cpa_azimuth_deg(self) -> float:
        """Azimuth of the ship at CPA, [0, 360)."""
        side = 90.0 if self.cpa_range_m >= 0 else -90.0
        return (self.course_deg + side) % 360.0

    def position(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] of the ship relative to the station at `time` [s since 1970]."""
        course = np.deg2rad(self.course_deg)
        along = self.speed_mps * (np.asarray(time, float) - self.cpa_time)
        east = self.cpa_range_m * np.cos(course) + along * np.sin(course)
        north = -self.cpa_range_m * np.sin(course) + along * np.cos(course)
        return east, north

    def observables(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Azimuth [deg], range [m] and range rate [m/s] of the ship where it is at `time`."""
        along = self.speed_mps * (np.asarray(time, float) - self.cpa_time)
        distance = np.hypot(self.cpa_range_m, along)
        rate = self.speed_mps * along / np.maximum(distance, 1e-9)
        azimuth = self.course_deg + np.rad2deg(np.arctan2(self.cpa_range_m, along))
        return azimuth % 360.0, distance, rate


@dataclass(frozen=True)
class BentCourse(StraightCourse):
    """A course that bends: the straight one is its tangent at CPA, from which its velocity departs on either side.

    The departure is a share of the speed, to starboard (`across`) and ahead (`along`): the first terms of a random walk of the
    velocity (Karhunen–Loève), sin((k − ½)π s/S) at s after or before CPA up to S and constant beyond. The first term holds 99 % of
    the variance of the ship's place at S, the first two 90 % of that of its velocity. A ship may also turn once.

    Attributes
    ----------
    reach_s : S before and after CPA, s.
    across, along : (term, side) shares of the speed, before and after CPA.
    turn_s, turn_deg : time after CPA (before it if negative) beyond which, seen from CPA, the course is another by so much.
    """

    reach_s: tuple[float, float] = (3600.0, 3600.0)
    across: tuple[tuple[float, float], ...] = ()
    along: tuple[tuple[float, float], ...] = ()
    turn_s: float = 0.0
    turn_deg: float = 0.0

    def position(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] of the ship relative to the station at `time` [s since 1970]."""
        side, ahead, _, _ = self._from_cpa(time)
        course = np.deg2rad(self.course_deg)
        east = side * np.cos(course) + ahead * np.sin(course)
        north = -side * np.sin(course) + ahead * np.cos(course)
        return east, north

    def observables(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Azimuth [deg], range [m] and range rate [m/s] of the ship where it is at `time`."""
        side, ahead, sideways, forwards = self._from_cpa(time)
        distance = np.hypot(side, ahead)
        rate = (side * sideways + ahead * forwards) / np.maximum(distance, 1e-9)
        azimuth = self.course_deg + np.rad2deg(np.arctan2(side, ahead))
        return azimuth % 360.0, distance, rate

    def _from_cpa(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place to starboard of the station and ahead of CPA [m], and the velocity along these [m/s]."""
        elapsed = np.asarray(time, float) - self.cpa_time
        after = (elapsed >= 0).astype(int)
        reach = np.asarray(self.reach_s)[after]
        side, ahead = np.zeros(elapsed.shape), elapsed.copy()
        sideways, forwards = np.zeros(elapsed.shape), np.ones(elapsed.shape)
        for term, (across, along) in enumerate(zip(self.across, self.along, strict=True)):
            way, rise = departure(abs(elapsed), reach, term)
            way = np.sign(elapsed) * way
            side += np.asarray(across)[after] * way
            sideways += np.asarray(across)[after] * rise
            ahead += np.asarray(along)[after] * way
            forwards += np.asarray(along)[after] * rise
        beyond = (
            np.maximum(elapsed - self.turn_s, 0.0)
            if self.turn_s >= 0
            else np.minimum(elapsed - self.turn_s, 0.0)
        )
        sine, cosine = np.sin(np.deg2rad(self.turn_deg)), np.cos(np.deg2rad(self.turn_deg))
        side, ahead = side + sine * beyond, ahead + (cosine - 1.0) * beyond
        sideways, forwards = sideways + sine * (beyond != 0), forwards + (cosine - 1.0) * (beyond != 0)
        v = self.speed_mps
        return self.cpa_range_m + v * side, v * ahead, v * sideways, v * forwards


def emission(
    motion: StraightCourse, heard: np.ndarray, delay: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Times [s since 1970] at which a ship made what is heard at `heard`: e + delay(range(e)) = t.

    Ships are so slow beside sound that four rounds settle it to 1 ms.
    """
    emitted = heard
    for _ in range(4):
        emitted = heard - np.asarray(delay(motion.observables(emitted)[1]), float)
    return emitted


def departure(elapsed: np.ndarray, reach: np.ndarray, term: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Integral [s] and value of a bend's term at `elapsed` ≥ 0 [s] from CPA: sin((term + ½)π s/S), constant beyond S = `reach`.

    >>> way, rise = departure(np.array([0.0, 3600.0]), np.array(3600.0))
    >>> rise.tolist()
    [0.0, 1.0]
    """
    order = (term + 0.5) * np.pi
    angle = order * np.minimum(elapsed / reach, 1.0)
    way = reach / order * (1.0 - np.cos(angle)) + (-1) ** term * np.maximum(elapsed - reach, 0.0)
    return way, np.sin(angle)


def fit_straight_course(time: np.ndarray, east: np.ndarray, north: np.ndarray) -> StraightCourse:
    """Least-squares straight course through positions (paper's Table I truth: a line fitted to the AIS positions).

    Parameters
    ----------
    time : array, s since 1970; two distinct times at least.
    east, north : arrays, m from the station.
    """
    time = np.asarray(time, float)
    origin = time.mean()
    design = np.stack([np.ones_like(time), time - origin], axis=1)
    (x0, vx), (y0, vy) = (
        np.linalg.lstsq(design, np.asarray(values, float), rcond=None)[0] for values in (east, north)
    )
    speed = float(np.hypot(vx, vy))
    cpa_time = float(origin - (x0 * vx + y0 * vy) / max(speed**2, 1e-12))
    signed = float((x0 * vy - y0 * vx) / max(speed, 1e-12))
    course = float(np.rad2deg(np.arctan2(vx, vy)) % 360.0)
    return StraightCourse(cpa_time, signed, course, speed)


def wrap180(angle_deg: np.ndarray | float) -> np.ndarray:
    """Angle difference in [-180, 180).

    >>> float(wrap180(350.0))
    -10.0
    """
    return (np.asarray(angle_deg) + 180.0) % 360.0 - 180.0
