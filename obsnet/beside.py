"""Work beside this process: a task in a forked copy of it that hears words in between, and a crew that does one thing many times."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

from obsnet.errors import WorkerDied


class Beside:
    """Runs a generator in a forked copy of this process: up to each `yield` at once, on from there when it is told a word.

    The copy has all that this process had when it was made, and hears the words, in their order; errors come back with
    `finish`. Where a process had better not be forked (it has threads, one core is all there is, macOS and Windows), the whole
    task runs in `finish`.

    Parameters
    ----------
    task : generator that takes a word at each yield, and ends; its value is dropped.
    cores : how many may be used.
    """

    def __init__(self, task: Generator[None, Any, None], cores: int | None = None) -> None:
        self._task, self._copy = task, None
        self._words: deque[Any] = deque()
        if (cores or os.cpu_count() or 1) > 1 and _may_fork():
            import multiprocessing

            context = multiprocessing.get_context("fork")
            self._line, there = context.Pipe()
            self._copy = context.Process(target=_work, args=(task, self._line, there), daemon=True)
            self._copy.start()
            there.close()

    def tell(self, word: Any) -> None:
        """Say what the next part of the task needs; a copy goes on with it."""
        if self._copy is None:
            self._words.append(word)
            return
        try:
            self._line.send(word)
        except OSError:
            return  # the copy has ended: `finish` says why

    def finish(self) -> None:
        """Wait for the task; raises what it raised."""
        if self._copy is None:
            _go_on(self._task, self._words.popleft)
            return
        try:
            error = self._line.recv()
        except (EOFError, OSError):
            self._copy.join()
            raise WorkerDied(
                f"a copy of this process ended with {self._copy.exitcode} (out of memory?)"
            ) from None
        if error is not None:
            raise error

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._copy is not None:
            self._copy.kill()  # a gentler signal is lost on a copy that is being made
            self._copy.join()
            self._line.close()


class Crew:
    """Does a task for many arguments beside this process: in forked copies of it, made at once, or in threads where it had
    better not be forked; with a size of one it does it itself, at once.

    Parameters
    ----------
    task : function; in a copy it sees this process as it was when the crew was made.
    size : how many may work at a time.
    """

    def __init__(self, task: Callable[..., Any], size: int) -> None:
        self._task = task
        self._executor: Executor | None = None
        self._forked = size > 1 and _may_fork()
        if self._forked:
            import multiprocessing

            context = multiprocessing.get_context("fork")
            self._executor = ProcessPoolExecutor(size, context, _join_crew, (task,))
            self._executor.submit(int)  # copies are made at the first task
        elif size > 1:
            self._executor = ThreadPoolExecutor(size)

    def submit(self, *arguments: Any) -> Future:
        """Have the task done; ask `result_of` for the result."""
        if self._executor is None:
            done: Future = Future()
            done.set_result(self._task(*arguments))
            return done
        if self._forked:
            return self._executor.submit(_crew_task, *arguments)
        return self._executor.submit(self._task, *arguments)

    @staticmethod
    def result_of(future: Future) -> Any:
        """What a task gave.

        Raises
        ------
        WorkerDied : its process did not live to say.
        """
        try:
            return future.result()
        except BrokenExecutor:
            raise WorkerDied("a copy of this process died at its work (out of memory?)") from None

    def close(self) -> None:
        """Forget what has not begun, and part."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None


def leave_signals_to_parent() -> None:
    """In a worker process: interruptions are the parent's to hear, and when it is gone this process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _may_fork() -> bool:
    return sys.platform == "linux" and threading.active_count() == 1


_task: Callable[..., Any] | None = None
"""What this process, a copy of a crew, is there for."""


def _join_crew(task: Callable[..., Any]) -> None:
    global _task
    _task = task
    leave_signals_to_parent()


def _crew_task(*arguments: Any) -> Any:
    assert _task is not None
    return _task(*arguments)


def _go_on(task: Generator[None, Any, None], heard: Callable[[], Any]) -> None:
    next(task)
    while True:
        try:
            task.send(heard())
        except StopIteration:
            return


def _work(task: Generator[None, Any, None], parents: Any, line: Any) -> None:
    parents.close()
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
