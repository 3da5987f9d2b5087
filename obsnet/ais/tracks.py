"""AIS positions in, reference tracks around a station out.

Positions are projected on the azimuthal equidistant plane centred on the station, where the distance and the
azimuth from the station are true; a ship is split where it was silent for long, and each of its crossings of
a disc around the station is one track. Between two reports a ship is taken to go straight at constant speed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import pandas as pd
from pyproj import Transformer

from obsnet.errors import AISError, ConfigError
from obsnet.kinematics import StraightCourse, fit_straight_course
from obsnet.layout import to_posix

DelayFunction = Callable[[np.ndarray], np.ndarray]
VELOCITY_HALF_SPAN_S = 120.0
CPA_HALF_SPAN_S = 900.0
ATTRIBUTES = ("ship_type", "length_m", "width_m", "to_stern_m")


class Located(Protocol):
    """Anything with a latitude and a longitude in degrees: a Station, say."""

    @property
    def latitude(self) -> float:
        """Degrees North."""

    @property
    def longitude(self) -> float:
        """Degrees East."""


@dataclass(frozen=True)
class ClosestApproach:
    """Where and when a ship came closest: time [s since 1970], range [m], azimuth [deg from the station]."""

    time: float
    range_m: float
    azimuth_deg: float


@dataclass(frozen=True, eq=False)
class ReferenceTrack:
    """One crossing of the disc around a station by one ship, as AIS reports it.

    ``time`` [s since 1970], ``east_m`` and ``north_m`` are the real reports of the crossing, with the last
    one before it and the first one after it where there are; ``starttime`` and ``endtime`` are those of the
    crossing itself.
    """

    mmsi: int
    name: str
    time: np.ndarray
    east_m: np.ndarray
    north_m: np.ndarray
    starttime: float
    endtime: float
    max_interpolation_s: float = 1800.0
    attributes: dict[str, Any] = field(default_factory=dict)

    def at(self, times: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """East and north [m] of the ship at `times` [s since 1970], and where that is interpolated.

        A position is flagged as interpolated where the nearest report is more than `max_interpolation_s`
        away; it is NaN before the first report and after the last.
        """
        times = np.asarray(times, float)
        known = (times >= self.time[0]) & (times <= self.time[-1])
        east, north = (
            np.where(known, np.interp(times, self.time, xy), np.nan) for xy in (self.east_m, self.north_m)
        )
        after = np.clip(np.searchsorted(self.time, times), 1, len(self.time) - 1)
        nearest = np.minimum(np.abs(times - self.time[after - 1]), np.abs(self.time[after] - times))
        return east, north, nearest > self.max_interpolation_s

    def velocity(self, times: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """East and north velocity [m/s] over 4 min about `times`: that averages the jitter of the reports."""
        times = np.clip(np.asarray(times, float), self.time[0], self.time[-1])
        before = np.maximum(times - VELOCITY_HALF_SPAN_S, self.time[0])
        after = np.minimum(times + VELOCITY_HALF_SPAN_S, self.time[-1])
        span = np.maximum(after - before, 1e-9)
        east, north = (
            (np.interp(after, self.time, xy) - np.interp(before, self.time, xy)) / span
            for xy in (self.east_m, self.north_m)
        )
        return east, north

    def observables(self, times: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Azimuth [deg], range [m], range rate [m/s] of the ship at `times`; NaN outside the reports."""
        east, north, _ = self.at(times)
        v_east, v_north = self.velocity(times)
        distance = np.hypot(east, north)
        rate = (east * v_east + north * v_north) / np.maximum(distance, 1e-9)
        return np.rad2deg(np.arctan2(east, north)) % 360.0, distance, rate

    def heard(
        self, times: np.ndarray | float, delay: DelayFunction | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observables of the ship as the station hears it at `times` [s since 1970].

        Parameters
        ----------
        delay : function of range [m] giving the travel time [s], or None where sound is to take no time.

        What is heard at t left the ship at t_e with t_e + delay(range(t_e)) = t, found by iterating
        t_e = t - delay(range(t_e)), which gains a factor (speed of the ship / speed of sound) each time. The
        range rate is that of the range heard, the ship's own divided by dt/dt_e = 1 + (ddelay/drange) rate.
        """
        times = np.asarray(times, float)
        if delay is None:
            return self.observables(times)
        emitted = times
        for _ in range(8):
            inside = np.clip(emitted, self.time[0], self.time[-1])
            east, north = (np.interp(inside, self.time, xy) for xy in (self.east_m, self.north_m))
            emitted = times - np.asarray(delay(np.hypot(east, north)), float)
        azimuth, distance, rate = self.observables(emitted)
        slowness = (np.asarray(delay(distance + 50.0)) - np.asarray(delay(distance - 50.0))) / 100.0
        return azimuth, distance, rate / (1.0 + slowness * rate)

    def line(self) -> StraightCourse:
        """The straight course fitted to the AIS positions within the disc (truth of the paper's Table I).

        The points where the interpolated track enters and leaves the disc count as positions too, so that one
        short burst of satellite reports does not decide the course alone.
        """
        inside = (self.time > self.starttime) & (self.time < self.endtime)
        times = np.concatenate([[self.starttime], self.time[inside], [self.endtime]])
        east, north, _ = self.at(times)
        return fit_straight_course(times, east, north)

    def course_at_cpa(self) -> StraightCourse:
        """The straight course fitted to the track over half an hour about its closest approach: where the ship really passed.

        That of a ship that turns is far from the line through its whole crossing.
        """
        middle = self.cpa().time
        low, high = max(middle - CPA_HALF_SPAN_S, self.time[0]), min(middle + CPA_HALF_SPAN_S, self.time[-1])
        if high - low < CPA_HALF_SPAN_S:
            return self.line()
        times = np.linspace(low, high, 61)
        east, north, _ = self.at(times)
        return fit_straight_course(times, east, north)

    def cpa(self) -> ClosestApproach:
        """Closest approach of the track, interpolated between its reports."""
        return _closest(self.time, self.east_m, self.north_m)


def reference_tracks(
    ais: pd.DataFrame,
    station: Located | tuple[float, float],
    *,
    max_range_m: float = 100e3,
    max_cpa_m: float | None = 25e3,
    max_gap_s: float = 24 * 3600.0,
    max_interpolation_s: float = 1800.0,
    min_reports: int = 2,
    source_astern: float = 0.0,
    merchant_only: bool = False,
    starttime: float | None = None,
    endtime: float | None = None,
) -> list[ReferenceTrack]:
    """Cut AIS positions into the ships' crossings of a disc around a station.

    Parameters
    ----------
    ais : DataFrame
        As `read` returns it: mmsi, time, lon, lat and, where known, name, ship_type, length_m, width_m,
        to_stern_m.
    station : Station, or (latitude, longitude) in degrees
    max_range_m : float
        Radius of the disc, m.
    max_cpa_m : float, optional
        Leave out the crossings that come no closer than this, m.
    max_gap_s : float
        A ship that was silent for longer is split, s.
    max_interpolation_s : float
        Positions farther in time from any report are flagged as interpolated, s.
    min_reports : int
        Real reports that a crossing needs, the one before and the one after it included.
    source_astern : float
        How far astern of the reported position the ship sounds, as a share of its length: positions are the
        antenna's and the noise is the propeller's. Ships of unknown length stay where they are.
    merchant_only : bool
        Keep cargo ships and tankers only (AIS types 70 to 89), as the core paper did.
    starttime, endtime : float, optional
        Keep the crossings whose closest approach falls between, s since 1970.

    Returns
    -------
    list of ReferenceTrack
        In order of their closest approaches.

    Raises
    ------
    AISError
        The table lacks a column.
    """
    missing = [name for name in ("mmsi", "time", "lon", "lat") if name not in ais]
    if missing:
        raise AISError(
            f"the AIS table lacks {', '.join(missing)}; it holds {', '.join(map(str, ais.columns))}"
        )
    if not max_range_m > 0 or not max_gap_s > 0 or min_reports < 2:
        raise ConfigError(
            "reference tracks need a positive radius and gap and two reports, "
            f"found {max_range_m=}, {max_gap_s=}, {min_reports=}"
        )
    latitude, longitude = station if isinstance(station, tuple) else (station.latitude, station.longitude)
    project = Transformer.from_crs(
        "EPSG:4326", f"+proj=aeqd +lat_0={latitude} +lon_0={longitude} +datum=WGS84", always_xy=True
    )
    ais = ais.sort_values(["mmsi", "time"], kind="stable").drop_duplicates(["mmsi", "time"])
    seconds = to_posix(ais["time"].to_numpy())
    east, north = project.transform(ais["lon"].to_numpy(float), ais["lat"].to_numpy(float))
    joined = (np.diff(ais["mmsi"].to_numpy()) == 0) & (np.diff(seconds) <= max_gap_s)
    tracks = []
    for first, last, start, end in _crossings(seconds, east, north, joined, max_range_m):
        part = slice(first, last + 1)
        closest = _closest(seconds[part], east[part], north[part])
        if last - first + 1 < min_reports or (max_cpa_m is not None and closest.range_m > max_cpa_m):
            continue
        if not (starttime or -np.inf) <= closest.time < (endtime or np.inf):
            continue
        mmsi = int(ais["mmsi"].iloc[first])
        facts = _attributes(ais.iloc[part])
        if merchant_only and not is_merchant(facts.get("ship_type")):
            continue
        name = str(facts.pop("name", None) or mmsi)
        track = ReferenceTrack(
            mmsi, name, seconds[part], east[part], north[part], start, end, max_interpolation_s, facts
        )
        tracks.append(_astern(track, source_astern * float(facts.get("length_m") or 0.0)))
    return sorted(tracks, key=lambda track: track.cpa().time)


def _crossings(
    time: np.ndarray, east: np.ndarray, north: np.ndarray, joined: np.ndarray, radius: float
) -> Iterator[tuple[int, int, float, float]]:
    """First and last report, and times of entry and exit, of each crossing of the disc.

    A leg from report i to i + 1 is P + s·D, 0 ≤ s ≤ 1; it is inside where |P + s·D|² < radius², a quadratic
    in s.
    """
    d_east, d_north = np.diff(east), np.diff(north)
    square = np.maximum(d_east**2 + d_north**2, 1e-6)
    middle = -(east[:-1] * d_east + north[:-1] * d_north) / square
    offset = np.hypot(east[:-1] + middle * d_east, north[:-1] + middle * d_north)
    half = np.sqrt(np.maximum(radius**2 - offset**2, 0.0) / square)
    enter, leave = np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)
    inside = joined & (offset < radius) & (enter < leave)
    duration = np.diff(time)
    legs = np.flatnonzero(inside)
    breaks = np.flatnonzero((np.diff(legs) > 1) | (leave[legs[:-1]] < 1.0) | (enter[legs[1:]] > 0.0))
    for run in np.split(legs, breaks + 1):
        if len(run):
            i, j = int(run[0]), int(run[-1])
            yield i, j + 1, float(time[i] + enter[i] * duration[i]), float(time[j] + leave[j] * duration[j])


def _closest(time: np.ndarray, east: np.ndarray, north: np.ndarray) -> ClosestApproach:
    d_east, d_north = np.diff(east), np.diff(north)
    square = np.maximum(d_east**2 + d_north**2, 1e-6)
    share = np.clip(-(east[:-1] * d_east + north[:-1] * d_north) / square, 0.0, 1.0)
    x, y = east[:-1] + share * d_east, north[:-1] + share * d_north
    leg = int(np.hypot(x, y).argmin())
    moment = time[leg] + share[leg] * (time[leg + 1] - time[leg])
    return ClosestApproach(
        float(moment), float(np.hypot(x, y)[leg]), float(np.rad2deg(np.arctan2(x[leg], y[leg])) % 360.0)
    )


def is_merchant(ship_type: str | None) -> bool:
    """Whether an AIS type, as a number or in words, is that of a cargo ship or a tanker; an unknown one is not."""
    words = str(ship_type or "").lower()
    return words.startswith(("cargo", "tanker")) or (words.isdigit() and 70 <= int(words) < 90)


def _attributes(reports: pd.DataFrame) -> dict[str, Any]:
    facts: dict[str, Any] = {}
    for column in ("name", *ATTRIBUTES):
        values = reports[column].dropna() if column in reports else pd.Series(dtype=object)
        if len(values):
            common = values.mode().iloc[0]
            facts[column] = common if isinstance(common, str) else float(common)
    return facts


def _astern(track: ReferenceTrack, offset_m: float) -> ReferenceTrack:
    """The track of a point `offset_m` behind the reported one."""
    if not offset_m:
        return track
    v_east, v_north = track.velocity(track.time)
    speed = np.hypot(v_east, v_north)
    ahead_east, ahead_north = (
        np.where(speed > 0.5, v / np.maximum(speed, 0.5), 0.0) for v in (v_east, v_north)
    )
    east, north = track.east_m - offset_m * ahead_east, track.north_m - offset_m * ahead_north
    return ReferenceTrack(
        track.mmsi,
        track.name,
        track.time,
        east,
        north,
        track.starttime,
        track.endtime,
        track.max_interpolation_s,
        track.attributes,
    )
