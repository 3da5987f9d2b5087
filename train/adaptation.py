"""What adapting the shipped models to a station is worth, on simulated records of the second generator, which training never uses:

    python train/adaptation.py --folder WORK [--days 60] [--others 40] [--seed 0]

One station, its sea and its faults are drawn; it records six hours a day, with one ship or two that AIS knows. `--days` of these are an
archive, to which both models are adapted as docs/training.md says; `--others`, every second of them without a ship, are what the models as
shipped and as adapted are measured on. The command goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
from elsewhere import kinds

from obsnet.layout import iso
from obsnet.learn import azimuth_training, range_training
from obsnet.learn.azimuth import AzimuthRows, AzimuthTaskConfig
from obsnet.learn.calibration import apply, metrics, outputs
from obsnet.learn.dataset import PreparedSet
from obsnet.learn.prepare import ArchiveData, archive_record, fill, prepare
from obsnet.learn.range_calibration import looked_at, measure

MODELS = Path(__file__).parents[1] / "obsnet" / "models"
DAY_S = 86400.0
HOURS = 6.0
FIRST_DAY = 1.62e9 // DAY_S * DAY_S
FIRST_OTHER = 1000
"""Day of the first record that both models are measured on."""
WITH_SHIPS = ("ordinary", "faint", "two_ships", "turning_ship", "whales_and_earthquakes", "directional_noise")
"""Kinds of record by turns: what a station hears in a season."""


def days(seed: int, first: int, count: int, quiet_every: int = 0) -> Iterator[kinds.Record]:
    """Records of one station on consecutive days, every `quiet_every`-th without a ship; all but the station is drawn anew."""
    station = kinds.compose("ordinary", seed, HOURS)
    for day in range(first, first + count):
        quiet = quiet_every and day % quiet_every == 0
        kind = "no_ship" if quiet else WITH_SHIPS[day // (quiet_every or 1) % len(WITH_SHIPS)]
        made = kinds.compose(kind, 100_000 + 1000 * seed + day, HOURS)
        start = FIRST_DAY + DAY_S * day
        later = start - made.start
        vessels = tuple(
            replace(
                vessel,
                mmsi=200_000_000 + 10 * day + number,
                course=replace(vessel.course, cpa_s=vessel.course.cpa_s + later),
            )
            for number, vessel in enumerate(made.vessels)
        )
        singers = tuple((song, replace(course, cpa_s=course.cpa_s + later)) for song, course in made.singers)
        yield replace(
            made, start=start, sea=station.sea, recorder=station.recorder, vessels=vessels, singers=singers
        )


def archive(folder: Path, records: Iterator[kinds.Record]) -> tuple[float, float]:
    """Write an archive: a file of waveforms and one of AIS for each day, StationXML; returns its span, s since 1970."""
    (folder / "waveforms").mkdir(parents=True, exist_ok=True)
    (folder / "ais").mkdir(exist_ok=True)
    span = (float("inf"), 0.0)
    for made in records:
        span = (min(span[0], made.start), made.start + DAY_S)
        name = iso(made.start)[:10]
        if not (folder / "ais" / f"{name}.csv").exists():
            stream = kinds.record(made.recorder, kinds.synthesise(made), made.start)
            stream.write(
                str(folder / "waveforms" / f"{name}.mseed"), format="MSEED", encoding="STEIM2", reclen=4096
            )
            kinds.inventory(made.recorder).write(str(folder / "station.xml"), format="STATIONXML")
            kinds.ais(made).to_csv(folder / "ais" / f"{name}.csv", index=False)
            print(f"{folder.name}: {name}, {made.kind}", flush=True)
    return span


def of_archive(folder: Path, span: tuple[float, float], absence_known: bool) -> ArchiveData:
    """How an archive is prepared."""
    ais = [str(path) for path in sorted((folder / "ais").glob("*.csv")) if len(pd.read_csv(path))]
    return ArchiveData(
        waveforms=str(folder / "waveforms"),
        stationxml=str(folder / "station.xml"),
        ais=tuple(ais),
        start=iso(span[0]),
        end=iso(span[1]),
        hours=HOURS,
        lead_s=0.0,
        absence_known=absence_known,
    )


def watched_days(folder: Path, span: tuple[float, float], data: ArchiveData) -> PreparedSet:
    """Every day of an archive as a test record."""
    jobs = []
    for day in range(round((span[1] - span[0]) / DAY_S)):
        stretch = (span[0] + DAY_S * day, span[0] + DAY_S * day + 3600.0 * HOURS)
        name = f"other-{day:03d}"
        jobs.append((name, functools.partial(archive_record, name, "test", stretch, data)))
    return fill(folder, data, jobs)


def azimuth_measured(weights: Path, prepared: PreparedSet) -> dict[str, float]:
    """What the azimuth's weights do on test records."""
    network, calibration, _ = azimuth_training.restored(weights)
    labels = AzimuthTaskConfig(prior_odds=calibration.prior_odds)
    said = outputs(network, AzimuthRows(prepared, "test", labels))
    return metrics(apply(said, calibration), said, labels)


def range_measured(weights: Path, prepared: PreparedSet) -> dict[str, float]:
    """What the range's weights do on test records."""
    network, calibration, features, _ = range_training.restored(weights)
    heard = range_training.hear_records(network, [prepared], "test", features, calibration)
    return measure(looked_at(heard, calibration.least), calibration, features)


def main() -> None:
    """Read the command line, make the records, adapt, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--days", type=int, default=60)
    parser.add_argument("--others", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    work = given.folder
    span = archive(work / "archive", days(given.seed, 0, given.days))
    passages = prepare(work / "prepared", of_archive(work / "archive", span, absence_known=False))
    span = archive(work / "others", days(given.seed, FIRST_OTHER, given.others, quiet_every=2))
    others = watched_days(work / "watched", span, of_archive(work / "others", span, absence_known=True))
    adapted = {name: work / name / "weights.pt" for name in ("azimuth", "range")}
    if not adapted["azimuth"].exists():
        azimuth_training.finetune(passages, work / "azimuth", MODELS / "azimuth.pt", say=print)
    if not adapted["range"].exists():
        range_training.finetune([passages], work / "range", MODELS / "range.pt", say=print)
    rows = {}
    for name, measured in (("azimuth", azimuth_measured), ("range", range_measured)):
        for state, weights in (("as shipped", MODELS / f"{name}.pt"), ("adapted", adapted[name])):
            rows[name, state] = measured(weights, others)
    print(f"{given.others} other simulated records of the station, minutes with a presence ratio above 0:")
    print(pd.DataFrame(rows).T.round(3).to_string())


if __name__ == "__main__":
    main()
