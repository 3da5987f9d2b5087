"""The recorder: channels, orientation, coupling and responses; pascals and metres per second become counts
and StationXML.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from obspy import UTCDateTime
from obspy.core.inventory import Channel, Inventory, Network, Response, Site, Station
from obspy.core.inventory.response import (
    CoefficientsTypeResponseStage,
    InstrumentSensitivity,
    PolesZerosResponseStage,
)
from scipy import fft

from obsnet.errors import ConfigError
from obsnet.twin.propagate import Field

REFERENCE_HZ = 10.0
VOLTS_TO_COUNTS = 419430.4


@dataclass(frozen=True)
class Transfer:
    """Poles and zeros [rad/s] and gain [counts per unit at 10 Hz] of one channel."""

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float

    def at(self, frequency: np.ndarray) -> np.ndarray:
        """Complex response at `frequency` [Hz], counts per unit; zero at 0 Hz."""
        return self.gain * self._shape(frequency) / abs(self._shape(np.array([REFERENCE_HZ]))[0])

    def _shape(self, frequency: np.ndarray) -> np.ndarray:
        s = 2j * np.pi * np.asarray(frequency, float)
        value = np.ones(s.shape, complex)
        for zero in self.zeros:
            value *= s - zero
        for pole in self.poles:
            value /= s - pole
        return value

    def response(self, unit: str, sampling_rate: float) -> Response:
        """Return the same as an obspy Response: sensor and digitiser."""
        norm = 1.0 / abs(self._shape(np.array([REFERENCE_HZ]))[0])
        volts = self.gain / VOLTS_TO_COUNTS
        sensor = PolesZerosResponseStage(
            1, volts, REFERENCE_HZ, unit, "V", "LAPLACE (RADIANS/SECOND)", REFERENCE_HZ,
            list(self.zeros), list(self.poles), normalization_factor=norm,
        )  # fmt: skip
        digitiser = CoefficientsTypeResponseStage(
            2, VOLTS_TO_COUNTS, REFERENCE_HZ, "V", "COUNTS", "DIGITAL", numerator=[1.0], denominator=[],
            decimation_input_sample_rate=sampling_rate, decimation_factor=1, decimation_offset=0,
            decimation_delay=0.0, decimation_correction=0.0,
        )  # fmt: skip
        sensitivity = InstrumentSensitivity(self.gain, REFERENCE_HZ, unit, "COUNTS")
        return Response(instrument_sensitivity=sensitivity, response_stages=[sensor, digitiser])


@dataclass(frozen=True)
class Coupling:
    """How a horizontal axis follows the ground: a damped resonator, (1 + 2iζx)/(1 − x² + 2iζx), x = f/f₀.

    Source: Sutton and Duennebier 1987, doi:10.1007/BF00310104.
    """

    resonance_hz: float = np.inf
    damping: float = 0.4

    def at(self, frequency: np.ndarray) -> np.ndarray:
        """Complex gain at `frequency` [Hz]."""
        x = np.asarray(frequency) / self.resonance_hz
        return (1 + 2j * self.damping * x) / (1 - x**2 + 2j * self.damping * x)


@dataclass(frozen=True)
class Recorder:
    """An ocean-bottom station as it truly is, and what its metadata say of it.

    Parameters
    ----------
    code : str
        NET.STA.
    latitude, longitude, depth_m : float
        Position, degrees and metres.
    sampling_rate : float
        Hz.
    orientation_deg : float
        True azimuth of the first horizontal; the second is 90° clockwise of it.
    hydrophone_polarity : int
        −1 where compression gives negative counts.
    declare_orientation, declare_polarity : bool
        Whether StationXML knows these; if not it says 0° and 90°, and nothing of a reversal.
    naming : {"12Z", "123", "NEZ"}
        Orientation codes of the seismometer.
    instrument_code : {"H", "L"}
    band : str
        First letter of the channel codes; drawn from the rate and the sensor where empty.
    hydrophone_counts, hydrophone_corner_hz : float
        Counts per Pa, and the corner of the hydrophone's first-order high pass.
    seismometer_counts, seismometer_period_s, seismometer_damping : float
        Counts per m/s, natural period and damping of the seismometer or geophone.
    coupling : tuple of Coupling
        Of the two horizontals.
    components : str
        Channels that exist, of "H", "1", "2", "Z".
    """

    code: str = "XX.SIM01"
    latitude: float = -21.3732
    longitude: float = 54.1294
    depth_m: float = 4340.0
    sampling_rate: float = 50.0
    orientation_deg: float = 0.0
    hydrophone_polarity: int = 1
    declare_orientation: bool = True
    declare_polarity: bool = True
    naming: Literal["12Z", "123", "NEZ"] = "12Z"
    band: str = ""
    hydrophone_counts: float = 4000.0
    hydrophone_corner_hz: float = 0.05
    seismometer_counts: float = 8.4e8
    seismometer_period_s: float = 60.0
    seismometer_damping: float = 0.707
    coupling: tuple[Coupling, Coupling] = field(default_factory=lambda: (Coupling(), Coupling()))
    components: str = "H12Z"

    def __post_init__(self) -> None:
        if self.code.count(".") != 1 or not all(self.code.split(".")):
            raise ConfigError(f"a station code is NET.STA, found {self.code!r}")
        if not 1.0 <= self.sampling_rate <= 4000.0:
            raise ConfigError(f"sampling_rate must lie between 1 and 4000 Hz, found {self.sampling_rate}")
        if self.hydrophone_polarity not in (-1, 1):
            raise ConfigError(f"hydrophone_polarity must be 1 or -1, found {self.hydrophone_polarity}")
        if not self.depth_m > 0:
            raise ConfigError(f"depth_m must be positive, found {self.depth_m}")
        if self.naming not in ("12Z", "123", "NEZ"):
            raise ConfigError(f"naming must be 12Z, 123 or NEZ, found {self.naming!r}")
        if not self.components or set(self.components) - set("H12Z"):
            raise ConfigError(f"components must be letters of H12Z, found {self.components!r}")

    @classmethod
    def random(cls, generator: np.random.Generator, sampling_rate: float = 50.0, **fixed: object) -> Recorder:
        """Draw orientation, polarity, depth, sensors and coupling; `fixed` fields are kept as given."""
        geophone = sampling_rate > 80 and generator.random() < 0.5
        resonance = float(generator.uniform(38.0, 90.0))
        drawn: dict[str, object] = {
            "depth_m": float(generator.uniform(2500.0, 5200.0)),
            "sampling_rate": sampling_rate,
            "orientation_deg": float(generator.uniform(0.0, 360.0)),
            "hydrophone_polarity": int(generator.choice([-1, 1])),
            "naming": "123" if geophone else "12Z",
            "hydrophone_counts": float(generator.uniform(2000.0, 8000.0)),
            "hydrophone_corner_hz": float(np.exp(generator.uniform(np.log(0.03), np.log(2.0)))),
            "seismometer_counts": float(generator.uniform(4e8, 9e8)) * (0.1 if geophone else 1.0),
            "seismometer_period_s": 1 / 4.5 if geophone else 60.0,
            "coupling": tuple(
                Coupling(resonance * float(generator.normal(1.0, 0.04)), float(generator.uniform(0.3, 0.6)))
                for _ in range(2)
            ),
        }
        return cls(**{**drawn, **fixed})  # type: ignore[arg-type]

    @property
    def channels(self) -> dict[str, str]:
        """Channel code of each existing component H, 1, 2, Z."""
        short = self.seismometer_period_s < 10.0
        high = self.sampling_rate >= 80.0
        band = (
            self.band
            or {(False, False): "B", (False, True): "H", (True, False): "S", (True, True): "E"}[short, high]
        )
        names = dict(zip("12Z", self.naming, strict=True))
        codes = {"H": f"{band}DH"} | {part: f"{band}H{name}" for part, name in names.items()}
        return {part: codes[part] for part in "H12Z" if part in self.components}

    def transfer(self, part: str) -> Transfer:
        """Response of component `part`; a hydrophone's is negative where its polarity is reversed."""
        if part == "H":
            corner = -2 * np.pi * self.hydrophone_corner_hz
            return Transfer((0j,), (complex(corner),), self.hydrophone_counts * self.hydrophone_polarity)
        natural, damping = 2 * np.pi / self.seismometer_period_s, self.seismometer_damping
        root = np.sqrt(complex(damping**2 - 1))
        poles = (complex(natural * (-damping + root)), complex(natural * (-damping - root)))
        return Transfer((0j, 0j), poles, self.seismometer_counts)

    def record(self, motion: Field, first: int, count: int) -> dict[str, np.ndarray]:
        """Counts (float64, not yet rounded) of each component for samples first … first + count − 1 of
        `motion`.

        The response acts by multiplication in the frequency domain; what lies outside is context, of which a
        minute at least is needed on either side.
        """
        azimuth = np.deg2rad(self.orientation_deg)
        ground = {
            "H": motion.pressure,
            "1": motion.north * np.cos(azimuth) + motion.east * np.sin(azimuth),
            "2": motion.east * np.cos(azimuth) - motion.north * np.sin(azimuth),
            "Z": -motion.down,
        }
        size = motion.pressure.size
        length = fft.next_fast_len(size, real=True)
        frequency = np.arange(length // 2 + 1) * (self.sampling_rate / length)
        window = _taper(size, min(first, size - first - count, round(30 * self.sampling_rate)))
        counts = {}
        for part in self.channels:
            gain = self.transfer(part).at(frequency)
            if part in "12":
                gain = gain * self.coupling[int(part) - 1].at(frequency)
            spectrum = fft.rfft(ground[part] * window, length) * gain
            counts[part] = fft.irfft(spectrum, length)[first : first + count]
        return counts

    def inventory(self) -> Inventory:
        """What StationXML says of the station."""
        orientation = self.orientation_deg if self.declare_orientation else 0.0
        angles = {
            "H": (0.0, 0.0),
            "1": (orientation, 0.0),
            "2": ((orientation + 90) % 360, 0.0),
            "Z": (0.0, -90.0),
        }
        start = UTCDateTime(2000, 1, 1)
        channels = []
        for part, code in self.channels.items():
            transfer = self.transfer(part)
            if part == "H" and not self.declare_polarity:
                transfer = Transfer(transfer.zeros, transfer.poles, abs(transfer.gain))
            channels.append(
                Channel(
                    code,
                    "00",
                    self.latitude,
                    self.longitude,
                    -self.depth_m,
                    0.0,
                    azimuth=angles[part][0] % 360,
                    dip=angles[part][1],
                    sample_rate=self.sampling_rate,
                    start_date=start,
                    response=transfer.response("PA" if part == "H" else "M/S", self.sampling_rate),
                )
            )
        network, code = self.code.split(".")
        site = Site("simulated ocean-bottom station")
        station = Station(
            code, self.latitude, self.longitude, -self.depth_m, channels=channels, site=site,
            start_date=start, creation_date=start,
        )  # fmt: skip
        return Inventory(
            [Network(network, [station], description="simulated")], source="obsnet twin (simulated)"
        )


def _taper(size: int, edge: int) -> np.ndarray:
    window = np.ones(size)
    if edge > 0:
        ramp = 0.5 * (1 - np.cos(np.pi * (np.arange(edge) + 0.5) / edge))
        window[:edge], window[-edge:] = ramp, ramp[::-1]
    return window
