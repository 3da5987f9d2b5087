"""Bytes of miniSEED (2 or 3) in, packets of samples out; what is no record is skipped and counted."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

_SECOND = 1_000_000_000
_RECORD = re.compile(rb"[0-9 \x00]{6}[DRQM][ \x00]|MS\x03")
_MIN_BYTES, _MAX_BYTES = 64, 1 << 20


@dataclass(frozen=True, eq=False)
class Packet:
    """Consecutive samples of one channel: SEED id, time of the first sample [ns since 1970], rate [Hz]."""

    seed_id: str
    start_ns: int
    rate: float
    samples: np.ndarray

    @property
    def end_ns(self) -> int:
        """One sample after the last."""
        return self.start_ns + round(len(self.samples) / self.rate * _SECOND)

    def after(self, time_ns: int) -> Packet | None:
        """The part from a time on; nothing where there is none."""
        first = int(np.ceil((time_ns - self.start_ns) / _SECOND * self.rate - 1e-6))
        if first <= 0:
            return self
        if first >= len(self.samples):
            return None
        start = self.start_ns + round(first / self.rate * _SECOND)
        return Packet(self.seed_id, start, self.rate, self.samples[first:])


def packet_of(record: bytes) -> Packet | None:
    """The packet in one miniSEED record; None where it holds no samples or does not decode."""
    import pymseed

    try:
        parsed = pymseed.MS3Record.parse(record, unpack_data=True)
        if parsed.numsamples == 0 or parsed.sampletype not in ("i", "f", "d") or not parsed.samprate > 0:
            return None
        network, station, location, channel = pymseed.sourceid2nslc(parsed.sourceid)
        samples = np.array(parsed.np_datasamples)
    except (pymseed.PymseedError, ValueError, BufferError):
        return None
    return Packet(
        f"{network}.{station}.{location}.{channel}", int(parsed.starttime), float(parsed.samprate), samples
    )


class RecordStream:
    """Cuts a stream of bytes into miniSEED records, wherever the bytes are cut.

    Attributes
    ----------
    garbage : bytes, or records, that could not be used.
    """

    def __init__(self) -> None:
        self._held = b""
        self.garbage = 0

    def push(self, data: bytes) -> list[Packet]:
        """The packets that `data` completes."""
        held = self._held + data
        found, position = [], 0
        while len(held) - position >= _MIN_BYTES:
            length = _length(held, position)
            if length is None or length > _MAX_BYTES:
                position = self._skip(held, position)
                continue
            if length == 0 or position + length > len(held):
                break
            packet = packet_of(held[position : position + length])
            if packet is None:
                self.garbage += 1
            else:
                found.append(packet)
            position += length
        self._held = held[position:]
        if len(self._held) > _MAX_BYTES:
            self.garbage += len(self._held)
            self._held = b""
        return found

    def _skip(self, held: bytes, position: int) -> int:
        """Where the next record may begin."""
        following = _RECORD.search(held, position + 1)
        end = following.start() if following else max(len(held) - 8, position + 1)
        self.garbage += end - position
        return end


def _length(held: bytes, position: int) -> int | None:
    """Length of the record that begins at a position; 0 where more is needed to tell, None where there is none."""
    from pymseed.clib import buffer_pointer, clibmseed, ffi

    if not _RECORD.match(held, position):
        return None
    head: Any = held[position : position + 8192]
    version = ffi.new("uint8_t *")
    pointer = buffer_pointer(head)
    length = int(clibmseed.ms3_detect(pointer, len(pointer), version))
    return None if length < 0 else length
