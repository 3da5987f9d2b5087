"""A whole archive: which station-days there are, which are still to be done, and what became of all of them."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from obsnet.archive.day import DayTask, detect_day, one_line
from obsnet.archive.ledger import COUNTS, Day, Ledger
from obsnet.archive.tracks import TracksTask, find_day_tracks, forget, tracks_tasks
from obsnet.archive.workers import Task, Workers, dask_workers, local_workers
from obsnet.console import counted
from obsnet.errors import ConfigError, StationError, WaveformError
from obsnet.output import write_text
from obsnet.pipeline import RunConfig
from obsnet.signals import inventory as inventories
from obsnet.signals.files import archived_days
from obsnet.signals.station import Station

REPORT_COLUMNS = [
    "station", "date", "status", "minutes", "azimuths", "ranges", "tracks", "bytes", "seconds", "error",
]  # fmt: skip


@dataclass
class Report:
    """What became of an archive's station-days.

    Attributes
    ----------
    rows : DataFrame over `REPORT_COLUMNS`; `status` is 'done', 'no data' or 'failed'. `tracks` counts those of the segments
        that begin on the day. A station that cannot serve has one failed row without a date.
    computed : station-days that were computed this time.
    """

    folder: Path
    rows: pd.DataFrame
    computed: int = 0

    @property
    def failed(self) -> pd.DataFrame:
        """Rows of the station-days that failed."""
        return self.rows[self.rows["status"] == "failed"]

    def lines(self) -> list[str]:
        """What to tell the user."""
        counts = self.rows["status"].value_counts()
        of_each = ", ".join(f"{counts.get(name, 0)} {name}" for name in ("done", "no data", "failed"))
        said = [f"{counted(len(self.rows), 'station-day')}: {of_each}; {self.computed} computed now"]
        said += [
            f"failed: {row.station} {row.date}: {row.error}" for row in self.failed.head(20).itertuples()
        ]
        if len(self.failed) > 20:
            said.append(f"… and {len(self.failed) - 20} more in report.csv")
        return [*said, f"{counted(int(self.rows['tracks'].sum()), 'track')}; written to {self.folder}"]


def archive(
    waveforms: str | Path,
    stations: str | Path | list[str | Path],
    start: str,
    end: str,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    select: list[str] | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> Report:
    """Detect and track many station-days of an SDS archive; what is finished is not done again.

    Parameters
    ----------
    waveforms : folder of an SDS archive.
    stations : StationXML file, folder of such (``*.xml``), or a list of either.
    start, end : UTC dates as ISO text; whole days from `start` to before `end`.
    out : folder of results; see `obsnet.archive.ledger`.
    config : RunConfig; the tracker must be the grid search.
    select : NET.STA, wildcards allowed; all stations by default.
    jobs : processes on this machine, all cores by default. scheduler : address of a Dask scheduler instead.
    progress : called with station-days done and in all.

    Raises
    ------
    ConfigError : the dates, the selection or the configuration cannot serve, or `out` was begun with another one.
    StationError, WaveformError : no station can be read, or the archive holds none of them.
    OutputError, SourceError : results cannot be written, or no scheduler answers.
    """
    config = config or RunConfig()
    if config.tracker != "grid":
        raise ConfigError(f"obsnet archive tracks with the grid search, found tracker {config.tracker!r}")
    dates = _dates(start, end)
    chosen = _choose(stations, select)
    root = Path(waveforms)
    if not root.is_dir():
        raise WaveformError(f"there is no archive {root}; give the folder of an SDS archive")
    root, folder = root.resolve(), Path(out).resolve()
    campaign = _Campaign(Ledger(folder), root, config, dates, progress)
    usable = campaign.usable(chosen)
    with campaign.ledger.begun(config, usable):
        crew: AbstractContextManager[Workers] = (
            dask_workers(scheduler, str(folder)) if scheduler else local_workers(jobs or os.cpu_count() or 1)
        )
        with crew as workers:
            try:
                campaign.run(workers, list(usable))
            finally:
                write_text(folder / "report.csv", campaign.rows().to_csv(index=False))
    return Report(folder, campaign.rows(), campaign.computed)


@dataclass
class _Campaign:
    ledger: Ledger
    waveforms: Path
    config: RunConfig
    dates: list[str]
    progress: Callable[[float, float], None] | None
    entries: dict[Day, dict[str, Any]] = field(default_factory=dict)
    found: dict[Day, dict[str, Any]] = field(default_factory=dict)
    left: dict[str, int] = field(default_factory=dict)
    computed: int = 0

    def usable(self, chosen: dict[str, Any]) -> dict[str, Any]:
        """The stations that can serve; the others go into the table, with their error."""
        served = {}
        for code, inventory in chosen.items():
            try:
                Station.from_stationxml(inventory, code)
                served[code] = inventory
            except StationError as error:
                self.entries[Day(code, "")] = {"status": "failed", "error": one_line(error)}
        if not served:
            raise StationError(f"no station can serve: {next(iter(self.entries.values()))['error']}")
        return served

    def run(self, workers: Workers, codes: list[str]) -> None:
        """Detect what is not finished, then track each station as its days are complete."""
        held = {code: archived_days(self.waveforms, code) for code in codes}
        if not any(held.values()):
            raise WaveformError(
                f"{self.waveforms} is not an SDS archive (YEAR/NET/STA/CHA.D/) with waveforms of {', '.join(codes[:8])}"
            )
        tasks: list[Task] = []
        for code in codes:
            for day in (Day(code, date) for date in self.dates):
                entry = self.ledger.finished(day)
                if entry is not None:
                    self.entries[day] = entry
                elif day.date not in held[code]:
                    self.entries[day] = {"status": "no data"}
                else:
                    task = DayTask(str(self.waveforms), str(self.ledger.folder), day, self.config)
                    tasks.append((detect_day, task))
                    self.left[code] = self.left.get(code, 0) + 1
        complete = [code for code in codes if code not in self.left]
        self._advance()
        workers.run([*(task for code in complete for task in self._tracking(code)), *tasks], self._finished)

    def _finished(self, task: Task, result: Any) -> Iterator[Task]:
        what, day = task[1], task[1].day
        if isinstance(result, BaseException):
            result = {"status": "failed", "error": f"{type(result).__name__}: {one_line(result)}"}
        if isinstance(what, TracksTask):
            self.found[day] = result
            return
        self.entries[day] = result
        self.computed += result["status"] == "done"
        self.left[day.code] -= 1
        self._advance()
        if not self.left[day.code]:
            yield from self._tracking(day.code)

    def _tracking(self, code: str) -> Iterator[Task]:
        """Tracking tasks of a station whose days are complete; those whose segments are as before are not repeated."""
        dates = sorted(path.stem for path in (self.ledger.folder / "days" / code).glob("????-??-??.json"))
        done = [date for date in dates if self.ledger.finished(Day(code, date))]
        wanted = tracks_tasks(self.ledger, self.config, code, done)
        for path in (self.ledger.folder / "days" / code).glob("*.tracks.json"):
            day = Day(code, path.name.removesuffix(".tracks.json"))
            if day not in {task.day for task in wanted}:
                forget(self.ledger, day)
        for task in wanted:
            entry = self.ledger.read(task.day, "tracks")
            if entry is not None and entry["status"] == "done" and entry.get("digest") == task.digest:
                self.found[task.day] = entry
            else:
                yield find_day_tracks, task

    def _advance(self) -> None:
        if self.progress is not None:
            left = sum(self.left.values())
            total = len(self.dates) * max(len({day.code for day in self.entries} | set(self.left)), 1)
            self.progress(total - left, total)

    def rows(self) -> pd.DataFrame:
        """One row a station-day so far."""
        table = []
        for day, entry in sorted(self.entries.items(), key=lambda item: (item[0].code, item[0].date)):
            tracks = self.found.get(day, {})
            row = {name: entry.get(name) for name in REPORT_COLUMNS} | {"station": day.code, "date": day.date}
            row["tracks"] = tracks.get("tracks", 0)
            if tracks.get("status") == "failed":
                row |= {"status": "failed", "error": tracks["error"]}
            table.append(row)
        frame = pd.DataFrame(table, columns=REPORT_COLUMNS)
        return frame.astype(dict.fromkeys(COUNTS, "Int64"))


def _dates(start: str, end: str) -> list[str]:
    """Dates from `start` to before `end`."""
    edges = []
    for name, text in (("start", start), ("end", end)):
        try:
            stamp = np.datetime64(text.removesuffix("Z"), "s")
        except ValueError:
            raise ConfigError(f"the {name} {text!r} is no date; give UTC dates, e.g. 2013-05-21") from None
        if stamp != stamp.astype("datetime64[D]"):
            raise ConfigError(f"the {name} {text} is not a midnight; an archive holds whole UTC days")
        edges.append(stamp.astype("datetime64[D]"))
    if not edges[0] < edges[1]:
        raise ConfigError(f"the start {start} is not before the end {end}; the end is not included")
    today = np.datetime64("now", "D")
    if edges[1] > today:
        raise ConfigError(
            f"the end {end} lies ahead: a day is computed once, when it is over; give an end of {today} at the latest"
        )
    return [str(date) for date in np.arange(*edges)]


def _choose(stations: Any, select: list[str] | None) -> dict[str, Any]:
    """Inventory of each station wanted, by NET.STA, from files and folders of StationXML."""
    paths = [Path(item) for item in (stations if isinstance(stations, list) else [stations])]
    files = [file for path in paths for file in (sorted(path.glob("*.xml")) if path.is_dir() else [path])]
    if not files:
        raise StationError(f"there is no StationXML (*.xml) in {', '.join(map(str, paths))}")
    found: dict[str, Any] = {}
    for file in files:
        inventory = inventories.read(file)
        for code in sorted({f"{net.code}.{sta.code}" for net in inventory for sta in net}):
            if select is None or any(fnmatch.fnmatchcase(code, pattern.strip()) for pattern in select):
                network, _, station = code.partition(".")
                part = inventory.select(network=network, station=station)
                found[code] = found[code] + part if code in found else part
    if not found:
        wanted = ", ".join(select or ["any station"])
        raise StationError(f"{', '.join(map(str, files[:4]))} describes none of {wanted}; check --select")
    return dict(sorted(found.items()))
