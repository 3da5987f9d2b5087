"""Simulated clicking animals around a compact array: their paths, the TDOAs of their clicks, and what
hydrophones record.

Everything here is simulated. Straight rays at one sound speed, a flat surface that inverts the click's sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.arrays.compact import CompactArray, angles
from obsnet.arrays.tdoa import quantised

SAMPLING_RATE_HZ = 96_000.0
QUANTISATION_S = 1.0 / (np.sqrt(12.0) * SAMPLING_RATE_HZ)
"""Standard deviation of rounding to samples."""

CLUTTER_S = 1.5e-3
CLICK_HZ, CLICK_BANDWIDTH_HZ = 12_000.0, 4_000.0
PULSES = ((0.0, 1.0), (0.0045, 0.3))
"""Delay [s] and amplitude of the pulses of a sperm whale's click: the main one and its echo inside the
head."""


@dataclass(frozen=True)
class AnimalPath:
    """Position of a simulated animal against time: east and north of the array and depth, m, every second."""

    second: np.ndarray
    position: np.ndarray

    def at(self, time: np.ndarray) -> np.ndarray:
        """Position (..., (east, north, depth)) at `time` [s]."""
        time = np.asarray(time, float)
        return np.stack([np.interp(time, self.second, column) for column in self.position.T], axis=-1)

    def direction(self, time: np.ndarray, array_depth_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Azimuth [0, 360) and elevation [deg] from the array at `time`."""
        return angles(self.at(time) - np.array([0.0, 0.0, array_depth_m]))

    def turned(self, angle_deg: float) -> AnimalPath:
        """The same path turned clockwise around the array."""
        angle = np.deg2rad(angle_deg)
        east, north, depth = self.position.T
        turned = (
            east * np.cos(angle) + north * np.sin(angle),
            north * np.cos(angle) - east * np.sin(angle),
            depth,
        )
        return AnimalPath(self.second, np.stack(turned, axis=1))


@dataclass(frozen=True)
class TdoaScene:
    """TDOAs scan by scan with clutter: channel, value and animal of each (−1: clutter), and the animals' own.

    Attributes
    ----------
    time : array (scan,), s. channel, value, animal : one array a scan.
    paths : animals; present : bool array (animal, scan), clicked in the scan.
    """

    time: np.ndarray
    channel: list[np.ndarray]
    value: list[np.ndarray]
    animal: list[np.ndarray]
    paths: list[AnimalPath]
    present: np.ndarray


def simulated_path(
    rng: np.random.Generator, duration_s: float, range_m: tuple[float, float] = (600.0, 2000.0)
) -> AnimalPath:
    """A diving animal: 1.7 m/s (the paper's 6 km/h), its course and its climb changing slowly at random.

    `range_m` is where it starts, horizontally; its depth stays between 300 and 1500 m.
    """
    second = np.arange(0.0, duration_s + 2.0)
    azimuth, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*range_m)
    course = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(np.deg2rad(1.5) * rng.standard_normal(len(second)))
    climb = np.clip(rng.uniform(-0.5, 0.5) + np.cumsum(0.02 * rng.standard_normal(len(second))), -1.0, 1.0)
    level = np.sqrt(1.7**2 - climb**2)
    east = distance * np.sin(azimuth) + np.cumsum(level * np.sin(course))
    north = distance * np.cos(azimuth) + np.cumsum(level * np.cos(course))
    depth = np.clip(rng.uniform(500.0, 1300.0) - np.cumsum(climb), 300.0, 1500.0)
    return AnimalPath(second, np.stack([east, north, depth], axis=1))


def simulated_click_times(
    rng: np.random.Generator, start_s: float, end_s: float, interval_s: float = 1.0
) -> np.ndarray:
    """Times of a train of clicks about `interval_s` apart, jittered by a tenth of it."""
    steps = interval_s * rng.normal(1.0, 0.1, int(2 * (end_s - start_s) / interval_s) + 2)
    times = start_s + np.cumsum(np.maximum(steps, 0.3 * interval_s))
    return times[times < end_s]


