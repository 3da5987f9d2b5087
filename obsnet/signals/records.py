"""miniSEED 2 files in, pieces of waveform out, each record at the time that its own header gives.

obspy joins records whose starts agree within half a sample of the record before, and forgets every start
but the first; the records of a drift-corrected ocean-bottom clock walk away from that by seconds over a
deployment. Only the records asked for are read, so that a file of a month costs the memory of a block.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import obspy
from obspy.io.mseed import InternalMSEEDWarning

from obsnet.console import patiently
from obsnet.errors import WaveformError
from obsnet.signals.timeline import JOIN_SAMPLES, Piece

_HEADER = re.compile(rb"[0-9 \x00]{6}[DRQM][ \x00]")
_CHUNK_BYTES = 4 << 20
_SECOND = 1_000_000_000
_TABLE = np.dtype(
    [("row", "i8"), ("channel", "S12"), ("start_ns", "i8"), ("count", "i4"), ("rate", "f8"), ("valid", "?")]
)


@dataclass(frozen=True, eq=False)
class ChannelRecords:
    """The records of one channel in one file, in order of time and without repeats.

    Attributes
    ----------
    seed_id : str
    table : structured ndarray
        Row in the file, start [ns since 1970], samples, rate [Hz].
    before : ndarray of int64
        Samples before each record; one longer than the table.
    repeats : int
        Records that repeat the time and the length of another one.
    """

    seed_id: str
    table: np.ndarray
    before: np.ndarray
    repeats: int


@dataclass(frozen=True, eq=False)
class RecordFile:
    """Record length [bytes], the channels, how many records (or a cut tail) are not readable, and records up to the end."""

    length: int
    channels: tuple[ChannelRecords, ...]
    broken: int
    rows: int


class RecordReader:
    """Reads pieces out of miniSEED files, keeping the tables of the last few.

    Parameters
    ----------
    note : callable, optional
        Is told of records that do not decode; their samples are NaN.
    files : int
        Tables to keep.
    """

    def __init__(self, note: Callable[[str], None] | None = None, files: int = 8) -> None:
        self._index = lru_cache(maxsize=files)(scan)
        self._note = note

    def pieces(self, path: Path) -> tuple[list[tuple[str, Piece]], RecordFile] | None:
        """Every unbroken stretch of every channel; None unless miniSEED with records of one length."""
        file = self._index(path)
        if file is None:
            return None
        made = []
        for number, channel in enumerate(file.channels):
            for first, last in stretches(channel.table):
                read = partial(self._read, path, number, first)
                made.append((channel.seed_id, piece_of(channel, first, last, read)))
        return made, file

    def _read(self, path: Path, number: int, record: int, first: int, last: int) -> np.ndarray:
        """Samples `first` to `last`, counted from the start of `record`."""
        file = self._index(path)
        if file is None or last <= first:
            return np.full(max(last - first, 0), np.nan, np.float32)
        channel = file.channels[number]
        origin = channel.before[record]
        low = int(np.searchsorted(channel.before, origin + first, "right")) - 1
        high = int(np.searchsorted(channel.before, origin + last, "left"))
        samples = self.decode(path, file.length, channel.table[low:high])
        skip = int(origin + first - channel.before[low])
        return samples[skip : skip + last - first]

    def decode(self, path: Path, length: int, table: np.ndarray) -> np.ndarray:
        """Samples of consecutive records; a record that does not decode gives NaN, the others are kept."""
        expected = int(table["count"].sum())
        try:
            raw = _gather(path, length, table["row"])
        except OSError as error:
            self._say(f"{path.name}: cannot be read any more ({error.strerror}); its samples are missing")
            return np.full(expected, np.nan, np.float32)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", InternalMSEEDWarning)
                with patiently():
                    parts = [trace.data for trace in obspy.read(io.BytesIO(raw), format="MSEED")]
            if sum(part.size for part in parts) == expected:
                return parts[0] if len(parts) == 1 else np.concatenate(parts)
        except (
            Exception
        ):  # obspy raises what its C library reports; the halves below find the record at fault
            pass
        if table.size == 1:
            self._say(f"{path.name}: some records do not decode; their samples are missing")
            return np.full(expected, np.nan, np.float32)
        middle = table.size // 2
        halves = (self.decode(path, length, half) for half in (table[:middle], table[middle:]))
        return np.concatenate(list(halves))

    def _say(self, text: str) -> None:
        if self._note is not None:
            self._note(text)


def scan(path: Path, skip: int = 0) -> RecordFile | None:
    """Index the records of a miniSEED file after the first `skip`; None unless miniSEED with records of one length.

    Raises
    ------
    WaveformError
        It would be miniSEED, but its first header is damaged.
    """
    with path.open("rb") as file:
        head = file.read(512)
        layout = _layout(head)
        if layout is None:
            if _HEADER.match(head) and not all(32 <= byte < 127 for byte in head[8:20]):
                raise WaveformError("miniSEED with a damaged header")
            return None
        length, order = layout
        file.seek(skip * length)
        parts, rows, tail = [], skip, 0
        while chunk := file.read(max(_CHUNK_BYTES // length, 1) * length):
            whole = len(chunk) // length
            parts.append(
                _parse(np.frombuffer(chunk, np.uint8, whole * length).reshape(whole, length), order, rows)
            )
            rows, tail = rows + whole, len(chunk) - whole * length
    table = np.concatenate(parts) if parts else np.empty(0, _TABLE)
    good = table[table["valid"]]
    if good.size < (rows - skip) / 2 or (good.size == 0 and skip == 0):
        return None
    channels = tuple(_channel(good[good["channel"] == code]) for code in np.unique(good["channel"]))
    return RecordFile(length, channels, rows - skip - good.size + (tail > 0), rows)


def _channel(table: np.ndarray) -> ChannelRecords:
    table = table[np.argsort(table["start_ns"], kind="stable")]
    same = np.zeros(table.size, bool)
    same[1:] = (np.diff(table["start_ns"]) == 0) & (np.diff(table["count"]) == 0)
    kept = table[~same]
    code = kept["channel"][0].decode("ascii", "replace").ljust(12)
    station, location, channel, network = (code[a:b].strip() for a, b in ((0, 5), (5, 7), (7, 10), (10, 12)))
    before = np.concatenate([[0], np.cumsum(kept["count"], dtype=np.int64)])
    return ChannelRecords(f"{network}.{station}.{location}.{channel}", kept, before, int(same.sum()))


def stretches(table: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of records that follow each other within half a sample, at one rate."""
    ends = table["start_ns"] + np.rint(table["count"] / table["rate"] * _SECOND).astype(np.int64)
    late = np.abs(table["start_ns"][1:] - ends[:-1]) / _SECOND * table["rate"][1:]
    breaks = np.flatnonzero((late > JOIN_SAMPLES) | (table["rate"][1:] != table["rate"][:-1])) + 1
    edges = [0, *breaks.tolist(), table.size]
    return list(pairwise(edges))


