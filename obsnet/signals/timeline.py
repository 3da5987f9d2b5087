"""Pieces of waveform in, runs of continuous samples out, each sample with its own time.

A piece is what one file holds without a break. Pieces that join within half a sample make a run; a later
piece that overlaps an earlier one gives way. Nothing is resampled: a sample's time is that of its piece or
record, so that neither a start off the sampling grid nor a clock that runs at 49.9987 Hz shifts anything
downstream.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

_SECOND = 1_000_000_000
JOIN_SAMPLES = 0.5 + 1e-6


@dataclass(frozen=True, eq=False)
class Piece:
    """Unbroken samples of one channel.

    Attributes
    ----------
    read : callable
        `read(first, last)` gives the samples of that index range.
    start_ns : int
        Time of sample 0, ns since 1970.
    count : int
        Number of samples.
    rate : float
        True sampling rate, Hz.
    knots : tuple of two arrays, optional
        Sample indices and their times in s after the start, where records follow a clock that no single
        rate describes.
    first, last : int
        The samples kept, when overlaps with other pieces are cut off; `last` is exclusive, -1 for all.
    """

    read: Callable[[int, int], np.ndarray]
    start_ns: int
    count: int
    rate: float
    knots: tuple[np.ndarray, np.ndarray] | None = None
    first: int = 0
    last: int = -1

    def __post_init__(self) -> None:
        if self.last < 0:
            object.__setattr__(self, "last", self.count)

    def seconds(self, index: np.ndarray | float) -> np.ndarray:
        """Time of (fractional) samples, s after the start."""
        index = np.asarray(index, float)
        if self.knots is None:
            return index / self.rate
        at, times = self.knots
        inside = np.interp(index, at, times)
        return inside + (np.minimum(index - at[0], 0) + np.maximum(index - at[-1], 0)) / self.rate

    def index(self, time_ns: np.ndarray | int) -> np.ndarray:
        """Fractional sample at a time, ns since 1970."""
        seconds = (np.asarray(time_ns) - self.start_ns) / _SECOND
        if self.knots is None:
            return seconds * self.rate
        at, times = self.knots
        inside = np.interp(seconds, times, at)
        return inside + (np.minimum(seconds - times[0], 0) + np.maximum(seconds - times[-1], 0)) * self.rate

    def time_ns(self, index: int) -> int:
        """Time of a sample, ns since 1970."""
        return self.start_ns + round(float(self.seconds(index)) * _SECOND)

    @property
    def begin_ns(self) -> int:
        """Time of the first sample kept."""
        return self.time_ns(self.first)

    @property
    def end_ns(self) -> int:
        """One sample after the last one kept."""
        return self.time_ns(self.last)


class Run:
    """Pieces that follow each other without a break; samples are counted from 0 through all of them."""

    def __init__(self, pieces: list[Piece]) -> None:
        self.pieces = pieces
        self.offsets = np.cumsum([0, *(piece.last - piece.first for piece in pieces)])
        self.length = int(self.offsets[-1])
        self.rate = pieces[0].rate
        self.begin_ns, self.end_ns = pieces[0].begin_ns, pieces[-1].end_ns
        self._begins = np.array([piece.begin_ns for piece in pieces])

    def nearest(self, times_ns: np.ndarray) -> np.ndarray:
        """Position of the sample nearest to each time; outside the run, negative or at least its length."""
        owner = np.searchsorted(self._begins - round(0.5 / self.rate * _SECOND), times_ns, "right") - 1
        owner = np.clip(owner, 0, len(self.pieces) - 1)
        position = np.empty(times_ns.size, np.int64)
        for j in np.unique(owner):
            piece, mine = self.pieces[j], owner == j
            index = np.rint(piece.index(times_ns[mine])).astype(np.int64)
            position[mine] = self.offsets[j] + index - piece.first
        return position

    def delay(self, position: np.ndarray, times_ns: np.ndarray) -> np.ndarray:
        """How long after `times_ns` the samples at `position` were taken, s."""
        owner = np.clip(np.searchsorted(self.offsets, position, "right") - 1, 0, len(self.pieces) - 1)
        late = np.empty(position.size)
        for j in np.unique(owner):
            piece, mine = self.pieces[j], owner == j
            seconds = piece.seconds(position[mine] - self.offsets[j] + piece.first)
            late[mine] = seconds - (times_ns[mine] - piece.start_ns) / _SECOND
        return late

    def read(self, first: int, last: int) -> np.ndarray:
        """Samples at positions `first` to `last` (exclusive), in the type they were recorded in."""
        parts = []
        j = max(bisect.bisect_right(self.offsets, first) - 1, 0)
        while j < len(self.pieces) and self.offsets[j] < last:
            piece, offset = self.pieces[j], int(self.offsets[j])
            begin = max(first - offset, 0) + piece.first
            end = min(last - offset, piece.last - piece.first) + piece.first
            parts.append(piece.read(begin, end))
            j += 1
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True)
class Overlap:
    """A stretch of time that two pieces cover; the samples of `late` are not used there."""

    late: Piece
    begin_ns: int
    end_ns: int


class Timeline:
    """All runs of one channel, in order of time.

    Parameters
    ----------
    pieces : iterable of Piece
        In any order, overlapping or not.

    Attributes
    ----------
    runs : list of Run
    overlaps : list of Overlap
        What was cut off: of two pieces that cover the same time, the one that starts first (the longer, if
        both start together) is kept.
    """

    def __init__(self, pieces: Iterable[Piece]) -> None:
        runs: list[list[Piece]] = []
        self.overlaps: list[Overlap] = []
        covered = -(2**62)
        for piece in sorted(pieces, key=lambda p: (p.begin_ns, p.first - p.last)):
            kept = self._cut(piece, covered)
            if kept is None:
                continue
            last = runs[-1][-1] if runs else None
            joins = abs(kept.begin_ns - covered) / _SECOND * kept.rate <= JOIN_SAMPLES
            if last is not None and joins and math.isclose(last.rate, kept.rate, rel_tol=1e-3):
                runs[-1].append(kept)
            else:
                runs.append([kept])
            covered = kept.end_ns
        self.runs = [Run(run) for run in runs]

    def _cut(self, piece: Piece, covered: int) -> Piece | None:
        """The part of `piece` after what is covered already."""
        first = (
            max(piece.first, math.ceil(float(piece.index(covered)) - JOIN_SAMPLES))
            if covered > piece.begin_ns
            else piece.first
        )
        if first > piece.first:
            self.overlaps.append(Overlap(piece, piece.begin_ns, min(covered, piece.end_ns)))
        return replace(piece, first=first) if first < piece.last else None

    @property
    def begin_ns(self) -> int:
        """Time of the first sample."""
        return self.runs[0].begin_ns

    @property
    def end_ns(self) -> int:
        """One sample after the last."""
        return max(run.end_ns for run in self.runs)

    @property
    def gap_s(self) -> float:
        """Seconds without samples between the first and the last."""
        return self.missing_s(self.begin_ns, self.end_ns)

    def missing_s(self, begin_ns: int, end_ns: int) -> float:
        """Seconds without samples in a span of time."""
        runs = self.between(begin_ns, end_ns)
        held = sum(min(run.end_ns, end_ns) - max(run.begin_ns, begin_ns) for run in runs)
        return max(end_ns - begin_ns - held, 0) / _SECOND

    def between(self, begin_ns: int, end_ns: int) -> list[Run]:
        """The runs that touch a span of time."""
        low = bisect.bisect_right([run.end_ns for run in self.runs], begin_ns)
        high = bisect.bisect_left([run.begin_ns for run in self.runs], end_ns)
        return self.runs[low:high]
