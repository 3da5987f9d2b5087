"""Files, folders, an SDS archive or a Stream in, one timeline of samples for each channel of a station out.

Headers are read first and samples only when a block needs them, so that memory stays flat with the length
of the record. Formats are recognised by obspy, except Python pickles, which could run code and are never
opened.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import obspy

from obsnet.errors import WaveformError
from obsnet.layout import iso, parse_utc
from obsnet.signals.files import FileReader, list_files, trace_piece
from obsnet.signals.records import RecordReader
from obsnet.signals.station import Station
from obsnet.signals.timeline import Overlap, Piece, Timeline

_SECOND = 1_000_000_000
_RATE_TOLERANCE = 1e-3
_EARLIEST_NS, _LATEST_NS = -2_208_988_800 * _SECOND, 7_258_118_400 * _SECOND
_CHECKED_OVERLAPS = 20
_CHECKED_S = 60.0


@dataclass
class ChannelReport:
    """What became of one channel; times ISO 8601, durations in s. The spectra fill in the last four.

    Frames are dead where samples stand still or are no numbers.
    """

    sampling_rate: float
    starttime: str
    endtime: str
    gaps: int = 0
    gap_s: float = 0.0
    overlaps: int = 0
    conflicting_overlaps: int = 0
    usable_frames: int = 0
    dead_frames: int = 0
    clipped_frames: int = 0
    transform: str = ""


@dataclass
class WaveformReport:
    """What was read, which files and channels were left aside and why; plain values for `run.json`."""

    files: int = 0
    ignored: dict[str, str] = field(default_factory=dict)
    left_aside: dict[str, str] = field(default_factory=dict)
    channels: dict[str, ChannelReport] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Add a remark once."""
        if text not in self.notes:
            self.notes.append(text)

    def to_dict(self) -> dict[str, Any]:
        """Nested plain dictionary."""
        return asdict(self)


class Waveforms(Protocol):
    """What spectra are made of: the timeline of every channel, whether of a record or of a live buffer."""

    station: Station
    timelines: dict[str, Timeline]
    report: WaveformReport

    def station_at(self, time_ns: int) -> Station:
        """The station with the channels that have waveforms and an epoch at a time."""
        ...


