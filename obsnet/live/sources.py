"""Where packets come from: a folder that something fills, standard input, or a SeedLink server (`seedlink`).

A source yields lists of packets, an empty one now and then so that the station can look around, and ends when nothing
more can come. Its `position` says where to go on, and is stored with the packets.
"""

from __future__ import annotations

import itertools
import os
import queue
import re
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from obsnet.errors import ConfigError, WaveformError
from obsnet.live.config import LiveConfig, address
from obsnet.live.packets import Packet, RecordStream
from obsnet.signals.files import FileReader, list_files
from obsnet.signals.records import ChannelRecords, RecordReader, scan
from obsnet.signals.station import Station

_SDS_DAY = re.compile(r"\.(\d{4})\.(\d{3})$")
_TICK_S = 0.5
_BIN_NS = 600_000_000_000
_PIECE_S = 60.0


class Source(Protocol):
    """Anything that packets come from.

    Attributes
    ----------
    name : for people.
    position : plain values to store with the packets yielded so far.
    counts : what happened, by name.
    trouble : why nothing comes; empty while something does.
    """

    name: str
    position: dict[str, Any]
    counts: dict[str, int]
    trouble: str

    def batches(self) -> Iterator[list[Packet]]:
        """Packets as they come."""
        ...

    def close(self) -> None:
        """End `batches`, from any thread."""
        ...


def open_source(
    text: str, station: Station, live: LiveConfig, position: dict[str, Any], after_ns: int | None, once: bool
) -> Source:
    """The source that an address names.

    Parameters
    ----------
    text : seedlink://HOST:PORT/NET.STA, a folder, or - for standard input.
    position : what the source's position was when the station stopped.
    after_ns : samples before this are not needed.
    once : whether to end when there is nothing more.

    Raises
    ------
    ConfigError : none of these.
    """
    if text == "-":
        return StandardInput()
    if text.startswith("seedlink:"):
        from obsnet.live.seedlink import SeedLinkServer

        _, host, port = address(text, ("seedlink",), "SOURCE")
        return SeedLinkServer(host, port, station_of(text, station), live, position)
    if not Path(text).is_dir():
        raise ConfigError(
            f"no folder {text}; SOURCE is seedlink://HOST:PORT/NET.STA, a folder, or - for standard input"
        )
    return Folder(Path(text), station, live, after_ns, once)


def station_of(text: str, station: Station) -> str:
    """NET.STA of a SeedLink address; it must be the StationXML's."""
    code = text.partition("://")[2].partition("/")[2].strip("/") or station.code
    if code != station.code:
        raise ConfigError(f"SOURCE names {code}, the StationXML describes {station.code}; make them agree")
    return code


