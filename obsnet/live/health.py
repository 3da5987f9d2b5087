"""Packets and rows as they come in; out, whether the station is well, in plain values."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
import pandas as pd

from obsnet.layout import iso


class Health:
    """What a station remembers of its last hour, to say whether it is well."""

    def __init__(self, silence_s: float) -> None:
        self.trouble = ""
        self._silence_s = silence_s
        self._heard: float | None = None
        self._heard_wall: float | None = None
        self._began = time.monotonic()
        self._coverage: deque[float] = deque(maxlen=60)
        self.last_minute: str | None = None
        self.minute_delay_s: float | None = None

    def heard(self) -> None:
        """A packet has come."""
        self._heard, self._heard_wall = time.monotonic(), time.time()

    def minute(self, rows: pd.DataFrame) -> None:
        """Minutes have been said."""
        self._coverage.extend(rows["coverage"].to_numpy(float)[-60:])
        self.last_minute = str(rows["time"].iloc[-1])
        if self._heard is not None:
            self.minute_delay_s = time.monotonic() - self._heard

    @property
    def silent_s(self) -> float:
        """Seconds since the last packet, or since the start."""
        return time.monotonic() - (self._began if self._heard is None else self._heard)

    def said(self, head_ns: int | None, source_trouble: str) -> dict[str, Any]:
        """Health in plain values; `trouble` is empty while all is well."""
        silent = self.silent_s > self._silence_s
        trouble = self.trouble or source_trouble or (f"no packet for {self.silent_s:.0f} s" if silent else "")
        return {
            "healthy": not trouble,
            "trouble": trouble,
            "last_packet": None if self._heard_wall is None else iso(round(self._heard_wall)),
            "silent_s": round(self.silent_s, 1),
            "data_latency_s": None if head_ns is None else round(time.time() - head_ns / 1e9, 1),
            "last_minute": self.last_minute,
            "minute_delay_s": None if self.minute_delay_s is None else round(self.minute_delay_s, 3),
            "coverage_last_hour": round(float(np.mean(self._coverage)), 3) if self._coverage else None,
        }