def simulated_tdoas(
    rng: np.random.Generator,
    array: CompactArray,
    pairs: np.ndarray,
    paths: list[AnimalPath],
    time: np.ndarray,
    present: np.ndarray,
    clutter: float = 1.0,
    detection: float = 1.0,
) -> TdoaScene:
    """TDOAs rounded to samples, with clutter uniform over ±1.5 ms: paper's fig. 7.

    Parameters
    ----------
    time : scans, s. present : bool array (animal, scan), an animal clicks in a scan.
    clutter : Poisson mean of clutter a pair and scan. detection : probability that a click is measured on a
        pair.
    """
    own = [array.tdoa(*path.direction(time, array.mean_depth_m), pairs) for path in paths]
    channels, values, animals = [], [], []
    for k in range(len(time)):
        measured = [
            (i, np.flatnonzero(rng.random(len(pairs)) < detection)) for i in np.flatnonzero(present[:, k])
        ]
        noise = np.repeat(np.arange(len(pairs)), rng.poisson(clutter, len(pairs)))
        channel = np.concatenate([*(which for _, which in measured), noise]).astype(int)
        click = [quantised(own[i][k, which], SAMPLING_RATE_HZ) for i, which in measured]
        value = np.concatenate([*click, rng.uniform(-CLUTTER_S, CLUTTER_S, len(noise))])
        animal = np.concatenate([*(np.full(len(which), i) for i, which in measured), np.full(len(noise), -1)])
        order = rng.permutation(len(channel))
        channels.append(channel[order])
        values.append(value[order])
        animals.append(animal[order].astype(int))
    return TdoaScene(np.asarray(time, float), channels, values, animals, paths, np.asarray(present, bool))


def simulated_recording(
    rng: np.random.Generator,
    array: CompactArray,
    paths: list[AnimalPath],
    clicks: list[np.ndarray],
    duration_s: float,
    source_level: float,
    reflection: float = 0.8,
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Samples of every hydrophone: clicks, their surface echoes, coloured noise of standard deviation 1.

    Parameters
    ----------
    clicks : times of emission of each animal, s. source_level : peak amplitude of a click 1000 m away.
    reflection : size of the surface's reflection; its sign is negative.

    Returns
    -------
    samples : float32 array (hydrophone, time).
    direct, echo : for each animal, arrival times at the array's centre, s.
    """
    count = int(duration_s * SAMPLING_RATE_HZ)
    samples = _sea_noise(rng, array.count, count)
    centre = array.positions.mean(axis=0)
    direct: list[np.ndarray] = []
    echo: list[np.ndarray] = []
    for path, emitted in zip(paths, clicks, strict=True):
        source = path.at(emitted) - np.array([0.0, 0.0, array.mean_depth_m])
        image = source * np.array([1.0, 1.0, -1.0]) - np.array([0.0, 0.0, 2.0 * array.mean_depth_m])
        for heard, vectors, factor in ((direct, source, 1.0), (echo, image, -reflection)):
            distance = np.linalg.norm(vectors, axis=1)
            arrival = emitted + distance / array.sound_speed_mps
            lead = (vectors / distance[:, None]) @ (array.positions - centre).T / array.sound_speed_mps
            for time, early, size in zip(
                arrival, lead, factor * source_level * 1000.0 / distance, strict=True
            ):
                _add_click(samples, time - early, size)
            heard.append(arrival[(arrival > 0.05) & (arrival < duration_s - 0.05)])
    return samples, direct, echo


def _add_click(samples: np.ndarray, arrival_s: np.ndarray, amplitude: float) -> None:
    """Add one click to every hydrophone at its own arrival time, exact to a fraction of a sample."""
    reach = 0.008
    first = int((arrival_s.min() - reach) * SAMPLING_RATE_HZ)
    last = int((arrival_s.max() + reach) * SAMPLING_RATE_HZ)
    if first < 0 or last > samples.shape[1]:
        return
    lag = np.arange(first, last) / SAMPLING_RATE_HZ - arrival_s[:, None]
    for delay, size in PULSES:
        envelope = np.exp(-0.5 * (2.0 * np.pi * CLICK_BANDWIDTH_HZ / 2.0 * (lag - delay)) ** 2)
        samples[:, first:last] += amplitude * size * envelope * np.cos(2.0 * np.pi * CLICK_HZ * (lag - delay))


def _sea_noise(rng: np.random.Generator, hydrophones: int, count: int) -> np.ndarray:
    """Noise falling by 5 dB an octave above 200 Hz, independent between hydrophones, standard deviation 1."""
    block = 2**19
    frequency = np.fft.rfftfreq(block, 1.0 / SAMPLING_RATE_HZ)
    shape = (np.maximum(frequency, 200.0) / 200.0) ** (-5.0 / 6.0)
    shape *= frequency > 50.0
    shape = (shape / np.sqrt(2.0 * np.mean(shape**2) / 2.0)).astype(np.float32)
    noise = np.empty((hydrophones, count), np.float32)
    for row in range(hydrophones):
        for first in range(0, count, block):
            spectrum = np.fft.rfft(rng.standard_normal(block, np.float32)) * shape
            last = min(first + block, count)
            noise[row, first:last] = np.fft.irfft(spectrum, block)[: last - first]
    return noise
