"""The kinds of simulated records that detectors are compared on, and the twin's way of making them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.sound_speed import Munk
from obsnet.twin.course import TurningCourse
from obsnet.twin.faults import Faults, Gap
from obsnet.twin.scenario import Scenario
from obsnet.twin.sea import Ambient
from obsnet.twin.seafloor import Earthquakes
from obsnet.twin.ship import Ship
from obsnet.twin.station import write_simulation
from obsnet.twin.whales import Whale

KINDS = (
    "ordinary", "faint", "whales_and_earthquakes", "directional_noise", "two_ships", "turning_ship", "no_ship",
    "another_depth", "another_bottom", "wrong_sound_speed", "gaps", "another_rate",
)  # fmt: skip
BOTTOMS = (Bottom(1700.0, 200.0, 1600.0), Bottom(3500.0, 1500.0, 2500.0), Bottom(1510.0, 0.0, 1450.0))
DEPTHS_M, RATES_HZ = (2000.0, 1500.0, 3000.0, 5500.0), (100.0, 62.5, 125.0, 250.0)


def write_twin(kind: str, seed: int, hours: float, folder: str | Path) -> None:
    """Write the twin's record of a kind: waveforms.mseed, station.xml, ais.csv, truth.csv, truth.json.

    Raises
    ------
    ConfigError : the kind is not one of `KINDS`.
    """
    write_simulation(twin_scenario(kind, seed, hours), folder)


def twin_scenario(kind: str, seed: int, hours: float) -> Scenario:
    """The twin's scenario of a kind, every draw its own."""
    if kind not in KINDS:
        raise ConfigError(f"no kind of record '{kind}'; choose one of {', '.join(KINDS)}")
    number = 100_000 + 100 * seed + KINDS.index(kind)
    rng = np.random.default_rng([number, 0xAB1])
    ships = {"two_ships": 2, "no_ship": 0}.get(kind, 1)
    rate = RATES_HZ[seed % len(RATES_HZ)] if kind == "another_rate" else 50.0
    scenario = Scenario.random(number, hours, ships, sampling_rate=rate, nuisances=False)
    if scenario.ambient is None:
        scenario = scenario.replace(ambient=Ambient())
    return scenario.replace(**_changes(kind, seed, scenario, rng))


def _changes(kind: str, seed: int, scenario: Scenario, rng: np.random.Generator) -> dict[str, Any]:
    recorder, ocean = scenario.recorder, scenario.ocean
    if kind == "faint":
        return {
            "passages": tuple(
                replace(p, ship=Ship.random(p.ship.seed, p.ship.mmsi, source_level_db=181.0))
                for p in scenario.passages
            )
        }
    if kind == "turning_ship":
        return {"passages": tuple(replace(p, course=_turning(p.course, rng)) for p in scenario.passages)}
    if kind == "another_depth":
        return {"recorder": replace(recorder, depth_m=DEPTHS_M[seed % len(DEPTHS_M)])}
    if kind == "another_bottom":
        return {"ocean": replace(ocean, bottom=BOTTOMS[seed % len(BOTTOMS)])}
    if kind == "wrong_sound_speed":
        faster = 1.0 + 0.02 * (-1) ** seed
        return {"ocean": replace(ocean, munk=Munk(axis_speed_mps=1487.842 * faster))}
    if kind == "gaps":
        begins = np.sort(rng.uniform(600.0, 3600.0 * scenario.hours - 1500.0, 5))
        return {"faults": Faults(gaps=tuple(Gap(float(b), float(rng.uniform(90, 900))) for b in begins))}
    if kind == "no_ship":
        return _nuisance(("none", "directional", "whales", "earthquakes")[seed % 4], scenario, rng)
    if kind in ("directional_noise", "whales_and_earthquakes"):
        names = ("directional",) if kind == "directional_noise" else ("whales", "earthquakes")
        changes: dict[str, Any] = {}
        for name in names:
            changes |= _nuisance(name, scenario, rng)
        return changes
    return {}


def _turning(course: Any, rng: np.random.Generator) -> TurningCourse:
    if not isinstance(course, StraightCourse):
        raise ConfigError("only a straight course can be made to turn")
    start = course.cpa_time + float(rng.choice([-1, 1]) * rng.uniform(900.0, 2700.0))
    return TurningCourse(course, start, float(rng.choice([-1, 1]) * rng.uniform(20.0, 60.0)))


def _nuisance(name: str, scenario: Scenario, rng: np.random.Generator) -> dict[str, Any]:
    if name == "directional":
        azimuth = float(rng.uniform(0.0, 360.0))
        ambient = scenario.ambient or Ambient()
        return {"ambient": replace(ambient, directional_fraction=0.7, directional_azimuth_deg=azimuth)}
    if name == "whales":
        return {"whales": tuple(Whale.random(rng, scenario.start, scenario.end) for _ in range(3))}
    if name == "earthquakes":
        return {"earthquakes": Earthquakes(per_day=240.0, seed=int(rng.integers(2**31)))}
    return {}
