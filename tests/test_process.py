"""The command as a process: what it imports, and how it ends when it is interrupted, unheard or out of room."""

import os
import platform
import re
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr

ROOT = Path(__file__).parents[1]
HEAVY = ("torch", "obspy", "xarray", "pandas", "numba", "onnxruntime", "scipy", "matplotlib")


def environment():
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def python(code, *arguments, **options):
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60, **options)


def command(*arguments):
    return [sys.executable, "-m", "obsnet", *map(str, arguments)]


def tracking(record, out, *options):
    given = ("track", record / "waveforms.mseed", "--station", record / "station.xml", "--out", out)
    return command(*given, "--set", "spectra.block_s=300", *options)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def heavy_after(code):
    told = python(
        f"import sys\n{code}\nprint(*[name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    assert told.returncode == 0, told.stderr
    return told.stderr.split()


def test_importing_brings_nothing_heavy():
    assert heavy_after("import obsnet") == []
    assert heavy_after("import obsnet, obsnet.cli") == []
    assert heavy_after("from obsnet.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass") == []


def test_a_run_and_a_station_bring_no_compiler():
    """Loading compiled loops would cost a process more time and memory than they save it."""
    assert not {"numba", "matplotlib", "scipy"} & set(
        heavy_after("import obsnet.run, obsnet.live.watch, obsnet.detectors.learned_range")
    )


FIVE_CORES = """
import os, sys
os.sched_getaffinity = lambda process: set(range(5))
from obsnet.cli import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize("detector", ["learned", "analytic"])
def test_how_many_processes_make_the_maps_changes_nothing(record, tmp_path, detector):
    for jobs in (1, 2, 5):
        given = tracking(record, tmp_path / str(jobs), "--quiet", "--jobs", jobs, "--detector", detector)
        done = subprocess.run(
            [*given[:1], "-c", FIVE_CORES, *given[3:]],
            env=environment(), capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    for name in ("detections.csv", "tracks.csv"):
        assert len({(tmp_path / str(jobs) / name).read_bytes() for jobs in (1, 2, 5)}) == 1
    with xr.open_dataset(tmp_path / "1/maps.nc") as one, xr.open_dataset(tmp_path / "5/maps.nc") as five:
        assert one.identical(five)


def test_the_check_of_imports_can_fail():
    assert "obspy" in heavy_after("import obsnet\nobsnet.Station")


@pytest.mark.parametrize("collects", [True, False])
def test_loading_leaves_the_collector_as_it_was(collects):
    told = python(f"""
import gc
from obsnet import console
(gc.enable if {collects} else gc.disable)()
with console.loading():
    assert not gc.isenabled()
    import json
assert gc.isenabled() == {collects} and gc.get_freeze_count() > 1000
""")
    assert told.returncode == 0, told.stderr


def test_importing_is_quick():
    code = "import sys, time; begin = time.perf_counter(); __import__(sys.argv[1]); print(time.perf_counter() - begin)"

    def seconds(package):
        return statistics.median(float(python(code, package).stdout) for _ in range(5))

    assert seconds("obsnet") < 4 * seconds("numpy")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_what_was_there(record, finished, tmp_path, number):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    before = contents(out)
    with subprocess.Popen(
        tracking(record, out), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while not any(any(stage.iterdir()) for stage in out.glob(".*.tmp")):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert errors == ""
    assert contents(out) == before


def test_an_interrupted_run_leaves_no_folder(record, tmp_path):
    out = tmp_path / "new" / "out"
    with subprocess.Popen(
        tracking(record, out), env=environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
    assert not (tmp_path / "new").exists()


def test_a_reader_who_leaves_does_not_stop_the_run(record, finished, tmp_path):
    out = tmp_path / "out"
    with subprocess.Popen(
        tracking(record, out), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
    assert (process.returncode, errors) == (0, "")
    assert (out / "tracks.csv").read_bytes() == (finished / "tracks.csv").read_bytes()


def test_help_that_nobody_reads():
    reading, writing = os.pipe()
    os.close(reading)
    told = subprocess.run(
        command("--help"), env=environment(), stdout=writing, stderr=subprocess.PIPE, timeout=60
    )
    os.close(writing)
    assert (told.returncode, told.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_standard_output_without_room():
    with open("/dev/full", "w") as full:
        told = subprocess.run(
            command("version"), env=environment(), stdout=full, stderr=subprocess.PIPE, timeout=60
        )
    assert told.returncode == 2
    assert told.stderr.decode().startswith("obsnet: error: cannot write to standard output: No space left")


@pytest.mark.parametrize("megabytes", [0.02, 3])
def test_a_disk_without_room(record, finished, tmp_path, megabytes):
    def limit():
        size = round(megabytes * 1e6)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    out = tmp_path / "out"
    told = subprocess.run(
        tracking(record, out, "--quiet"), env=environment(), capture_output=True, text=True, timeout=60, preexec_fn=limit
    )  # fmt: skip
    assert told.returncode == 2
    line = rf"obsnet: error: cannot write {re.escape(str(out))}/\w+\.nc: File too large; make room for it\n"
    assert re.fullmatch(line, told.stderr)
    assert not out.exists()


def test_bad_input_is_one_line_of_a_process(record, tmp_path):
    told = subprocess.run(
        tracking(record, tmp_path / "out", "--start", "soon"), env=environment(), capture_output=True, text=True
    )  # fmt: skip
    assert (told.returncode, told.stdout) == (2, "")
    assert (
        told.stderr
        == "obsnet: error: cannot read the time 'soon'; give ISO 8601, e.g. 2013-05-21T10:00:00Z\n"
    )


@pytest.mark.parametrize(("before", "threads"), [("", "1"), ("import numpy", "None")])
def test_children_compute_with_the_threads_of_their_parent(before, threads, monkeypatch):
    """BLAS reads its threads once: what is set after numpy would hold for child processes alone."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    code = f"""
{before}
import os
from obsnet.cli import main
try:
    main(["version"])
except SystemExit:
    pass
print(os.environ.get("OPENBLAS_NUM_THREADS"))
"""
    assert python(code).stdout.split()[-1] == threads


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc's allocator")
def test_kept_memory_is_not_faulted_in_again():
    code = """
import resource, sys
import numpy as np
from obsnet.console import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    one = np.ones(1 << 18)
    two = 2.0 * one
    del one, two
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    faults = {how: int(python(code, how).stdout) for how in ("kept", "given back")}
    assert faults["kept"] < 0.5 * faults["given back"]
