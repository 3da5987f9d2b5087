"""The core paper's test week: real courses of eleven ships, simulated waveforms at station RR03, the paper's Table I.

The courses are those of the satellite AIS that package `obsea` carries (21–26 May 2013); the waveforms are the twin's. The
table shows obsnet's rows beside the paper's printed ones (real waveforms) and beside `obsea`'s on the same simulated ones,
kept in ``table1_obsea.json`` with the command that made it.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from obsnet.ais import ReferenceTrack, read, reference_tracks
from obsnet.config import build, require_seed
from obsnet.errors import ConfigError, ModelError, ObsnetError
from obsnet.evaluation import Evaluation, evaluate
from obsnet.layout import to_posix
from obsnet.pipeline import RunConfig
from obsnet.run import Run, track
from obsnet.signals.station import Station
from obsnet.twin.course import WaypointCourse
from obsnet.twin.instrument import Recorder
from obsnet.twin.scenario import Passage, Scenario
from obsnet.twin.sea import Ambient
from obsnet.twin.ship import Ship
from obsnet.twin.station import write_simulation

LATITUDE, LONGITUDE, DEPTH_M = -21.3732, 54.1294, 4340.0
START, HOURS = "2013-05-21T00:00:00", 144.0
AIS_REACH_M = 130e3
DETECTORS = ("analytic", "learned-azimuth", "learned-range", "learned")

PAPER = {
    "azimuth_n": (287, 293, 251, 178, 103, 43, None, 156, None, 166, 283, 2004),
    "azimuth_smad_deg": (4.2, 7.8, 9.0, 5.6, 17.0, 19.7, None, 7.2, None, 13.6, 7.3, 7.3),
    "range_n": (40, 169, 135, 79, 116, 80, None, 67, None, 20, 15, 777),
    "range_smad_m": (377, 997, 315, 370, 452, 541, None, 400, None, 825, 446, 526),
    "range_rate_smad_kn": (0.21, 0.56, 0.48, 0.51, 0.48, 0.46, None, 0.34, None, 0.60, 0.68, 0.48),
    "cpa_time_s": (83, 86, 33, 22, 30, 8, None, 12, None, 36, 9, 45),
    "course_deg": (1.3, 1.8, 0.8, 2.5, 1.3, 8.1, None, 11.6, None, 5.5, 2.6, 3.6),
    "cpa_distance_m": (108, 1031, 1098, 235, 233, 482, None, 32, None, 1112, 1618, 531),
    "speed_kn": (0.19, 0.13, 0.02, 0.13, 0.30, 0.29, None, 0.31, None, 0.53, 12.92, 0.35),
}
"""Table I as printed: ships 1 to 11, then all; real waveforms."""


@dataclass(frozen=True)
class Result:
    """obsnet's evaluation of the simulated week, and `obsea`'s of the same waveforms where it was kept."""

    obsnet: Evaluation
    obsea: dict[str, Any] | None
    run: Run
    reference: list[ReferenceTrack]
    detectors: dict[str, Evaluation] = field(default_factory=dict)
    """The same waveforms through every detector, where all were asked for."""

    def to_json(self) -> dict[str, Any]:
        """Plain containers."""
        return {
            "simulated_waveforms": True,
            "obsnet": self.obsnet.to_json(),
            "detectors": {name: scored.to_json() for name, scored in self.detectors.items()},
            "obsea": self.obsea,
            "paper": PAPER,
        }

    def table(self) -> str:
        """Obsnet's Table I, then the medians of all three."""
        lines = [
            "Simulated waveforms on the real courses of 21-26 May 2013, station RR03",
            "",
            "obsnet:",
            self.obsnet.table(),
        ]
        if self.detectors:
            lines += ["", "every detector on the same waveforms:", _detector_table(self.detectors)]
        if self.obsea is not None:
            lines += [
                "",
                f"obsea 0.1 on the same waveforms ({self.obsea['command']}; errors against straight lines):",
                self.obsea["table"],
            ]
        lines += ["", "The paper's Table I (real waveforms):", _paper_table()]
        return "\n".join(lines)

    def plot(self, path: str | Path) -> None:
        """The week as a report figure."""
        self.run.plot(path, reference=self.reference)


def reproduce(
    runs: int = 1,
    seed: int = 0,
    progress: Callable[[float, float], None] | None = None,
    jobs: int = 1,
    detector: str | None = None,
) -> Result:
    """Simulate the week, track it, evaluate it.

    Parameters
    ----------
    runs : the week is one record; more than one is refused. seed : of the ships' sounds and the sea.
    progress : called with (done, total). jobs : threads.
    detector : name of a detector; 'all' for each of `DETECTORS` in turn, those without a model left out.

    Raises
    ------
    ConfigError : `runs`, `seed` or `detector` cannot be.
    """
    if runs != 1:
        raise ConfigError(
            f"the week is one record, not a Monte Carlo experiment; asked for {runs} runs, leave --runs out"
        )
    if detector not in (None, "all", *DETECTORS):
        raise ConfigError(f"detector must be one of {', '.join(DETECTORS)}, all; found {detector!r}")
    require_seed(seed)
    reference = ships()
    names: list[str | None] = [*DETECTORS] if detector == "all" else [detector]
    stages = len(names) + 1
    done: dict[str, Evaluation] = {}
    run: Run | None = None
    with tempfile.TemporaryDirectory(prefix="obsnet-table1-") as folder:
        simulate(Path(folder), reference, seed, _part(progress, 0, stages))
        for number, name in enumerate(names, 1):
            try:
                made = _tracked(Path(folder), name, jobs, _part(progress, number, stages))
            except ModelError:
                if detector != "all":
                    raise
                continue
            run = made
            done[run.config.detector] = evaluate(run.detections, run.tracks, reference, run.delay)
        assert run is not None
        # The maps of a week take more than a gigabyte: only those that are drawn come into memory.
        run.maps.load()
        run.features.load()
    every = done if detector == "all" else {}
    return Result(done[run.config.detector], kept_obsea(seed), run, reference, every)


