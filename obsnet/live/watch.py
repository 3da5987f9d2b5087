"""A whole watch: source, station and outputs put together, run until a signal or the end of the source."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from obsnet.live.config import WatchConfig
from obsnet.live.outputs import HealthServer, NmeaOutput
from obsnet.live.sources import open_source
from obsnet.live.station import LiveStation
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.output import prepare_folder
from obsnet.signals.station import Station


def watch_source(
    source: str,
    station: Station,
    config: WatchConfig,
    out: Path,
    *,
    once: bool = False,
    check: bool = False,
    amplitudes: Amplitudes | None = None,
    table: Any = None,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Keep a folder up to date with what a source sends, until it ends or the process is told to.

    Parameters
    ----------
    source : seedlink://HOST:PORT/NET.STA, a folder, or - for miniSEED on standard input.
    station, config : Station, WatchConfig
    out : folder of obsnet.sqlite and the files made from it.
    once : end when a folder or standard input has nothing more, the record closed.
    check : only make sure that everything is there and fits.
    amplitudes, table : as for `Pipeline`.
    say : called with a line for people when something happens.

    Raises
    ------
    ObsnetError : source, station, configuration or folder cannot serve.
    """
    if station.moved:
        say(
            f"note: {station.code} lay in several places: the last one serves, "
            f"{station.latitude:g}, {station.longitude:g}, {station.depth_m:g} m deep"
        )
    if check:
        from obsnet.pipeline import Pipeline

        prepare_folder(out)
        open_source(source, station, config.live, {}, None, once)
        Pipeline(station, config, amplitudes, table).state()
        say(f"{station.code}: configuration, station, detector, source and output folder are in order")
        return
    live = LiveStation(station, config, out, amplitudes, table, say)
    opened: list[NmeaOutput | HealthServer] = []
    try:
        if config.live.nmea:
            nmea = NmeaOutput(config.live.nmea, config.live.talker)
            opened.append(nmea)
            live.listeners.append(nmea)
        if config.live.http:
            opened.append(HealthServer(config.live.http, live.status))
        with stopping(live.stopping):
            found = open_source(source, station, config.live, live.resume, live.buffer.floor_ns, once)
            live.run(found, once)
        if once:
            for line in unused(live.status(), config.live.latency_s):
                say(line)
    finally:
        for output in opened:
            output.close()
        live.close()


def unused(status: dict[str, Any], latency_s: float) -> list[str]:
    """What to say of data that were not used, or did not come, when a source has ended."""
    fates = {fate: count for fate, count in status["packets"].items() if count}
    lost = {fate: count for fate, count in fates.items() if fate not in ("used", "repeated")}
    lines = []
    if lost:
        named = ", ".join(f"{count} {fate}" for fate, count in lost.items())
        lines.append(f"note: {sum(lost.values())} of {sum(fates.values())} packets were not used: {named}")
    if "late" in lost:
        lines.append(
            f"note: late packets came more than {latency_s:g} s after newer ones; sort them by time or raise --latency"
        )
    for what, unit in (("garbage", "bytes"), ("unreadable", "files")):
        if status["source_counts"].get(what):
            lines.append(f"note: {status['source_counts'][what]} {unit} could not be read")
    if not fates.get("used"):
        lines.append("nothing usable came")
    return lines


@contextmanager
def stopping(wish: threading.Event) -> Iterator[None]:
    """Turn the first SIGINT or SIGTERM into a wish to end in good order; the second acts as it did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def heard(number: int, frame: object) -> None:
        signal.signal(number, before[number])
        wish.set()

    before: dict[int, Any] = {}
    for number in (int(signal.SIGINT), int(signal.SIGTERM)):
        before[number] = signal.signal(number, heard)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
