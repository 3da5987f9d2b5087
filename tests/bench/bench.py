"""Benchmarks as ratios measured in one run: ``make bench``.

    python tests/bench/bench.py [--hours 8] [--repeat 3] [--python PYTHON] [--detector learned] [--no-obsea] [--no-day] [--no-experiments]

Waveforms are simulated. Whole processes are timed from outside, those of obsnet by the interpreter PYTHON: in an environment
that holds its base install they do not load what only others need (xarray loads dask wherever it is). `obsea`'s figure is the sum of its stages (azimuth, clutter,
range, track) in a process of its own on the same record, run after obsnet's and on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent


def timed(command: list[str], repeat: int) -> tuple[float, float, float]:
    """Median wall and processor seconds and greatest resident megabytes of a command, after one run that is not counted."""
    walls, processor, peaks = [], [], []
    for number in range(repeat + 1):
        clock = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"{' '.join(command)} failed")
        if number:
            walls.append(time.perf_counter() - clock)
            processor.append(usage.ru_utime + usage.ru_stime)
            peaks.append(usage.ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2))
    return statistics.median(walls), statistics.median(processor), max(peaks)


def import_ratio(python: str, repeat: int = 15) -> float:
    """Median time of `import obsnet` over that of `import numpy`, in processes of their own."""

    def measure(module: str) -> float:
        code = f"import time; t = time.perf_counter(); import {module}; print(time.perf_counter() - t)"
        times = [float(subprocess.check_output([python, "-c", code])) for _ in range(repeat)]
        return statistics.median(times)

    return measure("obsnet") / measure("numpy")


def record(folder: Path, hours: float) -> None:
    command = [
        sys.executable,
        "-m",
        "obsnet",
        "simulate",
        "--out",
        str(folder),
        "--hours",
        str(hours),
        "--seed",
        "7",
        "--quiet",
    ]
    subprocess.run(command, check=True)


def track(python: str, folder: Path, repeat: int, detector: str) -> tuple[float, float, float]:
    command = [python, "-m", "obsnet", "track", str(folder / "waveforms.mseed"), "--station", str(folder / "station.xml"),
               "--out", str(folder / "out"), "--quiet", "--detector", detector]  # fmt: skip
    return timed(command, repeat)


EXPERIMENTS = {"tkbd": 4, "bearings": 50, "clicks": 4, "focalization": 2}
"""Runs of each of the other papers' experiments that are timed."""


def experiments(folder: Path) -> None:
    """Seconds per run of each experiment, whole process."""
    for name, runs in EXPERIMENTS.items():
        clock = time.perf_counter()
        command = [sys.executable, "-m", "obsnet", "reproduce", name, "--runs", str(runs), "--json"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder)
        wall = time.perf_counter() - clock
        print(f"obsnet reproduce {name}, {runs} runs: {wall:.1f} s, {wall / runs:.2f} s a run", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--detector", default="learned")
    parser.add_argument("--no-obsea", action="store_true")
    parser.add_argument("--no-day", action="store_true")
    parser.add_argument("--no-experiments", action="store_true")
    arguments = parser.parse_args()
    print(
        f"{os.cpu_count()} cores, Python {sys.version.split()[0]}, simulated waveforms, four channels at 50 Hz"
    )
    print(f"import obsnet / import numpy: {import_ratio(arguments.python):.1f}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "short"
        record(folder, arguments.hours)
        wall, processor, peak = track(arguments.python, folder, arguments.repeat, arguments.detector)
        stages = json.loads((folder / "out" / "run.json").read_text())["seconds"]
        print(
            f"obsnet track, whole process, {arguments.hours:g} h: {wall:.2f} s ({processor:.2f} s on the processors), "
            f"{peak:.0f} MB; stages {stages}"
        )
        if not arguments.no_obsea:
            command = [
                sys.executable,
                str(HERE / "obsea_stages.py"),
                str(folder),
                "--out",
                str(folder / "obsea"),
            ]
            seconds = json.loads(
                subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL).splitlines()[-1]
            )
            theirs = sum(
                seconds[name] for name in ("azimuth", "clutter", "range", "track") if name in seconds
            )
            print(f"obsea, its stages: {theirs:.1f} s { ({k: round(v, 1) for k, v in seconds.items()}) }")
            children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            print(f"obsea / obsnet: {theirs / wall:.0f} times (obsea's peak memory {children:.0f} MB)")
        if not arguments.no_day:
            day = Path(temporary) / "day"
            record(day, 24.0)
            wall, processor, peak = track(
                arguments.python, day, max(arguments.repeat - 2, 1), arguments.detector
            )
            print(
                f"obsnet track, a station-day: {wall:.2f} s ({processor:.2f} s on the processors), {peak:.0f} MB"
            )
        if not arguments.no_experiments:
            experiments(Path(temporary))


if __name__ == "__main__":
    main()
