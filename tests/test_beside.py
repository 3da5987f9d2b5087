"""A task beside this process: it works at once, hears a word, and its errors come back."""

import os
import signal
import subprocess
import sys
import time

import pytest

from obsnet.beside import Beside, Crew, usable_cores
from obsnet.errors import ConfigError, OutputError


def noted(path, fail=None):
    path.write_text(f"begun {os.getpid()}")
    word = yield
    if fail is not None:
        raise fail
    path.write_text(f"{path.read_text()}, told {word}")


@pytest.mark.parametrize("cores", [1, 2])
def test_both_parts_are_done(tmp_path, cores):
    with Beside(noted(tmp_path / "note"), cores) as task:
        task.tell([1, 2])
        task.finish()
    begun, told = (tmp_path / "note").read_text().split(", ", 1)
    assert told == "told [1, 2]"
    if cores == 1:
        assert begun == f"begun {os.getpid()}"


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_the_first_part_does_not_wait_to_be_told(tmp_path):
    """In a process of its own: this one may have threads of other tests, and then is not forked."""
    code = """
import os, sys, time
from pathlib import Path
from obsnet.beside import Beside

path = Path(sys.argv[1])

def noted():
    path.write_text(str(os.getpid()))
    yield

with Beside(noted(), 2) as task:
    end = time.monotonic() + 10
    while not (path.exists() and path.read_text()) and time.monotonic() < end:
        time.sleep(0.01)
    assert path.read_text() != str(os.getpid())
    task.tell(None)
    task.finish()
"""
    made = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "note"], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr


@pytest.mark.parametrize("cores", [1, 2])
def test_errors_come_back(tmp_path, cores):
    with Beside(noted(tmp_path / "note", OutputError("no room")), cores) as task:
        task.tell(None)
        with pytest.raises(OutputError, match="no room"):
            task.finish()


def test_a_task_that_nobody_waits_for_ends_with_its_process(tmp_path):
    with pytest.raises(KeyboardInterrupt), Beside(noted(tmp_path / "note"), 2):
        raise KeyboardInterrupt
    assert "told" not in ((tmp_path / "note").read_text() if (tmp_path / "note").exists() else "")


def test_a_task_that_is_left_at_once_ends(tmp_path):
    """A process that handles a request to terminate hands its handler to the copy, until that has its own."""
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        for _ in range(30):
            with Beside(noted(tmp_path / "note"), 2):
                pass
    finally:
        signal.signal(signal.SIGTERM, before)


def thrice(number):
    if number < 0:
        raise ConfigError("no negative numbers")
    return 3 * number, os.getpid()


@pytest.mark.parametrize("size", [1, 3])
def test_a_crew_gives_results_and_errors(size):
    """Here the crew may be threads: other tests may have left some."""
    crew = Crew(thrice, size)
    try:
        futures = [crew.submit(n) for n in range(20)]
        assert [crew.result_of(future)[0] for future in futures] == [3 * n for n in range(20)]
        with pytest.raises(ConfigError, match="no negative"):
            crew.result_of(crew.submit(-1))
    finally:
        crew.close()


ALONE = """
import os, sys, time
from obsnet.beside import Crew
from obsnet.errors import WorkerDied
seen = []
def task(what):
    seen.append(what)
    if what == "die":
        os._exit(9)
    if what.startswith("sleep"):
        print(os.getpid(), flush=True)
        time.sleep(60)
    return os.getpid(), len(seen)
"""