def piece_of(channel: ChannelRecords, first: int, last: int, read: partial[np.ndarray]) -> Piece:
    """A stretch with its clock: the header's rate, the rate its records keep, or the records' own times."""
    table = channel.table[first:last]
    index = (channel.before[first:last] - channel.before[first]).astype(float)
    start, rate, count = int(table["start_ns"][0]), float(table["rate"][0]), int(table["count"].sum())
    seconds = (table["start_ns"] - start) / _SECOND
    # a header states times to 0.1 ms: less than that is no drift
    tolerance = max(0.02 / rate, 1.5e-4)
    if np.max(np.abs(seconds - index / rate)) <= tolerance:
        return Piece(read, start, count, rate)
    kept = float(index[-1] / seconds[-1])
    if np.max(np.abs(seconds - index / kept)) <= tolerance:
        return Piece(read, start, count, kept)
    return Piece(read, start, count, rate, (index, seconds))


def _gather(path: Path, length: int, rows: np.ndarray) -> bytes:
    """Bytes of the given records, neighbours read at once."""
    cuts = np.flatnonzero(np.diff(rows) != 1) + 1
    with path.open("rb") as file:
        parts = []
        for group in np.split(rows, cuts):
            file.seek(int(group[0]) * length)
            parts.append(file.read(group.size * length))
    return b"".join(parts)


