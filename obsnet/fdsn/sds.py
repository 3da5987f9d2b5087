"""An SDS archive that grows file by file, and the manifest that says what of it is complete."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from obspy import UTCDateTime

import obsnet
from obsnet.errors import OutputError

SETTLED_AFTER_S = 86400.0


@dataclass(frozen=True)
class Day:
    """One channel and the part of one UTC day that is wanted of it."""

    network: str
    station: str
    location: str
    channel: str
    start: UTCDateTime
    end: UTCDateTime

    @property
    def code(self) -> tuple[str, str, str, str]:
        """Network, station, location and channel."""
        return self.network, self.station, self.location, self.channel

    @property
    def name(self) -> str:
        """Name of its file."""
        return ".".join((*self.code, "D", f"{self.start.year}.{self.start.julday:03d}"))

    @property
    def path(self) -> str:
        """Path of its file in the archive."""
        return f"{self.start.year}/{self.network}/{self.station}/{self.channel}.D/{self.name}"


class Archive:
    """The folder: files written aside and moved into place, and a manifest of what is complete."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._manifest = folder / "fetch.json"
        self._entries: dict[str, dict[str, Any]] = {}
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"output {folder} is a file; give a folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self._manifest.exists():
                self._entries = dict(json.loads(self._manifest.read_text(encoding="utf-8"))["days"])
        except OSError as error:
            raise OutputError(f"cannot write into {folder}: {error.strerror or error}") from None
        except (ValueError, KeyError, TypeError):
            raise OutputError(
                f"{self._manifest} is not a manifest of obsnet fetch; remove it to fetch everything again"
            ) from None

    def write(self, name: str, content: bytes) -> None:
        """Write a file atomically."""
        path = self.folder / name
        partial = path.with_name(f".{path.name}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(content)
            os.replace(partial, path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise OutputError(f"cannot write {path}: {error.strerror or error}") from None

    def lacking(self, day: Day) -> Day | None:
        """What is to be fetched so that the day is complete: nothing, or its wanted part with what was
        there.
        """
        entry = self._entries.get(day.path)
        if entry is None:
            return day
        start, end = UTCDateTime(entry["start"]), UTCDateTime(entry["end"])
        whole = start <= day.start and end >= day.end and entry["settled"]
        if whole and (entry["bytes"] == 0 or self._size(day) == entry["bytes"]):
            return None
        return Day(*day.code, min(start, day.start), max(end, day.end))

    def store(self, day: Day, content: bytes, source: str) -> int:
        """Keep a day's records and note it in the manifest; return their size."""
        if content:
            self.write(day.path, content)
        settled = UTCDateTime() - day.end > SETTLED_AFTER_S
        self._entries[day.path] = {
            "start": str(day.start),
            "end": str(day.end),
            "bytes": len(content),
            "settled": settled,
            "source": source,
        }
        manifest = {"obsnet": obsnet.__version__, "days": self._entries}
        self.write(self._manifest.name, json.dumps(manifest, indent=0).encode())
        return len(content)

    def is_empty(self, day: Day) -> bool:
        """Whether the data centre had nothing of the day."""
        return self._entries[day.path]["bytes"] == 0

    def _size(self, day: Day) -> int:
        path = self.folder / day.path
        return path.stat().st_size if path.is_file() else -1
