"""The page's server: one socket, loopback unless told otherwise, until it is stopped."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from pathlib import Path

from obsnet.ais import ReferenceTrack
from obsnet.errors import LayoutError, OutputError
from obsnet.serve.app import make_app
from obsnet.serve.folder import open_folder

LOOPBACK = ["localhost", "127.0.0.1", "[::1]"]


def serve(
    folder: str | Path,
    host: str = "127.0.0.1",
    port: int = 8080,
    ships: Callable[[tuple[float, float]], list[ReferenceTrack]] | None = None,
    ready: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve a folder's page until a signal ends it.

    Parameters
    ----------
    port : 0 for any free one.
    ships : gives the AIS tracks around a latitude and longitude, if there are any.
    ready : is told the address.

    Raises
    ------
    LayoutError : the folder is neither of ``obsnet track`` nor of ``obsnet watch``.
    OutputError : the address cannot be had.
    """
    import uvicorn

    held = open_folder(folder)
    if ships is not None:
        station = held.about()["station"]
        if station.get("latitude") is None:
            raise LayoutError(f"{folder} does not say where its station lies; start without --ais")
        held.ships = ships((station["latitude"], station["longitude"]))
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OutputError(
            f"cannot listen on {host} port {port}: {reason}; give another --host or --port"
        ) from None
    with listening:
        name = f"[{host}]" if ":" in host else host
        app = make_app(held, [*LOOPBACK, name] if is_loopback(host) else None)
        options = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=1,
        )
        ready(f"http://{name}:{listening.getsockname()[1]}/")
        uvicorn.Server(options).run(sockets=[listening])


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
