"""Packets in, in any order within the latency; out, the frames whose samples are all there that will come.

Only the data's own time counts: neither the wall clock nor the order or the size of packets changes a frame. A frame is
ready when every channel of the station holds its samples, or when the newest sample of any channel lies `latency_s`
beyond it, and as long again as the longest packet: a packet cannot come before its last sample. What comes later than
that is not used, and counted.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from obsnet.layout import iso
from obsnet.live.config import LiveConfig
from obsnet.live.packets import Packet
from obsnet.signals.records import ChannelRecords, piece_of, stretches
from obsnet.signals.spectra import SILENCE_NS, SpectraConfig
from obsnet.signals.station import Station
from obsnet.signals.timeline import JOIN_SAMPLES, Piece, Timeline
from obsnet.signals.waveforms import ChannelReport, WaveformReport, match_channel, serving_ids

_SECOND = 1_000_000_000
_EARLIEST_NS, _LATEST_NS = 0, 7_258_118_400 * _SECOND
_RATE_TOLERANCE = 1e-3
_DAY_NS = 86400 * _SECOND
LONGEST_NS = 600 * _SECOND
"""Longest packet that is reckoned with in what is late; ns."""
MOST_PACKETS = 20_000
"""Packets of one channel that wait for the station's clock; more can only be nonsense."""

_TABLE = np.dtype([("start_ns", "i8"), ("count", "i4"), ("rate", "f8")])


