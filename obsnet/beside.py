"""Work beside this process: a task in a forked copy of it that hears words in between, and a crew that does one thing many times."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

from obsnet.errors import ConfigError, WorkerDied

_STOPS = (signal.SIGINT, signal.SIGTERM)


def usable_cores(asked: int | None = None) -> int:
    """How many may work at a time: as many as are asked for, but no more than there are cores for this process, the default.

    Raises
    ------
    ConfigError : fewer than one is asked for.
    """
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        cores = os.cpu_count() or 1
    if asked is None:
        return cores
    if isinstance(asked, bool) or not isinstance(asked, int) or asked < 1:
        raise ConfigError(
            f"threads and processes must be a whole number of at least 1, or none for all cores, found {asked!r}"
        )
    return min(asked, cores)


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
        self._task = task
        self._words: deque[Any] = deque()
        self._copy = _Copy(_work, task) if (cores or usable_cores()) > 1 and _may_fork() else None

    def tell(self, word: Any) -> None:
        """Say what the next part of the task needs; a copy goes on with it."""
        if self._copy is None:
            self._words.append(word)
        else:
            self._copy.tell(word)

    def finish(self) -> None:
        """Wait for the task; raises what it raised."""
        if self._copy is None:
            _go_on(self._task, self._words.popleft)
        else:
            self._copy.heard()

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._copy is not None:
            self._copy.kill()
            self._copy.part()


class Crew:
    """Does a task for many arguments beside this process: in forked copies of it, made at once, or in threads where it had
    better not be forked; with a size of one it does it itself, at once.

    A thread each waits for one copy: whatever becomes of a copy, its line ends with it, and nobody else waits for it.

    Parameters
    ----------
    task : function; in a copy it sees this process as it was when the crew was made.
    size : how many may work at a time.
    """

    def __init__(self, task: Callable[..., Any], size: int) -> None:
        self._task = task
        self._executor: Executor | None = None
        self._copies: list[_Copy] = []
        self._free: SimpleQueue[_Copy] = SimpleQueue()
        if size > 1 and _may_fork():
            self._task = self._asked
            try:
                for _ in range(size):
                    self._copies.append(_Copy(_work_on, task))
                    self._free.put(self._copies[-1])
            except BaseException:
                self.close()
                raise
        if size > 1:
            self._executor = ThreadPoolExecutor(size)

    def submit(self, *arguments: Any) -> Future:
        """Have the task done; ask `result_of` for the result."""
        if self._executor is None:
            done: Future = Future()
            done.set_result(self._task(*arguments))
            return done
        return self._executor.submit(self._task, *arguments)

    @staticmethod
    def result_of(future: Future) -> Any:
        """What a task gave; raises what it raised.

        Raises
        ------
        WorkerDied : its process did not live to say.
        """
        return future.result()

    def close(self) -> None:
        """Forget what is not done, and part at once from copies, whatever they are at."""
        for copy in self._copies:
            copy.kill()
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None
        for copy in self._copies:
            copy.part()
        self._copies = []

    def _asked(self, *arguments: Any) -> Any:
        copy = self._free.get()
        try:
            copy.tell(arguments)
            return copy.heard()
        finally:
            self._free.put(copy)


class _Copy:
    """A forked copy of this process, which does some work at the other end of a line; it ends with this process.

    Parameters
    ----------
    work : called there with the task and the line.
    """

    def __init__(self, work: Callable[[Any, Any], None], task: Any) -> None:
        import multiprocessing

        context = multiprocessing.get_context("fork")
        self._line, there = context.Pipe()
        self._process = context.Process(target=_in_copy, args=(work, task, self._line, there), daemon=True)
        # This process's handlers are not the copy's: raised there they would undo what is being made here.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        try:
            self._process.start()
            there.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        except BaseException:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            self.kill()
            self.part()
            raise

    def tell(self, word: Any) -> None:
        with suppress(OSError):  # it has ended: `heard` says so
            self._line.send(word)

    def heard(self) -> Any:
        """What the copy answers, or raises; `WorkerDied` where it did not live to say."""
        try:
            said, error = self._line.recv()
        except (EOFError, OSError):
            self._process.join()
            raise WorkerDied(
                f"a copy of this process ended with {self._process.exitcode} (out of memory?)"
            ) from None
        if error is not None:
            raise error
        return said

    def kill(self) -> None:
        if self._process.pid is not None:
            self._process.kill()

    def part(self) -> None:
        if self._process.pid is not None:
            self._process.join()
        self._line.close()


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


def _in_copy(work: Callable[[Any, Any], None], task: Any, parents: Any, line: Any) -> None:
    parents.close()
    leave_signals_to_parent()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPS)
    with suppress(EOFError, OSError):  # nobody is there any more
        work(task, line)


def _work(task: Generator[None, Any, None], line: Any) -> None:
    _answer(line, _go_on, task, line.recv)


def _work_on(task: Callable[..., Any], line: Any) -> None:
    while True:
        _answer(line, task, *line.recv())


def _answer(line: Any, task: Callable[..., Any], *arguments: Any) -> None:
    """Say what a task gives or raises."""
    said, failed = None, None
    try:
        said = task(*arguments)
    except Exception as error:
        error.add_note(traceback.format_exc())
        failed = error
    line.send((said, failed))


def _go_on(task: Generator[None, Any, None], heard: Callable[[], Any]) -> None:
    next(task)
    while True:
        try:
            task.send(heard())
        except StopIteration:
            return
