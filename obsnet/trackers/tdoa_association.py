"""Where a source is in; which delays its paths predict, and how likely a set of measured delays is, out.

Paths come from a propagation table here, from the image method in `waveguide`; measured delays carry no label,
so their likelihood sums over every valid assignment of measurements to pairs of paths.
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

LEAST_VISIBILITY = 0.02

UNDERFLOW_SIGMAS = 38.6
"""exp(−x²/2) is zero in double precision beyond this many standard deviations."""

NEGLIGIBLE_SIGMAS = 9.0
"""A detection this far off adds less than rounding to a sum in which every pair may also have been missed."""

NEVER_SIGMAS = 9.0
"""The tail of a normal distribution beyond this many standard deviations is less than 1's rounding."""


class TdoaModel(Protocol):
    """Anything that predicts the delays between pairs of paths from where the source is."""

    pairs: tuple[str, ...]

    def tdoas(self, range_m: np.ndarray, depth_m: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Delays [s], dims (source, pair); NaN where one of the paths cannot exist."""
        ...

    def visibility(self, range_m: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Factor of each pair's probability of detection, 0 to 1, dims (source, pair), or 1 where it is the
        same all over.
        """
        ...


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

    def visibility(self, range_m: np.ndarray, receiver_depth_m: float | None = None) -> np.ndarray:
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
    The sum is exact to rounding. Measurements are taken in the order of their delays, and for each set of pairs
    already served the sum over the assignments that serve just this set is kept, which visits every valid
    vector once without listing it. A pair is in these sets from the first to the last measurement that can be
    its own only: with L of them open at once, a measurement costs 2^L L steps.

    Source: Watkins et al., eq. (3).
    """
    predicted = np.ascontiguousarray(predicted_s, dtype=np.float64)
    detection = np.ascontiguousarray(
        np.broadcast_to(detection_probability, predicted.shape), dtype=np.float64
    )
    std = np.ascontiguousarray(np.broadcast_to(std_s, predicted.shape[1:]), dtype=np.float64)
    low, high = window_s
    unsorted = np.asarray(measured_s, dtype=np.float64)
    order = np.argsort(unsorted)
    density = np.broadcast_to(false_alarm_density, unsorted.shape).astype(np.float64)[order]
    return _sum_associations(predicted, unsorted[order], detection, std, density, low, high)


@njit(cache=True, nogil=True)
def _sum_associations(predicted, measured, detection, std, density, low, high):
    n_source, n_pair = predicted.shape
    log_ratio = np.empty(n_source)
    expected = np.empty(n_source)
    served, counted = np.empty(1 << n_pair), np.empty(1 << n_pair)
    miss, ratio = np.empty(n_pair), np.empty(n_pair)
    first, stop = np.empty(n_pair, np.int64), np.empty(n_pair, np.int64)
    opened = np.empty(n_pair, np.int64)
    for j in range(n_source):
        factor = 1.0
        for pair in range(n_pair):
            first[pair], stop[pair], miss[pair] = 0, 0, 1.0
            if not np.isnan(predicted[j, pair]):
                miss[pair] -= detection[j, pair] * _inside(predicted[j, pair], std[pair], low, high)
                reach = std[pair] * (NEGLIGIBLE_SIGMAS if miss[pair] > 1e-3 else UNDERFLOW_SIGMAS)
                first[pair] = np.searchsorted(measured, predicted[j, pair] - reach)
                stop[pair] = np.searchsorted(measured, predicted[j, pair] + reach)
            if first[pair] == stop[pair]:
                factor *= miss[pair]
        n_open, served[0], counted[0] = 0, factor, 0.0
        for m in range(len(measured)):
            for pair in range(n_pair):
                if first[pair] == m and stop[pair] > m:
                    _open(served, counted, n_open)
                    opened[n_open] = pair
                    n_open += 1
            if n_open == 0:
                continue
            for i in range(n_open):
                pair = opened[i]
                distance = (measured[m] - predicted[j, pair]) / std[pair]
                rate = detection[j, pair] / (np.sqrt(2.0 * np.pi) * std[pair] * density[m])
                ratio[i] = rate * np.exp(-0.5 * distance * distance)
            _serve(served, counted, ratio, n_open)
            for i in range(n_open - 1, -1, -1):
                if stop[opened[i]] == m + 1:
                    n_open -= 1
                    _close(served, counted, miss[opened[i]], i, n_open)
                    for later in range(i, n_open):
                        opened[later] = opened[later + 1]
        log_ratio[j] = np.log(served[0]) if served[0] > 0.0 else -np.inf
        expected[j] = counted[0] / served[0] if served[0] > 0.0 else 0.0
    return log_ratio, expected


@njit(cache=True, nogil=True)
def _open(served, counted, n_open):
    """One pair more, not yet served."""
    served[1 << n_open : 2 << n_open] = 0.0
    counted[1 << n_open : 2 << n_open] = 0.0


@njit(cache=True, nogil=True)
def _serve(served, counted, ratio, n_open):
    """The next measurement is false, or serves one of the open pairs."""
    for chosen in range((1 << n_open) - 1, 0, -1):
        total, weighted = served[chosen], counted[chosen]
        for i in range(n_open):
            if chosen >> i & 1:
                before = chosen ^ (1 << i)
                total += ratio[i] * served[before]
                weighted += ratio[i] * (counted[before] + served[before])
        served[chosen], counted[chosen] = total, weighted


@njit(cache=True, nogil=True)
def _close(served, counted, miss, place, n_open):
    """No later measurement can serve the pair at this place: what is not served is missed."""
    for rest in range(1 << n_open):
        without = (rest >> place << (place + 1)) | (rest & ((1 << place) - 1))
        chosen = without | (1 << place)
        served[rest] = miss * served[without] + served[chosen]
        counted[rest] = miss * counted[without] + counted[chosen]


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
