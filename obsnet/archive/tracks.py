"""Tracks of an archive: the joined minutes of a station in, segments; each group of segments to its tracks.

Segments are those of the whole stretch of finished days, so that a ship at midnight is one ship. Segments less than an hour
apart know of each other's tracks and are searched together: a group belongs to the day on which it begins.
"""

from __future__ import annotations

import hashlib
import json
import time
import traceback
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

import obsnet
from obsnet.archive.day import known_station, one_line, table_of
from obsnet.archive.ledger import DAY_S, Day, Ledger, put
from obsnet.detectors.maps import joined
from obsnet.errors import LayoutError, ObsnetError, OutputError
from obsnet.layout import iso, to_posix
from obsnet.ocean.rays import travel_time
from obsnet.pipeline import RunConfig
from obsnet.run import Run
from obsnet.tables import TRACK_COLUMNS
from obsnet.trackers.segmentation import segments
from obsnet.trackers.track import Segment, Track
from obsnet.tracking import NEIGHBOUR_S, segment_tracks

_PRESENCE = {
    "azimuth_llr": "azimuth",
    "range_llr": "range",
    "approaching_llr": "approaching",
    "leaving_llr": "leaving",
}


@dataclass(frozen=True)
class TracksTask:
    """What a worker needs to track one group of segments, which begins on `day`."""

    folder: str
    day: Day
    segments: tuple[Segment, ...]
    config: RunConfig

    @property
    def digest(self) -> str:
        """Changes when the segments do: a day that came later may have moved them."""
        return hashlib.sha256(json.dumps([asdict(s) for s in self.segments]).encode()).hexdigest()


def tracks_tasks(ledger: Ledger, config: RunConfig, code: str, dates: Iterable[str]) -> list[TracksTask]:
    """What is to be tracked at a station whose finished days are `dates`, in order of time."""
    days = [Day(code, date) for date in sorted(dates)]
    if not days:
        return []
    rows = _minutes(ledger, days)
    found = segments(_presence(rows), config.segmentation)
    groups: dict[str, list[Segment]] = {}
    begun, until = "", -np.inf
    for segment in found:
        if segment.start > until + NEIGHBOUR_S:
            begun = iso(segment.start)[:10]
        groups.setdefault(begun, []).append(segment)
        until = max(until, segment.end)
    return [
        TracksTask(str(ledger.folder), Day(code, date), tuple(group), config)
        for date, group in sorted(groups.items())
    ]


def find_day_tracks(task: TracksTask) -> dict[str, Any]:
    """Search a group's segments, write its tracks and their record; the record says 'done' or 'failed' and why."""
    ledger, begun = Ledger(task.folder), time.perf_counter()
    entry: dict[str, Any] = {
        "station": task.day.code,
        "date": task.day.date,
        "obsnet": obsnet.__version__,
        "digest": task.digest,
    }
    try:
        rows = _rows(task, ledger)
        forget(ledger, task.day)
        for date, part in rows.groupby(rows["start"].dt.strftime("%Y-%m-%d")):
            put(part, ledger.tracks(task.day.code, str(date), task.day.date))
        entry |= {"status": "done", "tracks": len(rows)}
    except OutputError:
        raise
    except ObsnetError as error:
        entry |= {"status": "failed", "error": f"tracks: {one_line(error)}"}
    except Exception as error:
        text = f"tracks: {type(error).__name__}: {one_line(error)}"
        entry |= {"status": "failed", "error": text, "traceback": traceback.format_exc()}
    entry["seconds"] = round(time.perf_counter() - begun, 3)
    ledger.write(task.day, entry, "tracks")
    return entry


def forget(ledger: Ledger, day: Day) -> None:
    """Remove the tracks that were found with the segments that begin on a day, and the record of it."""
    ledger.record(day, "tracks").unlink(missing_ok=True)
    for path in (ledger.folder / "tracks" / f"station={day.code}").glob(f"date=*/from-{day.date}.parquet"):
        path.unlink(missing_ok=True)


def track_name(code: str, found: Track) -> str:
    """Name of a track, unique and the same whenever it is found: station and time of its CPA."""
    stamp = pd.Timestamp(found.motion.cpa_time, unit="s").strftime("%Y%m%dT%H%M%S")
    return f"{code}-{stamp}"


def _rows(task: TracksTask, ledger: Ledger) -> pd.DataFrame:
    code, config = task.day.code, task.config
    station = known_station(ledger, code, min(s.start for s in task.segments))
    first = np.floor(min(s.start for s in task.segments) / DAY_S)
    last = np.floor(max(s.end for s in task.segments) / DAY_S)
    days = [Day(code, iso(DAY_S * number)[:10]) for number in np.arange(first, last + 1)]
    minutes = _minutes(ledger, days)
    run = Run(
        station, config, _maps(ledger, days), xr.Dataset(), minutes, _presence(minutes), [], [],
        table_of(config, station.depth_m),
    )  # fmt: skip
    tracks: list[Track] = []
    for segment in task.segments:
        near = [known for known in tracks if known.end > segment.start - NEIGHBOUR_S]
        tracks += segment_tracks(run, segment, travel_time(run.table), near)
    tracks.sort(key=lambda found: found.motion.cpa_time)
    rows = [found.row(0) | {"track": track_name(code, found), "method": found.method} for found in tracks]
    frame = pd.DataFrame(rows, columns=[*TRACK_COLUMNS, "method"])
    for name in ("start", "end", "cpa_time"):
        frame[name] = pd.to_datetime(frame[name], utc=True, format="ISO8601").astype("datetime64[ns, UTC]")
    return frame


def _maps(ledger: Ledger, days: list[Day]) -> xr.Dataset:
    """Maps of consecutive days, read when they are looked at; a detector that a day lacks is NaN there."""
    import dask

    dask.config.set(scheduler="synchronous")
    opened = [xr.open_zarr(ledger.maps(day), consolidated=False) for day in days]
    names = {name: held for held in opened for name in held.data_vars}
    whole = [
        held.assign(
            {
                n: xr.full_like(names[n][n], np.nan).assign_coords(time=held["time"])
                for n in names
                if n not in held
            }
        )
        for held in opened
    ]
    maps = joined(whole)
    for values in maps.variables.values():
        values.encoding = {}
    return maps


def _minutes(ledger: Ledger, days: list[Day]) -> pd.DataFrame:
    rows = pd.concat([_of_day(ledger, day) for day in days], ignore_index=True)
    return rows.assign(time=rows["time"].dt.tz_localize(None).astype("datetime64[ns]"))


def _of_day(ledger: Ledger, day: Day) -> pd.DataFrame:
    path = ledger.detections(day)
    try:
        return pd.read_parquet(path, partitioning=None)
    except (OSError, ValueError) as error:
        raise LayoutError(
            f"{path} cannot be read ({one_line(error)}); remove it, and the day is computed anew"
        ) from None


def _presence(rows: pd.DataFrame) -> pd.DataFrame:
    ratios = rows.set_index(to_posix(rows["time"].to_numpy()))[list(_PRESENCE)].rename(columns=_PRESENCE)
    return ratios.dropna(axis=1, how="all")
