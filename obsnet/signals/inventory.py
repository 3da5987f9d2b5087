"""StationXML in, the obspy description of one station out: parsing and look-up, with errors of one line."""

from __future__ import annotations

import math
import re
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import obspy

from obsnet.errors import StationError
from obsnet.layout import parse_utc

_CODE = re.compile(r"[A-Za-z0-9_-]{0,16}")
"""Of SEED identifiers, which become names of files and folders: no dot, no slash."""


def describe(source: Any) -> str:
    """How a message names the source."""
    return str(source) if isinstance(source, (str, Path)) else "the inventory"


def read(source: Any) -> Any:
    """Parse StationXML without entities, half-read files or codes that are none; an obspy Inventory is taken as it is."""
    if not isinstance(source, (str, Path)):
        if hasattr(source, "networks"):
            check_codes(source, describe(source))
            return source
        raise StationError(
            f"a station needs a StationXML path or an obspy Inventory, found {type(source).__name__}"
        )
    try:
        content = Path(source).read_bytes()
    except OSError as error:
        raise StationError(f"cannot read the StationXML {source}: {error.strerror}") from None
    if not content.strip():
        raise StationError(f"the StationXML {source} is empty")
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise StationError(
            f"the StationXML {source} declares entities, which StationXML has no use for; remove them"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            inventory = obspy.read_inventory(BytesIO(content), format="STATIONXML")
        except Exception as error:  # the XML parser and obspy's plugin raise whatever they meet
            detail = " ".join(str(error).split())[:120] or type(error).__name__
            if isinstance(error, TypeError) and "NoneType" in detail:
                detail = "a latitude, longitude or elevation is missing or no number"
            if b"<FDSNStationXML" not in content and b":FDSNStationXML" not in content:
                detail = "it has no FDSNStationXML element; give the station's StationXML"
            raise StationError(f"{source} is not a StationXML that can be read: {detail}") from None
    check_codes(inventory, describe(source))
    return inventory


def check_codes(inventory: Any, where: str) -> None:
    """Raise `StationError` where a network, station, location or channel has a code that no file could be named by."""
    for network in inventory.networks:
        for station in network.stations:
            parts = [((item.location_code or "").strip(), item.code) for item in station.channels]
            for code in (network.code, station.code, *(code for pair in parts for code in pair)):
                if not _CODE.fullmatch(code or ""):
                    raise StationError(
                        f"{where} has the code {code!r}; a code is at most 16 letters, digits, _ and -"
                    )


def find(inventory: Any, code: str | None, where: str) -> tuple[list[Any], str, str]:
    """All epochs (in order of start) of the one station asked for."""
    found: dict[tuple[str, str], list[Any]] = {}
    for network in inventory.networks:
        for station in network.stations:
            found.setdefault((network.code, station.code), []).append(station)
    names = ", ".join(f"{net}.{sta}" for net, sta in found) or "none"
    if len(names) > 200:
        names = names[:200].rpartition(",")[0] + ", …"
    wanted = [key for key in found if code is None or code in (key[1], ".".join(key))]
    if not wanted:
        raise StationError(
            f"{where} describes no station"
            if not found
            else f"{where} has {names}, not {code or 'empty text'}"
        )
    if len(wanted) > 1:
        raise StationError(f"{where} describes {len(wanted)} stations; name one with --code: {names}")
    network, name = wanted[0]
    return sorted(found[wanted[0]], key=lambda item: seconds(item.start_date, -math.inf)), network, name


def require_depth(station: Any, full: str) -> None:
    """Raise `StationError` where the elevation is not that of a sea floor."""
    if station.elevation is None:
        raise StationError(f"{full} has no elevation in its StationXML; give its depth (--depth)")
    elevation = float(station.elevation)
    if elevation >= 0:
        raise StationError(
            f"{full} has an elevation of {elevation:g} m, not below 0; give its depth (--depth)"
        )


def seconds(time: Any, default: float) -> float:
    """Seconds since 1970 of a UTCDateTime, datetime64 or ISO text; `default` for None."""
    if time is None:
        return default
    if hasattr(time, "timestamp") and not callable(time.timestamp):
        return float(time.timestamp)
    try:
        if isinstance(time, str):
            return parse_utc(time) / 1e9
        if np.isnat(stamp := np.datetime64(time, "ns")):
            raise ValueError
        return float(stamp.astype("int64")) / 1e9
    except (ValueError, TypeError):
        raise StationError(
            f"cannot read the time {time!r}; give ISO 8601, e.g. 2013-05-21T10:00:00Z"
        ) from None
