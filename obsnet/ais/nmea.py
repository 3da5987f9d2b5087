r"""Logged NMEA sentences (!AIVDM) with receive times in, a table of position reports out.

A receive time stands in a tag block (``\c:1369134796*53\!AIVDM…``), before the sentence
(``2013-05-21T11:13:16Z !AIVDM…``) or after it (``…*4E,1369134796``), in seconds or milliseconds since 1970 or
as ISO 8601 UTC.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any

import pandas as pd

from obsnet.errors import AISError

SENTENCE = re.compile(rb"![A-Z]{2}VD[MO],(\d),(\d),(\d?),[^*]*\*[0-9A-Fa-f]{2}")
TAG_TIME = re.compile(rb"\\[^\\]*?\bc:(\d{9,13})[^\\]*\\")
POSITIONS = {1, 2, 3, 18, 19, 27}
STATICS = {5, 19, 24}
NOT_SHIPS = {4, 9, 11, 21}


def decode(lines: Iterable[bytes], name: str) -> tuple[pd.DataFrame, Counter[str]]:
    """Decode a log with pyais.

    Returns
    -------
    table, counts
        One row per position report with its receive time (text or NaT), and what was passed over, by reason.

    Raises
    ------
    AISError
        pyais is not installed.
    """
    try:
        import pyais
        from pyais.exceptions import AISBaseException
    except ImportError:
        raise AISError(f"{name} holds NMEA sentences; to decode them: pip install obsnet[ais]") from None
    counts: Counter[str] = Counter()
    rows: list[dict[str, Any]] = []
    statics: dict[int, dict[str, Any]] = {}
    pending: dict[tuple[bytes, bytes], list[bytes]] = {}
    stamp: str | float | None = None
    for line in lines:
        match = SENTENCE.search(line)
        if match is None:
            counts["no AIS sentence"] += bool(line.strip())
            continue
        total, number, sequence = match.groups()
        received = _receive_time(line, match)
        stamp = received if received is not None or number == b"1" else stamp
        parts = [match.group()]
        if total != b"1":
            parts = pending.setdefault((sequence, total), []) if number != b"1" else []
            pending[(sequence, total)] = [*parts, match.group()]
            parts = pending[(sequence, total)]
            if len(parts) < int(total):
                continue
            del pending[(sequence, total)]
        try:
            message = pyais.decode(*parts, error_if_checksum_invalid=True).asdict()
        except (AISBaseException, ValueError, IndexError, KeyError, TypeError):
            counts["undecodable sentence"] += 1
            continue
        _sort_in(message, stamp, rows, statics, counts)
    table = pd.DataFrame(rows, columns=["mmsi", "time", "lon", "lat", "sog", "cog", "heading"])
    for column in ("ship_type", "length_m", "width_m", "to_stern_m", "name"):
        values = {mmsi: static[column] for mmsi, static in statics.items() if static.get(column)}
        if values:
            table[column] = table["mmsi"].map(values)
    table["time"] = _parse_times(table["time"])
    return table, counts


def _sort_in(
    message: dict[str, Any],
    stamp: str | float | None,
    rows: list[dict[str, Any]],
    statics: dict[int, dict[str, Any]],
    counts: Counter[str],
) -> None:
    kind, mmsi = int(message["msg_type"]), int(message["mmsi"])
    if kind in POSITIONS:
        speed = message.get("speed")
        if kind == 27 and speed is not None and speed >= 63:
            speed = None
        rows.append(
            {
                "mmsi": mmsi,
                "time": stamp,
                "lon": message["lon"],
                "lat": message["lat"],
                "sog": speed,
                "cog": message.get("course"),
                "heading": message.get("heading"),
            }
        )
    elif kind in NOT_SHIPS:
        counts["not a ship"] += 1
    elif kind not in STATICS:
        counts["message without position"] += 1
    if kind in STATICS:
        bow, stern = message.get("to_bow") or 0, message.get("to_stern") or 0
        width = (message.get("to_port") or 0) + (message.get("to_starboard") or 0)
        found = {
            "name": str(message.get("shipname") or "").strip(" @"),
            "ship_type": str(int(message.get("ship_type") or 0) or ""),
            "length_m": bow + stern,
            "width_m": width,
            "to_stern_m": stern if bow else 0,
        }
        statics.setdefault(mmsi, {}).update({key: value for key, value in found.items() if value})
        counts["message without position"] += kind != 19


def _receive_time(line: bytes, match: re.Match[bytes]) -> str | float | None:
    tag = TAG_TIME.search(line)
    if tag:
        return _seconds(tag.group(1))
    for side in (line[: match.start()].split(b"\\")[0], line[match.end() :]):
        words = side.decode("ascii", "replace").strip(" \t\r\n,;[]\"'")
        epoch = re.search(r"(?<![\d.])(\d{10}(?:\.\d+)?|\d{13})$", words)
        if epoch:
            return _seconds(epoch.group(1))
        clock = re.search(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?", words)
        if clock:
            return clock.group()
    return None


def _seconds(digits: bytes | str) -> float:
    value = float(digits)
    return value / 1000 if value > 1e11 else value


def _parse_times(stamps: pd.Series) -> pd.Series:
    """`datetime64[ns]` of a column that mixes ISO text and seconds since 1970."""
    seconds = pd.to_numeric(stamps, errors="coerce")
    times = pd.to_datetime(seconds, unit="s", errors="coerce").astype("datetime64[ns]")
    text = seconds.isna() & stamps.notna()
    if text.any():
        words = pd.to_datetime(stamps[text].astype(str), format="ISO8601", utc=True, errors="coerce")
        times = times.where(~text, words.dt.tz_localize(None).astype("datetime64[ns]").reindex(times.index))
    return times
