"""AIS files of seven dialects in, one table of ship positions out.

The dialect is recognised from the content, never from the name; so is compression (zstandard, gzip, bzip2,
xz, zip). What a row cannot give is NaN, a row that gives no position of a ship is dropped, and every drop is
counted by its reason.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from obsnet.ais import nmea
from obsnet.ais.compression import explained, streams
from obsnet.ais.dialects import KNOT, NMEA, clean, keys_of, recognise
from obsnet.ais.quality import distance_m, drop_jumps
from obsnet.errors import AISError, OutputError

CHUNK_ROWS = 500_000
Block = tuple[str, int, pd.DataFrame]
Disc = tuple[float, float, float]
COLUMNS = ["mmsi", "time", "lon", "lat", "sog_mps", "cog_deg", "heading_deg"]
STATIC = ["ship_type", "length_m", "width_m", "to_stern_m", "name"]


@dataclass(frozen=True)
class ReadReport:
    """What `read` found: the dialects, the rows, those kept, and those dropped by reason."""

    dialects: tuple[str, ...]
    rows: int
    kept: int
    dropped: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        """One line.

        >>> print(ReadReport(("plain",), 10, 8, {"no position": 2}))
        plain: 8 of 10 rows kept; dropped: 2 no position
        """
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())
        return f"{', '.join(self.dialects)}: {self.kept} of {self.rows} rows kept" + (
            reasons and f"; dropped: {reasons}"
        )

    def complaint(self) -> list[str]:
        """One line if a row was dropped for another reason than its distance, else none."""
        return [f"AIS file read as {self}"] if self.dropped.keys() - {"too far away"} else []


def read(
    path: str | Path | Sequence[str | Path],
    *,
    near: tuple[float, float] | None = None,
    within_m: float = 500e3,
) -> pd.DataFrame:
    """Read AIS positions from a file, or from several (days, say), whatever their dialects.

    Parameters
    ----------
    path : path or sequence of paths
        CSV files or NMEA logs, compressed or not.
    near : (latitude, longitude), optional
        Keep only positions within `within_m` [m] of this point: a national archive then fits into memory.

    Returns
    -------
    DataFrame
        ``mmsi`` (int64), ``time`` (datetime64[ns], UTC), ``lon`` (from -180 to 180), ``lat`` [deg], ``sog_mps`` [m/s],
        ``cog_deg``, ``heading_deg`` [deg from North], and where the file gives them ``ship_type``,
        ``length_m``, ``width_m``, ``to_stern_m`` (antenna to stern) and ``name``; sorted by ship and time,
        without duplicates and without positions that imply more than 60 knots. ``attrs["report"]`` is a
        `ReadReport`.

    Raises
    ------
    AISError
        The file cannot be read, is of no known dialect, or holds no usable position.
    """
    paths = [Path(path)] if isinstance(path, (str, Path)) else [Path(item) for item in path]
    if not paths:
        raise AISError("no AIS file was given")
    dropped: Counter[str] = Counter()
    dialects: list[str] = []
    tables: list[pd.DataFrame] = []
    rows = 0
    disc = None if near is None else (*near, within_m)
    for item in paths:
        for dialect, raw_rows, table in _tables(item, disc, dropped):
            if dialect not in dialects:
                dialects.append(dialect)
            rows += raw_rows
            tables.append(table)
    ais = _assemble(tables, dropped)
    report = ReadReport(tuple(dialects), rows, len(ais), {reason: n for reason, n in dropped.items() if n})
    if ais.empty:
        where = paths[0] if len(paths) == 1 else f"{len(paths)} files from {paths[0]}"
        detail = f"it was read as {report}" if rows else "it has a header and no rows"
        raise AISError(f"no usable ship position in {where}: {detail}")
    ais.attrs["report"] = report
    return ais


def write_plain(ais: pd.DataFrame, path: str | Path) -> None:
    """Write positions in the plain dialect (mmsi, time, lon, lat, sog [knots], cog …), atomically."""
    table = pd.DataFrame({"mmsi": ais["mmsi"]})
    stamps = pd.DatetimeIndex(ais["time"])
    table["time"] = np.char.add(np.datetime_as_string(stamps.to_numpy("datetime64[ms]")), "Z")
    table["lon"], table["lat"] = ais["lon"].round(7), ais["lat"].round(7)
    if "sog_mps" in ais:
        table["sog"] = (ais["sog_mps"] / KNOT).round(3)
    for ours, theirs in (("cog_deg", "cog"), ("heading_deg", "heading"), *((name, name) for name in STATIC)):
        if ours in ais and ais[ours].notna().any():
            table[theirs] = ais[ours]
    path = Path(path)
    partial = path.with_name(path.name + ".tmp")
    try:
        table.to_csv(partial, index=False)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"cannot write the AIS file {path}: {error.strerror or error}") from None


def _assemble(tables: list[pd.DataFrame], dropped: Counter[str]) -> pd.DataFrame:
    tables = [table for table in tables if len(table)]
    if not tables:
        return pd.DataFrame(columns=COLUMNS)
    ais = pd.concat(tables, ignore_index=True)
    ais = ais.sort_values(["mmsi", "time"], kind="stable")
    repeated = ais.duplicated(["mmsi", "time"]).to_numpy()
    dropped["repeated"] += int(repeated.sum())
    ais = ais[~repeated].reset_index(drop=True)
    plausible = drop_jumps(ais)
    dropped["impossible jump"] += int((~plausible).sum())
    ais = ais[plausible].reset_index(drop=True)
    static = [name for name in STATIC if name in ais and ais[name].notna().any()]
    return ais[COLUMNS + static]


def _tables(path: Path, disc: Disc | None, dropped: Counter[str]) -> list[Block]:
    """Dialect, raw rows and cleaned table of each block of a file; drops are counted into `dropped`.

    A quotation mark that is never closed would swallow the rest of a table: such a file is read again without
    quoting.
    """
    for quoting in (csv.QUOTE_MINIMAL, csv.QUOTE_NONE):
        counts: Counter[str] = Counter()
        try:
            with explained(path):
                tables = [_within(block, disc, counts) for block in _blocks(path, quoting, counts)]
        except pd.errors.ParserError as error:
            reason = " ".join(str(error).split())
            continue
        dropped.update(counts)
        return tables
    raise AISError(f"{path} cannot be read as a table: {reason}")


def _within(block: Block, disc: Disc | None, dropped: Counter[str]) -> Block:
    """The block's positions inside a disc (latitude, longitude, radius in m); the others are counted."""
    dialect, rows, table = block
    if disc is None:
        return block
    inside = (
        distance_m(disc[0], disc[1], table["lat"].to_numpy(float), table["lon"].to_numpy(float)) <= disc[2]
    )
    dropped["too far away"] += int((~inside).sum())
    return dialect, rows, table[inside]


