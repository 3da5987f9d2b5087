"""Simulated stations to train on: every nuisance drawn anew in every record, with ships and without.

A network learns whatever tells the records with ships from those without; so whales, earthquakes, tremor, directional noise,
levels, gaps, coupling and errors of the metadata are drawn alike in both.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from obsnet.ais import read
from obsnet.kinematics import StraightCourse
from obsnet.layout import parse_utc, to_posix
from obsnet.learn.oceans import Ocean, OceanSpread, draw_ocean
from obsnet.twin.course import Course, TurningCourse
from obsnet.twin.instrument import Recorder
from obsnet.twin.scenario import Passage, Scenario
from obsnet.twin.sea import Ambient, Lobe
from obsnet.twin.seafloor import Earthquakes
from obsnet.twin.ship import Ship
from obsnet.twin.whales import Whale

SPLIT_SEEDS = 1_000_000
"""What lies between the seeds of the splits: no split hears another's ships, noise or whales."""
STATION = (-21.3732, 54.1294)
"""Latitude and longitude of station RR03, around which the AIS of package `obsea` lies."""
NEVER_TRAINED = (parse_utc("2013-05-21") / 1e9, parse_utc("2013-05-27") / 1e9)
"""The core paper's test week, s since 1970."""
SHARES = {"train": 0.8, "validation": 0.1, "test": 0.1}


@dataclass(frozen=True)
class Scene:
    """A simulated record to be: the scenario, its ocean as it is and as it is believed, and the error of the orientation."""

    scenario: Scenario
    ocean: Ocean
    orientation_error_deg: float


@dataclass(frozen=True)
class SceneConfig:
    """What training scenes are drawn from.

    Parameters
    ----------
    hours : length of a record.
    ship_shares : probabilities of 0, 1, 2 … ships in a record with drawn courses.
    real_course_share : share of the records whose ships follow AIS, where there is any.
    source_level_db, source_level_spread_db : of the ships. lineless_share : of ships that give broadband noise alone, which a
        network must not take for the sea; the lines of the others lie `line_shift_db` above (or below) what the twin draws.
    orientation_error_deg : standard deviation of what StationXML says of the horizontals.
    without_z, without_hydrophone, without_horizontals : shares of records that lack a channel.
    lobe_shares : probabilities of 0, 1, 2 … lobes of noise that turn and swell. choir_share, swarm_share : shares of records with
        whales that sing at any pitch and pace, and with swarms of earthquakes.
    start : first sample of the drawn records, ISO 8601; courses after AIS keep their own times.
    """

    hours: float = 4.0
    ship_shares: tuple[float, ...] = (0.3, 0.4, 0.2, 0.1)
    real_course_share: float = 0.3
    source_level_db: float = 190.0
    source_level_spread_db: float = 6.0
    lineless_share: float = 0.3
    line_shift_db: tuple[float, float] = (-18.0, 3.0)
    orientation_error_deg: float = 2.0
    without_z: float = 0.15
    without_hydrophone: float = 0.1
    without_horizontals: float = 0.04
    lobe_shares: tuple[float, ...] = (0.4, 0.4, 0.2)
    choir_share: float = 0.45
    swarm_share: float = 0.25
    start: str = "2012-11-01T00:00:00Z"


def split_of(name: int | str) -> str:
    """Split that a ship (by its mmsi) or a week belongs to, always the same."""
    share = int.from_bytes(hashlib.sha256(str(name).encode()).digest()[:4], "big") / 2**32
    for split, width in SHARES.items():
        if share < width:
            return split
        share -= width
    return "test"


def read_courses(path: str | Path) -> pd.DataFrame:
    """AIS around the station, the core paper's test week left out; every ship keeps to the split of its mmsi."""
    ais = read(path, near=STATION, within_m=400e3)
    seconds = to_posix(ais["time"].to_numpy())
    return ais[(seconds < NEVER_TRAINED[0]) | (seconds >= NEVER_TRAINED[1])]


