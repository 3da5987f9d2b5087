"""What a command says and hears: lines on standard output, a progress bar, a wish that it stop;
and where its libraries keep their caches.

Standard error is for errors alone.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from obsnet.errors import ObsnetError, OutputError

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's `mallopt`, as malloc.h numbers them."""

_wishes: list[int] = []
"""Signals to stop that this process has been sent; like its handlers, they belong to the process."""


@contextmanager
def stoppable() -> Iterator[None]:
    """Let an interruption (SIGINT) and a request to terminate (SIGTERM) unwind a run, so that it leaves nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _wishes.clear()
    silent = sys.unraisablehook
    before = {number: signal.signal(number, _stop) for number in (signal.SIGINT, signal.SIGTERM)}
    sys.unraisablehook = lambda lost: None if _wishes else silent(lost)
    try:
        yield
    finally:
        sys.unraisablehook = silent
        for number, handler in before.items():
            signal.signal(number, handler)


def heed() -> None:
    """Stop if that was wished: Python loses an exception that a signal raises inside a finaliser."""
    if _wishes:
        _stop(_wishes[-1])


def _stop(number: int, frame: object = None) -> NoReturn:
    _wishes.append(number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


@contextmanager
def patiently() -> Iterator[None]:
    """Have an interruption or a request to terminate wait until the body is done: raised within a library's callback it crashes the process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if handler is not None}
    for number in handlers:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def caching() -> Iterator[None]:
    """A place for the caches of numba and matplotlib where neither package nor home can be written.

    It lasts as long as the command: a lasting one that others can write would hand them this process.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    near = next((path for path in (home, *home.parents) if path.exists()), home)
    if os.access(Path(__file__).parent, os.W_OK) or os.access(near, os.W_OK):
        yield
        return
    with tempfile.TemporaryDirectory(prefix="obsnet-") as folder:
        places = {name: folder for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR") if name not in os.environ}
        os.environ.update(places)
        try:
            yield
        finally:
            for name in places:
                del os.environ[name]


@contextmanager
def loading() -> Iterator[None]:
    """Import modules without looking for garbage, of which they make none: an eighth of the time. They are never looked at again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()


def keep_memory() -> None:
    """Have glibc, where it is the allocator, keep what arrays of some MB leave: else every one that comes is faulted in anew."""
    import ctypes

    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    for parameter, size in ((_MMAP_THRESHOLD, 1 << 25), (_TRIM_THRESHOLD, 1 << 29)):
        mallopt(parameter, size)


def say(text: str) -> None:
    """Print a line; a reader who has gone away stops the words, not the run."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        hush()
    except OSError as error:
        hush()
        raise OutputError(f"cannot write to standard output: {error.strerror}") from None


def line_of(error: Exception) -> str | None:
    """What to tell the user in one line; nothing where the error is a defect of ours."""
    text = str(error)
    if isinstance(error, OSError) and not isinstance(error, ObsnetError):
        if error.errno is None:
            return None
        text = (
            f"{error.strerror}: {error.filename or 'while reading or writing'}; make room or check the path"
        )
    elif isinstance(error, MemoryError):
        text = "this needs more memory than there is; give a shorter span or coarser grids"
    elif hasattr(error, "format_message"):
        command = getattr(error, "ctx", None)
        text = f"{error.format_message().rstrip('.')}; see {command.command_path if command else 'obsnet'} --help"
    elif not isinstance(error, ObsnetError):
        return None
    return " ".join(text.split())


def counted(number: int, thing: str) -> str:
    """A number of things.

    >>> counted(1, "track"), counted(0, "ship")
    ('1 track', '0 ships')
    """
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def flush() -> None:
    """Send what standard output still holds; `OutputError` where it cannot take it."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        hush()
    except OSError as error:
        hush()
        raise OutputError(f"cannot write to standard output: {error.strerror}") from None


def hush() -> None:
    """Point standard output at nothing, so that no later flush fails."""
    with suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)


@contextmanager
def progress(text: str, quiet: bool) -> Iterator[Callable[[float, float], None]]:
    """A bar on a terminal, a plain line a tenth elsewhere, nothing when quiet; each call heeds a wish to stop."""
    if quiet:
        yield lambda done, total: heed()
    elif sys.stderr is not None and sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(),
        )
        bar = Progress(*columns, console=Console(stderr=True))
        task = bar.add_task(text, total=None)

        def draw(done: float, total: float) -> None:
            heed()
            bar.start()  # not before: its thread would keep a process from being copied
            bar.update(task, completed=done, total=total)

        try:
            yield draw
        finally:
            bar.stop()
    else:
        yield _Tenths(text)


class _Tenths:
    """A line whenever another tenth is done."""

    def __init__(self, text: str) -> None:
        self._text, self._shown = text, -1

    def __call__(self, done: float, total: float) -> None:
        heed()
        tenth = int(10 * done / total) if total else 10
        if tenth > self._shown:
            self._shown = tenth
            say(f"{self._text}: {10 * tenth} %")
