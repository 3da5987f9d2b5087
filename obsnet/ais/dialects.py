"""The tables that AIS sources write: raw rows in, clean rows of ship positions in SI units out."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pandas as pd

from obsnet.errors import AISError

KNOT = 1852.0 / 3600.0
NO_LONGITUDE_DEG = 181.0
EARLIEST = pd.Timestamp("1990-01-01")
LATEST = pd.Timestamp("2200-01-01")
NOT_SHIPS = ("base station", "aton", "sar airborne", "search and rescue transponder", "man overboard device")

# Where each quantity is found, by names in lower case without blanks, dashes or underscores.
ALIASES = {
    "mmsi": ("mmsi",),
    "lon": ("lon", "longitude", "long"),
    "lat": ("lat", "latitude"),
    "sog": ("sog",),
    "cog": ("cog", "course"),
    "heading": ("heading", "trueheading"),
    "ship_type": ("vesseltype", "shiptype", "aisshiptype"),
    "length_m": ("length", "shiplength", "lengthm"),
    "width_m": ("width", "shipwidth", "widthm"),
    "to_stern_m": ("b", "sizeb", "tosternm"),
    "name": ("vesselname", "name", "shipname"),
    "mobile": ("typeofmobile",),
}
PLAIN_TIMES = ("time", "timestamp", "datetime", "datetimeutc", "timeutc")


@dataclass(frozen=True)
class Dialect:
    """How one source writes its table: its columns of time, what else marks it, its unit of speed."""

    name: str
    time: tuple[str, ...]
    marks: tuple[str, ...] = ()
    time_format: str = "ISO8601"
    speed: str = ""
    knots_per_unit: float = 1.0
    prepared: bool = False


DIALECTS = (
    Dialect("CLS", ("locdate", "loctime"), time_format="%d/%m/%Y %H:%M:%S"),
    Dialect("MarineTraffic", ("timestamputc",), speed="speed", knots_per_unit=0.1),
    Dialect("MarineCadastre", ("basedatetime",)),
    Dialect("Danish Maritime Authority", ("timestamp",), ("typeofmobile",), time_format="%d/%m/%Y %H:%M:%S"),
    *(Dialect("plain", (name,), prepared=True) for name in PLAIN_TIMES),
)
NMEA = Dialect("NMEA", ("time",))


def keys_of(header: list[str]) -> list[str]:
    """Names of columns as `ALIASES` spells them; a repeated name is numbered.

    >>> keys_of(["# Timestamp", "Type of mobile", "MMSI"])
    ['timestamp', 'typeofmobile', 'mmsi']
    """
    keys = [re.sub("[^a-z0-9]", "", column.lower()) for column in header]
    return [key if key not in keys[:i] else f"{key}#{i}" for i, key in enumerate(keys)]


def recognise(header: list[str], name: str) -> tuple[Dialect, dict[str, str]]:
    """Dialect of a header, and the key of the column where each quantity is found.

    Raises
    ------
    AISError
        No dialect fits; the columns found are named.
    """
    keys = keys_of(header)
    found = {ours: next((key for key in names if key in keys), "") for ours, names in ALIASES.items()}
    for dialect in DIALECTS:
        marked = set(dialect.time + dialect.marks) <= set(keys)
        if marked and found["mmsi"] and found["lon"] and found["lat"]:
            found["sog"] = dialect.speed if dialect.speed in keys else found["sog"]
            return dialect, {ours: key for ours, key in found.items() if key}
    shown = "".join(c if c.isprintable() else "?" for c in ", ".join(header))
    raise AISError(
        f"{name} is of no known AIS dialect: found columns {shown[:120]}; a plain file has mmsi,time,lon,lat"
        "[,sog,cog]; MarineCadastre, Danish, MarineTraffic, CLS and NMEA (!AIVDM) files are read as they are"
    )


def clean(raw: pd.DataFrame, dialect: Dialect, dropped: Counter[str]) -> pd.DataFrame:
    """Rows that place a ship, as numbers in SI units; the others are counted into `dropped` by reason."""

    def number(name: str) -> pd.Series:
        if name not in raw:
            return pd.Series(np.nan, raw.index)
        return pd.to_numeric(raw[name], errors="coerce").astype(float)

    mmsi, lon, lat = number("mmsi"), number("lon"), number("lat")
    lon = lon.mask(lon.between(180, 360, inclusive="right") & (lon != NO_LONGITUDE_DEG), lon - 360)
    time = _times(raw["time"], dialect.time_format)
    unlike_ship = pd.Series(False, raw.index) if dialect.prepared else _shore_or_aid(mmsi)
    if "mobile" in raw:
        unlike_ship |= raw["mobile"].str.strip().str.lower().isin(NOT_SHIPS)
    reasons = {
        "no MMSI": ~mmsi.between(0 if dialect.prepared else 1, 999_999_999),
        "not a ship": unlike_ship,
        "no readable time": time.isna(),
        "no position": ~(lon.between(-180, 180) & lat.between(-90, 90)) | ((lon == 0) & (lat == 0)),
    }
    keep = pd.Series(True, raw.index)
    for reason, bad in reasons.items():
        dropped[reason] += int((keep & bad).sum())
        keep &= ~bad
    table = pd.DataFrame({"mmsi": mmsi, "time": time, "lon": lon, "lat": lat})
    sog = number("sog") * dialect.knots_per_unit
    table["sog_mps"] = sog.where(sog.between(0, 102.15)) * KNOT
    for ours, angle in (("cog_deg", number("cog")), ("heading_deg", number("heading"))):
        table[ours] = angle.where(angle.between(0, 360, inclusive="left"))
    for name in ("length_m", "width_m", "to_stern_m"):
        if name in raw:
            table[name] = number(name).where(lambda value: value > 0)
    for name in ("ship_type", "name"):
        if name in raw:
            words = raw[name].astype("string").str.strip().str.removesuffix(".0")
            table[name] = words.where(words != "")
    return table[keep].astype({"mmsi": "int64"})


def _times(column: pd.Series, time_format: str) -> pd.Series:
    if not pd.api.types.is_datetime64_any_dtype(column):
        words = column.astype("string").str.strip().str.replace(r"\s*UTC$", "", regex=True)
        column = pd.to_datetime(words, format=time_format, utc=True, errors="coerce").dt.tz_localize(None)
    return column.where((column >= EARLIEST) & (column < LATEST)).astype("datetime64[ns]")


def _shore_or_aid(mmsi: pd.Series) -> pd.Series:
    """Coast stations (00MID…), aids to navigation (99MID…), aircraft (111MID…), beacons (970, 972, 974)."""
    prefix = mmsi // 1_000_000
    return prefix.between(2, 9) | prefix.between(990, 999) | prefix.isin([111, 970, 972, 974])
