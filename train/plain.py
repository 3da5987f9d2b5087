"""Records of a third generator: image sources in water of one speed, little else.

    python train/plain.py --folder DIR [--passages 30] [--silent 12] [--seed 1001]
    python train/score.py DIR/passages_*

It shares nothing with the twin nor with `elsewhere`: straight rays, a bottom that gives back one share of the sound whatever the
angle, noise of one slope. Many ships are faint, pass quickly or overhead, or pass together, so that short and masked passages
are seen. Records are simulated; those that a folder holds are not made again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import obspy
import pandas as pd
from obspy.core.inventory import Channel, Inventory, Network, Response, Station
from obspy.core.inventory.response import InstrumentSensitivity
from pyproj import Geod
from scipy.ndimage import map_coordinates, spline_filter1d
from scipy.signal import fftconvolve, firwin

LATITUDE, LONGITUDE = -20.0, 60.0
START = obspy.UTCDateTime("2021-03-04")
RATE_HZ, FINE_HZ = 50.0, 200.0
DENSITY = 1025.0
PATHS = 6
CODES = ("BH1", "BH2", "BHZ", "BDH")
GAINS = (2e9, 2e9, 2e9, 2e4)
"""Counts per m/s and per Pa."""


@dataclass(frozen=True)
class Ship:
    """A straight course (CPA on the starboard or port side), source density at 10 Hz [dB re 1 µPa²/Hz at 1 m], its slope [dB a decade], lines (Hz, dB)."""

    cpa_s: float
    cpa_m: float
    course_deg: float
    speed_mps: float
    starboard: bool
    level_db: float
    slope_db: float
    lines: tuple[tuple[float, float], ...]
    depth_m: float

    def east_north(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the ship is [m]."""
        course = np.deg2rad(self.course_deg)
        along = self.speed_mps * (time_s - self.cpa_s)
        side = -self.cpa_m if self.starboard else self.cpa_m
        return (
            side * np.cos(course) + along * np.sin(course),
            -side * np.sin(course) + along * np.cos(course),
        )


@dataclass(frozen=True)
class Scene:
    """A record: the sea, the station, the ships."""

    seed: int
    hours: float
    depth_m: float
    sound_speed_mps: float
    reflection: float
    noise_db: float
    white: bool
    self_noise_db: float
    lobes: int
    orientation_deg: float
    coupling: float
    gaps: int
    ships: tuple[Ship, ...]


def draw(seed: int, silent: bool = False) -> Scene:
    """A scene of one to three ships in four hours, or of none in six."""
    rng = np.random.default_rng([seed, int(silent)])

    def ship() -> Ship:
        lines = [(rng.uniform(5, 24), rng.uniform(150, 165)) for _ in range(rng.choice([0, 0, 3, 6]))]
        return Ship(
            cpa_s=rng.uniform(1800, 12_600), cpa_m=10 ** rng.uniform(2.7, 4.3), course_deg=rng.uniform(0, 360),
            speed_mps=rng.uniform(4, 14), starboard=bool(rng.random() < 0.5), level_db=rng.uniform(152, 170),
            slope_db=rng.uniform(-25, 0), lines=tuple(lines), depth_m=rng.uniform(3, 10),
        )  # fmt: skip

    return Scene(
        seed=seed,
        hours=6.0 if silent else 4.0,
        depth_m=rng.uniform(1500, 5500),
        sound_speed_mps=rng.uniform(1490, 1520),
        reflection=rng.uniform(0.2, 0.85),
        noise_db=rng.uniform(60, 76),
        white=bool(rng.random() < 0.2),
        self_noise_db=rng.uniform(-12, 3),
        lobes=int(rng.choice([1, 2, 3, 4] if silent else [0, 0, 1, 2, 3])),
        orientation_deg=rng.uniform(0, 360),
        coupling=rng.uniform(0.4, 1.0),
        gaps=int(rng.choice([0, 0, 0, 2])),
        ships=() if silent else tuple(ship() for _ in range(rng.integers(1, 4))),
    )


def _noise(rng: np.random.Generator, n: int, level_db: float, slope_db: float) -> np.ndarray:
    """Noise of a density [dB re 1 per Hz] at 10 Hz and a slope [dB a decade]."""
    size = 1 << int(np.ceil(np.log2(n)))
    frequency = np.maximum(np.fft.rfftfreq(size, 1 / FINE_HZ), 0.5)
    amplitude = 10 ** ((level_db + slope_db * np.log10(frequency / 10)) / 20)
    white = rng.standard_normal((2, frequency.size))
    return np.fft.irfft((white[0] + 1j * white[1]) * amplitude * np.sqrt(size * FINE_HZ / 4), size)[:n]


