"""Name of a kind of record and a seed in, a whole record out: miniSEED, StationXML, AIS and truth in a folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import obspy
import pandas as pd
from pyproj import Proj

from elsewhere import noise, paths, ships
from elsewhere.noise import Lobe, Surroundings
from elsewhere.paths import Sea, Source
from elsewhere.ships import Bent
from elsewhere.station import Recorder, inventory, record

KINDS = (
    "ordinary", "faint", "whales_and_earthquakes", "directional_noise", "two_ships", "turning_ship", "no_ship",
    "another_depth", "another_bottom", "wrong_sound_speed", "gaps", "another_rate",
)  # fmt: skip
SILENT = ("wind", "steady_lobe", "turning_lobe", "whales", "survey", "earthquakes", "strumming", "mixture")
"""What a record without ships is full of; the seed chooses in turn."""


@dataclass(frozen=True)
class Vessel:
    """A ship of a record: its course, source density at 15 Hz [dB re 1 µPa²/Hz at 1 m], and where its antenna is [m ahead]."""

    course: Bent
    source_db: float
    mmsi: int
    antenna_m: float = 30.0
    depth_m: float = 5.0


@dataclass(frozen=True)
class Record:
    """Everything that makes one record."""

    kind: str
    seed: int
    hours: float
    start: float
    sea: Sea
    recorder: Recorder
    around: Surroundings
    vessels: tuple[Vessel, ...] = ()
    singers: tuple[tuple[str, Bent], ...] = ()
    note: str = ""
    told: dict = field(default_factory=dict)


def compose(kind: str, seed: int, hours: float = 6.0) -> Record:
    """The record of a kind: every nuisance is drawn in every kind, each kind then insists on its own.

    Raises
    ------
    ValueError : the kind is not one of `KINDS`.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, found {kind!r}")
    rng = np.random.default_rng([KINDS.index(kind), seed, 20231])
    made = _ordinary(kind, seed, hours, rng)
    change = globals().get(f"_{kind}")
    return made if kind == "ordinary" or change is None else change(made, rng)


def _ordinary(kind: str, seed: int, hours: float, rng: np.random.Generator) -> Record:
    start = 1.6e9 + 86400.0 * int(rng.integers(0, 900)) + float(rng.uniform(0, 86400.0))
    depth = float(rng.uniform(3600.0, 4800.0))
    gradient = float(rng.choice([0.0, rng.uniform(0.002, 0.009)]))
    mean = float(rng.uniform(1495.0, 1505.0))
    sea = Sea(
        depth,
        mean - gradient * depth / 2.0,
        gradient,
        speed_ratio=float(rng.uniform(1.05, 1.3)),
        density_ratio=float(rng.uniform(1.5, 2.1)),
        loss=float(rng.uniform(0.005, 0.03)),
        loss_db_per_bounce=float(rng.uniform(0.5, 2.0)),
        scatter=float(rng.uniform(0.02, 0.12)),
    )
    recorder = Recorder(
        depth,
        latitude=float(rng.uniform(-50, 50)),
        longitude=float(rng.uniform(-179, 179)),
        orientation_deg=float(rng.uniform(0, 360)),
        orientation_error_deg=float(rng.normal(0, 0.5)),
        polarity=int(rng.choice([1, -1])),
        tilt_deg=tuple(rng.normal(0, 1.0, 2).tolist()),
        gains=tuple((1.0 + 0.02 * rng.standard_normal(4)).tolist()),
        clock_error_s=float(rng.normal(0, 0.1)),
        horizontals=str(rng.choice(["12", "NE", "XY"])),
        corners_hz=(float(rng.choice([0.05, 0.3, 2.0])), float(rng.choice([0.0083, 0.1, 1.0]))),
    )
    around = Surroundings(
        wind_db=float(rng.uniform(62.0, 72.0)),
        lobes=(Lobe(float(rng.uniform(56.0, 66.0)), float(rng.uniform(0, 360)), float(rng.uniform(15, 60))),),
        microseism_db=float(rng.uniform(110.0, 130.0)),
    )
    vessel = _vessel(rng, start + 3600.0 * hours * rng.uniform(0.4, 0.6), rng.uniform(172.0, 180.0), 1)
    return Record(kind, seed, hours, start, sea, recorder, around, (vessel,))


