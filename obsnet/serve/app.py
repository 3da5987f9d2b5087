"""The web application: a page, its parts, and the numbers that it draws; GET and HEAD only, from one folder only."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator, Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from obsnet.errors import ObsnetError
from obsnet.serve.folder import MOST_COLUMNS, LiveFolder, RunFolder

STATIC = {
    "page.css": "text/css",
    "page.js": "text/javascript",
    "charts.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
OFFERED = {
    ".csv": "text/csv",
    ".geojson": "application/geo+json",
    ".json": "application/json",
    ".png": "image/png",
}
"""Files of the folder that may be fetched, by suffix."""
HEADERS = {
    # Plotly writes style elements; scripts come from this server alone.
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
LOOK_S = 1.0
"""Spacing of the looks for something new."""
QUIET_S = 15.0
"""A listening page hears something at least so often."""


def make_app(folder: RunFolder | LiveFolder, hosts: list[str] | None = None) -> Starlette:
    """The application over a folder.

    Parameters
    ----------
    hosts : names by which it may be asked; any by default. A loopback server should be asked by loopback names alone, or
        another site's page could reach it under a name of its own.
    """
    middleware = [Middleware(_Headers), Middleware(GZipMiddleware, minimum_size=2000)]
    if hosts:
        middleware.insert(1, Middleware(TrustedHostMiddleware, allowed_hosts=hosts))
    routes = [
        Route("/", _page),
        Route("/static/plotly.js", _plotly),
        Route("/static/{name}", _static),
        Route("/files/{name:path}", _file),
        Route("/api/events", _events),
        *(Route(f"/api/{name}", _answer(make)) for name, make in ANSWERS.items()),
    ]
    app = Starlette(
        routes=routes,
        middleware=middleware,
        exception_handlers={HTTPException: _refuse, ObsnetError: _trouble, OSError: _trouble},
    )
    app.state.folder = folder
    return app


def _about(folder: RunFolder | LiveFolder, start: float, end: float, query: Any) -> Any:
    return folder.about() | {"stamp": folder.stamp(), "files": _offered(folder.path)}


def _tracks(folder: RunFolder | LiveFolder, start: float, end: float, query: Any) -> Any:
    inside = [track for track in folder.tracks() if track["span"][1] >= start and track["span"][0] <= end]
    return {"tracks": inside, "live": folder.live(start, end), "ais": folder.reference(start, end)}


def _detections(folder: RunFolder | LiveFolder, start: float, end: float, query: Any) -> Any:
    return folder.detections(start, end)


def _strips(folder: RunFolder | LiveFolder, start: float, end: float, query: Any) -> Any:
    columns = _number(query, "columns", 720.0)
    return folder.strips(start, end, int(min(max(columns, 1.0), MOST_COLUMNS)))


ANSWERS: dict[str, Callable[[RunFolder | LiveFolder, float, float, Any], Any]] = {
    "about": _about,
    "tracks": _tracks,
    "detections": _detections,
    "strips": _strips,
}


def _answer(make: Callable[..., Any]) -> Callable[[Request], Any]:
    async def answer(request: Request) -> Response:
        query = request.query_params
        # the years 1970 to 2200: what iso times can say and nobody means is refused
        start, end = (
            _number(query, name, value, 0.0, 7.26e9) for name, value in (("start", 0.0), ("end", 7.26e9))
        )
        value = await run_in_threadpool(make, request.app.state.folder, start, end, query)
        return JSONResponse(value, headers={"cache-control": "no-store"})

    return answer


def _number(query: Any, name: str, default: float, low: float = -math.inf, high: float = math.inf) -> float:
    try:
        value = float(query.get(name, default))
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise HTTPException(400, f"{name} must be a number of seconds since 1970")
    return value


def _offered(folder: Path) -> list[str]:
    """Names of the files that may be fetched."""
    return sorted(path.name for path in folder.iterdir() if path.suffix in OFFERED and _is_own(path, folder))


def _is_own(path: Path, folder: Path) -> bool:
    return path.is_file() and not path.name.startswith(".") and path.resolve().parent == folder


async def _page(request: Request) -> Response:
    return Response(_part("index.html"), media_type="text/html", headers={"cache-control": "no-cache"})


async def _static(request: Request) -> Response:
    name = request.path_params["name"]
    if name not in STATIC:
        raise HTTPException(404, "there is no such file")
    return Response(_part(name), media_type=STATIC[name], headers={"cache-control": "no-cache"})


async def _plotly(request: Request) -> Response:
    import plotly

    path = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
    return FileResponse(path, media_type="text/javascript", headers={"cache-control": "max-age=3600"})


async def _file(request: Request) -> Response:
    folder, name = request.app.state.folder.path, request.path_params["name"]
    if name not in _offered(folder):
        raise HTTPException(404, "there is no such file")
    path = folder / name
    return FileResponse(
        path, media_type=OFFERED[path.suffix], filename=name, headers={"cache-control": "no-store"}
    )


async def _events(request: Request) -> Response:
    """Server-sent events: the folder's stamp, whenever it changes."""
    folder = request.app.state.folder

    async def stamps() -> AsyncIterator[str]:
        told, when = None, 0.0
        while not await request.is_disconnected():
            stamp = await run_in_threadpool(folder.stamp)
            if stamp != told:
                told, when = stamp, time.monotonic()
                yield f"data: {json.dumps({'stamp': stamp})}\n\n"
            elif time.monotonic() - when > QUIET_S:
                when = time.monotonic()
                yield ": still here\n\n"
            await asyncio.sleep(LOOK_S)

    return StreamingResponse(stamps(), media_type="text/event-stream", headers={"cache-control": "no-store"})


def _part(name: str) -> bytes:
    return (files("obsnet.serve") / "static" / name).read_bytes()


async def _refuse(request: Request, error: Exception) -> Response:
    status, detail = (error.status_code, error.detail) if isinstance(error, HTTPException) else (500, "")
    headers = getattr(error, "headers", None)
    return JSONResponse({"error": detail}, status, headers=headers)


async def _trouble(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": " ".join(str(error).split())[:300]}, 503)


class _Headers:
    """Adds the security headers to every answer, refusals included."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def dressed(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message.get("headers", []),
                    *((k.encode(), v.encode()) for k, v in HEADERS.items()),
                ]
            await send(message)

        await self.app(scope, receive, dressed if scope["type"] == "http" else send)
