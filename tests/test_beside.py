"""A task beside this process: it works at once, hears a word, and its errors come back."""

import os
import subprocess
import sys

import pytest

from obsnet.beside import Beside
from obsnet.errors import OutputError


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
