"""A SeedLink server in, packets out: protocol 3 or 4, whichever the server speaks better, for months.

The client of EarthScope (`seedlink-client`) speaks both protocols; obspy's speaks 3 alone. Reconnecting is done here:
each attempt waits longer than the one before, by chance, and goes on after the last sequence number. Where the samples
do not go on (the server has begun to count anew) what it still holds is asked for by time.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from obsnet.live.buffer import LONGEST_NS
from obsnet.live.config import LiveConfig
from obsnet.live.packets import Packet, packet_of
from obsnet.live.sources import Queued

_SECOND = 1_000_000_000
_GAP_NS = 2 * _SECOND
_GARBAGE = ("Payload", "Could not determine", "Unexpected data", "Invalid v3", "Unrecognized", "Declared")
_V3_NUMBERS = 1 << 24
_MOST_SKIPPED = 1000


class SeedLinkServer(Queued):
    """Packets of one station from a SeedLink server.

    Parameters
    ----------
    host, port : the server.
    code : NET.STA.
    live : LiveConfig; `selectors`, `connect_s`, `silence_s`, `keepalive_s`, `retry_s` and `retry_max_s` serve here.
    position : `sequence` and `newest` (ns since 1970, by SEED id) of the packets that are stored.
    """

    def __init__(self, host: str, port: int, code: str, live: LiveConfig, position: dict[str, Any]) -> None:
        super().__init__(f"seedlink://{host}:{port}/{code}")
        self._address, self._code, self._live = (host, port), code.replace(".", "_"), live
        self._sequence: int | None = position.get("sequence")
        self._newest: dict[str, int] = dict(position.get("newest", {}))
        self.position = {"sequence": self._sequence, "newest": dict(self._newest)}
        self.counts = {"connections": 0, "failures": 0, "garbage": 0, "renumbered": 0}
        self._skipped = 0
        self._since_ns: int | None = None

    def _run(self) -> None:
        wait = self._live.retry_s
        while not self._stop.is_set():
            received = self._session()
            if self._since_ns is not None and received:
                continue
            wait = self._live.retry_s if received else min(2 * wait, self._live.retry_max_s)
            self._stop.wait(wait * random.uniform(0.5, 1.5))

    def _session(self) -> int:
        """Connect, and take packets until the connection ends; how many."""
        from seedlink_client import SeedLink, SeedLinkError

        client = SeedLink(
            *self._address,
            timeout=self._live.connect_s,
            keepalive=self._live.keepalive_s or None,
            idle_timeout=self._live.silence_s,
            clientname="obsnet",
        )
        received = 0
        try:
            client.connect()
            self._select(client)
            self.counts["connections"] += 1
            for packet in self._received(client):
                received += 1
                self._skipped, self.trouble = 0, ""
                self._put((packet, {"sequence": self._sequence, "newest": dict(self._newest)}))
            if not self._stop.is_set() and self._since_ns is None:
                self.trouble = "the server ended the connection"
        except (SeedLinkError, OSError, ValueError) as error:
            self._failed(error)
        finally:
            client.close()
        return received

    def _failed(self, error: Exception) -> None:
        """Remember why a connection ended; step over a packet that cannot be read."""
        self.counts["failures"] += 1
        self.trouble = " ".join(str(error).split())[:200] or type(error).__name__
        if any(self.trouble.startswith(word) for word in _GARBAGE):
            self.counts["garbage"] += 1
            self._skipped = min(self._skipped + 1, _MOST_SKIPPED)

    def _select(self, client: Any) -> None:
        """Ask for the station's packets after the last one, or since a time."""
        selectors = self._live.selectors or None
        if self._since_ns is not None:
            client.add_stream(self._code, selectors)
            client.set_timewindow(datetime.fromtimestamp(self._since_ns // _SECOND, UTC))
        elif self._sequence is None:
            client.add_stream(self._code, selectors)
        else:
            last = self._sequence + self._skipped
            if client.protocol.name == "V3":
                last %= _V3_NUMBERS
                last = -1 if last == _V3_NUMBERS - 1 else last  # the client asks for the number after it
            client.add_stream(self._code, selectors, seqnum=last)

    def _received(self, client: Any) -> Iterator[Packet]:
        """Packets of a connection; it ends early where the samples do not go on, to ask for them by time."""
        by_time, self._since_ns = self._since_ns is not None, None
        fresh: set[str] = set()
        for item in client.collect(reconnect=False):
            if self._stop.is_set():
                return
            packet = packet_of(item.payload)
            if packet is None:
                self.counts["garbage"] += 1
                self._sequence = item.seqnum if item.seqnum is not None else self._sequence
                continue
            newest = self._newest.get(packet.seed_id)
            first = packet.seed_id not in fresh
            fresh.add(packet.seed_id)
            if first and not by_time and newest is not None and packet.start_ns > newest + _GAP_NS:
                heard = self._heard_until(packet.start_ns)
                if newest in heard:
                    self.counts["renumbered"] += 1
                    self._since_ns = min(heard)
                    return
            self._sequence = item.seqnum if item.seqnum is not None else self._sequence
            if len(self._newest) < 1000:
                self._newest[packet.seed_id] = max(packet.end_ns, newest or 0)
            yield packet

    def _heard_until(self, before_ns: int) -> list[int]:
        """Newest samples before a time of the channels that are alive: what others lack nobody can use any more."""
        newest = [end for end in self._newest.values() if end < before_ns]
        reach = round(self._live.latency_s * _SECOND) + LONGEST_NS
        return [end for end in newest if end >= max(newest) - reach]
