"""What a station hears besides ships: wind, distant shipping, microseism, earthquakes, and its own shaking in a current."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elsewhere.paths import WATER_DENSITY
from elsewhere.ships import shaped, wander

IMPEDANCE = WATER_DENSITY * 1500.0


@dataclass(frozen=True)
class Lobe:
    """Diffuse noise from one side: density at 15 Hz [dB re 1 µPa²/Hz], mean azimuth, width and drift [deg, deg/h], slope [dB/octave]."""

    density_db: float
    azimuth_deg: float
    width_deg: float = 25.0
    drift_deg_per_hour: float = 0.0
    slope_db: float = -4.0
    swell: float = 0.15
    grazing_deg: float = 15.0


@dataclass(frozen=True)
class Surroundings:
    """Strength of every kind of noise; densities at 15 Hz [dB re 1 µPa²/Hz], earthquakes and T phases an hour."""

    wind_db: float = 68.0
    lobes: tuple[Lobe, ...] = ()
    microseism_db: float = 125.0
    sensor_db: float = 56.0
    horizontal_db: float = 62.0
    quakes_per_hour: float = 0.0
    t_phases_per_hour: float = 0.0
    strumming_db: float = 0.0


def surroundings(
    rng: np.random.Generator, around: Surroundings, start: float, count: int, rate_hz: float
) -> np.ndarray:
    """Pressure [Pa], velocity to the east, north and upwards [m/s] of everything but ships and whales, (4, count) float32."""
    out = np.zeros((4, count), np.float32)

    def wind(f: np.ndarray) -> np.ndarray:
        return (
            around.wind_db
            - 120.0
            - 10.0 * np.log10(1.0 + (f / 12.0) ** 1.7)
            + 10.0 * np.log10(1.0 + (3.0 / f) ** 2)
        )

    gusts = np.exp(0.15 * wander(rng, count, rate_hz, 1200.0))
    for row, share in enumerate((0.0, -4.8, -4.8, -4.8)):
        scale = 1.0 if row == 0 else 1.0 / IMPEDANCE
        out[row] += scale * gusts * shaped(rng, count, rate_hz, lambda f, share=share: wind(f) + share)
        own = around.sensor_db if row in (0, 3) else around.horizontal_db
        out[row] += scale * shaped(
            rng, count, rate_hz, lambda f, own=own: own - 120.0 + 12.0 * np.log10(1.0 + 5.0 / f)
        )
    for lobe in around.lobes:
        _lobe(rng, lobe, count, rate_hz, out)
    _microseism(rng, around.microseism_db, count, rate_hz, out)
    for per_hour, event in ((around.quakes_per_hour, _quake), (around.t_phases_per_hour, _t_phase)):
        for _ in range(rng.poisson(per_hour * count / rate_hz / 3600.0)):
            event(rng, int(rng.uniform(0, count)), rate_hz, out)
    if around.strumming_db:
        _strumming(rng, around.strumming_db, start, rate_hz, out)
    return out


def _lobe(rng: np.random.Generator, lobe: Lobe, count: int, rate_hz: float, out: np.ndarray) -> None:
    """Six incoherent plane waves within the lobe, each swelling on its own, all turning together."""
    hours = np.arange(count) / rate_hz / 3600.0

    def density(f: np.ndarray) -> np.ndarray:
        return lobe.density_db - 7.8 - 120.0 + lobe.slope_db * np.log2(np.maximum(f, 2.0) / 15.0)

    flat = np.cos(np.deg2rad(lobe.grazing_deg)) / IMPEDANCE
    for offset in lobe.width_deg * rng.standard_normal(6):
        p = shaped(rng, count, rate_hz, density) * np.exp(lobe.swell * wander(rng, count, rate_hz, 300.0))
        azimuth = np.deg2rad(lobe.azimuth_deg + offset + lobe.drift_deg_per_hour * hours)
        out[0] += p
        out[1] -= flat * p * np.sin(azimuth)
        out[2] -= flat * p * np.cos(azimuth)


def _microseism(
    rng: np.random.Generator, peak_db: float, count: int, rate_hz: float, out: np.ndarray
) -> None:
    """Rayleigh waves about 0.2 Hz from one side; pressure and vertical in phase."""
    peak, azimuth = rng.uniform(0.14, 0.3), rng.uniform(0.0, 2 * np.pi)
    p = shaped(
        rng, count, rate_hz, lambda f: peak_db - 120.0 - 90.0 * np.log10(f / peak) ** 2 * (1.0 + (f > peak))
    )
    across = shaped(
        rng, count, rate_hz, lambda f: peak_db - 126.0 - 90.0 * np.log10(f / peak) ** 2 * (1.0 + (f > peak))
    )
    for row, share in enumerate((1.0, np.sin(azimuth), np.cos(azimuth), 1.0)):
        out[row] += (p if row in (0, 3) else across) * share / (1.0 if row == 0 else IMPEDANCE)


def _quake(rng: np.random.Generator, first: int, rate_hz: float, out: np.ndarray) -> None:
    """P on all, S after it mostly on the horizontals, codas that die away; dominated by 3–12 Hz."""
    azimuth, lag = rng.uniform(0, 2 * np.pi), rng.uniform(2.0, 25.0)
    strength = 10.0 ** rng.uniform(-1.5, 1.0)
    corner = rng.uniform(4.0, 12.0)
    for delay, decay, (p, radial, across, up) in (
        (0.0, 4.0, (1.0, 0.25, 0.05, 0.8)),
        (lag, 8.0, (0.35, 0.9, 1.1, 0.3)),
    ):
        begin = first + int(delay * rate_hz)
        length = min(int(60.0 * rate_hz), out.shape[1] - begin)
        if length < 16:
            return
        t = np.arange(length) / rate_hz
        envelope = strength * (t / 0.3) * np.exp(1.0 - t / 0.3) + strength * 0.4 * np.exp(-t / decay) * (
            t > 0.3
        )
        body, coda = (
            shaped(rng, length, rate_hz, lambda f: -10.0 * np.log10(1.0 + (f / corner) ** 4))
            for _ in range(2)
        )
        rows = (
            p * body,
            (radial * np.sin(azimuth) * body + across * np.cos(azimuth) * coda) / IMPEDANCE,
            (radial * np.cos(azimuth) * body - across * np.sin(azimuth) * coda) / IMPEDANCE,
            up * body / IMPEDANCE,
        )
        for row, values in enumerate(rows):
            out[row, begin : begin + length] += envelope * values


def _t_phase(rng: np.random.Generator, first: int, rate_hz: float, out: np.ndarray) -> None:
    """A T phase: one to three minutes that swell and fade, 3–20 Hz, along the water from one azimuth."""
    length = min(int(rng.uniform(60.0, 180.0) * rate_hz), out.shape[1] - first)
    if length < 16:
        return
    azimuth = rng.uniform(0, 2 * np.pi)
    density = rng.uniform(-48.0, -30.0)
    p = (
        shaped(rng, length, rate_hz, lambda f: density - 30.0 * np.log10(f / 6.0) ** 2)
        * np.hanning(length) ** 2
    )
    for row, share in enumerate((1.0, -np.sin(azimuth) / IMPEDANCE, -np.cos(azimuth) / IMPEDANCE)):
        out[row, first : first + length] += p * share


def _strumming(
    rng: np.random.Generator, peak_db: float, start: float, rate_hz: float, out: np.ndarray
) -> None:
    """Lines of a strumming cable on the horizontals alone, their pitch and strength going with the tide."""
    time = start + np.arange(out.shape[1]) / rate_hz
    tide = np.abs(np.sin(2 * np.pi * time / 44712.0 + rng.uniform(0, np.pi)))
    phase = 2 * np.pi * np.cumsum((0.5 + 0.5 * tide) * rng.uniform(3.0, 7.0)) / rate_hz
    direction = rng.uniform(0, 2 * np.pi)
    for harmonic in (1, 2, 3):
        shake = 10.0 ** ((peak_db - 120.0) / 20.0) / harmonic * tide**2 * np.cos(harmonic * phase) / IMPEDANCE
        shake = shake * (1.0 + 0.3 * wander(rng, len(time), rate_hz, 30.0))
        out[1] += shake * np.sin(direction + 0.4 * harmonic)
        out[2] += shake * np.cos(direction + 0.4 * harmonic)
