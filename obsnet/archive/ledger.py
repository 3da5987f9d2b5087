"""The folder of an archive: where things lie, what is finished, and the parameters with which it was begun.

::

    archive.json                                     parameters and stations
    stations/NET.STA.xml                             metadata used
    detections/station=NET.STA/date=DATE/minutes.parquet
    maps/station=NET.STA/date=DATE.zarr
    tracks/station=NET.STA/date=DATE/from-DATE.parquet
    days/NET.STA/DATE.json, DATE.tracks.json         what was finished, and how; written last
    report.csv                                       one row a station-day
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import obspy

import obsnet
from obsnet.config import first_change, to_dict
from obsnet.detectors.model_card import ModelFile, shipped
from obsnet.errors import ConfigError, OutputError
from obsnet.output import prepare_folder, write_text
from obsnet.pipeline import RunConfig

DAY_S = 86400.0
UNFINISHED = ".unfinished-"
"""Beginning of the names of files and folders that are still being written."""
COUNTS = ("minutes", "azimuths", "ranges", "tracks", "bytes")
"""What records count."""


@dataclass(frozen=True)
class Day:
    """One station and one UTC day, its date as ISO text."""

    code: str
    date: str

    @property
    def start(self) -> float:
        """Its midnight, s since 1970."""
        return float(obspy.UTCDateTime(self.date).timestamp)


class Ledger:
    """Paths of an archive's folder, and the records of what is finished."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def station_file(self, code: str) -> Path:
        """StationXML of one station."""
        return self.folder / "stations" / f"{code}.xml"

    def detections(self, day: Day) -> Path:
        """Parquet file of a day's minutes."""
        return self.folder / "detections" / f"station={day.code}" / f"date={day.date}" / "minutes.parquet"

    def maps(self, day: Day) -> Path:
        """Zarr group of a day's maps."""
        return self.folder / "maps" / f"station={day.code}" / f"date={day.date}.zarr"

    def tracks(self, code: str, date: str, unit: str) -> Path:
        """Parquet file of the tracks that begin on `date`, found with the segments that begin on `unit`."""
        return self.folder / "tracks" / f"station={code}" / f"date={date}" / f"from-{unit}.parquet"

    def record(self, day: Day, stage: str = "") -> Path:
        """JSON record of a finished (or failed) day, or of its tracks."""
        return self.folder / "days" / day.code / f"{day.date}{stage and '.'}{stage}.json"

    def read(self, day: Day, stage: str = "") -> dict[str, Any] | None:
        """A day's record; None where there is none or it cannot be read."""
        try:
            found = json.loads(self.record(day, stage).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return found if _is_record(found) else None

    def finished(self, day: Day) -> dict[str, Any] | None:
        """The record of a day that is done and whose minutes are there; None where it is to be computed (again)."""
        import pyarrow.parquet

        entry = self.read(day)
        if entry is None or entry["status"] != "done":
            return None
        try:
            pyarrow.parquet.read_metadata(self.detections(day))
        except (OSError, ValueError):  # lost, or cut short
            return None
        return entry

    def write(self, day: Day, entry: dict[str, Any], stage: str = "") -> None:
        """Write a day's record, after all that it speaks of."""
        path = self.record(day, stage)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(entry, indent=1))

    @contextmanager
    def begun(self, config: RunConfig, inventories: dict[str, Any]) -> Iterator[None]:
        """The folder held for this process alone, what earlier ones left unfinished cleared away.

        Raises
        ------
        ConfigError : it was begun with other parameters or models, or with other metadata of a station.
        ModelError : a learned detector is asked for that is not there, or was altered.
        OutputError : it cannot be written, or another process is at work in it.
        """
        prepare_folder(self.folder)
        with (self.folder / ".lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise OutputError(
                    f"another obsnet archive is at work in {self.folder}; wait for it, or give another folder"
                ) from None
            self._match(config, inventories)
            self.clear()
            try:
                yield
            finally:
                self.clear()

    def clear(self) -> None:
        """Remove what was left half-written."""
        for name in ("detections", "maps", "tracks"):
            for path in list((self.folder / name).rglob(f"{UNFINISHED}*")):
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)

    def _match(self, config: RunConfig, inventories: dict[str, Any]) -> None:
        path, digests = self.folder / "archive.json", model_digests(config)
        held: dict[str, Any] = {}
        if path.exists():
            try:
                held = json.loads(path.read_text(encoding="utf-8"))
                stations, before = dict(held["stations"]), dict(held["config"])
            except (OSError, ValueError, KeyError, TypeError):
                raise ConfigError(
                    f"{path} is not one of obsnet archive; give another output folder"
                ) from None
            now = json.loads(json.dumps(to_dict(config))) | {"model digests": digests}
            changed = first_change(before | {"model digests": held.get("models", {})}, now)
            if changed:
                raise ConfigError(
                    f"{self.folder} was begun with {changed}; give the same parameters, or another output folder"
                )
        else:
            stations = {}
        (self.folder / "stations").mkdir(exist_ok=True)
        for code, inventory in inventories.items():
            text = _canonical(inventory)
            digest = hashlib.sha256(text).hexdigest()
            if stations.setdefault(code, digest) != digest:
                raise ConfigError(
                    f"the metadata of {code} are not those with which {self.folder} was begun; "
                    "give the same StationXML, or another output folder"
                )
            write_text(self.station_file(code), text.decode())
        about = {
            "obsnet": obsnet.__version__,
            "config": to_dict(config),
            "models": digests,
            "stations": stations,
        }
        write_text(path, json.dumps(held | about, indent=1))


def model_digests(config: RunConfig) -> dict[str, str]:
    """SHA-256 of the model of each learned detector that a configuration uses."""
    tasks = {"learned": ("azimuth", "range"), "learned-azimuth": ("azimuth",), "learned-range": ("range",)}
    return {
        task: ModelFile.read(getattr(config.models, task) or shipped(task), task).digest
        for task in tasks.get(config.detector, ())
    }


def put(frame: Any, path: Path) -> int:
    """Write a table as one Parquet file, whole or not at all; return its bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{UNFINISHED}{os.getpid()}-{path.name}")
    try:
        frame.to_parquet(partial, index=False, compression="zstd")
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise OutputError(f"cannot write {path}: {error.strerror or error}; make room for it") from None
    return path.stat().st_size


def _is_record(found: Any) -> bool:
    return (
        isinstance(found, dict)
        and isinstance(found.get("status"), str)
        and all(isinstance(found.get(name, 0), int) for name in COUNTS)
    )


def _canonical(inventory: Any) -> bytes:
    """StationXML that is the same whenever and by whatever it was made from the same metadata."""
    inventory = inventory.copy()
    inventory.created, inventory.source, inventory.sender = obspy.UTCDateTime(0), "obsnet", None
    inventory.module = inventory.module_uri = None
    buffer = BytesIO()
    inventory.write(buffer, format="STATIONXML")
    return buffer.getvalue()