class WaveformBuffer:
    """The waveforms that a live station still needs; a source of waveforms for `SpectraBuilder`.

    Parameters
    ----------
    station : Station
    spectra : SpectraConfig
    live : LiveConfig

    Attributes
    ----------
    begin_ns : samples before this belong to the record before; ns since 1970.
    longest_ns : length of the longest packet, ten minutes at most.
    next_frame : first frame that is not taken yet, in hops since 1970; None until the station's first.
    head_ns, newest : newest sample that the station believes in, of any channel and of each; ns since 1970.
    timelines : of every channel seen, by SEED id.
    heard_ids : SEED ids that usable packets had.
    counts : packets by what became of them: used, repeated, late, unknown, slow, empty, ahead.
    """

    def __init__(self, station: Station, spectra: SpectraConfig, live: LiveConfig) -> None:
        self.station, self.spectra, self.live = station, spectra, live
        self.report = WaveformReport()
        self.timelines: dict[str, Timeline] = {}
        self.counts: Counter[str] = Counter()
        self.newest: dict[str, int] = {}
        self.begin_ns: int | None = None
        self.head_ns: int | None = None
        self.next_frame: int | None = None
        self.covered_ns: int | None = None
        self.heard_ids: set[str] = set()
        self._known = {channel.seed_id for channel in station.epochs}
        self._packets: dict[str, list[Packet]] = {}
        self._starts: dict[str, list[int]] = {}
        self._ahead: dict[str, tuple[int, int]] = {}
        self.longest_ns = 0
        self._margin_ns = 2 * round(spectra.dead_s * _SECOND)

    @property
    def seen(self) -> list[str]:
        """SEED ids of the channels that have come."""
        return sorted(self.timelines)

    @property
    def floor_ns(self) -> int | None:
        """Samples before this were needed by frames that are taken already."""
        if self.next_frame is None:
            return self.begin_ns
        return (self.next_frame - 1) * self.spectra.hop_ns + self.spectra.window_ns + self._margin_ns

    def station_at(self, time_ns: int) -> Station:
        """The station with the channels that have come and have an epoch at a time."""
        return self.station.at(time_ns / _SECOND, self.timelines.keys())

    def add(self, packet: Packet) -> Packet | None:
        """Take a packet; the part of it that is kept, None where none is."""
        kept, fate = self._judge(packet)
        self.counts[fate] += 1
        if kept is None:
            return None
        starts = self._starts.setdefault(kept.seed_id, [])
        place = bisect.bisect(starts, kept.start_ns)
        starts.insert(place, kept.start_ns)
        self._packets.setdefault(kept.seed_id, []).insert(place, kept)
        if kept.seed_id not in self.timelines:
            self.timelines[kept.seed_id] = Timeline([])
            self.report.channels[kept.seed_id] = ChannelReport(kept.rate, iso(kept.start_ns / 1e9), "")
        self.longest_ns = max(self.longest_ns, min(kept.end_ns - kept.start_ns, LONGEST_NS))
        self._advance_clock(kept)
        return kept

    def _judge(self, packet: Packet) -> tuple[Packet | None, str]:
        own = match_channel(packet.seed_id, self._known)
        if own is None or serving_ids({*self.heard_ids, packet.seed_id}, self._known)[own] != packet.seed_id:
            self.report.left_aside.setdefault(packet.seed_id[:20], "not described")
            return None, "unknown"
        if not (len(packet.samples) and packet.samples.dtype.kind in "iuf" and math.isfinite(packet.rate)):
            return None, "empty"
        if packet.rate < self.spectra.analysis_rate_hz * (1 - _RATE_TOLERANCE):
            self.report.left_aside.setdefault(own, f"sampled at {packet.rate:g} Hz")
            return None, "slow"
        if not (packet.start_ns > _EARLIEST_NS and packet.end_ns < _LATEST_NS):
            return None, "empty"
        self._hear(packet.seed_id, own)
        floor = self.floor_ns
        kept = packet if floor is None or packet.start_ns >= floor else packet.after(floor)
        if kept is None:
            return None, "late"
        held = self._starts.get(own, [])
        place = bisect.bisect_right(held, kept.start_ns)
        if place and self._packets[own][place - 1].end_ns >= kept.end_ns:
            return None, "repeated"
        if len(held) >= MOST_PACKETS:
            return None, "ahead"
        return replace(kept, seed_id=own), "used"

    def _hear(self, seed_id: str, own: str) -> None:
        """Drop what still waits of another sensor that was taken for the channel until now."""
        if seed_id not in self.heard_ids and own in serving_ids(self.heard_ids, self._known):
            self._packets[own], self._starts[own] = [], []
        self.heard_ids.add(seed_id)

    def _advance_clock(self, packet: Packet) -> None:
        """Believe a packet's time if it goes on from the others', or once its channel keeps to it."""
        end = packet.end_ns
        jump, confirm = (round(s * _SECOND) for s in (self.live.jump_s, self.live.confirm_s))
        if self.head_ns is not None and packet.start_ns > self.head_ns + jump:
            begun, until = self._ahead.get(packet.seed_id, (packet.start_ns, packet.start_ns))
            if not begun - _SECOND <= packet.start_ns <= until + _SECOND:
                begun, until = packet.start_ns, packet.start_ns
            until = max(until, end)
            self._ahead[packet.seed_id] = (begun, until)
            if until - begun < confirm:
                return
            end = until
        elif self.head_ns is None:
            # the first packet of all may be the wrong one: the clock begins when a channel has gone on
            begun, until = self._ahead.get(packet.seed_id, (packet.start_ns, packet.start_ns))
            if not begun - jump <= packet.start_ns <= until + jump:
                begun, until = packet.start_ns, packet.start_ns
            self._ahead[packet.seed_id] = begun, until = min(begun, packet.start_ns), max(until, end)
            if until - begun < confirm:
                return
            end = until
        self._ahead.pop(packet.seed_id, None)
        self.head_ns = max(self.head_ns or 0, end)
        self.newest[packet.seed_id] = max(self.newest.get(packet.seed_id, 0), end)

    def believe_all(self) -> None:
        """Let the clock reach the newest packet of all that lies within a day of it: nothing more will come."""
        ends = sorted(packet.end_ns for packets in self._packets.values() for packet in packets)
        for end in ends:
            if self.head_ns is None or end - self.head_ns <= _DAY_NS:
                self.head_ns = max(self.head_ns or 0, end)

    def ready(self, ended: bool = False) -> list[tuple[int, int]]:
        """Ranges of frames (first, one past the last) that can be taken now; all there are when the waveforms have `ended`.

        Between two ranges lies a silence that is too long to have rows.
        """
        if self.head_ns is None:
            return []
        hop, window = self.spectra.hop_ns, self.spectra.window_ns
        half = round(0.5 / self.spectra.analysis_rate_hz * _SECOND)
        latency = round(self.live.latency_s * _SECOND) + self.longest_ns
        if self.next_frame is None:
            begin = self._first_ns(self.head_ns)
            if not ended and self.head_ns - begin < latency + window:
                return []
            self.next_frame = -(-(begin - half) // hop)
            self.covered_ns = begin
        if ended:
            last = (self.head_ns + half - window) // hop + 1
        else:
            settled = max(self.head_ns - latency, self._complete_ns())
            last = (settled - self._margin_ns - window) // hop + 1
        return self._ranges(self.next_frame, last, half)

    def _ranges(self, first: int, last: int, half_ns: int) -> list[tuple[int, int]]:
        """Frames from `first` up to `last` within the data, to half a sample; shorter silences are data."""
        assert self.head_ns is not None and self.covered_ns is not None
        hop, window = self.spectra.hop_ns, self.spectra.window_ns
        ranges, until = [], self.covered_ns
        spans = ((p.start_ns, p.end_ns) for packets in self._packets.values() for p in packets)
        for start, end in sorted(span for span in spans if span[0] <= self.head_ns):
            if start - until > SILENCE_NS:
                self.report.note(f"nothing from {iso(until / 1e9)} to {iso(start / 1e9)}: passed over")
                ranges.append((first, min(last, (until + half_ns - window) // hop + 1)))
                first = max(first, -(-(start - half_ns) // hop))
            until = max(until, end)
        return [(begin, end) for begin, end in (*ranges, (first, last)) if begin < end]

    def _first_ns(self, head_ns: int) -> int:
        """Start of the waveforms that lead to the station's clock: a packet dated days before them is nonsense."""
        first = head_ns
        for start in sorted(
            (s for starts in self._starts.values() for s in starts if s < head_ns), reverse=True
        ):
            if first - start > _DAY_NS:
                break
            first = start
        return first

    def _complete_ns(self) -> int:
        """Time up to which every channel of the station holds all samples."""
        assert self.next_frame is not None
        begin = self.next_frame * self.spectra.hop_ns
        expected = {c.seed_id for c in self.station.at(begin / _SECOND).channels} | {
            c.seed_id for c in self.station_at(begin).channels
        }
        return min((self._complete_until(seed_id, begin) for seed_id in expected), default=begin)

    def _complete_until(self, seed_id: str, begin: int) -> int:
        until = begin
        for packet in self._packets.get(seed_id, []):
            if packet.start_ns > until + round(JOIN_SAMPLES / packet.rate * _SECOND):
                break
            until = max(until, packet.end_ns)
        return until

    def take(self, last: int) -> None:
        """Lay out the timelines for the frames up to `last` and count these as taken."""
        for seed_id, packets in self._packets.items():
            self.timelines[seed_id] = Timeline(_pieces(seed_id, packets))
        self.next_frame = last

    @property
    def needed_ns(self) -> int:
        """Packets that end before this are not needed any more."""
        return (self.next_frame or 0) * self.spectra.hop_ns - self._margin_ns - _SECOND

    def position(self) -> dict[str, Any]:
        """Where the station is, in plain values; its packets are stored apart."""
        return {
            "begin_ns": self.begin_ns,
            "next_frame": self.next_frame,
            "head_ns": self.head_ns,
            "covered_ns": self.covered_ns,
            "longest_ns": self.longest_ns,
            "newest": self.newest,
            "heard_ids": sorted(self.heard_ids),
            "counts": dict(self.counts),
        }

    def begin_after(self, position: dict[str, Any]) -> None:
        """Begin a record where another one's `position` was; nothing has been added yet."""
        self.begin_ns, self.next_frame = position.get("begin_ns"), position["next_frame"]
        self.begin_ns, self.next_frame = self.floor_ns, None

    def take_up(self, packets: Iterable[Packet], position: dict[str, Any]) -> None:
        """Add packets that were kept, which bear their channels' ids whatever they came with."""
        for packet in packets:
            self.add(packet)
        self.heard_ids = set(position.get("heard_ids", ()))

    def restore(self, frame: int, channels: list[str], position: dict[str, Any]) -> None:
        """Go on from a frame, `channels` having served up to it and the packets kept since then having been added."""
        self.next_frame = frame
        for name in ("head_ns", "covered_ns", "longest_ns"):
            setattr(self, name, position[name])
        self.newest, self.counts = dict(position["newest"]), Counter(position["counts"])
        self.timelines = {seed_id: Timeline([]) for seed_id in channels}
        for seed_id in channels:
            self.report.channels.setdefault(seed_id, ChannelReport(0.0, "", ""))

    def forget(self) -> None:
        """Drop the packets that no later frame needs."""
        before = self.needed_ns
        for seed_id, packets in self._packets.items():
            while packets and packets[0].end_ns < before:
                self.covered_ns = max(self.covered_ns or 0, packets.pop(0).end_ns)
                del self._starts[seed_id][0]


def _pieces(seed_id: str, packets: list[Packet]) -> list[Piece]:
    """Unbroken stretches of packets, laid out as those of a file."""
    if not packets:
        return []
    table = np.array([(p.start_ns, len(p.samples), p.rate) for p in packets], _TABLE)
    before = np.concatenate([[0], np.cumsum(table["count"], dtype=np.int64)])
    records = ChannelRecords(seed_id, table, before, 0)
    return [
        piece_of(
            records, first, last, partial(_read, packets[first:last], before[first:last] - before[first])
        )
        for first, last in stretches(table)
    ]


def _read(packets: list[Packet], before: np.ndarray, first: int, last: int) -> np.ndarray:
    low = int(np.searchsorted(before, first, "right")) - 1
    high = int(np.searchsorted(before, last, "left"))
    samples = np.concatenate([packet.samples for packet in packets[low:high]])
    return samples[first - int(before[low]) : last - int(before[low])]
