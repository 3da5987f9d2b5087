"""Courses, and the waveforms of what sounds along them: ships, whales, seismic surveys."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class Bent:
    """A course past the station that may bend, speed up and wander: CPA of its straight part, turn, acceleration.

    `cpa_m` is positive where the ship passes with the station to its port. The heading swings by `turn_deg` around
    `turn_s` (s after the CPA of the straight part) over `turn_over_s`; the speed changes by `gain` of itself an hour.
    """

    cpa_s: float
    cpa_m: float
    course_deg: float
    speed_mps: float
    turn_deg: float = 0.0
    turn_s: float = 0.0
    turn_over_s: float = 900.0
    gain: float = 0.0
    yaw_deg: float = 0.4
    seed: int = 0

    def sampled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time [s], east and north [m] every 20 s over 20 h about the CPA."""
        t = np.arange(-36000.0, 36000.1, 20.0)
        swing = self.turn_deg / (1.0 + np.exp(-(t - self.turn_s) / (self.turn_over_s / 6.0)))
        swing -= self.turn_deg * (self.turn_s < 0)
        rng = np.random.default_rng([self.seed, 77])
        periods, phases = rng.uniform(600.0, 3600.0, 3), rng.uniform(0.0, 2 * np.pi, 3)
        yaw = self.yaw_deg * np.sin(2 * np.pi * t[:, None] / periods + phases).mean(axis=1)
        heading = np.deg2rad(self.course_deg + swing + yaw)
        speed = self.speed_mps * (1.0 + self.gain * np.tanh(t / 14400.0) * 4.0)
        here = self.cpa_m * np.array(
            [np.cos(np.deg2rad(self.course_deg)), -np.sin(np.deg2rad(self.course_deg))]
        )
        walked = []
        for component, velocity in zip(here, (speed * np.sin(heading), speed * np.cos(heading)), strict=True):
            steps = np.concatenate([[0.0], np.cumsum(10.0 * (velocity[1:] + velocity[:-1]))])
            walked.append(component + steps - steps[len(t) // 2])
        return self.cpa_s + t, walked[0], walked[1]

    def spline(self) -> CubicSpline:
        """Interpolating function of time [s] giving (east, north) [m]."""
        time, east, north = self.sampled()
        return CubicSpline(time, np.stack([east, north], axis=1))

    def __call__(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] at times [s]."""
        if not hasattr(self, "_spline"):
            object.__setattr__(self, "_spline", self.spline())
        place = self._spline(time)
        return place[:, 0], place[:, 1]


def shaped(
    rng: np.random.Generator, count: int, rate_hz: float, density_db, above_hz: float = 0.0
) -> np.ndarray:
    """Gaussian noise whose one-sided density is `density_db(frequency)` in dB re 1 unit²/Hz; none above `above_hz` if given."""
    n = scipy.fft.next_fast_len(count, real=True)
    frequency = scipy.fft.rfftfreq(n, 1.0 / rate_hz)
    frequency[0] = frequency[1]
    amplitude = 10.0 ** (np.asarray(density_db(frequency)) / 20.0) * np.sqrt(n * rate_hz / 4.0)
    if above_hz:
        amplitude = amplitude * np.clip((above_hz - frequency) / (0.04 * above_hz), 0.0, 1.0)
    draws = rng.standard_normal((2, len(frequency)), np.float32)
    spectrum = (draws[0] + 1j * draws[1]) * amplitude.astype(np.float32)
    return scipy.fft.irfft(spectrum, n)[:count]


def wander(rng: np.random.Generator, count: int, rate_hz: float, memory_s: float) -> np.ndarray:
    """A slow Gaussian process of variance 1 with this memory."""
    step = memory_s / 8.0
    nodes = int(count / rate_hz / step) + 80
    kernel = np.exp(-0.5 * (np.arange(-24, 25) / 8.0) ** 2)
    slow = np.convolve(rng.standard_normal(nodes), kernel, "same") / np.sqrt(np.sum(kernel**2))
    return np.interp(np.arange(count) / rate_hz, step * np.arange(nodes - 30), slow[30:]).astype(np.float32)


def level(db: float) -> float:
    """Pa (or Pa/√Hz) of a level re 1 µPa."""
    return 10.0 ** ((db - 120.0) / 20.0)


def ship(
    rng: np.random.Generator, count: int, rate_hz: float, source_db: float, length_m: float | None = None
) -> np.ndarray:
    """Waveform of a ship, Pa at 1 m: cavitation beating at the blade rate, propeller and diesel lines.

    `source_db` is the density of the broadband part at 15 Hz, dB re 1 µPa²/Hz at 1 m.
    """
    length = length_m or rng.choice([90.0, 180.0, 290.0, 400.0])
    slope, hump = rng.uniform(1.0, 3.0), rng.uniform(5.0, 14.0) * np.sqrt(200.0 / length)

    def density(f: np.ndarray) -> np.ndarray:
        shape = 1.0 / ((hump / f) ** 2.5 + (f / hump) ** slope)
        at15 = 1.0 / ((hump / 15.0) ** 2.5 + (15.0 / hump) ** slope)
        return source_db - 120.0 + 10.0 * np.log10(shape / at15)

    top = 0.48 * rate_hz
    shaft = rng.uniform(1.1, 2.3) * np.clip(200.0 / length, 0.8, 1.4) ** 0.5
    blades = int(rng.integers(4, 7))
    phase = _phase(rng, count, rate_hz, shaft, rng.uniform(3e-4, 3e-3))
    depth = rng.uniform(0.1, 0.5)
    beat = (
        1.0
        + depth * np.cos(blades * phase)
        + 0.3 * depth * (np.cos(2 * blades * phase + 1.0) + np.cos(phase))
    )
    sound = shaped(rng, count, rate_hz, density, top) * beat.astype(np.float32)
    for harmonic in range(1, int(0.9 * top / (blades * shaft)) + 1):
        strength = level(source_db + rng.uniform(-2.0, 9.0) - 3.0 * harmonic)
        sound += _line(rng, count, rate_hz, harmonic * blades * phase, strength)
    firing = rng.uniform(1.2, 4.0)
    engine = _phase(rng, count, rate_hz, firing, rng.uniform(1e-4, 1e-3))
    for harmonic in range(1, int(0.9 * top / firing) + 1):
        if rng.random() < 0.5:
            sound += _line(rng, count, rate_hz, harmonic * engine, level(source_db + rng.uniform(-12.0, 3.0)))
    return sound * np.exp(0.12 * wander(rng, count, rate_hz, 500.0))


def _phase(
    rng: np.random.Generator, count: int, rate_hz: float, frequency: float, jitter: float
) -> np.ndarray:
    rate = frequency * (1.0 + jitter * wander(rng, count, rate_hz, rng.uniform(20.0, 400.0)))
    return 2 * np.pi * np.cumsum(rate.astype(float)) / rate_hz


def _line(
    rng: np.random.Generator, count: int, rate_hz: float, phase: np.ndarray, strength: float
) -> np.ndarray:
    swell = np.exp(0.3 * wander(rng, count, rate_hz, 120.0))
    return (np.sqrt(2.0) * strength * swell * np.cos(phase + rng.uniform(0, 2 * np.pi))).astype(np.float32)


def whale(rng: np.random.Generator, count: int, rate_hz: float, kind: str) -> np.ndarray:
    """Song of one whale, Pa at 1 m: 'fin' doublets, 'blue' Z calls, 'pygmy' long tones; with pauses to breathe."""
    sound = np.zeros(count, np.float32)
    at, last = rng.uniform(0.0, 120.0), count / rate_hz
    source_db = rng.uniform(182.0, 190.0)
    short, long = sorted(rng.uniform(9.0, 30.0, 2))
    number, breath = 0, int(rng.integers(25, 60))
    interval = {"blue": rng.uniform(55.0, 75.0), "pygmy": rng.uniform(90.0, 190.0)}.get(kind, 0.0)
    while at < last - 40.0:
        call = _call(rng, rate_hz, kind) * level(source_db + rng.normal(0.0, 1.0)) * np.sqrt(2.0)
        first = int(at * rate_hz)
        sound[first : first + len(call)] += call[: count - first]
        number += 1
        at += (interval or (short if number % 2 else long)) * (1.0 + 0.02 * rng.standard_normal())
        at += rng.uniform(100.0, 400.0) if number % breath == 0 else 0.0
    return sound


def _call(rng: np.random.Generator, rate_hz: float, kind: str) -> np.ndarray:
    shape = {
        "fin": (0.9, [(0.0, 24.5), (1.0, 17.0)]),
        "blue": (20.0, [(0.0, 26.4), (0.5, 26.0), (0.56, 19.0), (1.0, 18.2)]),
        "pygmy": (18.0, [(0.0, 19.6), (0.4, 20.2), (1.0, 22.3)]),
    }[kind]
    seconds, knots = shape
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    frequency = np.interp(t / seconds, *zip(*knots, strict=True)) * (1.0 + 0.004 * rng.standard_normal())
    return (np.sin(2 * np.pi * np.cumsum(frequency) / rate_hz) * np.sin(np.pi * t / seconds) ** 0.7).astype(
        np.float32
    )


def survey(rng: np.random.Generator, count: int, rate_hz: float) -> np.ndarray:
    """Shots of a seismic survey, Pa at 1 m: a bubble pulse every ten to twenty seconds."""
    sound = np.zeros(count, np.float32)
    t = np.arange(0.0, 1.5, 1.0 / rate_hz)
    pulse = np.exp(-t / 0.12) * np.sin(2 * np.pi * rng.uniform(7.0, 12.0) * t) + np.exp(-((t / 0.02) ** 2))
    every = rng.uniform(9.0, 22.0)
    strength = level(rng.uniform(226.0, 236.0))
    for at in np.arange(1.0, count / rate_hz - 3.0, every):
        first = int((at + 0.05 * rng.standard_normal()) * rate_hz)
        sound[first : first + len(t)] += (strength * pulse).astype(np.float32)
    return sound
