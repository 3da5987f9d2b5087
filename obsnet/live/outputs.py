"""The live estimate as NMEA 0183 sentences, and the station's health over HTTP; on this machine unless told otherwise."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Callable, Iterator
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from obsnet.errors import OutputError
from obsnet.live.config import address

_KNOT_MPS = 1852.0 / 3600.0
_LEAST_EXISTENCE = 0.5
_MOST_READERS = 16


def sentences(row: dict[str, Any], talker: str = "RA") -> list[str]:
    """TTM and TLL of a live estimate, each with its checksum and CR LF; none where no ship is believed in.

    Parameters
    ----------
    row : of table `live`; where range, course and speed are unknown their fields are empty.
    talker : two letters.

    Notes
    -----
    NMEA 0183: TTM gives distance (nautical miles), true bearing, speed (knots), true course; TLL latitude and longitude.
    Status T is a ship that is believed in (existence over 0.9), Q one that is not yet.
    """
    if not (row.get("existence") or 0.0) >= _LEAST_EXISTENCE:
        return []
    status = "T" if row["existence"] > 0.9 else "Q"
    clock = datetime.fromisoformat(row["time"]).strftime("%H%M%S.00")
    distance, bearing, speed, course = (
        row.get(name) for name in ("range_m", "azimuth_deg", "speed_mps", "course_deg")
    )
    said = [
        f"{talker}TTM,01,{_number(distance, 1 / 1852.0, 2)},{_number(_around(bearing), 1.0, 1)},T,{_number(speed, 1 / _KNOT_MPS, 1)},"
        f"{_number(_around(course), 1.0, 1)},T,,,N,,{status},,{clock},A"
    ]
    if row.get("latitude") is not None and row.get("longitude") is not None:
        place = f"{_degrees(row['latitude'], 2, 'NS')},{_degrees(row['longitude'], 3, 'EW')}"
        said.append(f"{talker}TLL,01,{place},OBSNET,{clock},{status},")
    return [f"${text}*{_checksum(text):02X}\r\n" for text in said]


def _number(value: float | None, factor: float, digits: int) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value * factor:.{digits}f}"


def _around(degrees: float | None) -> float | None:
    """A direction that is not 360.0 when it has been rounded to tenths."""
    return None if degrees is None else round(degrees, 1) % 360.0


def _degrees(value: float, width: int, letters: str) -> str:
    """Degrees and minutes, and the hemisphere."""
    value = (value + 180.0) % 360.0 - 180.0 if width == 3 else value
    tenths = round(abs(value) * 60 * 10000)
    degrees, minutes = divmod(tenths, 60 * 10000)
    return f"{degrees:0{width}d}{minutes / 10000:07.4f},{letters[value < 0]}"


def _checksum(text: str) -> int:
    total = 0
    for byte in text.encode("ascii"):
        total ^= byte
    return total


class NmeaOutput:
    """Sends sentences to a UDP address, or to whoever connects to a TCP port; a reader that is gone or slow is dropped.

    Raises
    ------
    OutputError : the port is taken, or the host is not known.
    """

    def __init__(self, target: str, talker: str) -> None:
        self._scheme, host, port = address(target, ("udp", "tcp"), "nmea")
        self._talker, self._readers = talker, list[socket.socket]()
        try:
            family, _, _, _, where = socket.getaddrinfo(host, port)[0]
            if self._scheme == "udp":
                self._socket = socket.socket(family, socket.SOCK_DGRAM)
                self._socket.connect(where)
            else:
                self._socket = socket.create_server(where[:2], family=family, backlog=4)
                self._socket.setblocking(False)
        except OSError as error:
            raise OutputError(f"cannot send NMEA to {target}: {error.strerror or error}") from None
        self.port = int(self._socket.getsockname()[1])

    def __call__(self, row: dict[str, Any]) -> None:
        """Send a live estimate."""
        data = "".join(sentences(row, self._talker)).encode("ascii")
        if self._scheme == "udp":
            try:
                if data:
                    self._socket.send(data)
            except OSError:  # nobody listens: the next minute is another chance
                pass
            return
        self._accept()
        kept = []
        for reader in self._readers:
            try:
                if data and reader.send(data) != len(data):
                    raise OSError
                kept.append(reader)
            except OSError:
                reader.close()
        self._readers = kept

    def _accept(self) -> None:
        while len(self._readers) < _MOST_READERS:
            try:
                reader, _ = self._socket.accept()
            except OSError:
                return
            reader.setblocking(False)
            self._readers.append(reader)

    def close(self) -> None:
        """Close all connections."""
        for open_one in (*self._readers, self._socket):
            open_one.close()


class HealthServer:
    """Answers /healthz (200 while all is well, else 503) and /metrics (Prometheus text).

    Parameters
    ----------
    where : HOST:PORT.
    status : gives the station's status; called from the server's threads.

    Raises
    ------
    OutputError : the port is taken, or the host is not known.
    """

    def __init__(self, where: str, status: Callable[[], dict[str, Any]]) -> None:
        _, host, port = address(f"http://{where}", ("http",), "http")

        class Handler(BaseHTTPRequestHandler):
            server_version, sys_version, timeout = "obsnet", "", 10

            def do_GET(self) -> None:
                said = status()
                if self.path.partition("?")[0] == "/healthz":
                    code = 200 if said["healthy"] else 503
                    body, kind = json.dumps(said).encode(), "application/json"
                elif self.path.partition("?")[0] == "/metrics":
                    code, body, kind = 200, metrics(said), "text/plain; version=0.0.4; charset=utf-8"
                else:
                    code, body, kind = 404, b"/healthz or /metrics\n", "text/plain"
                self.send_response(code)
                for name, value in (
                    ("Content-Type", kind),
                    ("Content-Length", str(len(body))),
                    ("Cache-Control", "no-store"),
                    ("X-Content-Type-Options", "nosniff"),
                ):
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *arguments: Any) -> None:
                """Keep quiet."""

        try:
            self._server = ThreadingHTTPServer((host, port), Handler)
        except OSError as error:
            raise OutputError(f"cannot answer on {where}: {error.strerror or error}") from None
        self._server.daemon_threads = True
        self.port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, name="health", daemon=True).start()

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()


def metrics(status: dict[str, Any]) -> bytes:
    """A status as Prometheus text."""
    from prometheus_client import CollectorRegistry, generate_latest
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric

    class Collector:
        def collect(self) -> Iterator[Metric]:
            for name, key, text in _GAUGES:
                if status.get(key) is not None:
                    yield GaugeMetricFamily(f"obsnet_{name}", text, float(status[key]))
            packets = CounterMetricFamily(
                "obsnet_packets", "Packets by what became of them.", labels=["fate"]
            )
            for fate, count in status["packets"].items():
                packets.add_metric([fate], count)
            yield packets
            events = CounterMetricFamily("obsnet_source", "What happened at the source.", labels=["event"])
            for event, count in status["source_counts"].items():
                events.add_metric([event], count)
            yield events
            info = {
                "version": status["obsnet"],
                "station": status["station"]["code"],
                "detector": status["detector"],
            }
            yield InfoMetricFamily("obsnet", "The station.", info)
            models = InfoMetricFamily("obsnet_model", "A model in use.", labels=["name"])
            for name, digest in status["models"].items():
                models.add_metric([name], {"digest": str(digest)})
            yield models
            if status.get("tracks") is not None:
                yield CounterMetricFamily("obsnet_tracks", "Finished tracks.", float(status["tracks"]))

    registry = CollectorRegistry(auto_describe=False)
    registry.register(Collector())  # type: ignore[arg-type]
    return bytes(generate_latest(registry))


_GAUGES = (
    ("healthy", "healthy", "1 while all is well."),
    ("silent_seconds", "silent_s", "Time since the last packet."),
    ("data_latency_seconds", "data_latency_s", "Time since the newest sample was taken."),
    ("minute_delay_seconds", "minute_delay_s", "From a packet's arrival to the row that it finished."),
    ("coverage_last_hour_ratio", "coverage_last_hour", "Share of the last hour's minutes that was heard."),
    ("peak_memory_megabytes", "peak_memory_mb", "Largest resident memory so far."),
)
