"""Files of an output folder appear together, and what a killed run left goes with the next one."""

import os
import signal
import subprocess
import sys
import time

import pytest

from obsnet.output import staged

HOLD = """
import sys, time
from obsnet.output import staged
with staged(sys.argv[1]) as folder:
    (folder / "half").write_text("half")
    print(folder, flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holding(tmp_path):
    """A process that writes into a folder, and the stage that it writes to."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path / "out"], stdout=subprocess.PIPE, text=True
    )
    yield process, process.stdout.readline().strip()
    process.kill()
    process.wait()


def stages(tmp_path):
    return [str(path) for path in (tmp_path / "out").glob(".unfinished-*")]


def old(stage):
    os.utime(stage, (time.time() - 3600,) * 2)


def test_what_a_killed_run_left_goes_with_the_next(holding, tmp_path):
    process, stage = holding
    process.send_signal(signal.SIGKILL)
    process.wait()
    old(stage)
    assert stages(tmp_path) == [stage]
    with staged(tmp_path / "out") as folder:
        (folder / "whole").write_text("whole")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["whole"]


def test_a_run_that_goes_on_keeps_its_own(holding, tmp_path):
    _, stage = holding
    old(stage)
    with staged(tmp_path / "out"):
        pass
    assert stages(tmp_path) == [stage]
    assert os.listdir(stage) == ["half"]