def _vessel(rng: np.random.Generator, cpa_s: float, source_db: float, number: int, **course: float) -> Vessel:
    cpa = float(rng.choice([-1, 1]) * rng.uniform(1500.0, 15000.0))
    bent = Bent(
        cpa_s, cpa, float(rng.uniform(0, 360)), float(rng.uniform(5.0, 11.0)), gain=float(rng.normal(0, 0.003)),
        seed=int(rng.integers(1e9)), **course,
    )  # fmt: skip
    return Vessel(
        bent, float(source_db), 200_000_000 + number, float(rng.uniform(10, 60)), float(rng.uniform(3.5, 8.0))
    )


def _faint(made: Record, rng: np.random.Generator) -> Record:
    return replace(made, vessels=(replace(made.vessels[0], source_db=float(rng.uniform(158.0, 166.0))),))


def _singers(made: Record, rng: np.random.Generator, count: int) -> tuple[tuple[str, Bent], ...]:
    def swimmer() -> Bent:
        far = float(rng.uniform(4e3, 35e3))
        return Bent(
            made.start + 1800.0 * made.hours, far, float(rng.uniform(0, 360)), float(rng.uniform(0.5, 2.0))
        )

    return tuple((str(rng.choice(["fin", "blue", "pygmy"])), swimmer()) for _ in range(count))


def _whales_and_earthquakes(made: Record, rng: np.random.Generator) -> Record:
    around = replace(made.around, quakes_per_hour=rng.uniform(4, 15), t_phases_per_hour=rng.uniform(1, 4))
    return replace(made, around=around, singers=_singers(made, rng, int(rng.integers(2, 5))))


def _directional_noise(made: Record, rng: np.random.Generator) -> Record:
    lobe = Lobe(float(rng.uniform(72, 78)), float(rng.uniform(0, 360)), 20.0, float(rng.uniform(-8, 8)))
    return replace(made, around=replace(made.around, lobes=(*made.around.lobes, lobe)))


def _two_ships(made: Record, rng: np.random.Generator) -> Record:
    first = made.vessels[0].course
    middle = made.start + 1800.0 * made.hours
    apart = float(rng.uniform(1200.0, 3600.0))
    vessels = []
    for number, side in enumerate((-1, 1), 1):
        vessel = _vessel(rng, middle + side * apart / 2, rng.uniform(172, 178), number)
        turned = (first.course_deg + (90.0 + 90.0 * rng.random()) * (number - 1)) % 360.0
        vessels.append(replace(vessel, course=replace(vessel.course, course_deg=float(turned))))
    return replace(made, vessels=tuple(vessels))


def _turning_ship(made: Record, rng: np.random.Generator) -> Record:
    vessel = made.vessels[0]
    turn = {
        "turn_deg": float(rng.choice([-1, 1]) * rng.uniform(20, 60)),
        "turn_s": float(rng.choice([-1, 1]) * rng.uniform(900, 2700)),
    }
    return replace(made, vessels=(replace(vessel, course=replace(vessel.course, **turn)),))


def _no_ship(made: Record, rng: np.random.Generator) -> Record:
    what = SILENT[made.seed % len(SILENT)]
    around, singers = made.around, ()
    if what in ("steady_lobe", "turning_lobe", "mixture"):
        drift = float(rng.uniform(5, 20)) if what == "turning_lobe" else float(rng.uniform(-1, 1))
        lobe = Lobe(float(rng.uniform(70, 78)), float(rng.uniform(0, 360)), float(rng.uniform(8, 30)), drift)
        around = replace(around, lobes=(*around.lobes, lobe))
    if what in ("earthquakes", "mixture"):
        around = replace(around, quakes_per_hour=20.0, t_phases_per_hour=4.0)
    if what in ("strumming", "mixture"):
        around = replace(around, strumming_db=80.0)
    if what in ("whales", "mixture"):
        singers = _singers(made, rng, 3)
    if what in ("survey", "mixture"):
        singers += (
            (
                "survey",
                Bent(made.start + 1e4, float(rng.uniform(25e3, 60e3)), float(rng.uniform(0, 360)), 2.3),
            ),
        )
    return replace(made, vessels=(), around=around, singers=singers, note=what)


def _another_depth(made: Record, rng: np.random.Generator) -> Record:
    return _at_depth(made, (1050.0, 1500.0, 2100.0, 2700.0, 5400.0)[made.seed % 5])


def _at_depth(made: Record, depth: float) -> Record:
    mean = made.sea.surface_mps + made.sea.gradient * made.sea.depth_m / 2.0
    sea = replace(made.sea, depth_m=depth, surface_mps=mean - made.sea.gradient * depth / 2.0)
    return replace(made, sea=sea, recorder=replace(made.recorder, depth_m=depth), note=f"{depth:g} m deep")


