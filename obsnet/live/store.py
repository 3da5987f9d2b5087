"""Everything that a station must not lose, in one SQLite file (WAL): what it said, and what it needs to go on.

A transaction holds what belongs together: packets with the server's sequence numbers, rows with the frames they stand
for. Tables `detections` and `tracks` have the columns of the CSV files, `live` is the current estimate minute by minute;
the others are the station's own.
"""

from __future__ import annotations

import io
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from obsnet.errors import OutputError
from obsnet.live.packets import Packet
from obsnet.output import prepare_folder
from obsnet.tables import DETECTION_COLUMNS, TRACK_COLUMNS

LIVE_COLUMNS = [
    "time", "existence", "azimuth_deg", "azimuth_std_deg", "range_m", "range_std_m", "course_deg", "speed_mps",
    "longitude", "latitude",
]  # fmt: skip
_PRESENCE = ("azimuth", "range", "approaching", "leaving")
_TEXT = ("time", "start", "end", "cpa_time")


def _columns(names: Iterable[str], key: str) -> str:
    kinds = {key: "PRIMARY KEY", "track": "INTEGER"} if key == "track" else {key: "PRIMARY KEY"}
    made = []
    for name in names:
        kind = "INTEGER" if name == "track" else "TEXT" if name in _TEXT else "REAL"
        made.append(f'"{name}" {kind}' + (" PRIMARY KEY" if name in kinds and name == key else ""))
    return ", ".join(made)


_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS detections ({_columns(DETECTION_COLUMNS, "time")});
CREATE TABLE IF NOT EXISTS tracks ({_columns(TRACK_COLUMNS, "track")});
CREATE TABLE IF NOT EXISTS live ({_columns(LIVE_COLUMNS, "time")});
CREATE TABLE IF NOT EXISTS strips (time TEXT PRIMARY KEY, azimuth BLOB, range BLOB, spectrum BLOB);
CREATE TABLE IF NOT EXISTS courses (track INTEGER PRIMARY KEY, said TEXT);
CREATE TABLE IF NOT EXISTS presence (seconds REAL PRIMARY KEY, azimuth REAL, range REAL, approaching REAL, leaving REAL);
CREATE TABLE IF NOT EXISTS tiles (seconds REAL PRIMARY KEY, arrays BLOB);
CREATE TABLE IF NOT EXISTS packets (
    number INTEGER PRIMARY KEY, seed_id TEXT, start_ns INTEGER, end_ns INTEGER, rate REAL, dtype TEXT, samples BLOB);
