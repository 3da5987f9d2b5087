"""Pressure and ground velocity in, what the recorder writes out: counts in miniSEED, its metadata in StationXML."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import obspy
import scipy.fft
from obspy.core.inventory import Channel, Inventory, Network, Site, Station
from obspy.core.inventory.response import (
    CoefficientsTypeResponseStage,
    InstrumentSensitivity,
    PolesZerosResponseStage,
    Response,
)
from obspy.core.inventory.util import Azimuth, Dip

CLIP = 2**23 - 1


@dataclass(frozen=True)
class Recorder:
    """A station: place, rate [Hz], how its horizontals stand, what is wrong with it and what its metadata admit.

    `gaps` are (begin, end) in seconds after the start; `gap_channel` is the one channel concerned, or all if -1.
    """

    depth_m: float
    rate_hz: float = 50.0
    latitude: float = -12.5
    longitude: float = 61.3
    orientation_deg: float = 0.0
    orientation_error_deg: float = 0.0
    polarity: int = 1
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    gains: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    clock_error_s: float = 0.0
    horizontals: str = "12"
    code: str = "ZZ.UNS01"
    gaps: tuple[tuple[float, float], ...] = ()
    gap_channel: int = -1
    corners_hz: tuple[float, float] = (0.3, 0.02)
    counts: tuple[float, float] = (2.0e4, 6.0e9)
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        band = "B" if self.rate_hz < 80 else "H"
        letters = ("DH", f"H{self.horizontals[0]}", f"H{self.horizontals[1]}", "HZ")
        object.__setattr__(self, "names", tuple(band + letter for letter in letters))


def record(recorder: Recorder, motion: np.ndarray, start: float) -> obspy.Stream:
    """Counts of the four channels as an obspy Stream of integers, gaps left out."""
    angle = np.deg2rad(recorder.orientation_deg)
    first = np.sin(angle) * motion[1] + np.cos(angle) * motion[2]
    second = np.cos(angle) * motion[1] - np.sin(angle) * motion[2]
    lean = np.sin(np.deg2rad(recorder.tilt_deg))
    channels = (
        motion[0] * recorder.polarity,
        first + lean[0] * motion[3],
        second + lean[1] * motion[3],
        motion[3],
    )
    stream = obspy.Stream()
    network, station = recorder.code.split(".")
    for number, values in enumerate(channels):
        counts = _counts(recorder, number, values)
        trace = obspy.Trace(
            counts, {"network": network, "station": station, "channel": recorder.names[number]}
        )
        trace.stats.sampling_rate = recorder.rate_hz
        trace.stats.starttime = obspy.UTCDateTime(start + recorder.clock_error_s)
        hit = recorder.gaps if recorder.gap_channel in (-1, number) else ()
        stream += _without(trace, hit)
    return stream


def _counts(recorder: Recorder, number: int, values: np.ndarray) -> np.ndarray:
    n = scipy.fft.next_fast_len(len(values), real=True)
    s = 2j * np.pi * scipy.fft.rfftfreq(n, 1.0 / recorder.rate_hz)
    response = np.ones_like(s)
    poles, zeros = _poles(recorder, number)
    for pole in poles:
        response /= s - pole
    for zero in zeros:
        response *= s - zero
    volts = scipy.fft.irfft(scipy.fft.rfft(values, n) * response, n)[: len(values)]
    gain = recorder.counts[min(number, 1)] * recorder.gains[number]
    return np.clip(np.rint(volts * gain), -CLIP, CLIP).astype(np.int32)


def _poles(recorder: Recorder, number: int) -> tuple[list[complex], list[complex]]:
    """A single pole for the hydrophone, a damped pendulum for the seismometer; high-frequency gain 1."""
    corner = 2 * np.pi * recorder.corners_hz[min(number, 1)]
    if number == 0:
        return [-corner + 0j], [0j]
    return [corner * complex(-0.707, 0.7072), corner * complex(-0.707, -0.7072)], [0j, 0j]


def _without(trace: obspy.Trace, gaps: tuple[tuple[float, float], ...]) -> obspy.Stream:
    begin, rate = trace.stats.starttime, trace.stats.sampling_rate
    pieces, at = obspy.Stream(), 0
    for lo, hi in [*gaps, (trace.stats.npts / rate, 0.0)]:
        stop = min(int(lo * rate), trace.stats.npts)
        if stop > at:
            piece = trace.copy()
            piece.data = trace.data[at:stop]
            piece.stats.starttime = begin + at / rate
            pieces += piece
        at = int(hi * rate)
    return pieces


def inventory(recorder: Recorder) -> Inventory:
    """Metadata of the station, as StationXML has them; a reversed hydrophone is told by the sign of its gain."""
    network, code = recorder.code.split(".")
    place = {
        "latitude": recorder.latitude,
        "longitude": recorder.longitude,
        "elevation": -recorder.depth_m,
    }
    told = recorder.orientation_deg + recorder.orientation_error_deg
    channels = []
    for number, name in enumerate(recorder.names):
        azimuth, dip = ((0.0, 0.0), (told % 360.0, 0.0), ((told + 90.0) % 360.0, 0.0), (0.0, -90.0))[number]
        channels.append(
            Channel(
                name, "", depth=0.0, azimuth=Azimuth(azimuth), dip=Dip(dip), sample_rate=recorder.rate_hz,
                response=_response(recorder, number), start_date=obspy.UTCDateTime(2010, 1, 1), **place,
            )
        )  # fmt: skip
    station = Station(code, site=Site(name="simulated, second generator"), channels=channels, **place)
    return Inventory(
        networks=[Network(network, stations=[station])], source="obsnet unseen generator (simulated)"
    )


def _response(recorder: Recorder, number: int) -> Response:
    unit = "PA" if number == 0 else "M/S"
    poles, zeros = _poles(recorder, number)
    sign = recorder.polarity if number == 0 else 1
    at = 10.0
    s = 2j * np.pi * at
    value = np.prod([s - z for z in zeros]) / np.prod([s - p for p in poles])
    volts = 1e-3 if number == 0 else 1e3
    counts = recorder.counts[min(number, 1)] / volts
    sensor = PolesZerosResponseStage(
        1, sign * volts * abs(value), at, unit, "V", "LAPLACE (RADIANS/SECOND)", at, zeros, poles,
        normalization_factor=1.0 / abs(value),
    )  # fmt: skip
    digitiser = CoefficientsTypeResponseStage(
        2, counts, 0.0, "V", "COUNTS", "DIGITAL", numerator=[1.0], denominator=[], decimation_input_sample_rate=recorder.rate_hz,
        decimation_factor=1, decimation_offset=0, decimation_delay=0.0, decimation_correction=0.0,
    )  # fmt: skip
    total = InstrumentSensitivity(sign * volts * abs(value) * counts, at, unit, "COUNTS")
    return Response(instrument_sensitivity=total, response_stages=[sensor, digitiser])