class Folder:
    """Files, or an SDS archive, that something else fills: what is there in order of time, then what is added.

    miniSEED is read record by record as it grows; files in other formats are read once they stop growing.
    """

    def __init__(
        self, folder: Path, station: Station, live: LiveConfig, after_ns: int | None, once: bool
    ) -> None:
        self.name, self.trouble = str(folder), ""
        self.position: dict[str, Any] = {}
        self.counts = {"files": 0, "unreadable": 0}
        self._folder, self._station, self._live, self._after, self._once = (
            folder,
            station,
            live,
            after_ns,
            once,
        )
        self._rows: dict[Path, int] = {}
        self._sizes: dict[Path, int] = {}
        self._last: dict[tuple[Path, str], tuple[int, int]] = {}
        self._records, self._files = RecordReader(files=2), FileReader(files=2)
        self._stop = threading.Event()

    def batches(self) -> Iterator[list[Packet]]:
        """Packets in order of time, a folder's day by day."""
        while not self._stop.is_set():
            for day in self._days():
                for batch in self._merged([part for path in day for part in self._fresh(path)]):
                    if self._stop.is_set():
                        return
                    yield batch
            if self._once:
                return
            yield []
            self._wait()

    def close(self) -> None:
        """End `batches`."""
        self._stop.set()

    def _wait(self) -> None:
        self._stop.wait(self._live.poll_s)

    def _days(self) -> list[list[Path]]:
        """Files that have grown, those of one day of an SDS archive together."""
        try:
            paths = list(list_files([self._folder], self._station, self._after, None))
            sizes = {path: path.stat().st_size for path in paths}
        except (OSError, WaveformError) as error:
            self.trouble = str(error)
            return []
        self.trouble = "" if paths else f"no files in {self._folder}"
        days: dict[str, list[Path]] = {}
        for path in paths:
            if self._once or sizes[path] != self._sizes.get(path) or path not in self._rows:
                match = _SDS_DAY.search(path.name)
                days.setdefault("".join(match.groups()) if match else "", []).append(path)
        self._sizes = sizes
        self._rows = {path: rows for path, rows in self._rows.items() if path in sizes}
        self._last = {key: last for key, last in self._last.items() if key[0] in sizes}
        return [days[key] for key in sorted(days)]

    def _fresh(self, path: Path) -> Iterable[tuple[Path, int, ChannelRecords] | tuple[str, Any]]:
        """What a file holds beyond what was read of it: tables of records, or pieces."""
        before = self._rows.get(path, 0)
        try:
            # the last record read may have been a short one that has grown since
            file = scan(path, max(before - 1, 0)) if self._sizes.get(path) else None
            if file is not None:
                self.counts["files"] += before == 0
                self._rows[path] = file.rows
                return [(path, file.length, self._wanted(path, channel)) for channel in file.channels]
            if before == 0 and self._sizes.get(path) and self._settled(path):
                found = list(self._files.pieces(path))
                self.counts["files"] += 1
                self._rows[path] = -1
                return found
        except (OSError, WaveformError):
            self.counts["unreadable"] += path not in self._rows
            self._rows.setdefault(path, 0)
        return []

    def _settled(self, path: Path) -> bool:
        return self._once or time.time() - path.stat().st_mtime > 2 * self._live.poll_s

    def _wanted(self, path: Path, channel: ChannelRecords) -> ChannelRecords:
        """The records that end after what the station has done with, but for the one read last time."""
        table = channel.table
        chosen = np.ones(len(table), bool)
        if self._after is not None:
            chosen = _ends(table) > self._after
        again = self._last.get((path, channel.seed_id))
        if again is not None:
            chosen &= (table["start_ns"] != again[0]) | (table["count"] != again[1])
        self._last[path, channel.seed_id] = (int(table["start_ns"][-1]), int(table["count"][-1]))
        kept = table[chosen]
        before = np.concatenate([[0], np.cumsum(kept["count"], dtype=np.int64)])
        return ChannelRecords(channel.seed_id, kept, before, channel.repeats)

    def _merged(self, parts: list[Any]) -> Iterator[list[Packet]]:
        """Packets of several channels and files, ten minutes of all of them at a time."""
        order: list[tuple[int, int, int, int]] = []
        for number, part in enumerate(parts):
            if len(part) == 3:
                bins = part[2].table["start_ns"] // _BIN_NS
                edges = [0, *(np.flatnonzero(np.diff(bins)) + 1).tolist(), len(bins)]
                order += [(int(bins[a]), number, a, b) for a, b in pairwise(edges) if b > a]
            else:
                piece, step = part[1], max(int(_PIECE_S * part[1].rate), 1)
                for a in range(0, piece.count, step):
                    order.append((piece.time_ns(a) // _BIN_NS, number, a, min(a + step, piece.count)))
        for _, group in itertools.groupby(sorted(order), key=lambda entry: entry[0]):
            yield [packet for _, number, a, b in group for packet in self._read(parts[number], a, b)]

    def _read(self, part: Any, first: int, last: int) -> list[Packet]:
        if len(part) == 3:
            path, length, channel = part
            table = channel.table[first:last]
            samples = self._records.decode(path, length, table)
            cuts = np.cumsum(table["count"])[:-1]
            rows = zip(
                table["start_ns"].tolist(), table["rate"].tolist(), np.split(samples, cuts), strict=True
            )
            return [Packet(channel.seed_id, start, rate, own) for start, rate, own in rows]
        seed_id, piece = part
        return [Packet(seed_id, piece.time_ns(first), piece.rate, np.asarray(piece.read(first, last)))]


def _ends(table: np.ndarray) -> np.ndarray:
    return table["start_ns"] + np.rint(table["count"] / table["rate"] * 1e9).astype(np.int64)


class Queued(ABC):
    """A source whose packets a thread of its own puts into a bounded queue: a slow station makes the sender wait."""

    def __init__(self, name: str) -> None:
        self.name, self.trouble = name, ""
        self.position: dict[str, Any] = {}
        self.counts: dict[str, int] = {}
        self._queue: queue.Queue[tuple[Packet, dict[str, Any]] | None] = queue.Queue(maxsize=2000)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def batches(self) -> Iterator[list[Packet]]:
        """Packets as they come."""
        self._thread.start()
        while not self._stop.is_set():
            batch: list[Packet] = []
            ended = False
            try:
                item = self._queue.get(timeout=_TICK_S)
                while item is not None and len(batch) < 256:
                    packet, self.position = item
                    batch.append(packet)
                    item = self._queue.get_nowait()
                ended = item is None
                if item is not None:
                    packet, self.position = item
                    batch.append(packet)
            except queue.Empty:
                pass
            yield batch
            if ended:
                return

    def close(self) -> None:
        """End `batches`."""
        self._stop.set()

    def _put(self, item: tuple[Packet, dict[str, Any]] | None) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(item, timeout=_TICK_S)
                return
            except queue.Full:
                continue

    @abstractmethod
    def _run(self) -> None:
        """Put packets until there are no more or `close` is called; runs in the source's own thread."""


class StandardInput(Queued):
    """miniSEED records on standard input, or on any file descriptor; ends with it."""

    def __init__(self, descriptor: int | None = None) -> None:
        super().__init__("standard input")
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor

    def _run(self) -> None:
        stream = RecordStream()
        while not self._stop.is_set():
            try:
                data = os.read(self._descriptor, 1 << 16)
            except OSError as error:
                self.trouble = str(error.strerror)
                break
            if not data:
                break
            for packet in stream.push(data):
                self._put((packet, {}))
            self.counts["garbage"] = stream.garbage
        self._put(None)
