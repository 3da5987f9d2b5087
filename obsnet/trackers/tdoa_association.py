"""Where a source is in; which delays its paths predict, and how likely a set of measured delays is, out.

Paths come from the image method in a shallow waveguide or from a propagation table; measured delays carry no
label, so their likelihood sums over every valid assignment of measurements to pairs of paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import erfc
from typing import Protocol

import numpy as np
import xarray as xr
from numba import njit

from obsnet.errors import ConfigError
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import strongest_delay, tdoa

IMAGE_DEPTHS = {
    "direct": (0, 1),
    "surface": (0, -1),
    "bottom": (2, -1),
    "surface-bottom": (-2, 1),
    "bottom-surface": (2, 1),
    "surface-bottom-surface": (-2, -1),
    "bottom-surface-bottom": (4, -1),
}
"""Depth of the receiver's image for each path, as (multiple of the water depth, multiple of the receiver's
depth); a path's name lists its reflections from the source on."""

LEAST_VISIBILITY = 0.02

UNDERFLOW_SIGMAS = 38.6
"""exp(−x²/2) is zero in double precision beyond this many standard deviations."""

NEGLIGIBLE_SIGMAS = 11.0
"""A detection this far off adds less than rounding to a sum in which every pair may also have been missed."""

NEVER_SIGMAS = 9.0
"""The tail of a normal distribution beyond this many standard deviations is less than 1's rounding."""


