"""A folder of ``obsnet track`` or of ``obsnet watch`` in; out, what the page asks for, as plain values.

Nothing is written. A live folder's database is opened read-only for every answer, so that a station never waits for a page.
"""

from __future__ import annotations

import base64
import json
import math
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from obsnet.ais import ReferenceTrack
from obsnet.detectors.maps import MARGINAL
from obsnet.errors import LayoutError
from obsnet.layout import iso, parse_utc, to_posix
from obsnet.run import Run, read_run
from obsnet.serve.geometry import circle, ship_shape, track_shape
from obsnet.strips import Axis, columns, plain
from obsnet.tables import DETECTION_COLUMNS, TRACK_COLUMNS, track_of_row
from obsnet.trackers.track import Track

DATABASE = "obsnet.sqlite"
MOST_COLUMNS = 1440
TRAIL_S, TRAIL_GAP_S, TRAIL_LEAP_KM = 10800.0, 300.0, 5.0
"""What of the live estimates is drawn as one ship's way."""
HEALTH = {
    "source": "source", "detector": "detector", "last_packet": "last packet", "data_latency_s": "data latency",
    "minute_delay_s": "a minute's delay", "coverage_last_hour": "coverage, last hour", "peak_memory_mb": "peak memory [MB]",
}  # fmt: skip
"""What of status.json is shown, and its name."""
STRIPS = ("azimuth", "range", "spectrum")


def open_folder(path: str | Path, ships: list[ReferenceTrack] | None = None) -> RunFolder | LiveFolder:
    """The folder of a finished run or of a live station.

    Raises
    ------
    LayoutError : it is neither.
    """
    path = Path(path)
    if (path / DATABASE).is_file():
        return LiveFolder(path, ships or [])
    if (path / "run.json").is_file():
        return RunFolder(path, ships or [])
    found = "is not there" if not path.is_dir() else f"holds neither run.json nor {DATABASE}"
    raise LayoutError(f"{path} {found}; give a folder of obsnet track or of obsnet watch")


class _Folder:
    """What both kinds have in common."""

    kind = ""

    def __init__(self, path: Path, ships: list[ReferenceTrack]) -> None:
        self.path, self.ships = path.resolve(), ships

    def reference(self, start: float, end: float) -> list[dict[str, Any]]:
        """AIS tracks within a span."""
        shapes = (ship_shape(ship, start, end) for ship in self.ships)
        return [shape for shape in shapes if shape is not None]


