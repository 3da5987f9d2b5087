"""Tasks in, results out as they come: in processes of this machine, or on a Dask cluster.

A task that takes its process with it (out of memory, a crash in compiled code) is an answer too: the tasks that were
under way are tried again one at a time, and the one that does it again is given up.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from typing import Any

from obsnet import console
from obsnet.beside import leave_signals_to_parent
from obsnet.errors import ObsnetError, SourceError, WorkerDied

Task = tuple[Callable[[Any], Any], Any]
"""A function that a worker can import, and its argument."""

SINGLE_THREADED = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


Finished = Callable[[Task, Any], Iterable[Task]]
"""Takes a task and its result (or the exception that stands for it); returns further tasks."""


class Workers:
    """An executor whose workers may die.

    Parameters
    ----------
    make : gives a fresh executor. capacity : says how many tasks to keep under way.
    """

    def __init__(self, make: Callable[[], Executor], capacity: Callable[[], int]) -> None:
        self._make, self._capacity = make, capacity
        self._executor = make()

    def run(self, tasks: Iterable[Task], finished: Finished) -> None:
        """Do all tasks and those that they bring; an `ObsnetError` that a task raises ends it all."""
        waiting, suspects, lost = deque(tasks), deque[Task](), list[Task]()
        flying: dict[Future, Task] = {}
        while waiting or suspects or flying:
            console.heed()
            alone = bool(suspects)
            while not lost and len(flying) < (1 if alone else self._capacity()) and (suspects or waiting):
                self._submit(suspects[0] if alone else waiting.popleft(), flying)
            ready, _ = wait(flying, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in ready:
                task = flying.pop(future)
                result = _result(future)
                if isinstance(result, BrokenExecutor) and not alone:
                    lost.append(task)
                    continue
                if isinstance(result, BrokenExecutor):
                    self._renew()
                    result = WorkerDied("the worker process died (out of memory?)")
                if alone:
                    suspects.popleft()
                waiting.extend(finished(task, result))
            if lost and not flying:
                self._renew()
                suspects.extend(lost)
                lost.clear()

    def _renew(self) -> None:
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._executor = self._make()

    def _submit(self, task: Task, flying: dict[Future, Task]) -> None:
        function, argument = task
        try:
            future = self._executor.submit(function, argument)
        except BrokenExecutor:  # a worker died while results were taken; those under way come back broken
            self._renew()
            future = self._executor.submit(function, argument)
        flying[future] = task

    def close(self, wait: bool = False) -> None:
        """Forget what has not begun; leave the workers, or wait until they have gone."""
        self._executor.shutdown(wait=wait, cancel_futures=True)


def _result(future: Future) -> Any:
    """What a task gave, or the exception that stands for it."""
    try:
        return future.result()
    except ObsnetError:
        raise
    except CancelledError:
        raise SourceError("the workers went away; what is finished is kept: run again") from None
    except Exception as error:
        return error


@contextmanager
def local_workers(jobs: int) -> Iterator[Workers]:
    """Processes of this machine, single-threaded each; ended with the block."""
    before = {name: os.environ.get(name) for name in SINGLE_THREADED}
    os.environ.update(dict.fromkeys(SINGLE_THREADED, "1"))
    spawn = multiprocessing.get_context("spawn")
    workers = Workers(
        lambda: ProcessPoolExecutor(jobs, mp_context=spawn, initializer=leave_signals_to_parent), lambda: jobs
    )
    try:
        yield workers
        workers.close(wait=True)
    finally:
        workers.close()
        for child in multiprocessing.active_children():
            child.terminate()
            child.join()
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextmanager
def dask_workers(address: str, folder: str) -> Iterator[Workers]:
    """Workers of the Dask cluster whose scheduler has `address`; they must see `folder` under the same path.

    Raises
    ------
    SourceError : no scheduler answers there, or a worker does not see the folder.
    """
    from distributed import Client

    try:
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split())[:150] or type(error).__name__
        raise SourceError(f"no Dask scheduler answers at {address} ({reason}); check --scheduler") from None
    try:
        for worker, sees in client.run(os.path.isdir, folder).items():
            if not sees:
                raise SourceError(
                    f"the Dask worker {worker} does not see {folder}; workers must share the disk"
                )
        workers = Workers(
            lambda: client.get_executor(pure=False),
            lambda: max(2 * sum(client.nthreads().values()), 1),
        )
        yield workers
    finally:
        client.close(timeout=5)
