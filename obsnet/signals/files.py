"""Paths in, waveform files out; and pieces of waveform from a file in any format that obspy reads.

Python pickles, which obspy would recognise and which can run code, are never opened.
"""

from __future__ import annotations

import glob
import re
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import obspy
from obspy.core.util.base import ENTRY_POINTS
from obspy.core.util.decorator import uncompress_file
from obspy.core.util.misc import buffered_load_entry_point

from obsnet.console import patiently
from obsnet.errors import WaveformError
from obsnet.signals.station import Station
from obsnet.signals.timeline import Piece

_DAY_NS = 86_400_000_000_000
_OTHER_SUFFIXES = frozenset(
    {".xml", ".csv", ".json", ".geojson", ".nc", ".png", ".pdf", ".svg", ".html", ".md", ".yaml", ".yml"}
    | {".toml", ".onnx", ".zst", ".pickle", ".pkl"}
)
_SDS_FILE = re.compile(r"^([^.]+)\.([^.]+)\.([^.]*)\.([^.]+)\.[A-Z]\.(\d{4})\.(\d{3})$")


def list_files(
    paths: list[str | Path], station: Station, begin: int | None, end: int | None
) -> Iterator[Path]:
    """Every file once, in order; in an SDS archive only the station's days."""
    seen: set[Path] = set()
    for item in paths:
        path = Path(item)
        if path.is_dir():
            try:
                found = _list_folder(path, station, begin, end)
            except OSError as error:
                raise WaveformError(f"cannot read the folder {path}: {error.strerror}") from None
        elif path.exists():
            found = [path]
        else:
            found = [Path(match) for match in sorted(glob.glob(str(item), recursive=True))]
            found = [match for match in found if match.is_file()]
            if not found:
                raise WaveformError(f"there is no file, folder or archive {item}; check the path")
        for file in found:
            key = file.resolve()
            if key not in seen:
                seen.add(key)
                yield file


def _list_folder(folder: Path, station: Station, begin: int | None, end: int | None) -> list[Path]:
    network, _, name = station.code.partition(".")
    years = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and re.fullmatch(r"\d{4}", sub.name)]
    roots = [year / network / name for year in years if (year / network / name).is_dir()]
    if years and not roots:
        held = {
            f"{sub.parent.parent.name}.{sub.parent.name}" for year in years for sub in year.glob("*/*/*.D")
        }
        if held:
            found = ", ".join(sorted(held)[:8])
            raise WaveformError(f"the archive {folder} holds no waveforms of {station.code}; it has {found}")
    listed = []
    for root in roots or [folder]:
        for file in sorted(root.rglob("*")):
            hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
            other = hidden or file.suffix.lower() in _OTHER_SUFFIXES
            if not other and file.is_file() and _day_overlaps(file.name, begin, end):
                listed.append(file)
    return listed


def _day_overlaps(name: str, begin: int | None, end: int | None) -> bool:
    """Whether a file named as in an SDS archive may reach into the span, records spilling over midnight."""
    match = _SDS_FILE.match(name)
    if match is None:
        return True
    day = np.datetime64(match.group(5), "D") + int(match.group(6)) - 1
    midnight = int(day.astype("datetime64[ns]").astype(np.int64))
    return (begin is None or midnight + 2 * _DAY_NS > begin) and (end is None or midnight - _DAY_NS < end)


def archived_days(folder: Path, code: str) -> set[str]:
    """Dates (ISO text) for which an SDS archive holds a file of a station, from the files' names."""
    network, _, name = code.partition(".")
    dates = set()
    for path in folder.glob(f"[0-9][0-9][0-9][0-9]/{network}/{name}/*.D/*"):
        match = _SDS_FILE.match(path.name)
        if match is not None and (match.group(1), match.group(2)) == (network, name):
            dates.add(str(np.datetime64(match.group(5), "D") + int(match.group(6)) - 1))
    return dates


class FileReader:
    """Reads whole files through obspy, keeping the last few.

    Parameters
    ----------
    note : callable, optional
        Is told of files whose headers can be read but whose samples cannot; they are NaN.
    files : int
        Files to keep.
    """

    def __init__(self, note: Callable[[str], None] | None = None, files: int = 6) -> None:
        self._kept: OrderedDict[Path, Any] = OrderedDict()
        self._note, self._files = note, files

    def pieces(self, path: Path) -> Iterator[tuple[str, Piece]]:
        """SEED id and piece of every trace of a file, from its headers."""
        for number, trace in enumerate(_read_with_obspy(path, headonly=True)):
            if trace.stats.npts > 0 and trace.stats.sampling_rate > 0:
                yield trace.id, trace_piece(trace, partial(self._read, path, number))

    def _read(self, path: Path, number: int, first: int, last: int) -> np.ndarray:
        traces = self._traces(path)
        data = traces[number].data[first:last] if number < len(traces) else np.zeros(0)
        if data.size != last - first or data.dtype.kind not in "iuf":
            if self._note is not None:
                self._note(f"{path.name}: the samples cannot be read; they are missing")
            return np.full(last - first, np.nan, np.float32)
        return np.ma.filled(data.astype(np.float64), np.nan) if np.ma.isMaskedArray(data) else data

    def _traces(self, path: Path) -> Any:
        if path not in self._kept:
            try:
                self._kept[path] = _read_with_obspy(path, headonly=False)
            except (WaveformError, OSError):
                self._kept[path] = []
            while len(self._kept) > self._files:
                self._kept.popitem(last=False)
        self._kept.move_to_end(path)
        return self._kept[path]


def _read_with_obspy(path: Path, headonly: bool) -> Any:
    """Traces of a file in any format but pickle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            stream = _read_plain(str(path), headonly=headonly)
        except WaveformError:
            raise
        except Exception as error:  # every plugin raises its own errors on a damaged file
            detail = " ".join(str(error).split())[:100] or type(error).__name__
            raise WaveformError(f"cannot be read ({detail})") from None
    return stream


@uncompress_file
def _read_plain(path: str, headonly: bool) -> Any:
    for name, entry in ENTRY_POINTS["waveform"].items():
        if name == "PICKLE":
            continue
        recognises = buffered_load_entry_point(entry.dist.name, f"obspy.plugin.waveform.{name}", "isFormat")
        if recognises(path):
            with patiently():
                return obspy.read(path, format=name, headonly=headonly, check_compression=False)
    raise WaveformError("no format that obspy reads")


def trace_piece(trace: Any, read: Callable[[int, int], np.ndarray]) -> Piece:
    """Piece of an obspy Trace whose samples `read` gives."""
    return Piece(read, int(trace.stats.starttime.ns), int(trace.stats.npts), float(trace.stats.sampling_rate))