def draw_scene(
    seed: int, split: str, config: SceneConfig = SceneConfig(), courses: pd.DataFrame | None = None
) -> Scene:
    """Draw a scene; its ships are of the given split where they follow AIS."""
    number_of_split = list(SHARES).index(split)
    generator = np.random.default_rng([seed, 0xA21, number_of_split])
    own = seed + SPLIT_SEEDS * number_of_split
    ocean = draw_ocean(generator, None, OceanSpread())
    start = parse_utc(config.start) / 1e9 + 60.0 * int(generator.integers(0, 1440))
    rate = float(generator.choice([50.0, 62.5, 100.0, 125.0], p=[0.8, 0.08, 0.08, 0.04]))
    recorder = replace(
        Recorder.random(generator, rate),
        depth_m=ocean.depth_m,
        components=_components(generator, config),
    )
    passages: tuple[Passage, ...] = ()
    number = int(generator.choice(len(config.ship_shares), p=config.ship_shares))
    if courses is not None and number and generator.random() < config.real_course_share:
        start, passages = _after_ais(generator, own, split, config, courses, recorder)
    elif number:
        passages = tuple(
            Passage(
                _ship(generator, 1000 * own + i, 100000001 + i, config),
                _course(generator, start, config.hours),
            )
            for i in range(number)
        )
    scenario = Scenario.random(own, config.hours, 0, start, recorder=recorder, passages=passages)
    life = _life(np.random.default_rng([seed, 0x11FE, number_of_split]), scenario, config)
    scenario = scenario.replace(ambient=_ambient(generator), **life)
    return Scene(scenario, ocean, float(generator.normal(0.0, config.orientation_error_deg)))


def _components(generator: np.random.Generator, config: SceneConfig) -> str:
    dice = generator.random()
    for share, components in (
        (config.without_z, "H12"),
        (config.without_hydrophone, "12Z"),
        (config.without_horizontals, "H"),
    ):
        if dice < share:
            return components
        dice -= share
    return "H12Z"


def _ship(generator: np.random.Generator, seed: int, mmsi: int, config: SceneConfig) -> Ship:
    level = float(generator.normal(config.source_level_db, config.source_level_spread_db))
    ship = Ship.random(seed, mmsi, level)
    shift = float(generator.uniform(*config.line_shift_db))
    lines = tuple(replace(s, levels_db=tuple(db + shift for db in s.levels_db)) for s in ship.lines)
    return replace(
        ship,
        lines=() if generator.random() < config.lineless_share else lines,
        level_spread_db=float(generator.uniform(0.3, 2.5)),
        peak_hz=float(generator.uniform(8.0, 30.0)),
        slope_db=float(generator.uniform(20.0, 40.0)),
        ripple_db=float(generator.uniform(0.5, 3.5)),
    )


def _course(generator: np.random.Generator, start: float, hours: float) -> Course:
    straight = StraightCourse(
        start + 3600.0 * float(generator.uniform(0.1, 0.9)) * hours,
        float(generator.choice([-1, 1]) * 60e3 * generator.random() ** 1.5),
        float(generator.uniform(0.0, 360.0)),
        float(generator.uniform(3.0, 13.0)),
    )
    if generator.random() > 0.2:
        return straight
    when = start + 3600.0 * float(generator.uniform(0.2, 0.8)) * hours
    turn = float(generator.choice([-1, 1]) * generator.uniform(15.0, 100.0))
    return TurningCourse(straight, when, turn, float(generator.uniform(800.0, 3000.0)))


def _ambient(generator: np.random.Generator) -> Ambient:
    """A background of any level and direction; two in five with most of the noise from a sector."""
    fraction = generator.uniform(0.0, 0.4) if generator.random() < 0.6 else generator.uniform(0.3, 0.9)
    return replace(
        Ambient.random(generator),
        level_db=float(generator.uniform(70.0, 88.0)),
        level_spread_db=float(generator.uniform(0.3, 3.0)),
        directional_fraction=float(fraction),
        directional_elevation_deg=float(generator.uniform(0.0, 50.0)),
        directional_width_deg=float(generator.uniform(10.0, 60.0)),
        horizontal_share=float(generator.uniform(0.2, 0.5)),
    )


