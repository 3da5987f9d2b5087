"""Two workers against one on the same station-days: ``python tests/bench/archive.py [--days 4] [--repeat 1]``.

Waveforms are simulated: one day, under the dates of several. Whole `obsnet archive` processes are timed from outside, one
thread each worker; the ratio is to be at least 1.8 on two idle cores. Prints what docs/archive.md plans with: seconds and bytes of
a station-day.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import obspy
import pandas as pd


def days(folder: Path, count: int) -> None:
    """A simulated day with two ships, as an SDS archive of `count` days."""
    made = folder / "simulated"
    command = [sys.executable, "-m", "obsnet", "simulate", "--out", str(made), "--hours", "24", "--seed", "7", "--ships", "2",
               "--start", "2013-05-21T00:00:00Z", "--quiet"]  # fmt: skip
    subprocess.run(command, check=True)
    stream = obspy.read(made / "waveforms.mseed").merge()
    for number in range(count):
        for trace in stream.split():
            trace.stats.starttime += 86400 * number
            date = trace.stats.starttime + 1.0
            network, station, _, channel = trace.id.split(".")
            path = folder / "sds" / str(date.year) / network / station / f"{channel}.D"
            path.mkdir(parents=True, exist_ok=True)
            with (path / f"{trace.id}.D.{date.year}.{date.julday:03d}").open("ab") as file:
                trace.write(file, format="MSEED", encoding="STEIM2")


def run(folder: Path, count: int, jobs: int) -> tuple[float, float, pd.DataFrame]:
    """Wall and processor seconds of a whole process with its workers, and its report."""
    out = folder / f"out-{jobs}"
    shutil.rmtree(out, ignore_errors=True)
    end = str((obspy.UTCDateTime(2013, 5, 21) + 86400 * count).date)
    command = [sys.executable, "-m", "obsnet", "archive", str(folder / "sds"), "--stations",
               str(folder / "simulated" / "station.xml"), "--start", "2013-05-21", "--end", end, "--out", str(out), "--jobs",
               str(jobs), "--quiet"]  # fmt: skip
    clock, before = time.perf_counter(), processor()
    subprocess.run(command, check=True)
    return time.perf_counter() - clock, processor() - before, pd.read_csv(out / "report.csv")


def processor() -> float:
    """Processor seconds of all children so far, theirs included."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--days", type=int, default=4)
    parser.add_argument("--repeat", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        days(folder, arguments.days)
        run(folder, 1, 1)  # compiled loops into their cache
        load = os.getloadavg()[0]
        runs = {jobs: [run(folder, arguments.days, jobs) for _ in range(arguments.repeat)] for jobs in (1, 2)}
        one, two = (min(runs[jobs], key=lambda done: done[0]) for jobs in (1, 2))
        report = one[2]
        print(f"{os.cpu_count()} cores, load {load:.1f} before; {arguments.days} simulated station-days")
        print(f"one worker {one[0]:.1f} s, two workers {two[0]:.1f} s: {one[0] / two[0]:.2f} times as fast")
        print(f"processor seconds: one worker {one[1]:.1f}, two workers {two[1]:.1f}")
        print(
            f"a station-day: {report['seconds'].median():.1f} s, {report['bytes'].median() / 1e6:.1f} MB; "
            f"processor, tracking and start included, {one[1] / arguments.days:.1f} s; "
            f"greatest process {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024:.0f} MB"
        )


if __name__ == "__main__":
    main()
