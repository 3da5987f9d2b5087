"""StationXML in, `Station` out: position, depth, and for every channel its direction, polarity and response.

Which channels are used. A motion channel has a motion instrument code (H, L, N, G, P, M); a pressure
channel has instrument code D or orientation code H. Among the channels at hand (`Station.at`), the motion
sensor (one location, band and instrument) with the most components wins, then the lowest sampling rate,
then the lowest location code. The pressure channel comes from the same location and band if it can, a
hydrophone (H) before a gauge (F, G).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from obsnet.errors import StationError
from obsnet.layout import iso
from obsnet.signals import inventory as inventories

_MOTION_INSTRUMENTS = "HLNGPM"
_PAIRS = ("NE", "12", "XY", "23", "13", "TR", "UV", "AB")
_PRESSURE_ORDER = "HFG"


@dataclass(frozen=True)
class Channel:
    """One epoch of one channel.

    Attributes
    ----------
    seed_id : str
        NET.STA.LOC.CHA.
    kind : {"pressure", "motion"}
        Pascal, or metre a second.
    azimuth_deg : float or None
        Direction of positive motion, clockwise from North; None where the metadata do not say.
    dip_deg : float
        Degrees below the horizontal (SEED): -90 is up, +90 down. Meaningless for pressure.
    polarity : int
        -1 for a pressure channel that is known to be reversed against its response.
    response : obspy Response or None
        None: the samples are taken as Pa or m/s already.
    sampling_rate : float
        Hz as the metadata have it; 0 where they do not say. The waveforms decide.
    starttime, endtime : float
        Epoch, seconds since 1970.
    """

    seed_id: str
    kind: Literal["pressure", "motion"]
    azimuth_deg: float | None = None
    dip_deg: float = 0.0
    polarity: int = 1
    response: Any = field(default=None, compare=False, repr=False)
    sampling_rate: float = 0.0
    starttime: float = -math.inf
    endtime: float = math.inf

    @property
    def code(self) -> str:
        """Three-letter channel code."""
        return self.seed_id.rpartition(".")[2]

    @property
    def orientation(self) -> str:
        """Orientation letter, the last of the code."""
        return self.code[-1:]

    @property
    def group(self) -> str:
        """SEED id without the orientation letter: channels of one sensor share it."""
        return self.seed_id[:-1]

    @property
    def horizontal(self) -> bool:
        """Whether it is a motion channel nearer to the horizontal than to the vertical."""
        return self.kind == "motion" and abs(self.dip_deg) <= 45.0

    @property
    def direction(self) -> np.ndarray:
        """Unit vector (east, north, down) of positive motion."""
        azimuth, dip = math.radians(self.azimuth_deg or 0.0), math.radians(self.dip_deg)
        flat = math.cos(dip)
        return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(dip)])

    def covers(self, time: float) -> bool:
        """Whether `time` (s since 1970) lies in the epoch."""
        return self.starttime <= time < self.endtime


@dataclass(frozen=True)
class Site:
    """Where a station lay from a time [s since 1970] on: degrees in WGS 84, and the depth of the sea floor [m]."""

    starttime: float
    latitude: float
    longitude: float
    depth_m: float

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude, longitude and depth."""
        return self.latitude, self.longitude, self.depth_m