CREATE TABLE IF NOT EXISTS state (name TEXT PRIMARY KEY, value BLOB);
"""


class Store:
    """The station's database.

    Parameters
    ----------
    folder : output folder; the file is `obsnet.sqlite` within it.

    Raises
    ------
    OutputError : the folder cannot be written, the file is damaged, or another station writes to it.
    """

    def __init__(self, folder: Path) -> None:
        self.path = prepare_folder(folder) / "obsnet.sqlite"
        self._written: dict[str, np.ndarray] = {}
        try:
            # one writer at a time: the lock is held as long as the station runs
            self._lock = _locked(self.path.with_name(".obsnet.lock"))
            self._db = sqlite3.connect(self.path, isolation_level=None, timeout=5.0)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.execute("PRAGMA journal_size_limit=16000000")
            self._db.executescript(_SCHEMA)
        except sqlite3.Error as error:
            raise OutputError(
                f"cannot use {self.path}: {error}; make room, or move a damaged file away"
            ) from None

    def close(self) -> None:
        """Close the file; nothing is lost without it."""
        self._db.close()
        self._lock.close()

    @contextmanager
    def transaction(self) -> Iterator[Store]:
        """All that is written within appears together, or `OutputError` and nothing of it."""
        written = dict(self._written)
        try:
            self._db.execute("BEGIN IMMEDIATE")
            yield self
            self._db.execute("COMMIT")
        except BaseException as error:
            self._written = written
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                raise OutputError(f"cannot write {self.path}: {error}; make room for it") from None
            raise

    def put(self, table: str, columns: Iterable[str], rows: Iterable[tuple]) -> None:
        """Insert rows, over those with the same key."""
        names = list(columns)
        marks = ", ".join("?" * len(names))
        quoted = ", ".join(f'"{name}"' for name in names)
        self._db.executemany(f"INSERT OR REPLACE INTO {table} ({quoted}) VALUES ({marks})", rows)

    def put_packet(self, packet: Packet) -> None:
        """Keep a packet until `forget_packets`."""
        samples = np.ascontiguousarray(packet.samples)
        row = (
            packet.seed_id,
            packet.start_ns,
            packet.end_ns,
            packet.rate,
            samples.dtype.str,
            samples.tobytes(),
        )
        self._db.execute(
            "INSERT INTO packets (seed_id, start_ns, end_ns, rate, dtype, samples) VALUES (?, ?, ?, ?, ?, ?)",
            row,
        )

    def packets(self) -> Iterator[Packet]:
        """The packets kept, in the order in which they came."""
        rows = self.rows("SELECT seed_id, start_ns, rate, dtype, samples FROM packets ORDER BY number")
        for seed_id, start_ns, rate, dtype, samples in rows:
            yield Packet(seed_id, start_ns, rate, np.frombuffer(samples, np.dtype(dtype)))

    def forget_packets(self, before_ns: int) -> None:
        """Drop the packets that end before a time."""
        self._db.execute("DELETE FROM packets WHERE end_ns < ?", (before_ns,))

    def put_arrays(self, room: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep arrays under names, in place of those kept there before; the same objects are not written again."""
        prefix = f"{room}/"
        for name in [
            n for n in self._written if n.startswith(prefix) and n.removeprefix(prefix) not in arrays
        ]:
            self._db.execute("DELETE FROM state WHERE name = ?", (name,))
            del self._written[name]
        changed = {
            prefix + name: value
            for name, value in arrays.items()
            if self._written.get(prefix + name) is not value
        }
        self.put("state", ("name", "value"), ((name, to_bytes(value)) for name, value in changed.items()))
        self._written |= changed

    def arrays(self, room: str) -> dict[str, np.ndarray]:
        """The arrays kept by `put_arrays`."""
        prefix = f"{room}/"
        rows = self.rows("SELECT name, value FROM state WHERE substr(name, 1, ?) = ?", (len(prefix), prefix))
        found = {name: from_bytes(value) for name, value in rows}
        self._written |= found
        return {name.removeprefix(prefix): value for name, value in found.items()}

    def forget_arrays(self, room: str) -> None:
        """Drop what `put_arrays` kept."""
        prefix = f"{room}/"
        self._db.execute("DELETE FROM state WHERE substr(name, 1, ?) = ?", (len(prefix), prefix))
        self._written = {name: value for name, value in self._written.items() if not name.startswith(prefix)}

    def note(self, name: str, value: Any) -> None:
        """Keep a plain value."""
        self.put("state", ("name", "value"), [(name, json.dumps(value))])

    def noted(self, name: str, default: Any = None) -> Any:
        """A value kept by `note`."""
        held = self.rows("SELECT value FROM state WHERE name = ?", (name,))
        return json.loads(held[0][0]) if held else default

    def rows(self, query: str, parameters: tuple = ()) -> list[tuple]:
        """Answer of a query; `OutputError` where the file is damaged."""
        try:
            return self._db.execute(query, parameters).fetchall()
        except sqlite3.Error as error:
            raise OutputError(f"cannot read {self.path}: {error}; move a damaged file away") from None

    def execute(self, statement: str, parameters: tuple = ()) -> None:
        """Run a statement within a transaction."""
        self._db.execute(statement, parameters)

    def table(
        self, name: str, columns: Iterable[str], where: str = "", parameters: tuple = ()
    ) -> pd.DataFrame:
        """A table's rows in order of its first column."""
        names = list(columns)
        quoted = ", ".join(f'"{column}"' for column in names)
        rows = self.rows(f'SELECT {quoted} FROM {name} {where} ORDER BY "{names[0]}"', parameters)
        return pd.DataFrame(rows, columns=names)

    def put_presence(self, presence: pd.DataFrame) -> None:
        """Keep presence ratios by minute."""
        table = presence.reindex(columns=list(_PRESENCE))
        rows = (
            (float(t), *_plain(values)) for t, values in zip(table.index, table.to_numpy(float), strict=True)
        )
        self.put("presence", ("seconds", *_PRESENCE), rows)

    def put_strips(
        self, times: list[str], columns: Mapping[str, np.ndarray], axes: Mapping[str, Any]
    ) -> None:
        """Keep columns of the maps (`obsnet.strips`) by minute."""
        names = list(columns)
        rows = zip(times, *([row.tobytes() for row in columns[name]] for name in names), strict=True)
        self.put("strips", ("time", *names), rows)
        self.note("strips", axes)

    def presence(self) -> pd.DataFrame:
        """Presence ratios kept, indexed by s since 1970; columns without any value are left out."""
        table = self.table("presence", ("seconds", *_PRESENCE)).astype(float)
        return table.set_index("seconds").dropna(axis=1, how="all")


def _plain(values: Iterable[Any]) -> Iterator[Any]:
    """Values as SQLite takes them: empty where not finite."""
    for value in values:
        if isinstance(value, str | int) or value is None:
            yield value
        else:
            yield float(value) if np.isfinite(value) else None


def plain_rows(table: pd.DataFrame, columns: Iterable[str]) -> list[tuple]:
    """Rows of a table as SQLite takes them."""
    return [tuple(_plain(row)) for row in table[list(columns)].itertuples(index=False, name=None)]


def to_bytes(array: np.ndarray) -> bytes:
    """An array in numpy's own format, without pickles."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return file.getvalue()


def from_bytes(data: bytes) -> np.ndarray:
    """An array of `to_bytes`."""
    return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


def _locked(path: Path) -> Any:
    """An open file that no other process has locked."""
    import fcntl

    file = path.open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise OutputError(f"another obsnet watch writes into {path.parent}; give another folder") from None
    return file