class WaveformSource:
    """The waveforms of one station, channel by channel.

    Attributes
    ----------
    station : Station
        Placed where it lay when the record begins.
    timelines : dict of Timeline
        By SEED id, for the channels that can serve.
    begin_ns, end_ns : int
        The span asked for, cut to what is there; ns since 1970.
    report : WaveformReport
    """

    def __init__(
        self,
        station: Station,
        timelines: dict[str, Timeline],
        report: WaveformReport,
        begin_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        self.station, self.timelines, self.report = station, timelines, report
        first = min(timeline.begin_ns for timeline in timelines.values())
        last = max(timeline.end_ns for timeline in timelines.values())
        self.begin_ns = first if begin_ns is None else begin_ns
        self.end_ns = last if end_ns is None else end_ns
        self.data_begin_ns, self.data_end_ns = first, last
        if self.begin_ns >= last or self.end_ns <= first:
            found = f"they span {_iso(first)} to {_iso(last)}"
            raise WaveformError(f"{station.code} has no waveforms {_span(begin_ns, end_ns)}; {found}")
        if station.moved:
            self._place()

    def _place(self) -> None:
        runs = (run for timeline in self.timelines.values() for run in timeline.runs)
        heard = min(max(run.begin_ns, self.begin_ns) for run in runs if run.end_ns > self.begin_ns)
        self.station = placed = self.station.placed(heard / _SECOND)
        here, end = (placed.latitude, placed.longitude, placed.depth_m), min(self.end_ns, self.data_end_ns)
        for site in placed.sites:
            if heard < site.starttime * _SECOND < end and site.place != here:
                self.report.note(
                    f"{placed.code} lies elsewhere from {iso(site.starttime)} on: where it lay when the record "
                    "begins is used throughout; use the parts by themselves (--start, --end)"
                )
                return

    def covered(self, silence_ns: int) -> list[tuple[int, int]]:
        """Spans that any channel covers, silences of up to `silence_ns` included; ns since 1970."""
        spans: list[tuple[int, int]] = []
        runs = (run for timeline in self.timelines.values() for run in timeline.runs)
        for begin, end in sorted((run.begin_ns, run.end_ns) for run in runs):
            if spans and begin - spans[-1][1] <= silence_ns:
                spans[-1] = (spans[-1][0], max(spans[-1][1], end))
            else:
                spans.append((begin, end))
        return spans

    def station_at(self, time_ns: int) -> Station:
        """The station with the channels that have waveforms and an epoch at a time."""
        return self.station.at(time_ns / _SECOND, self.timelines.keys())


def open_waveforms(
    source: Any,
    station: Station,
    *,
    starttime: Any = None,
    endtime: Any = None,
    min_rate_hz: float = 50.0,
) -> WaveformSource:
    """Find a station's waveforms.

    Parameters
    ----------
    source : obspy Stream, path, list of paths, or WaveformSource
        What was opened before keeps its span where no other is given. Files in any format that obspy reads (pickles excepted), folders (searched to any depth), wildcards,
        SDS archives.
    station : Station
        Whose channels to look for. Waveforms that differ from a channel in nothing but a location code, or
        an empty network code, are taken for it where it has none of its own, and the report says so.
    starttime, endtime : optional
        datetime64, ISO text, UTCDateTime or s since 1970.
    min_rate_hz : float
        Channels sampled more slowly cannot serve.

    Returns
    -------
    WaveformSource

    Raises
    ------
    WaveformError
        Nothing usable was found; the message says what was.
    """
    begin, end = (None if time is None else to_ns(time) for time in (starttime, endtime))
    if begin is not None and end is not None and begin >= end:
        raise WaveformError(
            f"the start {_iso(begin)} is not before the end {_iso(end)}; swap or correct them"
        )
    if isinstance(source, WaveformSource):
        begin = source.begin_ns if begin is None else begin
        end = source.end_ns if end is None else end
        return WaveformSource(station, source.timelines, source.report, begin, end)
    report = WaveformReport()
    if isinstance(source, (obspy.Stream, obspy.Trace)):
        what, found = "the stream", _from_stream(source)
    else:
        paths = _paths(source)
        what = ", ".join(str(path) for path in paths[:3]) + (", …" if len(paths) > 3 else "")
        found = _from_files(paths, station, begin, end, report)
    timelines = _sort(found, station, min_rate_hz, report)
    if not timelines:
        raise WaveformError(_nothing(what, station, report, _span(begin, end)))
    for seed_id, timeline in timelines.items():
        report.channels[seed_id] = _describe(timeline)
    silent = station.pressure.seed_id if station.pressure else None
    if silent and silent not in report.left_aside and not station.at(seed_ids=timelines.keys()).pressure:
        report.note(f"{silent} has no waveforms")
    return WaveformSource(station, timelines, report, begin, end)


def to_ns(time: Any) -> int:
    """Nanoseconds since 1970 of a datetime64, ISO text, UTCDateTime, datetime or number of seconds.

    >>> to_ns("1970-01-01T00:00:10.24Z")
    10240000000
    """
    if isinstance(time, obspy.UTCDateTime):
        return int(time.ns)
    if isinstance(time, (int, float)) and not isinstance(time, bool):
        return round(time * _SECOND)
    try:
        if isinstance(time, str):
            return parse_utc(time)
        stamp = np.datetime64(time, "ns")
        if np.isnat(stamp):
            raise ValueError
        return int(stamp.astype(np.int64))
    except (ValueError, TypeError):
        raise WaveformError(
            f"cannot read the time {time!r}; give ISO 8601, e.g. 2013-05-21T10:00:00Z"
        ) from None


def _iso(time_ns: int) -> str:
    return iso(np.datetime64(time_ns, "ns"))


def _span(begin: int | None, end: int | None) -> str:
    """The span asked for, in words."""
    if begin is not None and end is not None:
        return f"between {_iso(begin)} and {_iso(end)}"
    return (
        f"from {_iso(begin)} on"
        if begin is not None
        else f"before {_iso(end)}"
        if end is not None
        else "at all"
    )


def _paths(source: Any) -> list[str | Path]:
    paths = [source] if isinstance(source, (str, Path)) else source
    if not isinstance(paths, (list, tuple)) or not all(isinstance(path, (str, Path)) for path in paths):
        raise WaveformError(f"obsnet takes paths or an obspy Stream, found {type(source).__name__}")
    if not all(str(path).strip() for path in paths):
        raise WaveformError("a path of waveforms is empty text; name files, folders or an archive")
    return list(paths)


def _from_stream(stream: Any) -> Iterator[tuple[str, Piece]]:
    traces = [stream] if isinstance(stream, obspy.Trace) else list(stream)
    for trace in traces:
        parts = trace.split() if isinstance(trace.data, np.ma.MaskedArray) else [trace]
        for part in parts:
            if part.stats.npts and part.data.dtype.kind in "iuf":
                data = np.ma.getdata(part.data)
                yield part.id, trace_piece(part, partial(_slice, data))


def _slice(data: np.ndarray, first: int, last: int) -> np.ndarray:
    return data[first:last]


def _from_files(
    paths: list[Any], station: Station, begin: int | None, end: int | None, report: WaveformReport
) -> Iterator[tuple[str, Piece]]:
    records, others = RecordReader(report.note), FileReader(report.note)
    for path in list_files(paths, station, begin, end):
        report.files += 1
        try:
            if path.stat().st_size == 0:
                report.ignored[str(path)] = "empty"
                continue
            scanned = records.pieces(path)
            if scanned is None:
                yield from others.pieces(path)
                continue
        except (OSError, WaveformError) as error:
            report.ignored[str(path)] = getattr(error, "strerror", None) or str(error)
            continue
        pieces, file = scanned
        if file.broken:
            report.note(f"{path.name}: {file.broken} records are cut or unreadable")
        repeats = sum(channel.repeats for channel in file.channels)
        if repeats:
            report.note(f"{path.name}: {repeats} records are repeated; used once")
        yield from pieces


def _sort(
    found: Iterable[tuple[str, Piece]], station: Station, min_rate_hz: float, report: WaveformReport
) -> dict[str, Timeline]:
    """Pieces by channel of the station, the unusable ones set aside with a reason."""
    known = {channel.seed_id for channel in station.epochs}
    pieces: dict[str, list[Piece]] = {}
    for seed_id, piece in found:
        if match_channel(seed_id, known) is None:
            report.left_aside[seed_id] = f"not described for {station.code}"
        elif not _EARLIEST_NS < piece.start_ns < _LATEST_NS:
            report.left_aside[seed_id] = "dated outside 1900 to 2200"
        elif piece.rate < min_rate_hz * (1 - _RATE_TOLERANCE):
            report.left_aside[seed_id] = f"sampled at {piece.rate:g} Hz, below the {min_rate_hz:g} Hz needed"
        else:
            pieces.setdefault(seed_id, []).append(piece)
    serving = serving_ids(pieces, known)
    for own, seed_id in serving.items():
        if own != seed_id:
            report.note(f"{seed_id} taken for {own}")
    for seed_id in sorted(pieces.keys() - serving.values()):
        report.left_aside[seed_id] = f"not described for {station.code}"
    return {own: Timeline(pieces[serving[own]]) for own in sorted(serving)}


def match_channel(seed_id: str, known: set[str]) -> str | None:
    """The station's channel that `seed_id` stands for, forgiving a location code or an empty network code."""
    if seed_id in known:
        return seed_id
    network, station, _, channel = (seed_id.split(".") + [""] * 4)[:4]
    alike = [
        other
        for other in known
        if other.split(".")[1] == station
        and other.split(".")[3] == channel
        and network in ("", other.split(".")[0])
    ]
    return alike[0] if len(alike) == 1 else None


def serving_ids(found: Iterable[str], known: set[str]) -> dict[str, str]:
    """Which of the SEED ids found serves as each of the station's channels: its own, else the first alike.

    Two locations are two sensors: they are never mixed.
    """
    serving: dict[str, str] = {}
    for seed_id in sorted(found, key=lambda seed_id: (seed_id not in known, seed_id)):
        own = match_channel(seed_id, known)
        if own is not None:
            serving.setdefault(own, seed_id)
    return serving


def _nothing(what: str, station: Station, report: WaveformReport, span: str) -> str:
    reasons: dict[str, list[str]] = {}
    for path, reason in report.ignored.items():
        reasons.setdefault(reason, []).append(Path(path).name)
    found = [f"{_some(names)}: {reason}" for reason, names in reasons.items()]
    found += [f"{seed_id} {reason}" for seed_id, reason in list(report.left_aside.items())[:4]]
    channels = ", ".join(sorted({channel.seed_id for channel in station.epochs})[:8])
    inside = "; ".join(found) or (
        "no samples" if report.files else f"no files {span}".removesuffix(" at all")
    )
    return f"no usable waveforms of {station.code} in {what or 'no path'} (found {inside}); wanted {channels}"


def _some(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} files such as {names[0]}"


def _describe(timeline: Timeline) -> ChannelReport:
    """Summary of a timeline; overlaps are compared sample by sample over their first minute."""
    return ChannelReport(
        round(timeline.runs[0].rate, 6),
        _iso(timeline.begin_ns),
        _iso(timeline.end_ns),
        gaps=len(timeline.runs) - 1,
        gap_s=round(timeline.gap_s, 3),
        overlaps=len(timeline.overlaps),
        conflicting_overlaps=sum(_conflicts(timeline, o) for o in timeline.overlaps[:_CHECKED_OVERLAPS]),
    )


def _conflicts(timeline: Timeline, overlap: Overlap) -> bool:
    """Whether the samples that were not used differ from those that were, over the first minute."""
    late = overlap.late
    for run in timeline.between(overlap.begin_ns, overlap.end_ns):
        position = int(run.nearest(np.array([late.begin_ns]))[0])
        if 0 <= position < run.length:
            wanted = int(float(late.index(overlap.end_ns))) - late.first
            count = max(min(wanted, run.length - position, int(_CHECKED_S * late.rate)), 0)
            used = run.read(position, position + count)
            return not np.array_equal(used, late.read(late.first, late.first + count))
    return False
