"""A week through a live station, the bundled passage again and again: is memory flat, and the store?

    python tests/bench/live_week.py [--days 7] [--detector analytic]

Prints resident memory, the size of the database and milliseconds a minute after every half day; ends with an error where
memory after the first day grows by more than 5 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from obsnet.config import build
from obsnet.live.bench import _minutes, _resident_mb
from obsnet.live.config import WatchConfig
from obsnet.live.station import LiveStation
from obsnet.sample import sample_folder
from obsnet.signals.station import Station

_HOUR_NS = 3600 * 10**9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--detector", default="analytic")
    options = parser.parse_args()
    config = build(WatchConfig, {"detector": options.detector})
    station = Station.from_stationxml(sample_folder() / "station.xml")
    # As the command has it: threads of BLAS take longer to wake than a minute's products do.
    with threadpool_limits(1, user_api="blas"), tempfile.TemporaryDirectory(prefix="obsnet-week-") as folder:
        live = LiveStation(station, config, Path(folder) / "out")
        half_days, shift_h, fed = [], 0, 0
        spent = time.process_time()
        while fed < options.days * 1440:
            for packets in _minutes(station, config.live):
                live.take([replace(p, start_ns=p.start_ns + shift_h * _HOUR_NS) for p in packets])
                fed += 1
                if fed % 720 == 0:
                    used, spent = time.process_time() - spent, time.process_time()
                    half_days.append(_resident_mb())
                    size = live.store.path.stat().st_size / 1e6
                    print(
                        f"day {fed / 1440:4.1f}: {half_days[-1]:6.1f} MB resident, database {size:6.1f} MB, "
                        f"{1e3 * used / 720:5.1f} ms a minute, {live.status()['tracks']} tracks",
                        flush=True,
                    )
            shift_h += 5
        live.close()
    after_a_day = half_days[1:]
    if len(after_a_day) > 1 and max(after_a_day[1:]) > 1.05 * after_a_day[0]:
        sys.exit(f"memory grows: {after_a_day[0]:.0f} to {max(after_a_day):.0f} MB")


if __name__ == "__main__":
    main()