def _blocks(path: Path, quoting: int, dropped: Counter[str]) -> Iterator[Block]:
    for name, stream in streams(path):
        if re.search(rb"![A-Z]{2}VD[MO],", _peek(stream)):
            raw, counts = nmea.decode(stream, name)
            dropped.update(counts)
            yield "NMEA", len(raw) + sum(counts.values()), clean(raw, NMEA, dropped)
        else:
            yield from _csv_blocks(stream, name, quoting, dropped)


def _csv_blocks(stream: IO[bytes], name: str, quoting: int, dropped: Counter[str]) -> Iterator[Block]:
    encoding = "utf-16" if _peek(stream)[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = io.TextIOWrapper(stream, encoding=encoding, errors="replace", newline="")
    header, separator = _header(text, name)
    dialect, sources = recognise(header, name)
    label = "MarineCadastre 2024+" if "base_date_time" in header else dialect.name
    texts = [*dialect.time, *(sources[ours] for ours in ("ship_type", "name", "mobile") if ours in sources)]
    options: dict[str, Any] = {
        "names": keys_of(header),
        "header": None,
        "index_col": False,
        "usecols": [*dialect.time, *sources.values()],
        "sep": separator,
        "decimal": "." if separator == "," else ",",
        "dtype": dict.fromkeys(texts, str),
        "quoting": quoting,
        "low_memory": False,
        "chunksize": CHUNK_ROWS,
    }
    try:
        with pd.read_csv(text, **options) as chunks:
            for chunk in chunks:
                raw = pd.DataFrame({ours: chunk[key] for ours, key in sources.items()})
                first, *rest = (chunk[key] for key in dialect.time)
                raw["time"] = first.str.cat(rest, sep=" ") if rest else first
                yield label, len(raw), clean(raw, dialect, dropped)
    except pd.errors.EmptyDataError:
        yield label, 0, pd.DataFrame(columns=COLUMNS)


def _header(text: IO[str], name: str) -> tuple[list[str], str]:
    """The first line that names columns (comments before it are skipped), and its separator."""
    while line := text.readline(1 << 16):
        stripped = line.strip()
        if not stripped or (stripped.startswith("#") and "timestamp" not in stripped.lower()):
            continue
        separator = max(",;\t|", key=stripped.count)
        return [column.strip().strip("\"'").strip() for column in stripped.split(separator)], separator
    raise AISError(f"the AIS file {name} is empty")


def _peek(stream: IO[bytes]) -> bytes:
    return stream.peek(1 << 15)  # type: ignore[attr-defined, no-any-return]
