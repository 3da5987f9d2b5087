"""How obsnet does on simulated records, folder by folder: ships found, missed and false; minutes right and wrong above thresholds.

    python train/score.py RECORD… [--above 0 2] [--set section.key=value]

A RECORD is a folder that `train/plain.py`, `train/unseen.py`, `train/ablate.py` or `obsnet simulate` wrote: waveforms.mseed, station.xml,
ais.csv and, for the minutes, truth.csv. A minute's azimuth is right within 10° of a ship.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import obsnet
from obsnet.ais import read, reference_tracks
from obsnet.config import build, merge_overrides
from obsnet.evaluation import evaluate
from obsnet.experiments.ablation_minutes import minute_table
from obsnet.pipeline import RunConfig
from obsnet.run import Run

EXPECTED_CPA_M = 25e3
"""Ships that come no closer need not be found; a track of one is not false."""
REGIONS = {50: 0.6745, 90: 1.645}
"""Standard deviations of a normal error's central regions, by per cent."""


def ships(run: Run, folder: Path) -> dict[str, Any]:
    """Ships of a record's AIS found and missed, false tracks; errors and stated spreads of the found (s, m, deg, m/s)."""
    station = run.station
    where = (station.latitude, station.longitude)
    if pd.read_csv(folder / "ais.csv").empty:
        return {"found": 0, "missed": 0, "false": len(run.tracks), "errors": []}
    about = reference_tracks(read(folder / "ais.csv", near=where), where, max_cpa_m=None)
    said = evaluate(run.detections, run.tracks, about, run.delay, expected_cpa_m=EXPECTED_CPA_M)
    found = [ship for ship in said.ships if ship.number and ship.track is not None]
    errors = [
        (s.cpa_time_error_s, s.cpa_distance_error_m, s.course_error_deg, s.speed_error_mps) for s in found
    ]
    spread = [run.tracks[ship.track - 1].std for ship in found if ship.track is not None]
    return {
        "found": len(found),
        "missed": len(said.missed),
        "false": len(said.false_tracks),
        "errors": np.abs(errors),
        "of_spread": np.abs(errors) / np.array(spread),
    }


def minutes(run: Run, folder: Path) -> pd.DataFrame | None:
    """A row for each minute with data, with its azimuth's ratio of presence, whether it is right, whether there is a ship."""
    if not (folder / "truth.csv").exists() or "azimuth_llr" not in run.maps:
        return None
    table = minute_table(run.maps, pd.read_csv(folder / "truth.csv"))
    table = table[table["covered"] > 0]
    return table.assign(ship=np.isfinite(table["range_true_m"]))


def in_words(rows: pd.DataFrame, above: list[float]) -> str:
    """Shares right and minutes wrong an hour above each threshold."""
    text = []
    for threshold in above:
        said = rows["azimuth_llr"] > threshold
        right = (said & (rows["azimuth_right"] > 0) & rows["ship"]).sum()
        share = f"{right / rows['ship'].sum():.3f} right, " if rows["ship"].any() else ""
        text.append(f"above {threshold:g}: {share}{60 * (said.sum() - right) / len(rows):.2f} wrong an hour")
    return "; ".join(text)


def main() -> None:
    """Read the command line, track every record, print a line for each and one for all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, nargs="+")
    parser.add_argument("--above", type=float, nargs="+", default=[0.0, 2.0], help="log presence ratios")
    parser.add_argument("--set", action="append", default=[], help="as of obsnet track")
    given = parser.parse_args()
    config = build(RunConfig, merge_overrides({}, given.set))
    scores, tables = [], []
    for folder in given.records:
        station = obsnet.Station.from_stationxml(folder / "station.xml")
        run = obsnet.track(folder / "waveforms.mseed", station, config=config)
        score, table = ships(run, folder), minutes(run, folder)
        scores.append(score)
        line = f"{folder.name}: " + ", ".join(
            f"{score[name]} {name}" for name in ("found", "missed", "false")
        )
        if table is not None:
            tables.append(table)
            line += f"; azimuth {in_words(table, given.above)}"
        print(line, flush=True)
    total = {name: sum(score[name] for score in scores) for name in ("found", "missed", "false")}
    print(
        f"{len(scores)} simulated records: " + ", ".join(f"{count} {name}" for name, count in total.items())
    )
    if total["found"]:
        told = [score for score in scores if len(score["errors"])]
        errors = np.median(np.concatenate([score["errors"] for score in told]), axis=0)
        print("medians of the errors: {:.1f} s, {:.0f} m, {:.2f}°, {:.2f} m/s".format(*errors))
        for share, reach in REGIONS.items():
            within = 100 * (np.concatenate([score["of_spread"] for score in told]) <= reach).mean(axis=0)
            print(
                f"{share} % regions hold CPA time, distance, course, speed in {', '.join(f'{x:.0f}' for x in within)} %"
            )
    if tables:
        print(f"azimuth {in_words(pd.concat(tables), given.above)}")


if __name__ == "__main__":
    main()
