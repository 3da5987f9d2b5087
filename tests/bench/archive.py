"""Two workers against one on the same station-days: ``python tests/bench/archive.py [--days 4] [--repeat 1]``.

Waveforms are simulated: one day, under the dates of several. Whole `obsnet archive` processes are timed from outside, one
thread each worker; the ratio is to be at least 1.8 on two idle cores. Prints what docs/archive.md plans with: seconds and bytes of
a station-day.
"""

from __future__ import annotations

import argparse
import os
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


def wall(folder: Path, count: int, jobs: int) -> tuple[float, pd.DataFrame]:
    """Seconds of a whole process, and its report."""
    out = folder / f"out-{jobs}"
    shutil.rmtree(out, ignore_errors=True)
    end = str((obspy.UTCDateTime(2013, 5, 21) + 86400 * count).date)
    command = [sys.executable, "-m", "obsnet", "archive", str(folder / "sds"), "--stations",
               str(folder / "simulated" / "station.xml"), "--start", "2013-05-21", "--end", end, "--out", str(out), "--jobs",
               str(jobs), "--quiet"]  # fmt: skip
    clock = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - clock, pd.read_csv(out / "report.csv")


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
        wall(folder, 1, 1)  # compiled loops into their cache
        load = os.getloadavg()[0]
        walls = {
            jobs: [wall(folder, arguments.days, jobs) for _ in range(arguments.repeat)] for jobs in (1, 2)
        }
        best = {jobs: min(seconds for seconds, _ in found) for jobs, found in walls.items()}
        report = walls[1][0][1]
        print(f"{os.cpu_count()} cores, load {load:.1f} before; {arguments.days} simulated station-days")
        print(
            f"one worker {best[1]:.1f} s, two workers {best[2]:.1f} s: {best[1] / best[2]:.2f} times as fast"
        )
        print(
            f"a station-day: {report['seconds'].median():.1f} s, {report['bytes'].median() / 1e6:.1f} MB; "
            f"whole process over days {best[1] / arguments.days:.1f} s"
        )


if __name__ == "__main__":
    main()
