"""Workers of an archive: processes that may die, and a Dask cluster."""

import math
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from obsnet.archive.workers import SINGLE_THREADED, WorkerDied, local_workers

pytest.importorskip("pyarrow")
distributed = pytest.importorskip("distributed")
ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


def results(tasks, brings=()):
    found = {}

    def finished(task, result):
        found[task] = result
        return brings if result == 4.0 else []

    with local_workers(2) as workers:
        workers.run(tasks, finished)
    return found


def test_tasks_bring_tasks_and_an_error_is_a_result():
    found = results([(math.sqrt, 16.0), (math.sqrt, -1.0)], brings=[(math.sqrt, 25.0)])
    assert found[math.sqrt, 16.0] == 4.0 and found[math.sqrt, 25.0] == 5.0
    assert isinstance(found[math.sqrt, -1.0], ValueError)


def test_a_worker_that_dies_is_a_result_and_the_others_are_done():
    tasks = [(math.sqrt, 1.0), (os._exit, 9), (math.sqrt, 81.0), (math.sqrt, 25.0)]
    found = results(tasks)
    assert isinstance(found.pop((os._exit, 9)), WorkerDied)
    assert list(found.values()) and all(value == math.sqrt(task[1]) for task, value in found.items())
    assert len(found) == 3


def test_workers_that_die_while_a_result_is_taken_are_replaced():
    """The pool is broken by the time that the next task would be sent."""
    tasks = [(math.sqrt, 4.0), (time.sleep, 2.0), (math.sqrt, 81.0), (math.sqrt, 25.0)]
    before, found = set(multiprocessing.active_children()), {}

    def finished(task, result):
        found[task] = result
        if task == tasks[0]:
            for worker in set(multiprocessing.active_children()) - before:
                worker.kill()
            time.sleep(1.0)
        return []

    with local_workers(2) as workers:
        workers.run(tasks, finished)
    assert found == dict(zip(tasks, [2.0, None, 9.0, 5.0], strict=True))


def test_workers_have_one_thread():
    before = dict(os.environ)
    found = results([(os.getenv, name) for name in SINGLE_THREADED])
    assert set(found.values()) == {"1"}
    assert dict(os.environ) == before


def done(out):
    return list(pd.read_csv(out / "report.csv")["status"])


def test_on_a_local_cluster(command, sds, tmp_path):
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        status, _, errors = command(sds, tmp_path / "dask", "--scheduler", cluster.scheduler_address)
    assert (status, errors) == (0, [])
    assert done(tmp_path / "dask") == ["done"]
    assert command(sds, tmp_path / "here", "--jobs", "1")[0] == 0
    tables = [pd.read_parquet(tmp_path / name / "detections") for name in ("dask", "here")]
    pd.testing.assert_frame_equal(*tables)


def test_on_a_scheduler_in_its_own_process(command, three_days, tmp_path):
    address = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def start(*words):
        line = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(address)]
        return subprocess.Popen(
            line, env=environment, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    processes = [start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")]
    try:
        processes.append(start("worker", "--nworkers", "1", "--nthreads", "1", "--no-dashboard"))
        with distributed.Client(scheduler_file=str(address), timeout=60, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
            where = client.scheduler.address
        status, _, _ = command(three_days, tmp_path / "out", "--scheduler", where, end="2013-05-24")
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(20)
    assert status == 3
    assert done(tmp_path / "out") == ["done", "failed", "done"]


def test_a_scheduler_that_goes_away_is_one_line(command, sds, tmp_path):
    with distributed.LocalCluster(n_workers=0, dashboard_address=None, host="127.0.0.1") as cluster:
        where = cluster.scheduler_address
    begun = time.monotonic()
    status, _, errors = command(sds, tmp_path / "out", "--scheduler", where)
    assert status == 2 and len(errors) == 1 and "no Dask scheduler answers" in errors[0]
    assert time.monotonic() - begun < 30
