"""A source of packets in; rows, estimates and tracks out, each committed with the state that it leaves behind."""

from __future__ import annotations

import random
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import obsnet
from obsnet import strips
from obsnet.config import build, to_dict
from obsnet.console import counted
from obsnet.errors import ObsnetError, OutputError
from obsnet.layout import iso, to_posix
from obsnet.live.buffer import WaveformBuffer
from obsnet.live.config import WatchConfig
from obsnet.live.files import Files, rounded
from obsnet.live.fingerprint import fingerprint
from obsnet.live.health import Health
from obsnet.live.packets import Packet
from obsnet.live.ships import LiveEstimate, Ships
from obsnet.live.sources import Source
from obsnet.live.store import LIVE_COLUMNS, Store, plain_rows
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.pipeline import Minutes, Pipeline
from obsnet.signals.spectra import SpectraBuilder
from obsnet.signals.station import Station
from obsnet.tables import DETECTION_COLUMNS

_SECOND = 1_000_000_000
_FOREVER = 1 << 29
_REST_S = 5.0
_STATUS_S = 60.0
_BEHIND_S = 1800.0


class LiveStation:
    """A station that takes packets and survives: whatever it has said is stored with what it needs to go on.

    Parameters
    ----------
    station : Station
    config : WatchConfig
    folder : output folder.
    amplitudes, table : as for `Pipeline`.
    say : called with a line for people when something happens.

    Raises
    ------
    ObsnetError : the folder cannot be used, or station and configuration do not fit.
    """

    def __init__(
        self,
        station: Station,
        config: WatchConfig,
        folder: Path,
        amplitudes: Amplitudes | None = None,
        table: Any = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.station, self.config, self.folder, self._say = station, config, folder, say
        self._amplitudes = amplitudes
        self.pipeline = Pipeline(station, config, amplitudes, table)
        self.fingerprint = fingerprint(station, config, self.pipeline.models, self.pipeline.table, amplitudes)
        self.store = Store(folder)
        self.buffer = WaveformBuffer(station, config.spectra, config.live)
        self.ships = Ships(self.store, station, config, self.pipeline.table)
        self.estimate = LiveEstimate(station)
        self.files = Files(folder, self.store, station, self.ships)
        self.stopping = threading.Event()
        self.source: Source | None = None
        self.listeners: list[Callable[[dict[str, Any]], None]] = []
        self.health = Health(config.live.silence_s)
        self._builder: SpectraBuilder | None = None
        self._channels: list[str] = []
        self._pending: list[Packet] = []
        self._snapshot_frame: int | None = None
        self._rested = time.monotonic()
        self._late_since: float | None = None
        self._told = -np.inf
        try:
            self._restore()
            self._look()
        except (ObsnetError, AttributeError, LookupError, TypeError, ValueError) as error:
            self.store.close()
            if isinstance(error, ObsnetError):
                raise
            what = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise OutputError(
                f"cannot go on from what {self.store.path} holds ({what}); move a damaged file away"
            ) from None

    def run(self, source: Source, once: bool = False) -> None:
        """Take packets until the source ends or `stopping` is set; at the end of a record close it, if `once`."""
        self.source = source
        self.files.repair()
        self.tell()
        try:
            for batch in source.batches():
                self.take(batch, patient=not once)
                if self.stopping.is_set():
                    break
                if time.monotonic() - self._told > _STATUS_S:
                    self.tell()
            if once and not self.stopping.is_set():
                self.finish()
            elif self.buffer.next_frame is not None:
                self._lasting(self._snapshot, patient=False)
        finally:
            source.close()
            self.tell()

    def close(self) -> None:
        """Release the database."""
        self.store.close()

    def take(self, packets: list[Packet], patient: bool = True) -> None:
        """Take packets, and say what they finish."""
        late, held = self.buffer.counts["late"], len(self._pending)
        for packet in packets:
            kept = self.buffer.add(packet)
            if kept is not None:
                self._pending.append(kept)
        if len(self._pending) > held:
            self._late_since = None
        elif self.buffer.counts["late"] > late and self._late_since is None:
            self._late_since = time.monotonic()
        if packets:
            self.health.heard()
        ranges = self.buffer.ready()
        if ranges and ranges[-1][1] >= self._wanted():
            self._advance(ranges, patient)
        if self._pending:
            self._lasting(self._keep_pending, patient)
        if self._late_since is not None and time.monotonic() - self._late_since > _BEHIND_S:
            self.begin_anew("packets have been late for half an hour: the clock was set back", patient)

    def finish(self) -> None:
        """Say what is left when the record has ended; what a longer record would change is said again then."""
        self.buffer.believe_all()
        self._advance(self.buffer.ready(ended=True), patient=False)
        if self.buffer.next_frame is None:
            return
        self._lasting(self._snapshot, patient=False)
        for minutes in self.pipeline.flush():
            self._lasting(
                partial(self._keep_minutes, minutes, self.estimate.step(minutes.maps)), patient=False
            )
            self.files.append([str(t) for t in rounded(minutes.detections)["time"]])
        ((last_track,),) = self.store.rows("SELECT coalesce(max(track), 0) FROM tracks")
        closed = self.store.noted("closed")
        self._lasting(lambda: self.store.note("provisional", [last_track, closed]), patient=False)
        self._close_segments(ended=True, patient=False)

    # --- frames ---

    def _wanted(self) -> int:
        """Frames needed, at least, to finish the next minute."""
        following, spectra = self.pipeline.next_minute, self.config.spectra
        if following is None:
            return 0
        centre = following + self.config.azimuth.window_s / 2 - spectra.hop_s
        return int(np.ceil((centre - spectra.window_s / 2) / spectra.hop_s - 1e-6)) + 1

    def _advance(self, ranges: list[tuple[int, int]], patient: bool) -> None:
        for first, last in ranges:
            if self._builder is not None and first > (self.buffer.next_frame or 0):
                self._end_record(patient)
            for begin, end, boundary in self._cuts(first, last):
                self.buffer.take(end)
                finished = self._take_up_channels(begin) + self._push(begin, end)
                self._publish(finished, patient, boundary)
                self._close_segments(patient=patient)
        self.buffer.forget()

    def _push(self, begin: int, end: int) -> list[Minutes]:
        assert self._builder is not None
        return self.pipeline.push(self._builder.block(np.arange(begin, end)))

    def _build(self, frame: int) -> None:
        """Fix which channels serve from a frame on."""
        self._channels = self.buffer.seen
        self._builder = SpectraBuilder(self.buffer, self.config.spectra, frame, frame + _FOREVER)

    def _cuts(self, first: int, last: int) -> Iterator[tuple[int, int, bool]]:
        """Ranges of frames that end where a snapshot may be taken."""
        hop, step = self.config.spectra.hop_s, self.config.live.snapshot_s
        centre = self.config.spectra.window_s / 2
        while first < last:
            boundary = (np.floor((first * hop + centre) / step + 1e-9) + 1) * step
            end = min(last, max(int(np.ceil((boundary - centre) / hop - 1e-9)), first + 1))
            yield first, end, end * hop + centre >= boundary - 1e-6
            first = end

    # --- what is written ---

    def _publish(self, finished: list[Minutes], patient: bool, boundary: bool = False) -> None:
        """Commit minutes, the live estimate, the packets and the position; then the files made from them."""
        rows = [row for minutes in finished for row in self.estimate.step(minutes.maps)]
        due = boundary and (time.monotonic() - self._rested > _REST_S or self._snapshot_frame is None)

        def write() -> None:
            for minutes in finished:
                self._keep_minutes(minutes, [])
            self._keep_live(rows)
            self._keep_pending()
            if due or self._snapshot_frame is None:
                self._snapshot()

        if not finished and not due and self._snapshot_frame is not None:
            self._lasting(self._keep_pending, patient)
            return
        self._lasting(write, patient)
        if finished:
            said = pd.concat([rounded(minutes.detections) for minutes in finished])
            self.health.minute(said)
            self._look()
            self.files.append([str(t) for t in said["time"]])
            if self.stopping.is_set():
                return
            for listener in self.listeners if rows else []:
                listener(rows[-1])

    def _keep_minutes(self, minutes: Minutes, rows: list[dict[str, Any]]) -> None:
        table = rounded(minutes.detections)
        self.store.put("detections", DETECTION_COLUMNS, plain_rows(table, DETECTION_COLUMNS))
        self.ships.keep(minutes)
        self._keep_strips(minutes, list(table["time"]))
        self._keep_live(rows)

    def _keep_strips(self, minutes: Minutes, times: list[str]) -> None:
        hours = self.config.live.strips_h
        if not hours or not times:
            return
        made, axes = strips.columns(minutes.maps, minutes.features, self.config.spectra.window_s)
        self.store.put_strips(times, made, strips.plain(axes))
        oldest = iso(float(to_posix(minutes.maps["time"].values[-1])) - 3600.0 * hours)
        self.store.execute("DELETE FROM strips WHERE time < ?", (oldest,))

    def _keep_live(self, rows: list[dict[str, Any]]) -> None:
        self.store.put("live", LIVE_COLUMNS, [tuple(row.get(name) for name in LIVE_COLUMNS) for row in rows])

    def _keep_pending(self) -> None:
        for packet in self._pending:
            self.store.put_packet(packet)
        self.store.note("position", self._position())

    def _snapshot(self) -> None:
        """Keep the memory of all stages as of the next frame, and only the packets that come after it."""
        self._keep_pending()
        frame = self.buffer.next_frame
        assert frame is not None
        self.store.put_arrays("pipeline", self.pipeline.state())
        self.store.put_arrays("estimate", self.estimate.state())
        made = {"fingerprint": self.fingerprint, "config": to_dict(self.config)}
        self.store.note("snapshot", {"frame": frame, "channels": self._channels} | made)
        self.store.forget_packets(self.buffer.needed_ns)
        self._snapshot_frame, self._rested = frame, time.monotonic()

    def _position(self) -> dict[str, Any]:
        return self.buffer.position() | {"source": self.source.position if self.source else self.resume}

    def _lasting(self, write: Callable[[], None], patient: bool) -> None:
        """Commit, if need be again and again: a full disk is waited for, and nothing is taken meanwhile."""
        wait = self.config.live.retry_s
        while True:
            try:
                with self.store.transaction():
                    write()
                self._pending = []
                self.health.trouble = ""
                return
            except OutputError as error:
                if not patient:
                    raise
                if not self.health.trouble:
                    self._say(f"{error}; waiting")
                self.health.trouble = str(error)
                if self.stopping.wait(wait * random.uniform(0.5, 1.5)):
                    raise
                wait = min(2 * wait, self.config.live.retry_max_s)

    def _close_segments(self, ended: bool = False, patient: bool = True, ships: Ships | None = None) -> None:
        ships = ships or self.ships
        for segment in ships.close(ended):
            try:
                tracks = ships.search(segment)
            except ObsnetError as error:
                self._say(f"the segment from {iso(segment.start)} to {iso(segment.end)} is left: {error}")
                tracks = []
            self._lasting(lambda s=segment, t=tracks: ships.say(s, t), patient)  # type: ignore[misc]
            self._look()
            if tracks:
                self._say(f"{counted(len(tracks), 'track')} from {iso(segment.start)} to {iso(segment.end)}")
            try:
                self.files.write_tracks()
            except OutputError as error:
                self._say(str(error))

    # --- where a record ends, begins, or goes on after a stop ---
    #
    # A record is what one memory has heard. Other channels begin another memory, in the commit of the first frames that it
    # heard; ships go on. A silence that is too long to have rows ends the ships, too. So do other settings, after which a
    # record begins where the former one was left; and a clock that was set back, after which times come that were before.

    def begin_anew(self, why: str, patient: bool = True) -> None:
        """Close the record and start another, whose times may lie anywhere."""
        self._say(why)
        if self.buffer.next_frame is not None:
            self._advance(self.buffer.ready(ended=True), patient)
            self._end_record(patient)
        self.pipeline = Pipeline(self.station, self.config, self._amplitudes, self.pipeline.table)
        self.estimate = LiveEstimate(self.station)
        self.buffer = WaveformBuffer(self.station, self.config.spectra, self.config.live)
        self._builder, self._channels, self._snapshot_frame, self._pending = None, [], None, []
        self._late_since = None

        def write() -> None:
            self._forget()
            self.ships.leave_behind()

        self._lasting(write, patient)
        self._look()

    def _take_up_channels(self, frame: int) -> list[Minutes]:
        """Have the channels serve that have come; where they change what is known, the minutes of the memory before."""
        if self._builder is not None and self._channels == self.buffer.seen:
            return []
        before = None if self._builder is None else set(self._builder.units)
        self._build(frame)
        self._snapshot_frame = None
        assert self._builder is not None
        if before is None or before == set(self._builder.units):
            return []
        self._say(f"channels are now {', '.join(self._channels)}: a new record begins")
        finished = self.pipeline.flush()
        self.pipeline = Pipeline(self.station, self.config, self._amplitudes, self.pipeline.table)
        return finished

    def _end_record(self, patient: bool) -> None:
        """Say what is left of the record, its ships too; what comes next is kept as the beginning of another."""
        self._publish(self.pipeline.flush(), patient)
        self._close_segments(ended=True, patient=patient)
        self._lasting(self.ships.forget, patient)
        self._snapshot_frame = None

    def _forget(self) -> None:
        """Drop from the store what the next frame of a record would depend on."""
        for room in ("pipeline", "estimate"):
            self.store.forget_arrays(room)
        self.store.execute("DELETE FROM packets")
        self.store.execute("DELETE FROM state WHERE name IN ('snapshot', 'provisional')")
        self.store.note("position", self._position())
        self.ships.forget()

    def _restore(self) -> None:
        position, snapshot = self.store.noted("position"), self.store.noted("snapshot")
        self.resume = (position or {}).get("source", {})
        if snapshot is None or position is None:
            if position is not None:
                self.buffer.begin_after(position)
            self.buffer.take_up(self.store.packets(), position or {})
            return
        if snapshot["fingerprint"] != self.fingerprint:
            self._say("station, configuration or version changed: a new record begins")
            self._close_former(snapshot)
            self.buffer.begin_after(position)
            with self.store.transaction():
                self._forget()
            return
        self._unsay_provisional()
        self.pipeline.restore(self.store.arrays("pipeline"))
        self.estimate.restore(self.store.arrays("estimate"))
        self.buffer.take_up(self.store.packets(), position)
        self.buffer.restore(snapshot["frame"], snapshot["channels"], position)
        self._snapshot_frame = snapshot["frame"]
        if snapshot["channels"]:
            self._build(snapshot["frame"])
        until = position["next_frame"]
        for begin, end, _ in self._cuts(snapshot["frame"], until):
            self.buffer.take(end)
            for minutes in self._push(begin, end):
                self.estimate.step(minutes.maps)
        if until > snapshot["frame"]:
            self.buffer.forget()

    def _close_former(self, snapshot: dict[str, Any]) -> None:
        """Say the ships that were under way when other settings had been made, as those would have had it."""
        try:
            config = build(WatchConfig, snapshot["config"])
            ships = Ships(self.store, self.station, config, self.pipeline.table)
            self._close_segments(ended=True, patient=False, ships=ships)
        except OutputError:
            raise
        except Exception as error:
            # another version may have kept anything, and must not keep this one from beginning
            what = f"{type(error).__name__}: {' '.join(str(error).split())}"
            self._say(f"the ships that were under way are left: {what}")

    def _unsay_provisional(self) -> None:
        """Take back the tracks of a record that was closed and now goes on."""
        provisional = self.store.noted("provisional")
        if provisional is None:
            return
        track, closed = provisional
        with self.store.transaction():
            for table in ("tracks", "courses"):
                self.store.execute(f"DELETE FROM {table} WHERE track > ?", (track,))
            self.store.execute("DELETE FROM state WHERE name IN ('provisional', 'closed')")
            if closed is not None:
                self.store.note("closed", closed)
        self.ships.reread()

    # --- what it says of itself ---

    def _look(self) -> None:
        """Read from the store what `status` tells of it."""
        ((tracks,),) = self.store.rows("SELECT count(*) FROM tracks")
        self._known: dict[str, Any] = {"live": self.ships.heard_now(), "tracks": tracks}

    def tell(self) -> None:
        """Rewrite status.json."""
        self._told = time.monotonic()
        try:
            self.files.write_status(self.status())
        except OutputError as error:
            self.health.trouble = self.health.trouble or str(error)

    def status(self) -> dict[str, Any]:
        """What the station does and how it is, as plain values; any thread may ask."""
        head = self.buffer.head_ns
        source = self.source
        scale = 1024 if sys.platform != "darwin" else 1024**2
        return {
            "obsnet": obsnet.__version__,
            "time": iso(time.time()),
            "station": {
                "code": self.station.code,
                "latitude": self.station.latitude,
                "longitude": self.station.longitude,
                "depth_m": self.station.depth_m,
            },
            "source": None if source is None else source.name,
            "detector": self.config.detector,
            "models": self.pipeline.models,
            **self.health.said(head, "" if source is None else source.trouble),
            "last_sample": None if head is None else iso(head / 1e9),
            "channels": {
                seed_id: iso(end / 1e9) for seed_id, end in sorted(dict(self.buffer.newest).items())
            },
            "packets": dict(self.buffer.counts),
            "source_counts": {} if source is None else dict(source.counts),
            "notes": self.buffer.report.notes[-20:],
            "left_aside": dict(list(dict(self.buffer.report.left_aside).items())[:20]),
            **self._known,
            "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale, 1),
        }