class TdoaModel(Protocol):
    """Anything that predicts the delays between pairs of paths from where the source is."""

    pairs: tuple[str, ...]

    def tdoas(self, range_m: np.ndarray, depth_m: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Delays [s], dims (source, pair); NaN where one of the paths cannot exist."""
        ...

    def visibility(self, range_m: np.ndarray) -> np.ndarray:
        """Factor of each pair's probability of detection, 0 to 1, dims (source, pair), or 1 where it is the
        same all over.
        """
        ...


class ImageModel:
    """Delays in a waveguide of constant depth and sound speed, by the image method.

    Path k has the length q_k = √((p − i_k)² + r²), p the source's depth, i_k that of the receiver's image;
    the delay of a pair is |q_a − q_b|/c. A source above the surface, below the bottom, or at a negative range
    has no paths.

    Parameters
    ----------
    water_depth_m, sound_speed_mps : m, m/s, positive.
    paths : names out of `IMAGE_DEPTHS`; every two of them make a pair, ordered (0, 1), (0, 2), (1, 2).

    Raises
    ------
    ConfigError
        A path is unknown or named twice, or a size is not positive.

    Source: Watkins et al., eq. (2) and fig. 1.

    >>> model = ImageModel(65.0, 1508.0)
    >>> model.pairs
    ('direct,bottom', 'direct,bottom-surface', 'bottom,bottom-surface')
    """

    def __init__(
        self,
        water_depth_m: float,
        sound_speed_mps: float,
        paths: Sequence[str] = ("direct", "bottom", "bottom-surface"),
    ) -> None:
        for name, value in {"water depth": water_depth_m, "sound speed": sound_speed_mps}.items():
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"the {name} must be positive, found {value}")
        unknown = [path for path in paths if path not in IMAGE_DEPTHS]
        if unknown:
            raise ConfigError(f"unknown path '{unknown[0]}'; the known ones are {', '.join(IMAGE_DEPTHS)}")
        if len(paths) < 2 or len(set(paths)) < len(paths):
            raise ConfigError(f"delays need two different paths at least, found {list(paths)}")
        self.water_depth_m, self.sound_speed_mps = float(water_depth_m), float(sound_speed_mps)
        self.paths = tuple(paths)
        self._first, self._second = np.triu_indices(len(self.paths), k=1)
        self.pairs = tuple(
            f"{self.paths[a]},{self.paths[b]}" for a, b in zip(self._first, self._second, strict=True)
        )

    def tdoas(self, range_m: np.ndarray, depth_m: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Delays [s], dims (source, pair)."""
        if receiver_depth_m is None or not 0.0 <= receiver_depth_m <= self.water_depth_m:
            raise ConfigError(
                f"the receiver's depth must lie in the water, 0 to {self.water_depth_m} m, "
                f"found {receiver_depth_m}"
            )
        factors = np.array([IMAGE_DEPTHS[path] for path in self.paths], float)
        images = factors @ np.array([self.water_depth_m, receiver_depth_m])
        range_m, depth_m = np.asarray(range_m, float), np.asarray(depth_m, float)
        lengths = np.sqrt((depth_m[:, None] - images) ** 2 + range_m[:, None] ** 2)
        lengths[(range_m < 0) | (depth_m < 0) | (depth_m > self.water_depth_m)] = np.nan
        return np.abs(lengths[:, self._first] - lengths[:, self._second]) / self.sound_speed_mps

    def visibility(self, range_m: np.ndarray) -> np.ndarray:
        """1: detection probabilities do not depend on position, as in the paper."""
        return np.ones((1, len(self.pairs)))


class TableModel:
    """Delays of a station's path pairs from a propagation table, for a source just below the surface.

    Parameters
    ----------
    table : Dataset with dims (path, range), as of `obsnet.ocean.rays`; a path's delay is NaN where it does
        not exist.
    pairs : names such as "1-3": two numbers of water-column crossings that the table holds.
    amplitudes : cepstral amplitude a(r) of each pair, where it is known. The probability of detection is then
        reduced by a²/(a² + a_½²), to 2 % at least: amplitudes are averages over ships.
    half_amplitude : a_½, at which a pair is seen half as often as at best.
    range_step_m : m, spacing of the uniform grid between whose points delays are interpolated linearly.

    Raises
    ------
    LayoutError, ConfigError
        The table lacks a variable; a pair is not two different paths of the table, or has no amplitude.
    """

    def __init__(
        self,
        table: xr.Dataset,
        pairs: Sequence[str] = ("1-3", "3-5", "5-7"),
        amplitudes: Amplitudes | None = None,
        half_amplitude: float = 0.02,
        range_step_m: float = 20.0,
    ) -> None:
        if not pairs:
            raise ConfigError("asked for the delays of no path pair; name one at least, such as '1-3'")
        self.pairs = tuple(pairs)
        self.range_step_m = float(range_step_m)
        self.grid_m = np.arange(0.0, float(table["range"].values[-1]) + range_step_m / 2, range_step_m)
        self._curves = np.stack(
            [np.abs(tdoa(table, pair, self.grid_m).values) for pair in self.pairs], axis=1
        )
        self._travel = strongest_delay(table, self.grid_m).values
        self._seen = np.ones_like(self._curves)
        if amplitudes is not None:
            energy = np.stack([amplitudes.evaluate(pair, self.grid_m) ** 2 for pair in self.pairs], axis=1)
            self._seen = np.maximum(energy / (energy + half_amplitude**2), LEAST_VISIBILITY)

    def tdoas(
        self, range_m: np.ndarray, depth_m: np.ndarray | None = None, receiver_depth_m: float | None = None
    ) -> np.ndarray:
        """Delays [s], dims (source, pair); the depths are the table's own and not asked for."""
        return interpolate_uniform(np.asarray(range_m, float), self._curves, self.range_step_m)

    def visibility(self, range_m: np.ndarray) -> np.ndarray:
        """Factor of each pair's probability of detection, dims (source, pair)."""
        return interpolate_uniform(np.asarray(range_m, float), self._seen, self.range_step_m)

    def travel_time(self, range_m: np.ndarray) -> np.ndarray:
        """Delay [s] of the strongest arrival from `range_m`: what is heard now left the source so long
        ago.
        """
        return np.interp(range_m, self.grid_m, self._travel)


def association_log_likelihood(
    predicted_s: np.ndarray,
    measured_s: np.ndarray,
    detection_probability: np.ndarray,
    std_s: np.ndarray,
    false_alarm_density: np.ndarray | float,
    window_s: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood ratio of unlabelled delays for each hypothetical source, against false alarms alone.

    With d_l the probability that pair l gives a measurement, λ the density of false alarms and [a, b) the
    window of observable delays,

        ln Σ_a Π_l r_l(a_l),   r_l(0) = 1 − d_l P_l,   r_l(m) = d_l N(z_m; g_l, σ_l²) / λ(z_m),

    over all vectors a in which no measurement serves two pairs. d_l is zero where the prediction is NaN. P_l
    is the probability that the noisy delay falls into the window, without which a branch that leaves the
    window would count as missed.

    Parameters
    ----------
    predicted_s : array, dims (source, pair), s; NaN where a path cannot exist.
    measured_s : array, dims (measurement,), s, all within `window_s`.
    detection_probability : array, dims (pair,) or (source, pair), 0 to 1.
    std_s : array, dims (pair,), s.
    false_alarm_density : λ, false alarms (Poisson) per second of delay, positive; dims (measurement,) or one
        for all, μ_FA / (b − a) for the paper's uniform ones.
    window_s : s, the window [a, b).

    Returns
    -------
    log_ratio : array, dims (source,); minus infinity where no assignment is possible.
    expected : array, dims (source,), mean number of measurements that the source accounts for.

    Notes
    -----
    The sum is exact. Taking the measurements one by one and keeping, for each of the 2^L sets of pairs
    already served, the sum over the assignments that serve just this set visits every valid vector once,
    without listing them.

    Source: Watkins et al., eq. (3).
    """
    predicted = np.ascontiguousarray(predicted_s, dtype=np.float64)
    detection = np.ascontiguousarray(
        np.broadcast_to(detection_probability, predicted.shape), dtype=np.float64
    )
    std = np.ascontiguousarray(np.broadcast_to(std_s, predicted.shape[1:]), dtype=np.float64)
    low, high = window_s
    measured = np.ascontiguousarray(measured_s, dtype=np.float64)
    density = np.ascontiguousarray(np.broadcast_to(false_alarm_density, measured.shape), dtype=np.float64)
    return _sum_associations(predicted, measured, detection, std, density, low, high)


@njit(cache=True, nogil=True)
def _sum_associations(predicted, measured, detection, std, density, low, high):
    n_source, n_pair = predicted.shape
    log_ratio = np.empty(n_source)
    expected = np.empty(n_source)
    served = np.empty(1 << n_pair)
    rest = np.empty(1 << n_pair)
    miss = np.empty(n_pair)
    ratio = np.empty(n_pair)
    close = np.empty(n_pair, np.int64)
    precision = 1.0 / std
    peak = precision / np.sqrt(2.0 * np.pi)
    for j in range(n_source):
        reach, total, weighted = NEGLIGIBLE_SIGMAS, 1.0, 0.0
        for pair in range(n_pair):
            miss[pair] = 1.0
            if not np.isnan(predicted[j, pair]):
                miss[pair] -= detection[j, pair] * _inside(predicted[j, pair], std[pair], low, high)
            total *= miss[pair]
            if miss[pair] < 1e-3:
                reach = UNDERFLOW_SIGMAS
        anything = False
        for m in range(len(measured)):
            n_close = 0
            for pair in range(n_pair):
                distance = (measured[m] - predicted[j, pair]) * precision[pair]
                if abs(distance) < reach:
                    rate = detection[j, pair] * peak[pair] / density[m]
                    ratio[n_close] = rate * np.exp(-0.5 * distance * distance)
                    close[n_close] = 1 << pair
                    n_close += 1
            if n_close > 0:
                if not anything:
                    served[:] = 0.0
                    served[0] = 1.0
                    anything = True
                _serve(served, close, ratio, n_close)
        if anything:
            total, weighted = _collect(served, miss, rest)
        log_ratio[j] = np.log(total) if total > 0.0 else -np.inf
        expected[j] = weighted / total if total > 0.0 else 0.0
    return log_ratio, expected


@njit(cache=True, nogil=True)
def _serve(served, close, ratio, n_close):
    for chosen in range(len(served) - 1, 0, -1):
        for i in range(n_close):
            if chosen & close[i]:
                served[chosen] += ratio[i] * served[chosen ^ close[i]]


@njit(cache=True, nogil=True)
def _collect(served, miss, rest):
    last = len(served) - 1
    rest[last] = 1.0
    total, weighted = served[last], len(miss) * served[last]
    for chosen in range(last - 1, -1, -1):
        left_out = 0
        while chosen >> left_out & 1:
            left_out += 1
        rest[chosen] = rest[chosen | 1 << left_out] * miss[left_out]
        term = served[chosen] * rest[chosen]
        total += term
        if term > 0.0:
            count = 0
            for pair in range(len(miss)):
                count += chosen >> pair & 1
            weighted += count * term
    return total, weighted


@njit(cache=True, nogil=True)
def _inside(predicted, std, low, high):
    root = std * np.sqrt(2.0)
    inside = 1.0
    if predicted < low + NEVER_SIGMAS * std:
        inside -= 0.5 * erfc((predicted - low) / root)
    if predicted > high - NEVER_SIGMAS * std:
        inside -= 0.5 * erfc((high - predicted) / root)
    return inside


@njit(cache=True, nogil=True)
def interpolate_uniform(range_m, curves, step):
    """Rows of `curves`, dims (grid, pair), linearly interpolated at `range_m`; NaN outside the grid, which
    starts at 0.
    """
    n_grid, n_pair = curves.shape
    delays = np.empty((len(range_m), n_pair))
    for j in range(len(range_m)):
        place = range_m[j] / step
        if not 0.0 <= place <= n_grid - 1:
            delays[j] = np.nan
            continue
        left = min(int(place), n_grid - 2)
        part = place - left
        for pair in range(n_pair):
            delays[j, pair] = (1.0 - part) * curves[left, pair] + part * curves[left + 1, pair]
    return delays
