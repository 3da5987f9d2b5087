"""The files of a live station, all made from its database: CSV that only grows, GeoJSON, and what it is doing now."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from obsnet.errors import OutputError
from obsnet.live.ships import Ships
from obsnet.live.store import Store
from obsnet.output import write_text
from obsnet.signals.station import Station
from obsnet.tables import (
    DETECTION_COLUMNS,
    DETECTION_DIGITS,
    TRACK_COLUMNS,
    detections_csv,
    geojson,
    tracks_csv,
)

_CHECKED_DAYS = 3


class Files:
    """Keeps `detections-YYYY-MM-DD.csv`, `tracks.csv` and `tracks.geojson` beside the database.

    A line is appended after its row is committed. What a crash or a full disk left out, tore or doubled is put right
    from the database by `repair`.
    """

    def __init__(self, folder: Path, store: Store, station: Station, ships: Ships) -> None:
        self._folder, self._store, self._station, self._ships = folder, store, station, ships
        self._dirty: set[str] = set()
        self._until: dict[str, str] = {}

    def repair(self) -> None:
        """Make the last days' files, and any that is missing, say what the database says."""
        days = [
            day
            for (day,) in self._store.rows("SELECT DISTINCT substr(time, 1, 10) FROM detections ORDER BY 1")
        ]
        self._dirty |= {day for day in days if not self._path(day).exists()} | set(days[-_CHECKED_DAYS:])
        self._mend()
        self.write_tracks()

    def append(self, times: list[str]) -> None:
        """Add the rows of the given times, already committed."""
        for day in sorted({time[:10] for time in times}):
            inside = [time for time in times if time[:10] == day]
            path = self._path(day)
            if day in self._dirty or (path.exists() and min(inside) <= self._until.get(day, "~")):
                self._dirty.add(day)
                continue
            text = self._text("WHERE time BETWEEN ? AND ?", (min(inside), max(inside)))
            try:
                fresh = not path.exists()
                with path.open("a", encoding="utf-8", newline="") as file:
                    file.write(text if fresh else text.partition("\n")[2])
                self._until = {day: max(inside)} | {k: v for k, v in self._until.items() if k >= day}
            except OSError:
                self._dirty.add(day)
        self._mend()

    def write_tracks(self) -> None:
        """Write tracks.csv and tracks.geojson."""
        table = self._store.table("tracks", TRACK_COLUMNS)
        numbers = [name for name in TRACK_COLUMNS if name not in ("track", "start", "end", "cpa_time")]
        text = tracks_csv(table.astype(dict.fromkeys(numbers, float)))
        _replace(self._folder / "tracks.csv", text)
        _replace(self._folder / "tracks.geojson", json.dumps(geojson(self._ships.tracks(), self._station)))

    def write_status(self, status: dict[str, Any]) -> None:
        """Rewrite status.json."""
        write_text(self._folder / "status.json", json.dumps(status, indent=1))

    def _mend(self) -> None:
        for day in sorted(self._dirty):
            try:
                _replace(self._path(day), self._text("WHERE time BETWEEN ? AND ?", (day, day + "U")))
                self._dirty.discard(day)
                ((self._until[day],),) = self._store.rows(
                    "SELECT max(time) FROM detections WHERE time BETWEEN ? AND ?", (day, day + "U")
                )
            except OutputError:  # no room: the database has the rows, and the next minute tries again
                return

    def _text(self, where: str, parameters: tuple[str, ...]) -> str:
        table = self._store.table("detections", DETECTION_COLUMNS, where, parameters)
        table = table.astype(dict.fromkeys(DETECTION_COLUMNS[1:], float))
        table["time"] = pd.to_datetime(table["time"].str.removesuffix("Z")).to_numpy("datetime64[ns]")
        return detections_csv(table)

    def _path(self, day: str) -> Path:
        return self._folder / f"detections-{day}.csv"


def rounded(detections: pd.DataFrame) -> pd.DataFrame:
    """Detections as the CSV files have them, times as text."""
    stamps = np.datetime_as_string(detections["time"].to_numpy("datetime64[s]"))
    return detections.reset_index(drop=True).round(DETECTION_DIGITS).assign(time=np.char.add(stamps, "Z"))


def _replace(path: Path, text: str) -> None:
    """Make a file hold `text`: by adding to it where it holds the beginning, else in its place."""
    try:
        held = path.read_text(encoding="utf-8") if path.exists() else None
        if held == text:
            return
        if held and text.startswith(held) and held.endswith("\n"):
            with path.open("a", encoding="utf-8", newline="") as file:
                file.write(text[len(held) :])
                file.flush()
                os.fsync(file.fileno())
            return
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        pass
    write_text(path, text)
