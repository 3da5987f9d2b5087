"""Run `obsea` on the simulated test week of `obsnet reproduce table1` and keep its Table I (takes about half an hour).

python tests/bench/obsea_week.py --seed 0
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import pandas as pd
from obsea_stages import run

from obsnet.evaluation import evaluate
from obsnet.experiments import table1
from obsnet.ocean.rays import propagation_table
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.run import travel_time


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="keep the simulated week here")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        reference = table1.ships()
        if not (folder / "waveforms.mseed").exists():
            table1.simulate(folder, reference, arguments.seed)
        seconds = run(folder, folder / "obsea")
        detections = pd.read_csv(folder / "obsea" / "detections.csv", parse_dates=["time"])
        detections["time"] = detections["time"].dt.tz_localize(None)
        tracks = pd.read_csv(folder / "obsea" / "tracks.csv")
        delay = travel_time(propagation_table(OceanConfig(), table1.DEPTH_M))
        evaluation = evaluate(detections, tracks, reference, delay)
    kept = {
        "command": f"python tests/bench/obsea_week.py --seed {arguments.seed}",
        "seed": arguments.seed,
        "seconds": seconds,
        "table": evaluation.table(),
        "evaluation": evaluation.to_json(),
    }
    target = Path(table1.__file__).with_name("table1_obsea.json")
    target.write_text(json.dumps(kept, indent=1) + "\n")
    print(evaluation.table())


if __name__ == "__main__":
    main()