def _layout(head: bytes) -> tuple[int, str] | None:
    """Record length and byte order of the first record, from its year and its blockette 1000."""
    if len(head) < 64 or not _looks_like_data(np.frombuffer(head[:64], np.uint8)[None])[0]:
        return None
    order = ">" if 1900 <= int.from_bytes(head[20:22], "big") <= 2200 else "<"
    word: Literal["big", "little"] = "big" if order == ">" else "little"
    position = int.from_bytes(head[46:48], word)
    while 48 <= position <= len(head) - 8:
        if int.from_bytes(head[position : position + 2], word) == 1000:
            exponent = head[position + 6]
            return (1 << exponent, order) if 7 <= exponent <= 20 else None
        following = int.from_bytes(head[position + 2 : position + 4], word)
        position = following if following > position else 0
    return None


def _looks_like_data(raw: np.ndarray) -> np.ndarray:
    number, codes = raw[:, :6], raw[:, 8:20]
    digits = ((number >= 48) & (number <= 57)) | (number == 32) | (number == 0)
    printable = (codes >= 32) & (codes < 127)
    kind = np.isin(raw[:, 6], list(b"DRQM")) & np.isin(raw[:, 7], (32, 0))
    return digits.all(axis=1) & printable.all(axis=1) & kind


def _parse(raw: np.ndarray, order: str, base: int) -> np.ndarray:
    """Table of the headers and blockettes 100, 1000, 1001 of records, one a row (SEED 2.4, ch. 8)."""
    table = np.zeros(len(raw), _TABLE)
    rows = np.arange(len(raw))

    def number(at: int | np.ndarray, kind: str) -> np.ndarray:
        width = np.dtype(kind).itemsize
        field = (
            raw[:, at : at + width]
            if isinstance(at, int)
            else raw[rows[:, None], at[:, None] + np.arange(width)]
        )
        values = np.ascontiguousarray(field).view(order + kind)[:, 0]
        return values if kind == "f4" else values.astype(np.int64)

    year, day = number(20, "u2"), number(22, "u2")
    clock = number(24, "u1") * 3600 + number(25, "u1") * 60 + number(26, "u1")
    plausible = (year >= 1900) & (year <= 2200) & (day >= 1) & (day <= 366) & (clock <= 86400)
    days = (np.where(plausible, year, 1970) - 1970).astype("datetime64[Y]").astype("datetime64[D]")
    start = ((days.astype(np.int64) + day - 1) * 86400 + clock) * _SECOND + number(28, "u2") * 100_000
    uncorrected = (number(36, "u1") & 2) == 0
    start += np.where(uncorrected, number(40, "i4"), 0) * 100_000
    factor, multiplier = number(32, "i2"), number(34, "i2")
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.where(factor > 0, factor, -1 / factor) * np.where(
            multiplier > 0, multiplier, -1 / multiplier
        )
    textual = np.zeros(len(raw), bool)
    position = number(46, "u2")
    for _ in range(8):
        inside = (position >= 48) & (position <= raw.shape[1] - 8)
        if not inside.any():
            break
        at = np.where(inside, position, 0)
        kind = np.where(inside, number(at, "u2"), 0)
        rate = np.where(kind == 100, number(at + 4, "f4"), rate)
        start += np.where(kind == 1001, number(at + 5, "i1"), 0) * 1000
        textual |= (kind == 1000) & (
            (number(at + 4, "u1") == 0) | (1 << (number(at + 6, "u1") % 31) != raw.shape[1])
        )
        following = number(at + 2, "u2")
        position = np.where(inside & (following > position), following, 0)
    table["row"], table["start_ns"], table["count"] = base + rows, start, number(30, "u2")
    table["rate"] = np.where(np.isfinite(rate) & (rate > 0), rate, 0)
    table["channel"] = np.ascontiguousarray(raw[:, 8:20]).view("S12")[:, 0]
    table["valid"] = _looks_like_data(raw) & plausible & ~textual & (table["count"] > 0) & (table["rate"] > 0)
    return table
