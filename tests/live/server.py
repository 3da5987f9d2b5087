"""A scripted SeedLink server (protocols 3.1 and 4.0) for tests: it cuts, falls silent, counts anew and sends garbage."""

import contextlib
import io
import socket
import socketserver
import struct
import threading
import time

import obspy


def records(stream, reclen=512):
    """miniSEED records of a stream, in order of their ends, as (end, bytes)."""
    made = []
    for trace in stream:
        file = io.BytesIO()
        obspy.Stream([trace]).write(file, "MSEED", reclen=reclen, encoding="STEIM2")
        data = file.getvalue()
        for at in range(0, len(data), reclen):
            record = data[at : at + reclen]
            header = obspy.read(io.BytesIO(record), headonly=True)[0].stats
            made.append((float(header.endtime.timestamp), record))
    return sorted(made, key=lambda pair: pair[0])


class Server:
    """Sends a ring of records.

    Parameters
    ----------
    ring : list of (end, bytes); what is no record is garbage that takes a number.
    first : number of the first.
    protocol : 3 or 4.
    script : called with (connection, packets sent on it) before every packet; "close", "silence" or None.
    pause : s between packets. held : packets that the server has when it starts; the others come one by one.
    port : 0 for any.
    """

    def __init__(
        self, ring, first=1, protocol=3, script=lambda connection, sent: None, pause=0.0, held=None, port=0
    ):
        self.ring, self.first, self.protocol, self.script, self.pause = ring, first, protocol, script, pause
        self.held = len(ring) if held is None else held
        self.connections, self.commands, self.asked = 0, [], []
        self._open, self._closed = set(), threading.Event()
        outer = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self):
                outer.connections += 1
                outer._open.add(self.connection)
                with contextlib.suppress(OSError):
                    outer._serve(self, outer.connections)
                outer._open.discard(self.connection)

        class Tcp(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        self._tcp = Tcp(("127.0.0.1", port), Handler)
        self.port = self._tcp.server_address[1]
        threading.Thread(target=self._tcp.serve_forever, args=(0.01,), daemon=True).start()

    def url(self, code="XX.SIM01"):
        return f"seedlink://127.0.0.1:{self.port}/{code}"

    def close(self):
        self._closed.set()
        self._tcp.shutdown()
        self._tcp.server_close()
        for connection in list(self._open):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def _serve(self, handler, connection):
        begin = self._negotiate(handler)
        if begin is None:
            return
        for sent, index in enumerate(range(begin, len(self.ring))):
            while index >= self.held and not self._closed.is_set():
                time.sleep(0.002)
            act = self.script(connection, sent)
            while act == "silence" and not self._closed.is_set():
                time.sleep(0.01)
            if act == "close" or self._closed.is_set():
                return
            handler.wfile.write(self._packet(index))
            time.sleep(self.pause)
        while handler.rfile.read(1):
            pass

    def _packet(self, index):
        number, (_, record) = self.first + index, self.ring[index]
        if self.protocol == 3:
            return b"SL%06X" % (number % (1 << 24)) + record
        station = b"XX_SIM01"
        return b"SE2D" + struct.pack("<IQB", len(record), number, len(station)) + station + record

    def _negotiate(self, handler):
        """Answer commands up to END; index of the first packet to send, None if the client has gone."""
        begin = self.held
        line = bytearray()
        while byte := handler.rfile.read(1):
            if byte not in b"\r\n":
                line += byte
                continue
            command, line = line.decode(), bytearray()
            if not command:
                continue
            self.commands.append(command)
            word, *arguments = command.split()
            if word == "HELLO":
                names = b"SLPROTO:3.1" if self.protocol == 3 else b"SLPROTO:4.0 SLPROTO:3.1"
                handler.wfile.write(b"SeedLink v3.2 scripted :: " + names + b"\r\na test\r\n")
            elif word == "END":
                return begin
            elif word == "BYE":
                return None
            else:
                begin = self._begin(word, arguments, begin)
                handler.wfile.write(b"OK\r\n")
        return None

    def _begin(self, word, arguments, begin):
        self.asked += [(word, *arguments)] if word in ("DATA", "TIME") else []
        if word == "TIME" or (word == "DATA" and len(arguments) == 2):
            text = arguments[-1]
            parts = [int(part) for part in text.split(",")] if "," in text else None
            time_s = (obspy.UTCDateTime(*parts) if parts else obspy.UTCDateTime(text)).timestamp
            return next((i for i, (end, _) in enumerate(self.ring) if end >= time_s), self.held)
        if word == "DATA" and arguments and arguments[0] != "ALL":
            number = int(arguments[0], 16 if self.protocol == 3 else 10)
            index = (number - self.first) % (1 << 24)
            return index if index <= self.held else self.held
        return 0 if word == "DATA" and begin == self.held and not self.asked[1:] else begin