def alone(code):
    """In a process of its own, which has no threads and may be copied."""
    return subprocess.run(
        [sys.executable, "-c", ALONE + code], capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_a_crew_is_copies_of_the_process():
    made = alone("""
crew = Crew(task, 2)
found = [crew.result_of(future) for future in [crew.submit("work") for _ in range(8)]]
crew.close()
assert os.getpid() not in {process for process, _ in found}, found
assert not seen
""")
    assert made.returncode == 0, made.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_a_copy_that_dies_is_an_error():
    made = alone("""
crew = Crew(task, 2)
try:
    crew.result_of(crew.submit("die"))
except WorkerDied as error:
    assert "out of memory" in str(error)
else:
    raise SystemExit("it was not said")
crew.close()
""")
    assert made.returncode == 0, made.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_copies_end_with_a_process_that_is_killed(alive):
    made = subprocess.Popen(
        [sys.executable, "-c", ALONE + "crew = Crew(task, 2)\ncrew.submit('sleep')\ntime.sleep(60)"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    copy = int(made.stdout.readline())
    made.kill()
    made.wait()
    end = time.monotonic() + 10
    while alive(copy) and time.monotonic() < end:
        time.sleep(0.05)
    assert not alive(copy)
    made.stdout.close()


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
@pytest.mark.parametrize("dead", ["before", "meanwhile"])
def test_work_for_copies_that_were_killed_is_an_error(dead):
    """More work than a line holds, so that it is being sent when they are killed."""
    made = alone(f"""
import multiprocessing, signal
crew = Crew(task, 2)
def kill():
    for copy in multiprocessing.active_children():
        copy.kill()
        copy.join()
if {dead!r} == "before":
    kill()
futures = [crew.submit("sleep" + 10_000_000 * "!") for _ in range(9)]
if {dead!r} == "meanwhile":
    time.sleep(0.2)
    kill()
for future in futures:
    try:
        crew.result_of(future)
    except WorkerDied as error:
        assert "out of memory" in str(error)
    else:
        raise SystemExit("it was not said")
crew.close()
""")
    assert made.returncode == 0, made.stderr
    assert made.stderr == ""


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
@pytest.mark.parametrize("at", ["work", "a stop"])
def test_a_crew_is_left_at_once(at):
    """Whatever its copies are at, as in half of an answer."""
    begin = time.monotonic()
    made = alone(f"""
import multiprocessing, signal
crew = Crew(task, 2)
futures = [crew.submit("sleep") for _ in range(5)]
time.sleep(0.2)
if {at!r} == "a stop":
    for copy in multiprocessing.active_children():
        os.kill(copy.pid, signal.SIGSTOP)
crew.close()
assert not multiprocessing.active_children()
""")
    assert made.returncode == 0, made.stderr
    assert time.monotonic() - begin < 20


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_a_request_to_the_whole_group_ends_it():
    """As by systemctl stop, Slurm or timeout: the copies die of it while the process unwinds."""
    made = subprocess.run(
        [sys.executable, "-c", ALONE + """
import signal
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
crew = Crew(task, 2)
futures = [crew.submit("sleep" + 10_000_000 * "!") for _ in range(9)]
try:
    os.killpg(0, signal.SIGTERM)
    crew.result_of(futures[0])
finally:
    crew.close()
"""],
        capture_output=True, text=True, check=False, timeout=60, start_new_session=True,
    )  # fmt: skip
    assert (made.returncode, made.stderr) == (143, "")


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
@pytest.mark.parametrize("beside", ["Crew(task, 2)", "Beside(noted(), 2)"])
def test_a_copy_that_is_being_made_does_not_unwind_its_parent(beside):
    """What a handler raises within the copy would otherwise go through all that the parent is in."""
    made = alone(f"""
import multiprocessing, signal
from obsnet.beside import Beside
def noted():
    yield
    yield
def stop(*_):
    print("handled", flush=True)
    sys.exit(143)
signal.signal(signal.SIGTERM, stop)
os.register_at_fork(after_in_child=lambda: os.kill(os.getpid(), signal.SIGTERM))
made = {beside}
for copy in multiprocessing.active_children():
    copy.join()
    assert copy.exitcode == -signal.SIGTERM, copy.exitcode
""")
    assert made.returncode == 0, made.stderr
    assert made.stdout == ""


@pytest.mark.parametrize("asked", [0, -2, 1.5, True, "2"])
def test_numbers_of_workers_that_cannot_be(asked):
    with pytest.raises(ConfigError, match="whole number of at least 1"):
        usable_cores(asked)


@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="processes are bound to cores on Linux alone"
)
def test_no_more_work_at_a_time_than_there_are_cores():
    """Those that this process is bound to, as by taskset or a batch system."""
    before = os.sched_getaffinity(0)
    assert usable_cores() == usable_cores(5000) == len(before)
    assert usable_cores(1) == 1
    os.sched_setaffinity(0, {min(before)})
    try:
        assert usable_cores() == usable_cores(8) == 1
    finally:
        os.sched_setaffinity(0, before)


def test_words_to_a_task_that_has_failed_are_no_error_of_their_own(tmp_path):
    def fails():
        yield
        raise OutputError("no room")
        yield

    with Beside(fails(), 2) as task:
        task.tell(1)
        time.sleep(0.2)
        task.tell(2)
        with pytest.raises(OutputError, match="no room"):
            task.finish()
