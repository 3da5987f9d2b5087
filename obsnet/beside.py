"""A task beside this process: a copy of it works while it goes on, and takes one word in between."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Generator
from typing import Any


class Beside:
    """Runs a generator in a forked copy of this process: as far as its `yield` at once, the rest when it is told a word.

    The copy has all that this process had when it was made, and no more; errors come back with `finish`. Where a
    process had better not be forked (it has threads, one core is all there is, macOS and Windows), the whole task runs in
    `finish`.

    Parameters
    ----------
    task : generator that yields once, receives the word there, and ends; its value is dropped.
    cores : how many may be used.
    """

    def __init__(self, task: Generator[None, Any, None], cores: int | None = None) -> None:
        self._task, self._word, self._copy = task, None, None
        if (cores or os.cpu_count() or 1) > 1 and sys.platform == "linux" and threading.active_count() == 1:
            import multiprocessing

            context = multiprocessing.get_context("fork")
            self._line, there = context.Pipe()
            self._copy = context.Process(target=_work, args=(task, there), daemon=True)
            self._copy.start()
            there.close()

    def tell(self, word: Any) -> None:
        """Say what the second part of the task needs; a copy goes on with it."""
        self._word = word
        if self._copy is not None:
            self._line.send(word)

    def finish(self) -> None:
        """Wait for the task; raises what it raised."""
        if self._copy is None:
            _go_on(self._task, lambda: self._word)
            return
        try:
            error = self._line.recv()
        except EOFError:
            self._copy.join()
            raise RuntimeError(f"a task beside this process ended with {self._copy.exitcode}") from None
        if error is not None:
            raise error

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._copy is not None:
            self._copy.terminate()
            self._copy.join()
            self._line.close()


def _go_on(task: Generator[None, Any, None], heard: Any) -> None:
    next(task)
    try:
        task.send(heard())
    except StopIteration:
        return
    raise RuntimeError("a task beside a process yields once")


def _work(task: Generator[None, Any, None], line: Any) -> None:
    # The process that was copied hears of interruptions, and ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    said: BaseException | None = None
    try:
        _go_on(task, line.recv)
    except EOFError:
        return
    except Exception as error:
        error.add_note(traceback.format_exc())
        said = error
    line.send(said)