def _tracked(
    folder: Path, detector: str | None, jobs: int, progress: Callable[[float, float], None] | None
) -> Run:
    station = Station.from_stationxml(folder / "station.xml")
    config = RunConfig() if detector is None else build(RunConfig, {"detector": detector})
    return track(
        folder / "waveforms.mseed",
        station,
        config,
        threads=jobs,
        folder=folder / f"run-{detector}",
        progress=progress,
    )


def _part(
    progress: Callable[[float, float], None] | None, stage: int, stages: int
) -> Callable[[float, float], None] | None:
    """Progress of one stage of several alike."""
    return progress and (lambda done, total: progress(stage * total + done, stages * total))


def _detector_table(detectors: dict[str, Evaluation]) -> str:
    """One line for each detector: minutes right and wrong, ships found, medians of the tracks' errors."""
    names: tuple[str, ...] = (
        "detector",
        "az right",
        "wrong/h",
        "range right",
        "wrong/h",
        "found",
        "missed",
        "false",
        "CPA s",
        "course deg",
        "CPA m",
    )
    rows: list[tuple[str, ...]] = [names]
    for name, scored in detectors.items():
        shares = [scored.minutes[sensor] for sensor in ("azimuth", "range")]
        numbers = [f"{share[key]:.2f}" for share in shares for key in ("right", "wrong_or_false_per_hour")]
        found = sum(ship.track is not None for ship in scored.ships)
        errors = (
            scored.total.cpa_time_error_s,
            scored.total.course_error_deg,
            scored.total.cpa_distance_error_m,
        )
        counts = (found, len(scored.missed), len(scored.false_tracks))
        rows.append((name, *numbers, *map(str, counts), *(f"{value:.3g}" for value in errors)))
    widths = [max(len(row[i]) for row in rows) for i in range(len(names))]
    return "\n".join("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in rows)


def ships(max_range_m: float = 100e3) -> list[ReferenceTrack]:
    """The eleven merchant ships that passed within 25 km of the station in the week, in order of their CPA."""
    if find_spec("obsea") is None:
        raise ObsnetError("the AIS of the paper's week comes with package obsea; install obsnet[bench]")
    path = Path(str(find_spec("obsea").origin)).parent / "data" / "ais_week_cls.csv"  # type: ignore[union-attr]
    first = float(to_posix(np.datetime64(START)))
    return reference_tracks(
        read(path, near=(LATITUDE, LONGITUDE)),
        (LATITUDE, LONGITUDE),
        max_range_m=max_range_m,
        max_cpa_m=25e3,
        merchant_only=True,
        starttime=first,
        endtime=first + 3600.0 * HOURS,
    )


def simulate(
    folder: Path,
    reference: list[ReferenceTrack],
    seed: int = 0,
    progress: Callable[[float, float], None] | None = None,
) -> None:
    """Write the week's simulated waveforms, StationXML, AIS and truth to a folder."""
    far = {(track.mmsi, round(track.cpa().time)): track for track in ships(AIS_REACH_M)}
    passages = []
    for number, ship in enumerate(reference, 1):
        whole = far.get((ship.mmsi, round(ship.cpa().time)), ship)
        course = WaypointCourse(whole.time, whole.east_m, whole.north_m, smooth=False)
        passages.append(Passage(Ship.random(1000 * seed + number, 999_000_000 + number), course))
    scenario = Scenario(
        start=float(to_posix(np.datetime64(START))),
        hours=HOURS,
        passages=tuple(passages),
        recorder=Recorder(
            code="YV.RR03",
            latitude=LATITUDE,
            longitude=LONGITUDE,
            depth_m=DEPTH_M,
            orientation_deg=77.0,
            hydrophone_polarity=-1,
        ),
        ambient=Ambient.random(np.random.default_rng([seed, 0x7AB1E1])),
        seed=seed,
    )
    write_simulation(scenario, folder, progress=progress)


def kept_obsea(seed: int) -> dict[str, Any] | None:
    """What `obsea` made of the same waveforms, kept because it takes half an hour; only for the seed that it ran on."""
    path = Path(__file__).with_name("table1_obsea.json")
    if not path.is_file():
        return None
    kept: dict[str, Any] = json.loads(path.read_text())
    return kept if kept["seed"] == seed else None


def _paper_table() -> str:
    names = ("#", "az N", "deg", "r N", "m", "kn", "CPA s", "course deg", "CPA m", "kn")
    columns = [
        [*map(str, range(1, 12)), "All"],
        *([("-" if v is None else f"{v:g}") for v in column] for column in PAPER.values()),
    ]
    widths = [max(len(name), *map(len, column)) for name, column in zip(names, columns, strict=True)]
    rows = [names, *zip(*columns, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    )