class RunFolder(_Folder):
    """A finished run, read once."""

    kind = "run"

    def __init__(self, path: Path, ships: list[ReferenceTrack]) -> None:
        super().__init__(path, ships)
        self._run: Run = read_run(self.path)
        self._seconds = to_posix(self._run.detections["time"].to_numpy())
        self.strips = lru_cache(maxsize=4)(self._read_strips)

    def stamp(self) -> str:
        """Changes when there is something new to show: never."""
        return "finished"

    def about(self) -> dict[str, Any]:
        """Station, span of time and health."""
        info = self._run.info
        span = [float(self._seconds[0]), float(self._seconds[-1])] if len(self._seconds) else [0.0, 60.0]
        channels = info.get("waveforms", {}).get("channels", {})
        health = {
            "record": f"{info['start']} to {info['end']}",
            "detector": info.get("config", {}).get("detector", ""),
            "minutes with data": int((self._run.detections["coverage"] > 0).sum()),
            "notes": "; ".join([*info.get("notes", []), *info.get("waveforms", {}).get("notes", [])][:10]),
        }
        for seed_id, channel in channels.items():
            health[seed_id] = (
                f"{channel['gaps']} gaps ({channel['gap_s']:g} s), {channel['clipped_frames']} clipped frames"
            )
        return {
            "kind": self.kind,
            "station": info["station"],
            "span": span,
            "healthy": True,
            "trouble": "",
            "health": {key: value for key, value in health.items() if value not in ("", None)},
            "obsnet": info.get("obsnet", ""),
        }

    def tracks(self) -> list[dict[str, Any]]:
        """All tracks."""
        return [_track(track.row(number), track) for number, track in enumerate(self._run.tracks, 1)]

    def detections(self, start: float, end: float) -> dict[str, list]:
        """Minutes within a span, column by column."""
        inside = (self._seconds >= start) & (self._seconds <= end)
        return _columns(self._run.detections[inside].assign(time=self._seconds[inside]))

    def live(self, start: float, end: float) -> dict[str, Any] | None:
        """A finished run has no ship that is heard now."""
        return None

    def _read_strips(self, start: float, end: float, most: int) -> dict[str, Any]:
        """Azimuth and range maps and the spectrum within a span."""
        chosen = _thinned(np.flatnonzero((self._seconds >= start) & (self._seconds <= end)), most)
        if not len(chosen):
            return {"time": [], "strips": {}}
        parts: list[dict[str, np.ndarray]] = []
        axes: dict[str, Axis] = {}
        features = self._run.features
        features = features[[name for name in ("power", MARGINAL) if name in features]]
        maps = self._run.maps.drop_vars("range_llr" if MARGINAL in features else [])
        for part in np.array_split(chosen, max(1, len(chosen) // 120)):
            at = {"time": part}
            made, axes = columns(
                maps.isel(at).load(), features.isel(at).load(), self._run.config.spectra.window_s
            )
            parts.append(made)
        whole = {name: np.concatenate([part[name] for part in parts]) for name in axes}
        return _strips(self._seconds[chosen], whole, plain(axes))


class LiveFolder(_Folder):
    """A folder that a station writes to now, or wrote to."""

    kind = "live"

    def stamp(self) -> str:
        """Changes when there is something new to show."""
        parts = []
        for name in (DATABASE, f"{DATABASE}-wal", "status.json"):
            try:
                held = (self.path / name).stat()
                parts.append(f"{held.st_mtime_ns:x}.{held.st_size:x}")
            except OSError:
                parts.append("-")
        return "/".join(parts)

    def about(self) -> dict[str, Any]:
        """Station, span of time and health."""
        try:
            status = json.loads((self.path / "status.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            status = {}
        if not isinstance(status, dict):
            status = {}
        with self._database() as database:
            (first,) = database.execute("SELECT min(time) FROM detections").fetchone()
            # the last one written: a clock that was set back leaves later times before it
            last = database.execute("SELECT time FROM detections ORDER BY rowid DESC LIMIT 1").fetchone()
        span = [_posix(first), _posix(last[0])] if last else [0.0, 60.0]
        health = {name: status[key] for key, name in HEALTH.items() if status.get(key) is not None}
        health |= {
            name: _duration(health[name]) for name in ("data latency", "a minute's delay") if name in health
        }
        health |= {f"{seed_id} until": time for seed_id, time in status.get("channels", {}).items()}
        counts = status.get("packets", {})
        if counts:
            health["packets"] = ", ".join(f"{count} {what}" for what, count in counts.items())
        return {
            "kind": self.kind,
            "station": status.get("station") or {"code": self.path.name},
            "span": span,
            "healthy": bool(status.get("healthy", bool(status))),
            "trouble": status.get("trouble", "") if status else "no status.json: has obsnet watch begun?",
            "status_time": status.get("time"),
            "health": health,
            "obsnet": status.get("obsnet", ""),
        }

    def tracks(self) -> list[dict[str, Any]]:
        """All tracks."""
        rows = self._table("tracks", TRACK_COLUMNS)
        numbers = [name for name in TRACK_COLUMNS if name not in ("track", "start", "end", "cpa_time")]
        rows = rows.astype(dict.fromkeys(numbers, float))
        return [_track({str(k): v for k, v in row.items()}, track_of_row(row)) for _, row in rows.iterrows()]

    def detections(self, start: float, end: float) -> dict[str, list]:
        """Minutes within a span, column by column."""
        rows = self._table("detections", DETECTION_COLUMNS, start, end)
        rows = rows.astype(dict.fromkeys(DETECTION_COLUMNS[1:], float))
        return _columns(rows.assign(time=[_posix(text) for text in rows["time"]]))

    def live(self, start: float, end: float) -> dict[str, Any] | None:
        """The ship that is heard now, and its last hours; none where the filter holds none."""
        rows = self._table("live", None, start, end)
        rows = rows[rows["existence"].astype(float) > 0.5] if len(rows) else rows
        if not len(rows):
            return None
        numbers = [name for name in rows.columns if name != "time"]
        rows = rows.astype(dict.fromkeys(numbers, float))
        azimuth, distance = np.deg2rad(rows["azimuth_deg"]), rows["range_m"] / 1e3
        seconds = np.array([_posix(text) for text in rows["time"]])
        east, north = (np.asarray(distance * turn(azimuth)) for turn in (np.sin, np.cos))
        begin = _same_ship(seconds, east, north)
        trail = {
            "time": seconds[begin:].tolist(),
            "east_km": _rounded(east[begin:], 4),
            "north_km": _rounded(north[begin:], 4),
        }
        last = {key: _number(value) for key, value in rows.iloc[-1].items()}
        known = [last.get(name) for name in ("range_m", "range_std_m", "azimuth_deg", "azimuth_std_deg")]
        outline = circle(*known) if all(value is not None for value in known) else None  # type: ignore[arg-type]
        return {"now": last, "trail": trail, "ellipse": outline}

    def strips(self, start: float, end: float, most: int) -> dict[str, Any]:
        """Azimuth and range maps and the spectrum within a span, as the station keeps them; empty where it keeps none."""
        rows = self._table("strips", None, start, end)
        with self._database() as database:
            said = _one(database, "SELECT value FROM state WHERE name = 'strips'")
        if not len(rows) or said is None:
            return {"time": [], "strips": {}}
        axes = json.loads(said)
        rows = rows.iloc[_thinned(np.arange(len(rows)), most)]
        values = {}
        for name in (name for name in STRIPS if name in axes):
            empty = bytes(axes[name]["count"])
            joined = b"".join(held if held and len(held) == len(empty) else empty for held in rows[name])
            values[name] = np.frombuffer(joined, np.uint8).reshape(len(rows), -1)
        times = np.array([_posix(text) for text in rows["time"]])
        return _strips(times, values, {name: axes[name] for name in values})

    def _table(
        self, name: str, wanted: list[str] | None, start: float | None = None, end: float | None = None
    ) -> pd.DataFrame:
        """Rows of a table of the station's, in order of its first column; empty where it has none of that name."""
        with self._database() as database:
            held = [row[1] for row in database.execute(f'PRAGMA table_info("{name}")')]
            chosen = [column for column in (wanted or held) if column in held]
            if not chosen:
                return pd.DataFrame(columns=wanted or ["time", "existence"])
            quoted = ", ".join(f'"{column}"' for column in chosen)
            where, span = (
                ("", ())
                if start is None or end is None
                else ("WHERE time BETWEEN ? AND ?", (iso(start)[:19], iso(end)[:19] + "Z"))
            )
            rows = database.execute(f'SELECT {quoted} FROM "{name}" {where} ORDER BY "{chosen[0]}"', span)
            table = pd.DataFrame(rows.fetchall(), columns=chosen)
        return table.reindex(columns=wanted) if wanted else table

    @contextmanager
    def _database(self) -> Iterator[sqlite3.Connection]:
        address = f"file:{quote(str(self.path / DATABASE))}?mode=ro"
        if not (self.path / f"{DATABASE}-wal").exists():
            # nobody writes: without this, a database in WAL mode wants to make files beside it
            address += "&immutable=1"
        try:
            database = sqlite3.connect(address, uri=True, timeout=5.0)
            try:
                yield database
            finally:
                database.close()
        except sqlite3.Error as error:
            raise LayoutError(f"cannot read {self.path / DATABASE}: {error}") from None


def _same_ship(seconds: np.ndarray, east_km: np.ndarray, north_km: np.ndarray) -> int:
    """Index from which on the estimate went on without a break or a leap: the ship that is heard now, three hours at most."""
    leap = np.hypot(np.diff(east_km), np.diff(north_km)) > TRAIL_LEAP_KM
    apart = np.flatnonzero(leap | (np.diff(seconds) > TRAIL_GAP_S)) + 1
    recent = int(np.searchsorted(seconds, seconds[-1] - TRAIL_S))
    return max(recent, int(apart[-1]) if len(apart) else 0)


def _track(row: dict[str, Any], track: Track) -> dict[str, Any]:
    plain_row = {key: _number(value) for key, value in row.items()}
    return plain_row | {"span": [track.start, track.end], "shape": track_shape(track)}


def _columns(rows: pd.DataFrame) -> dict[str, list]:
    digits = {
        "time": 0,
        "coverage": 3,
        "azimuth_deg": 1,
        "azimuth_llr": 2,
        "range_m": 0,
        "range_rate_mps": 2,
        "range_llr": 2,
    }
    return {name: _rounded(rows[name], digits[name]) for name in DETECTION_COLUMNS}


def _strips(times: np.ndarray, values: dict[str, np.ndarray], axes: dict[str, Any]) -> dict[str, Any]:
    made = {
        name: axes[name] | {"bytes": base64.b64encode(held.T.tobytes()).decode()}
        for name, held in values.items()
    }
    return {"time": times.tolist(), "strips": made}


def _thinned(index: np.ndarray, most: int) -> np.ndarray:
    """Every n-th, so that at most `most` are left."""
    return index[:: max(1, math.ceil(len(index) / most))]


def _rounded(values: Any, digits: int) -> list:
    return [None if not math.isfinite(v) else round(float(v), digits) for v in np.asarray(values, float)]


def _number(value: Any) -> Any:
    """A value as JSON can hold it."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _duration(seconds: float) -> str:
    """Seconds in the unit that suits them."""
    units = (("days", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0))
    unit, size = next((u for u in units if abs(seconds) >= 2 * u[1]), ("s", 1.0))
    value = seconds / size
    return f"{value:.0f} {unit}" if abs(value) >= 100 else f"{value:.3g} {unit}"


def _posix(text: str) -> float:
    return parse_utc(text) / 1e9


def _one(database: sqlite3.Connection, query: str) -> Any:
    try:
        row = database.execute(query).fetchone()
    except sqlite3.OperationalError:
        return None
    return None if row is None else row[0]