@dataclass(frozen=True)
class Station:
    """An ocean-bottom station.

    Attributes
    ----------
    code : str
        "NET.STA".
    latitude, longitude : float
        Degrees, WGS 84.
    depth_m : float
        Depth of the sea floor below the surface, positive.
    channels : tuple of Channel
        The channels in use: at most one pressure channel and one motion sensor; the module says how chosen.
    epochs : tuple of Channel
        Every usable channel of every epoch, location and band; what `at` chooses from.
    sites : tuple of Site
        Where it lay, in order of time; what `placed` chooses from.

    Examples
    --------
    >>> station = Station("YV.RR03", -21.4, 54.2, 4340.0, (Channel("YV.RR03.00.BDH", "pressure"),))
    >>> station.pressure.code
    'BDH'
    """

    code: str
    latitude: float
    longitude: float
    depth_m: float
    channels: tuple[Channel, ...] = ()
    epochs: tuple[Channel, ...] = field(default=(), repr=False)
    sites: tuple[Site, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        if not (-90 <= self.latitude <= 90 and -180 <= self.longitude <= 360):
            where = f"latitude {self.latitude}, longitude {self.longitude}"
            raise StationError(f"{self.code} cannot lie at {where}; correct its position")
        if not (math.isfinite(self.depth_m) and 0 < self.depth_m < 12000):
            raise StationError(
                f"{self.code} cannot have a depth of {self.depth_m:g} m; give its depth below the surface, "
                "above 0 and below 12000 m (--depth)"
            )
        if not self.epochs:
            object.__setattr__(self, "epochs", self.channels)

    @classmethod
    def from_stationxml(
        cls,
        source: Any,
        code: str | None = None,
        *,
        time: Any = None,
        orientation_deg: float | None = None,
        hydrophone_polarity: int | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        depth_m: float | None = None,
    ) -> Station:
        """Read a station from StationXML.

        Parameters
        ----------
        source : path or obspy Inventory
            Where the station is described.
        code : str, optional
            "NET.STA" (or "STA" where that is unique); may be left out if there is only one station.
        time : datetime64, ISO text or UTCDateTime, optional
            Keep only the epochs in force at this time, and the place of then. By default the times of the
            waveforms decide; until they are known, the place is the latest.
        orientation_deg : float, optional
            Azimuth of the first horizontal (N, 1, X, else the lower code), overriding the metadata. The
            others keep their angle to it; where the metadata give none, the second is 90° clockwise of the
            first.
        hydrophone_polarity : {1, -1}, optional
            -1 if a compression makes the hydrophone, corrected for its response, go down.
        latitude, longitude, depth_m : float, optional
            Override the position [deg] and the depth [m].

        Raises
        ------
        StationError
            Unreadable metadata, another station, no usable channel, no epoch at `time`, no depth.

        Notes
        -----
        The polarity of a pressure channel is the sign of its response; its dip is not used, since instrument
        parks disagree on what it means.
        """
        where = inventories.describe(source)
        station, network, name = inventories.find(inventories.read(source), code, where)
        full = f"{network}.{name}"
        epochs = tuple(channel for item in station for channel in _channels(item, full))
        if not epochs:
            raise StationError(
                f"{where} has no hydrophone and no motion channel of {full}; check its channel codes"
            )
        if time is not None:
            epochs = _in_force(epochs, time, full)
            begins = [inventories.seconds(item.start_date, -math.inf) for item in station]
            station = [station[_last_begun(begins, inventories.seconds(time, 0.0))]]
        sites = tuple(_site(item, latitude, longitude, depth_m) for item in station)
        if depth_m is None:
            inventories.require_depth(station[-1], full)
        made = cls(full, *sites[-1].place, epochs=epochs, sites=sites)
        return made.calibrated(orientation_deg=orientation_deg, hydrophone_polarity=hydrophone_polarity).at()

    @property
    def pressure(self) -> Channel | None:
        """The hydrophone or pressure gauge in use."""
        return next((channel for channel in self.channels if channel.kind == "pressure"), None)

    @property
    def motion(self) -> tuple[Channel, ...]:
        """The motion channels in use."""
        return tuple(channel for channel in self.channels if channel.kind == "motion")

    @property
    def horizontals(self) -> tuple[Channel, ...]:
        """The horizontals in use, the first one first."""
        return tuple(sorted((c for c in self.channels if c.horizontal), key=_horizontal_order))

    @property
    def orientation_deg(self) -> float | None:
        """Azimuth of the first horizontal, or None where there is none or it is unknown."""
        return self.horizontals[0].azimuth_deg if self.horizontals else None

    def without(self, seed_id: str) -> Station:
        """The station as if it had not one of its channels."""
        channels, epochs = (
            tuple(channel for channel in held if channel.seed_id != seed_id)
            for held in (self.channels, self.epochs)
        )
        return replace(self, channels=channels, epochs=epochs)

    def at(self, time: float | None = None, seed_ids: Collection[str] | None = None) -> Station:
        """The station with the channels that serve at a time.

        Parameters
        ----------
        time : float, optional
            Seconds since 1970; by default each channel's latest epoch.
        seed_ids : collection of str, optional
            Choose among these channels only (those that have waveforms).
        """
        pool: dict[str, Channel] = {}
        for channel in sorted(self.epochs, key=lambda c: c.starttime):
            wanted = seed_ids is None or channel.seed_id in seed_ids
            if wanted and (time is None or channel.covers(time)):
                pool[channel.seed_id] = channel
        motion = _choose_motion([c for c in pool.values() if c.kind == "motion"])
        pressure = _choose_pressure([c for c in pool.values() if c.kind == "pressure"], motion)
        return replace(self, channels=(*pressure, *motion))

    @property
    def moved(self) -> bool:
        """Whether it lay in several places."""
        return len({site.place for site in self.sites}) > 1

    def placed(self, time: float) -> Station:
        """The station where it lay at a time [s since 1970]: in the last place that it had by then, else the first.

        Raises
        ------
        StationError
            Its depth there is not known.
        """
        if not self.moved:
            return self
        site = self.sites[_last_begun([site.starttime for site in self.sites], time)]
        latitude, longitude, depth_m = site.place
        return replace(self, latitude=latitude, longitude=longitude, depth_m=depth_m)

    def calibrated(
        self,
        *,
        orientation_deg: float | None = None,
        hydrophone_polarity: int | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        depth_m: float | None = None,
    ) -> Station:
        """The station with metadata overridden; arguments as in `from_stationxml`."""
        if hydrophone_polarity not in (None, 1, -1):
            raise StationError(f"the hydrophone's polarity must be 1 or -1, found {hydrophone_polarity}")
        if orientation_deg is not None and not math.isfinite(orientation_deg):
            raise StationError(f"the orientation must be an azimuth in degrees, found {orientation_deg}")
        epochs = self.epochs
        if orientation_deg is not None:
            epochs = tuple(_turned(channel, epochs, orientation_deg) for channel in epochs)
        if hydrophone_polarity is not None:
            epochs = tuple(
                replace(c, polarity=hydrophone_polarity) if c.kind == "pressure" else c for c in epochs
            )
        chosen = {(c.seed_id, c.starttime) for c in self.channels}
        given = {"latitude": latitude, "longitude": longitude, "depth_m": depth_m}
        place: dict[str, Any] = {name: float(value) for name, value in given.items() if value is not None}
        return replace(
            self,
            **place,
            channels=tuple(c for c in epochs if (c.seed_id, c.starttime) in chosen),
            epochs=epochs,
            sites=tuple(replace(site, **place) for site in self.sites),
        )


def _channels(station: Any, full: str) -> list[Channel]:
    made = []
    for item in station.channels:
        code = item.code
        if len(code) != 3:
            continue
        pressure = code[1] == "D" or code[2] == "H"
        if not pressure and code[1] not in _MOTION_INSTRUMENTS:
            continue
        dip = item.dip if item.dip is not None else (-90.0 if code[2] == "Z" else 0.0)
        made.append(
            Channel(
                f"{full}.{item.location_code or ''}.{code}",
                "pressure" if pressure else "motion",
                None if item.azimuth is None else float(item.azimuth) % 360.0,
                float(dip),
                1,
                item.response,
                float(item.sample_rate or 0.0),
                inventories.seconds(item.start_date, -math.inf),
                inventories.seconds(item.end_date, math.inf),
            )
        )
    return made


def _site(item: Any, latitude: float | None, longitude: float | None, depth_m: float | None) -> Site:
    """An epoch's place, or what was given in its stead; a depth that is not known is not above 0."""
    return Site(
        inventories.seconds(item.start_date, -math.inf),
        float(item.latitude if latitude is None else latitude),
        float(item.longitude if longitude is None else longitude),
        -float(item.elevation or 0.0) if depth_m is None else float(depth_m),
    )


def _last_begun(starts: list[float], time: float) -> int:
    """Which of several consecutive epochs was the last to begin by a time; the first where none had."""
    return max(bisect_right(starts, time) - 1, 0)


def _in_force(epochs: tuple[Channel, ...], time: Any, full: str) -> tuple[Channel, ...]:
    stamp = inventories.seconds(time, 0.0)
    kept = tuple(channel for channel in epochs if channel.covers(stamp))
    if not kept:
        begin, end = min(c.starttime for c in epochs), max(c.endtime for c in epochs)
        span = " to ".join(iso(edge) if math.isfinite(edge) else "now" for edge in (begin, end))
        raise StationError(f"no channel of {full} has an epoch at {iso(stamp)}; its epochs span {span}")
    return kept


def _choose_motion(channels: list[Channel]) -> tuple[Channel, ...]:
    groups: dict[str, list[Channel]] = {}
    for channel in channels:
        groups.setdefault(channel.group, []).append(channel)
    if not groups:
        return ()
    chosen = [_three(group) for group in groups.values()]
    return min(chosen, key=lambda g: (-len(g), g[0].sampling_rate or math.inf, g[0].group))


def _three(group: list[Channel]) -> tuple[Channel, ...]:
    """At most three components: the vertical and one pair of horizontals."""
    flat = sorted((c for c in group if c.horizontal), key=_horizontal_order)
    steep = sorted((c for c in group if not c.horizontal), key=lambda c: c.orientation != "Z")
    if len(flat) + len(steep) > 3:
        letters = "".join(c.orientation for c in flat)
        pair = next((pair for pair in _PAIRS if set(pair) <= set(letters)), letters[:2])
        flat = [c for c in flat if c.orientation in pair][:2]
    return (*flat, *steep)[:3]


def _choose_pressure(channels: list[Channel], motion: tuple[Channel, ...]) -> tuple[Channel, ...]:
    if not channels:
        return ()

    def preference(channel: Channel) -> tuple[Any, ...]:
        location, band = channel.seed_id.split(".")[2], channel.code[0]
        beside = motion[0].seed_id.split(".")[2] if motion else location
        like = motion[0].code[0] if motion else band
        kind = _PRESSURE_ORDER.find(channel.orientation) % 99
        return (location != beside, band != like, kind, channel.sampling_rate or math.inf, channel.seed_id)

    return (min(channels, key=preference),)


def _horizontal_order(channel: Channel) -> tuple[bool, str]:
    return (channel.orientation != "N", channel.orientation)


def _turned(channel: Channel, epochs: tuple[Channel, ...], orientation_deg: float) -> Channel:
    """`channel` as its sensor would say had the first horizontal this azimuth."""
    if not channel.horizontal:
        return channel
    beside = [c for c in epochs if c.horizontal and c.group == channel.group and _overlap(c, channel)]
    first = min(beside, key=_horizontal_order)
    if first.seed_id == channel.seed_id:
        relative = 0.0
    elif first.azimuth_deg is None or channel.azimuth_deg is None or first.azimuth_deg == channel.azimuth_deg:
        relative = 90.0
    else:
        relative = channel.azimuth_deg - first.azimuth_deg
    return replace(channel, azimuth_deg=(orientation_deg + relative) % 360.0)


def _overlap(first: Channel, second: Channel) -> bool:
    return first.starttime < second.endtime and second.starttime < first.endtime