def field(scene: Scene) -> np.ndarray:
    """Velocity east, north, up [m/s] and pressure [Pa] at `FINE_HZ`, dims (4, time)."""
    rng = np.random.default_rng([scene.seed, 9])
    n = int(scene.hours * 3600 * FINE_HZ)
    time, knots = np.arange(n) / FINE_HZ, np.arange(-100.0, scene.hours * 3600 + 100)
    impedance = DENSITY * scene.sound_speed_mps
    out = np.zeros((4, n))
    for ship in scene.ships:
        begin = -200.0
        source = _noise(rng, n + int(400 * FINE_HZ), ship.level_db - 120, ship.slope_db)
        clock = np.arange(source.size) / FINE_HZ
        for frequency, level in ship.lines:
            wander = 0.13 * np.cumsum(rng.standard_normal(source.size)) / np.sqrt(FINE_HZ)
            source += 10 ** ((level - 120) / 20) * np.sqrt(2) * np.cos(2 * np.pi * frequency * clock + wander)
        source = spline_filter1d(source, order=3)
        east, north = ship.east_north(knots)
        distance = np.hypot(east, north)
        toward = np.interp(time, knots, np.unwrap(np.arctan2(east, north)))
        for bounces in range(PATHS):
            height = (2 * bounces + 1) * scene.depth_m
            arrival = np.zeros(n)
            for sign, below in ((1, -ship.depth_m), (-1, ship.depth_m)):
                length = np.hypot(distance, height + below)
                emitted = knots - length / scene.sound_speed_mps
                for _ in range(2):
                    emitted = knots - np.interp(emitted, knots, length) / scene.sound_speed_mps
                loss = sign * (-scene.reflection) ** bounces / np.interp(emitted, knots, length)
                when = np.interp(time, knots, emitted)
                heard = map_coordinates(source, [(when - begin) * FINE_HZ], order=3, prefilter=False)
                arrival += np.interp(time, knots, loss) * heard
            slant = np.hypot(distance, height)
            level = np.interp(time, knots, distance / slant) * arrival / impedance
            out[0] -= level * np.sin(toward)
            out[1] -= level * np.cos(toward)
            out[2] -= np.interp(time, knots, height / slant) * arrival / impedance
            out[3] += arrival
    out[:2] *= scene.coupling
    slope, quiet = (0 if scene.white else -15), scene.noise_db - 120
    out[3] += _noise(rng, n, quiet, slope)
    for component in out[:3]:
        component += _noise(rng, n, quiet - 20 * np.log10(impedance) + scene.self_noise_db, slope)
    for _ in range(scene.lobes):
        azimuth, period = rng.uniform(0, 2 * np.pi), rng.uniform(600, 5000)
        swell = 1 + 0.5 * np.sin(2 * np.pi * time / period + rng.uniform(0, 2 * np.pi))
        sound = swell * _noise(rng, n, quiet + rng.uniform(-3, 3), -15)
        out[0] -= 0.9 * np.sin(azimuth) * sound / impedance
        out[1] -= 0.9 * np.cos(azimuth) * sound / impedance
        out[2] -= 0.4 * sound / impedance
        out[3] += sound
    return out


def write(scene: Scene, folder: Path) -> None:
    """Write waveforms.mseed, station.xml, ais.csv and scene.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    east, north, up, pressure = field(scene)
    turn = np.deg2rad(scene.orientation_deg)
    first = east * np.sin(turn) + north * np.cos(turn)
    second = east * np.cos(turn) - north * np.sin(turn)
    taps = firwin(401, 0.42 * RATE_HZ, fs=FINE_HZ)
    stream, channels = obspy.Stream(), []
    azimuths = (scene.orientation_deg, (scene.orientation_deg + 90) % 360, 0.0, 0.0)
    for code, values, gain, azimuth in zip(
        CODES, (first, second, up, pressure), GAINS, azimuths, strict=True
    ):
        kept = fftconvolve(values, taps, "same")[:: int(FINE_HZ / RATE_HZ)] * gain
        header = {
            "network": "XX",
            "station": "PLAIN",
            "channel": code,
            "sampling_rate": RATE_HZ,
            "starttime": START,
        }
        trace = obspy.Trace(np.round(kept).astype(np.int32), header)
        parts = scene.gaps + 1
        edges = [START + 3600 * scene.hours * part / parts for part in range(parts + 1)]
        for begin, end in pairwise(edges):
            stream += trace.slice(begin + (90 if begin > START else 0), end)
        unit = "PA" if code.endswith("H") else "M/S"
        channels.append(
            Channel(
                code, "", LATITUDE, LONGITUDE, -scene.depth_m, 0.0, azimuth=azimuth, dip=-90.0 if code == "BHZ" else 0.0,
                sample_rate=RATE_HZ, start_date=START - 86400,
                response=Response(instrument_sensitivity=InstrumentSensitivity(gain, 10.0, unit, "COUNTS")),
            )
        )  # fmt: skip
    stream.write(str(folder / "waveforms.mseed"), format="MSEED")
    station = Station(
        "PLAIN", LATITUDE, LONGITUDE, -scene.depth_m, channels=channels, start_date=START - 86400
    )
    Inventory([Network("XX", [station])], source="simulated").write(str(folder / "station.xml"), "STATIONXML")
    rows = []
    for number, ship in enumerate(scene.ships):
        when = np.arange(-60.0, 3600 * scene.hours + 60, 60.0)
        east, north = ship.east_north(when)
        azimuth, distance = np.rad2deg(np.arctan2(east, north)), np.hypot(east, north)
        there = Geod(ellps="WGS84").fwd([LONGITUDE] * when.size, [LATITUDE] * when.size, azimuth, distance)
        rows += [
            (200_000_000 + number, str(START + t), lat, lon)
            for t, lat, lon in zip(when, there[1], there[0], strict=True)
        ]
    pd.DataFrame(rows, columns=["mmsi", "time", "lat", "lon"]).to_csv(folder / "ais.csv", index=False)
    (folder / "scene.json").write_text(json.dumps(asdict(scene), indent=1, default=float))


def main() -> None:
    """Make the records that are not there."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--passages", type=int, default=30, help="records with ships, four hours each")
    parser.add_argument("--silent", type=int, default=12, help="records without, six hours each")
    parser.add_argument("--seed", type=int, default=1001)
    given = parser.parse_args()
    for kind, count in (("passages", given.passages), ("silent", given.silent)):
        for seed in range(given.seed, given.seed + count):
            folder = given.folder / f"{kind}_{seed}"
            if not (folder / "scene.json").exists():
                write(draw(seed, kind == "silent"), folder)


if __name__ == "__main__":
    main()