def _another_bottom(made: Record, rng: np.random.Generator) -> Record:
    name = ("mud", "layer", "rock")[made.seed % 3]
    bottoms = {
        "mud": {"speed_ratio": 0.985, "density_ratio": 1.4, "loss": 0.01, "loss_db_per_bounce": 1.0},
        "layer": {"speed_ratio": 1.04, "layer_m": float(rng.uniform(25, 150)), "layer_reflection": 0.45},
        "rock": {"speed_ratio": 2.2, "density_ratio": 2.4, "loss": 0.02, "loss_db_per_bounce": 2.5},
    }
    return replace(made, sea=replace(made.sea, **bottoms[name]), note=name)


def _wrong_sound_speed(made: Record, rng: np.random.Generator) -> Record:
    off = float(rng.choice([-1, 1]) * rng.uniform(0.015, 0.025))
    sea = replace(made.sea, surface_mps=made.sea.surface_mps * (1.0 + off))
    return replace(made, sea=sea, note=f"sound {100 * off:+.1f} % faster than elsewhere")


def _gaps(made: Record, rng: np.random.Generator) -> Record:
    begins = np.sort(rng.uniform(600.0, 3600.0 * made.hours - 1800.0, 5))
    lengths = np.minimum(rng.uniform(90.0, 1200.0, 5), np.append(np.diff(begins), 1e9) - 60.0)
    spans = tuple((float(b), float(b + n)) for b, n in zip(begins, lengths, strict=True) if n > 0)
    channel = int(rng.choice([-1, -1, 0, 1]))
    return replace(
        made, recorder=replace(made.recorder, gaps=spans, gap_channel=channel), note=f"channel {channel}"
    )


def _another_rate(made: Record, rng: np.random.Generator) -> Record:
    rate = (62.5, 100.0, 125.0, 250.0)[made.seed % 4]
    return replace(made, recorder=replace(made.recorder, rate_hz=rate), note=f"{rate:g} Hz")


def synthesise(made: Record) -> np.ndarray:
    """Pressure [Pa] and ground velocity east, north, up [m/s] of a record, (4, n) float32."""
    rng = np.random.default_rng([KINDS.index(made.kind), made.seed, 7])
    rate = made.recorder.rate_hz
    count = int(made.hours * 3600.0 * rate)
    out = noise.surroundings(rng, made.around, made.start, count, rate)
    own_rate = 100.0 if rate < 80.0 else 125.0
    begin = made.start - 200.0
    length = int((made.hours * 3600.0 + 230.0) * own_rate)
    for vessel in made.vessels:
        sound = ships.ship(rng, length, own_rate, vessel.source_db)
        source = Source(vessel.course, vessel.depth_m, float(rng.uniform(0, 0.3)), rng)
        out += paths.receive(
            _below(sound, own_rate, rate), own_rate, begin, made.sea, source, made.start, count, rate
        )
    for kind, course in made.singers:
        sound = (
            ships.survey(rng, length, own_rate)
            if kind == "survey"
            else ships.whale(rng, length, own_rate, kind)
        )
        source = Source(course, 7.0 if kind == "survey" else float(rng.uniform(15, 25)), rng=rng)
        out += paths.receive(
            _below(sound, own_rate, rate), own_rate, begin, made.sea, source, made.start, count, rate
        )
    return out


def _below(sound: np.ndarray, own_rate: float, rate: float) -> np.ndarray:
    """The sound below the recorder's anti-alias corner."""
    from scipy.signal import firwin, oaconvolve

    corner = 0.46 * min(rate, own_rate)
    return oaconvolve(sound, firwin(255, corner, fs=own_rate).astype(np.float32), "same")


