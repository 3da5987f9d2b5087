"""Monte Carlo runs, in parallel, each with its own reproducible seed."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from typing import Any, TypeVar

import numpy as np

from obsnet.beside import leave_signals_to_parent
from obsnet.config import require_seed
from obsnet.errors import ConfigError, WorkerDied

Outcome = TypeVar("Outcome")
Progress = Callable[[int, int], None]


def seeds(runs: int, seed: int) -> list[np.random.SeedSequence]:
    """One independent seed per run; run i has the same seed whatever `runs` is.

    >>> one, two = seeds(2, seed=7)
    >>> one.spawn_key, two.spawn_key
    ((0,), (1,))
    """
    if isinstance(runs, bool) or not isinstance(runs, (int, np.integer)) or runs < 1:
        raise ConfigError(f"a Monte Carlo study needs a whole number of runs, at least 1, found {runs!r}")
    require_seed(seed)
    return np.random.SeedSequence(int(seed)).spawn(int(runs))


def run(
    trial: Callable[..., Outcome],
    runs: int,
    seed: int,
    jobs: int = 1,
    progress: Progress | None = None,
    arguments: Sequence[Any] = (),
) -> list[Outcome]:
    """Outcomes of `trial(rng, *arguments)` over independent runs, in the order of the runs.

    The result does not depend on `jobs`, nor the first runs on how many follow.

    Parameters
    ----------
    trial : callable
        Takes a `numpy.random.Generator` and `arguments`; a module-level function where `jobs` > 1, because it
        crosses to other processes, as do the arguments and the outcomes.
    runs : int
    seed : int
    jobs : int
        Processes; 1 stays in this one.
    progress : callable(done, total), optional
        Called in this process after each run.

    Raises
    ------
    ConfigError
        `runs`, `seed` or `jobs` is out of range.
    WorkerDied
        A process did not live to say what its runs gave.
    Exception
        What a trial raises; the other runs end there, as they do on an interruption.
    """
    if isinstance(jobs, bool) or not isinstance(jobs, (int, np.integer)) or jobs < 1:
        raise ConfigError(f"a Monte Carlo study needs at least 1 job, found {jobs!r}")
    sequences = seeds(runs, seed)
    if jobs == 1 or runs == 1:
        outcomes = []
        for sequence in sequences:
            outcomes.append(trial(np.random.default_rng(sequence), *arguments))
            if progress is not None:
                progress(len(outcomes), runs)
        return outcomes
    before = set(multiprocessing.active_children())
    with ProcessPoolExecutor(
        min(jobs, runs),
        multiprocessing.get_context("spawn"),
        initializer=leave_signals_to_parent,
    ) as pool:
        futures = [pool.submit(_one, trial, sequence, tuple(arguments)) for sequence in sequences]
        try:
            _follow(futures, progress)
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - before:
                worker.terminate()
                worker.join()
            if isinstance(error, BrokenExecutor):
                raise WorkerDied("a process of the runs died (out of memory?); give fewer --jobs") from None
            raise
        return [future.result() for future in futures]


def _one(trial: Callable[..., Outcome], sequence: np.random.SeedSequence, arguments: tuple) -> Outcome:
    return trial(np.random.default_rng(sequence), *arguments)


def _follow(futures: list[Future], progress: Progress | None) -> None:
    pending, done = set(futures), 0
    while pending:
        finished, pending = wait(pending, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
            done += 1
            if progress is not None:
                progress(done, len(futures))
