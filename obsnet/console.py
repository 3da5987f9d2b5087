"""What a command says and hears: lines on standard output, a progress bar, a request to terminate.

Standard error is for errors alone.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from obsnet.errors import OutputError


@contextmanager
def terminable() -> Iterator[None]:
    """Let a request to terminate unwind the run, so that it leaves nothing behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def say(text: str) -> None:
    """Print a line; a reader who has gone away stops the words, not the run."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        hush()
    except OSError as error:
        hush()
        raise OutputError(f"cannot write to standard output: {error.strerror}") from None


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
def progress(text: str, quiet: bool) -> Iterator[Callable[[float, float], None] | None]:
    """A bar on a terminal, a plain line a tenth elsewhere, nothing when quiet."""
    if quiet:
        yield None
        return
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(text, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    shown = -1

    def plain(done: float, total: float) -> None:
        nonlocal shown
        tenth = int(10 * done / total) if total else 10
        if tenth > shown:
            shown = tenth
            say(f"{text}: {10 * tenth} %")

    yield plain
