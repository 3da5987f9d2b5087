import multiprocessing
import os
import time

import numpy as np
import pytest

from obsnet.errors import ConfigError, FilterError, WorkerDied
from obsnet.experiments import montecarlo


def draw(rng, scale=1.0):
    return scale * rng.normal(size=3)


def die(rng):
    raise FilterError("all weights are zero")


def test_outcomes_do_not_depend_on_the_number_of_processes():
    alone = montecarlo.run(draw, runs=4, seed=3, jobs=1, arguments=(2.0,))
    together = montecarlo.run(draw, runs=4, seed=3, jobs=2, arguments=(2.0,))
    np.testing.assert_array_equal(alone, together)


def test_the_first_runs_do_not_depend_on_how_many_follow_and_seeds_differ():
    few, many = (montecarlo.run(draw, runs=n, seed=5) for n in (2, 6))
    np.testing.assert_array_equal(few, many[:2])
    assert len({outcome[0] for outcome in many}) == 6
    assert not np.array_equal(few, montecarlo.run(draw, runs=2, seed=6))


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_counts_every_run_once(jobs):
    seen = []
    montecarlo.run(draw, runs=3, seed=0, jobs=jobs, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def end_abruptly(rng):
    os._exit(9)


def test_a_process_that_dies_is_an_error_of_its_own():
    with pytest.raises(WorkerDied):
        montecarlo.run(end_abruptly, runs=4, seed=0, jobs=2)


def say_and_wait(rng, folder):
    (folder / f"{os.getpid()}").touch()
    time.sleep(60.0)


def wait_for(wish, seconds=30.0):
    until = time.monotonic() + seconds
    while not wish():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_runs_end_with_the_process_that_wants_them(tmp_path, alive):
    wanting = multiprocessing.get_context("spawn").Process(
        target=montecarlo.run, args=(say_and_wait, 2, 0, 2, None, (tmp_path,))
    )
    wanting.start()
    wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    wanting.kill()
    wanting.join()
    wait_for(lambda: not any(alive(int(path.name)) for path in tmp_path.iterdir()))


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failing_trial_fails_the_study(jobs):
    with pytest.raises(FilterError, match="all weights are zero"):
        montecarlo.run(die, runs=3, seed=0, jobs=jobs)


def linger(rng):
    time.sleep(120.0 if rng.random() > 0.5 else 0.0)


def runs(pid):
    """Whether there is a process: of two threads that wait for one, multiprocessing tells the later nothing."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_an_interruption_ends_the_runs_that_go_on():
    seed = 1
    quick = [np.random.default_rng(sequence).random() < 0.5 for sequence in montecarlo.seeds(2, seed)]
    assert sorted(quick) == [False, True]

    def interrupt(done, total):
        raise KeyboardInterrupt

    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        montecarlo.run(linger, runs=2, seed=seed, jobs=2, progress=interrupt)
    assert time.monotonic() - begin < 60.0
    assert not [child for child in multiprocessing.active_children() if runs(child.pid)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"runs": 0, "seed": 0}, "number of runs"),
        ({"runs": 2.5, "seed": 0}, "number of runs"),
        ({"runs": 1, "seed": -1}, "seed"),
        ({"runs": 1, "seed": 0, "jobs": 0}, "job"),
    ],
)
def test_bad_requests_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        montecarlo.run(draw, **settings)