def write(made: Record, folder: str | Path) -> None:
    """Write waveforms.mseed, station.xml, ais.csv, truth.csv and truth.json into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stream = record(made.recorder, synthesise(made), made.start)
    stream.write(str(folder / "waveforms.mseed"), format="MSEED", encoding="STEIM2", reclen=4096)
    inventory(made.recorder).write(str(folder / "station.xml"), format="STATIONXML")
    ais(made).to_csv(folder / "ais.csv", index=False)
    truth(made).to_csv(folder / "truth.csv", index=False, float_format="%.8g")
    (folder / "truth.json").write_text(json.dumps(describe(made), indent=1))


def ais(made: Record) -> pd.DataFrame:
    """AIS reports of the ships, plain dialect: irregular, of the antenna, seen as far as 150 km."""
    local = Proj(proj="aeqd", lat_0=made.recorder.latitude, lon_0=made.recorder.longitude, datum="WGS84")
    rng = np.random.default_rng([made.seed, 5])
    tables = []
    for vessel in made.vessels:
        t = made.start - 5400.0 + np.cumsum(rng.uniform(20.0, 200.0, int((made.hours + 3.0) * 36)))
        (east, north), (later_e, later_n) = vessel.course(t), vessel.course(t + 10.0)
        going = np.arctan2(later_e - east, later_n - north)
        speed = np.hypot(later_e - east, later_n - north) / 10.0
        longitude, latitude = local(
            east + vessel.antenna_m * np.sin(going), north + vessel.antenna_m * np.cos(going), inverse=True
        )
        columns = {
            "mmsi": vessel.mmsi,
            "time": [str(obspy.UTCDateTime(round(float(x)))) for x in t],
            "lon": np.round(longitude, 6),
            "lat": np.round(latitude, 6),
            "sog": np.round(speed / 0.514444, 1),
            "cog": np.round(np.rad2deg(going) % 360.0, 1),
        }
        tables.append(pd.DataFrame(columns))
    names = ["mmsi", "time", "lon", "lat", "sog", "cog"]
    return pd.concat(tables)[names] if tables else pd.DataFrame(columns=names)


def truth(made: Record) -> pd.DataFrame:
    """Where each ship was when it emitted what is heard at each UTC minute by the path that arrives first."""
    minutes = np.arange(np.ceil(made.start / 60.0), (made.start + 3600.0 * made.hours) / 60.0) * 60.0
    tables = []
    for vessel in made.vessels:
        emitted = minutes.copy()
        for _ in range(8):
            emitted = minutes - _travel(made.sea, np.hypot(*vessel.course(emitted)))
        east, north = vessel.course(emitted)
        range_m = np.hypot(east, north)
        rate = (np.hypot(*vessel.course(emitted + 1.0)) - np.hypot(*vessel.course(emitted - 1.0))) / 2.0
        columns = {
            "time": [str(obspy.UTCDateTime(float(x))) for x in minutes],
            "mmsi": vessel.mmsi,
            "azimuth_deg": np.rad2deg(np.arctan2(east, north)) % 360.0,
            "range_m": range_m,
            "range_rate_mps": rate,
        }
        tables.append(pd.DataFrame(columns))
    return (
        pd.concat(tables)
        if tables
        else pd.DataFrame(columns=["time", "mmsi", "azimuth_deg", "range_m", "range_rate_mps"])
    )


def _travel(sea: Sea, range_m: np.ndarray) -> np.ndarray:
    """Travel time of the first path that still exists at each range."""
    delay = sea.delay(11, range_m)
    for crossings in (9, 7, 5, 3, 1):
        delay = np.where(range_m <= sea.reach(crossings), sea.delay(crossings, range_m), delay)
    return delay


def describe(made: Record) -> dict:
    """What truth.json holds."""
    passages = []
    for vessel in made.vessels:
        fine = np.arange(vessel.course.cpa_s - 14400.0, vessel.course.cpa_s + 14400.0)
        east, north = vessel.course(fine)
        nearest = int(np.argmin(np.hypot(east, north)))
        here, there = (vessel.course(fine[[nearest]] + shift) for shift in (-300.0, 300.0))
        passages.append(
            {
                "mmsi": vessel.mmsi,
                "cpa_time": float(fine[nearest]),
                "cpa_distance_m": float(np.hypot(east[nearest], north[nearest])),
                "cpa_azimuth_deg": float(np.rad2deg(np.arctan2(east[nearest], north[nearest])) % 360.0),
                "course_deg": float(
                    np.rad2deg(np.arctan2(there[0] - here[0], there[1] - here[1]))[0] % 360.0
                ),
                "speed_mps": float(np.hypot(there[0] - here[0], there[1] - here[1])[0] / 600.0),
                "source_db": vessel.source_db,
            }
        )
    return {
        "simulated": True, "generator": "elsewhere", "kind": made.kind, "note": made.note, "seed": made.seed, "start": made.start,
        "hours": made.hours, "sea": made.sea.__dict__, "orientation_deg": made.recorder.orientation_deg,
        "polarity": made.recorder.polarity, "rate_hz": made.recorder.rate_hz, "passages": passages,
    }  # fmt: skip
