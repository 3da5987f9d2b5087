"""What a live station costs on this machine: milliseconds a minute of data, resident memory, cold start."""

from __future__ import annotations

import json
import os
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from obsnet.config import build
from obsnet.errors import OutputError
from obsnet.live.config import LiveConfig, WatchConfig
from obsnet.live.packets import Packet
from obsnet.live.sources import Folder
from obsnet.live.station import LiveStation
from obsnet.sample import sample_folder
from obsnet.signals.station import Station

_WARM_MIN = 30
_MINUTE_NS = 60_000_000_000
_STARTS = 3
BARS = {"ms_per_minute": 100.0, "resident_mb": 250.0, "cold_start_s": 3.0}
"""What a station should stay below."""


@dataclass(frozen=True)
class StationCost:
    """Processor time a minute of data [ms] (median and 95 %), resident memory [MB] while following and at its peak
    (with the grid search of a closed segment), cold start and its processor time [s], and the processor time of a segment's search [s].
    """

    detector: str
    minutes: int
    ms_per_minute: float
    ms_95_percent: float
    resident_mb: float
    peak_mb: float
    cold_start_s: float
    cold_start_cpu_s: float
    search_s: float

    def table(self) -> str:
        """The numbers in words, each beside what it should stay below."""
        return "\n".join(
            [
                f"detector {self.detector}, one core, {self.minutes} minutes of the bundled passage (simulated waveforms)",
                f"a minute of data   {self.ms_per_minute:8.1f} ms   (95 %: {self.ms_95_percent:.1f} ms; bar 100 ms)",
                f"resident memory    {self.resident_mb:8.1f} MB   (peak {self.peak_mb:.1f} MB; bar 250 MB)",
                f"cold start         {self.cold_start_s:8.2f} s    ({self.cold_start_cpu_s:.2f} s of it on the processor; bar 3 s)",
                f"a segment's search {self.search_s:8.2f} s    (once, when a segment closes)",
            ]
        )

    def to_json(self) -> dict[str, Any]:
        """The same as plain values."""
        return self.__dict__ | {"bars": BARS}


def station_cost(detector: str | None = None) -> StationCost:
    """Measure a station in processes of its own, on the bundled passage.

    Raises
    ------
    ConfigError : there is no such detector. OutputError : a process failed.
    """
    build(WatchConfig, {} if detector is None else {"detector": detector})
    with tempfile.TemporaryDirectory(prefix="obsnet-bench-") as folder:
        starts = [_cold_start(Path(folder) / f"start{i}", detector) for i in range(_STARTS)]
        told = _python("-m", "obsnet.live.bench", str(Path(folder) / "run"), detector or "")
    wall, processor = (round(statistics.median(values), 3) for values in zip(*starts, strict=True))
    return StationCost(**json.loads(told), cold_start_s=wall, cold_start_cpu_s=processor)


def _environment() -> dict[str, str]:
    one = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    return os.environ | one | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}


def _python(*arguments: str) -> str:
    told = subprocess.run([sys.executable, *arguments], env=_environment(), capture_output=True, text=True)
    if told.returncode:
        raise OutputError(f"the station's process failed: {told.stderr.strip().splitlines()[-1:]}")
    return told.stdout


def _cold_start(out: Path, detector: str | None) -> tuple[float, float]:
    """Seconds from the start of ``obsnet watch`` until it takes packets, and of processor time until it has ended."""
    source = out.with_suffix(".in")
    source.mkdir(parents=True)
    command = [sys.executable, "-m", "obsnet", "watch", str(source), "--out", str(out), "--quiet"]
    command += [
        "--station",
        str(sample_folder() / "station.xml"),
        *(("--detector", detector) if detector else ()),
    ]
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(command, env=_environment(), stderr=subprocess.PIPE, text=True) as process:
        while not (out / "status.json").exists():
            if process.poll() is not None:
                raise OutputError(
                    f"obsnet watch ended: {process.stderr.read() if process.stderr else ''}".strip()
                )
            time.sleep(0.01)
        seconds = time.perf_counter() - begin
        process.send_signal(signal.SIGTERM)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _resident_mb() -> float:
    """Resident memory now; the peak where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return _peak_mb()


def _peak_mb() -> float:
    return (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1024 if sys.platform != "darwin" else 1) / 1e6
    )


def follow(out: Path, detector: str | None) -> dict[str, Any]:
    """Follow the bundled passage minute by minute; everything of `StationCost` but the cold start."""
    config = build(WatchConfig, {"detector": detector} if detector else {})
    station = Station.from_stationxml(sample_folder() / "station.xml")
    live = LiveStation(station, config, out)
    spent = []
    for packets in _minutes(station, config.live):
        begin = time.process_time()
        live.take(packets)
        spent.append(1e3 * (time.process_time() - begin))
    resident, warm = _resident_mb(), spent[_WARM_MIN:]
    begin = time.process_time()
    live.finish()
    return {
        "detector": config.detector,
        "minutes": len(warm),
        "ms_per_minute": round(statistics.median(warm), 2),
        "ms_95_percent": round(sorted(warm)[int(0.95 * len(warm))], 2),
        "resident_mb": round(resident, 1),
        "peak_mb": round(_peak_mb(), 1),
        "search_s": round(time.process_time() - begin, 2),
    }


def _minutes(station: Station, live: LiveConfig) -> Iterator[list[Packet]]:
    """The bundled passage in minutes of packets of ten seconds, as a digitiser would send it."""
    held: list[Packet] = []
    minute = 0
    for batch in Folder(sample_folder(), station, live, None, once=True).batches():
        held = sorted(
            [*held, *(part for packet in batch for part in _parts(packet))], key=lambda part: part.end_ns
        )
        minute = minute or held[0].start_ns // _MINUTE_NS
        newest = min(batch[-1].end_ns, held[-1].end_ns)
        while (minute + 2) * _MINUTE_NS <= newest:
            minute += 1
            now = [part for part in held if part.end_ns < minute * _MINUTE_NS]
            held = held[len(now) :]
            if now:
                yield now


def _parts(packet: Packet, seconds: float = 10.0) -> list[Packet]:
    step = int(seconds * packet.rate)
    return [
        Packet(
            packet.seed_id,
            packet.start_ns + round(i / packet.rate * 1e9),
            packet.rate,
            packet.samples[i : i + step],
        )
        for i in range(0, len(packet.samples), step)
    ]


if __name__ == "__main__":
    print(json.dumps(follow(Path(sys.argv[1]), sys.argv[2] or None)))