def _life(generator: np.random.Generator, scenario: Scenario, config: SceneConfig) -> dict[str, object]:
    """What moves, or begins and ends, without being a ship: lobes of noise, whales that sing as nowhere, swarms of earthquakes."""
    number = generator.choice(len(config.lobe_shares), p=config.lobe_shares)
    lobes = tuple(_lobe(generator, scenario.start) for _ in range(number))
    whales = scenario.whales
    if generator.random() < config.choir_share:
        count = int(generator.integers(1, 5))
        whales += tuple(_singer(generator, scenario.start, scenario.end) for _ in range(count))
    earthquakes = scenario.earthquakes
    if generator.random() < config.swarm_share:
        earthquakes = Earthquakes(
            per_day=float(np.exp(generator.uniform(np.log(20.0), np.log(800.0)))),
            level_db=float(generator.uniform(95.0, 125.0)),
            level_spread_db=float(generator.uniform(5.0, 14.0)),
            seed=int(generator.integers(2**31)),
            t_gain=float(np.exp(generator.uniform(np.log(0.3), np.log(5.0)))),
            t_stretch=float(generator.uniform(0.5, 2.5)),
        )
    return {"lobes": lobes, "whales": whales, "earthquakes": earthquakes}


def _lobe(generator: np.random.Generator, since: float) -> Lobe:
    turning = generator.normal(0.0, 1.0) if generator.random() < 0.4 else generator.normal(0.0, 15.0)
    return Lobe(
        level_db=float(generator.uniform(62.0, 84.0)),
        slope_db=float(generator.uniform(0.0, 32.0)),
        azimuth_deg=float(generator.uniform(0.0, 360.0)),
        width_deg=float(generator.uniform(6.0, 60.0)),
        elevation_deg=float(generator.uniform(0.0, 40.0)),
        turning_deg_per_h=float(turning),
        wander_deg=float(generator.uniform(0.0, 15.0)) if generator.random() < 0.5 else 0.0,
        swell_db=float(generator.uniform(0.0, 4.0)),
        since=since,
        seed=int(generator.integers(2**31)),
    )


def _singer(generator: np.random.Generator, start: float, end: float) -> Whale:
    whale = Whale.random(generator, start, end)
    always = generator.random() < 0.5
    return replace(
        whale,
        source_level_db=float(generator.uniform(178.0, 194.0)),
        span=(-np.inf, np.inf) if always else whale.span,
        pitch=float(np.exp(generator.normal(0.0, 0.18))),
        pace=float(np.exp(generator.uniform(-0.7, 0.9))),
        length=float(np.exp(generator.uniform(-0.6, 0.3))),
        level_spread_db=float(generator.uniform(0.0, 3.0)),
    )


def _after_ais(
    generator: np.random.Generator,
    seed: int,
    split: str,
    config: SceneConfig,
    courses: pd.DataFrame,
    recorder: Recorder,
) -> tuple[float, tuple[Passage, ...]]:
    """Start and ships of a record about a moment at which a ship of the split was within 60 km."""
    ours = courses[[split_of(mmsi) == split for mmsi in courses["mmsi"]]]
    metre = 111.2e3
    east = (ours["lon"] - STATION[1]) * metre * np.cos(np.deg2rad(STATION[0]))
    north = (ours["lat"] - STATION[0]) * metre
    close = ours[np.hypot(east, north) < 60e3]
    if close.empty:
        return parse_utc(config.start) / 1e9, ()
    moment = to_posix(close["time"].to_numpy())[int(generator.integers(len(close)))]
    start = 60.0 * round(float(moment - 3600.0 * generator.uniform(0.2, 0.8) * config.hours) / 60.0)
    found = Scenario.from_ais(ours, start, config.hours, recorder, seed, radius_m=100e3, max_gap_s=6 * 3600.0)
    minutes = start + np.arange(0.0, 3600.0 * config.hours, 300.0)
    nearest = sorted(found.passages, key=lambda passage: np.hypot(*passage.course.position(minutes)).min())
    ships = (
        replace(passage, ship=_ship(generator, 1000 * seed + i, passage.ship.mmsi, config))
        for i, passage in enumerate(nearest[: len(config.ship_shares) - 1])
    )
    return start, tuple(ships)
