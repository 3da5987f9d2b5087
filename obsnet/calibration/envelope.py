"""Envelope of the cepstrogram along the delays of path pairs: where the station is, and how strongly pairs
interfere.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import scipy.signal
import xarray as xr
from scipy.ndimage import gaussian_filter1d, maximum_filter
from scipy.optimize import least_squares

from obsnet.calibration.passages import Passages, vertex
from obsnet.ocean.amplitudes import Amplitudes, SkewNormal
from obsnet.ocean.rays import delay_echoes, parse_pair, tdoa, travel_time
from obsnet.signals.cepstrogram import noise_std

BLOCK_S = 1200.0
CLIP = 40.0
SEPARATION_S = 0.15
LAGS = np.arange(-4, 5)
MIN_FRAMES = 20
MIN_BIN_FRAMES = 8
SIGNIFICANCE = 8.0
BLUR = 2.0
RIVAL, MAX_RIVALS = 0.6, 3
MODEL_STD_M, MAX_STD_M = 25.0, 300.0
UNHEARD = 0.02


@dataclass(frozen=True)
class Offset:
    """Offset of the station from its stated position, m east and north, with standard deviations and
    correlation.

    `significance` is its score over the standard deviation that noise alone would give the score.
    """

    east_m: float
    north_m: float
    east_std_m: float
    north_std_m: float
    correlation: float
    significance: float


class Branches:
    """Excess of the cepstrum's squared envelope over noise, in units of σ², to be read along pairs' delays.

    With Ĉ the analytic cepstrum, |Ĉ/σ|² of noise is χ² with 2 degrees of freedom, and the mean of |Ĉ/σ|² − 2
    is |μ̂/σ|² (paper's eqs C1–C2).

    A lag τ_ij in a frame centred at t pairs sound that came by path i at t − τ_ij/2 with its echo by path j
    at t + τ_ij/2: it left the ship at t − (τ_i + τ_j)/2, some seconds from the loudest path's t − τ.
    """

    def __init__(self, passages: Passages, table: xr.Dataset, pairs: tuple[str, ...]) -> None:
        valid = np.isfinite(passages.cepstra).all(axis=1) & passages.heard.alone
        self.heard = passages.heard[valid]
        self.step = float(passages.quefrency[1] - passages.quefrency[0])
        self.std = noise_std(passages.quefrency, passages.nfft)
        analytic = scipy.signal.hilbert(passages.cepstra[valid].astype(float), axis=1)
        self.excess = np.abs(analytic / self.std) ** 2 - 2.0
        self.pairs = tuple(
            pair for pair in pairs if set(parse_pair(pair)) <= set(table["path"].values.tolist())
        )
        self._along(table)

    def _along(self, table: xr.Dataset) -> None:
        """Take pairs' delays from this table."""
        self.table = table
        self.range_m = table["range"].values.astype(float)
        self.delay = np.stack([tdoa(table, pair).values for pair in self.pairs])
        told = self.delay.copy()
        for i in range(len(self.pairs)):
            close = np.any(np.abs(np.delete(told, i, 0) - told[i]) < SEPARATION_S, axis=0)
            self.delay[i] = np.where(close, np.nan, self.delay[i])
        self.east_m, self.north_m = self._emitted(table)
        # The first 0.3 s hold the source's own spectrum, the clutter filter notwithstanding.
        self.delay[self.delay < 0.3] = np.nan

    def late(self, echo_delay_s: float) -> Branches:
        """The same cepstra along the delays of a sea floor whose echo comes this much later [s]."""
        other = copy.copy(self)
        other._along(delay_echoes(self.table, echo_delay_s))
        return other

    def _emitted(self, table: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m] of the ship at t − (τ_i + τ_j)/2, for each pair and frame."""
        heard = self.heard
        distance = heard.relative_to(0.0, 0.0)[1][:, 0]
        loudest = travel_time(table)(distance)
        later = np.zeros((len(self.pairs), distance.size))
        for i, pair in enumerate(self.pairs):
            mean = table["delay"].sel(path=list(parse_pair(pair))).mean("path", skipna=False).values
            exists = np.isfinite(mean)
            if exists.any():
                later[i] = loudest - np.interp(distance, self.range_m[exists], mean[exists])
        return heard.east_m[:, 0] + heard.east_mps * later, heard.north_m[:, 0] + heard.north_mps * later

    def ranges(self, pair: int, offset_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Range [m], from a station at this offset, at which each frame's ship emitted what makes a pair's
        lag.
        """
        return np.hypot(self.east_m[pair] - offset_m[0], self.north_m[pair] - offset_m[1])

    def read(self, excess: np.ndarray, pair: int, range_m: np.ndarray, lag_s: float = 0.0) -> np.ndarray:
        """Excess of each frame at a pair's delay for the ranges [m]; NaN where the pair is not to be seen."""
        position = (np.interp(range_m, self.range_m, self.delay[pair], right=np.nan) + lag_s) / self.step
        inside = np.isfinite(position) & (position < excess.shape[1] - 1)
        left = np.where(inside, position, 0.0).astype(int)
        share = np.where(inside, position, 0.0) - left
        row = np.arange(range_m.size)
        value = (1.0 - share) * excess[row, left] + share * excess[
            row, np.minimum(left + 1, excess.shape[1] - 1)
        ]
        return np.where(inside, value, np.nan)

    def weights(self, amplitudes: Amplitudes) -> np.ndarray:
        """Weight a_ij(r)²/σ² of each pair and frame in the score of an offset."""
        rows = [
            amplitudes.evaluate(pair, self.ranges(i)) ** 2 / self.variance(i, self.ranges(i))
            for i, pair in enumerate(self.pairs)
        ]
        return np.stack(rows)

    def variance(self, pair: int, range_m: np.ndarray) -> np.ndarray:
        """Cepstral noise variance σ² at a pair's delay for the ranges [m]."""
        delay = np.interp(range_m, self.range_m, np.nan_to_num(self.delay[pair]))
        return np.interp(delay, self.step * np.arange(self.std.size), self.std) ** 2


def scan(branches: Branches, weights: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Score of each offset east and north in `grid` [m], over all frames, of the blurred envelope."""
    blurred = gaussian_filter1d(np.minimum(branches.excess, CLIP), BLUR, axis=1)
    return score_offsets(branches, blurred, weights, grid, grid, np.zeros(branches.heard.time.size, int))[0]


def scan_noise(weights: np.ndarray) -> float:
    """Standard deviation of a `scan`'s scores where there is noise alone.

    |Ĉ/σ|² has variance 4, frames overlap by half, and the blur averages neighbours.
    """
    return float(np.sqrt(2.0 * 4.0 * np.nansum(weights**2) / (2.0 * BLUR * np.sqrt(np.pi))))


def locate(branches: Branches, amplitudes: Amplitudes, search_m: float, step_m: float) -> list[Offset]:
    """Offsets of the station that put the cepstral branches of all passages where the AIS ranges say.

    The score of an offset is the sum over frames and pairs of a_ij(r)²/σ² times the excess at τ_ij(r), the
    locally best statistic; it is searched over ±`search_m` and refined. Leaving out each stretch of 20 min in
    turn gives the covariance (jackknife), to which `MODEL_STD_M` is added for what the delays leave out, the
    sediment above all.

    Returns
    -------
    list of Offset, the best first; empty where nothing stands out of the noise or the passages leave a
    direction open. Ranges to straight courses alone do not tell a place from its mirror image beyond the
    course: there may be two.
    """
    if branches.heard.time.size < MIN_FRAMES:
        return []
    weights = branches.weights(amplitudes)
    grid = np.arange(-search_m, search_m + step_m / 2, step_m)
    scores = scan(branches, weights, grid)
    scores -= np.median(scores)
    noise = scan_noise(weights)
    peaks = (scores == maximum_filter(scores, 7)) & (scores > max(SIGNIFICANCE * noise, RIVAL * scores.max()))
    best = np.unravel_index(scores.argmax(), scores.shape)
    if not peaks[best] or min(best) == 0 or max(best) == grid.size - 1:
        return []
    peaks &= np.pad(np.ones((grid.size - 2, grid.size - 2), bool), 1)
    order = sorted(np.argwhere(peaks), key=lambda at: -scores[tuple(at)])[:MAX_RIVALS]
    refined = (_refine(branches, weights, (grid[i], grid[j]), step_m, scores[i, j] / noise) for i, j in order)
    return [offset for offset in refined if offset is not None]


def _refine(
    branches: Branches, weights: np.ndarray, start: tuple[float, float], step_m: float, significance: float
) -> Offset | None:
    """Peak of the score near `start` and its covariance; none where leaving out a stretch moves it far
    away.
    """
    excess, blocks = np.minimum(branches.excess, CLIP), branches.heard.blocks(BLOCK_S)
    for reach in (1.5 * step_m, 4.5 * step_m):
        around = np.linspace(-reach, reach, 2 * 9 + 1)
        east, north = start[0] + around, start[1] + around
        parts = score_offsets(branches, excess, weights, east, north, blocks)
        parts = gaussian_filter1d(gaussian_filter1d(parts, 1.0, axis=1), 1.0, axis=2)
        total = parts.sum(axis=0)
        left_out = np.array([_peak(total - part, east, north) for part in parts])
        if np.abs(left_out - np.array(start)).max() < reach and len(parts) > 1:
            break
    else:
        return None
    best = _peak(total, east, north)
    scatter = left_out - left_out.mean(axis=0)
    spread = (len(parts) - 1) / len(parts) * scatter.T @ scatter + np.eye(2) * MODEL_STD_M**2
    std = np.sqrt(np.diag(spread))
    correlation = spread[0, 1] / (std[0] * std[1])
    if std.max() > MAX_STD_M:
        return None
    return Offset(*map(float, (best[0], best[1], std[0], std[1], correlation, significance)))


def stack(branches: Branches, offset_m: tuple[float, float], edges_m: np.ndarray) -> xr.Dataset:
    """Cepstral amplitude of each pair in bins of range, and its variance, stacked over all frames.

    Returns
    -------
    Dataset, dims (pair, range): square, the mean squared amplitude |μ̂|² less the noise's (paper's eq. C2),
    its standard error `error`, and the number of frames. The envelope is read at the lag, one per pair within
    ±0.08 s, at which the whole stack is strongest.
    """
    count = edges_m.size - 1
    shape = (len(branches.pairs), count)
    square, error, frames = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, int)
    for i in range(len(branches.pairs)):
        distance = branches.ranges(i, offset_m)
        bins = np.digitize(distance, edges_m) - 1
        readings = np.stack(
            [branches.read(branches.excess, i, distance, lag * branches.step) for lag in LAGS]
        )
        if not np.isfinite(readings).any():
            continue
        value = readings[np.nanmean(readings, axis=1).argmax()]
        use = np.isfinite(value) & (bins >= 0) & (bins < count)
        number = np.bincount(bins[use], minlength=count)
        mean = np.bincount(bins[use], value[use], count) / np.maximum(number, 1)
        variance = branches.variance(i, 0.5 * (edges_m[1:] + edges_m[:-1]))
        # Frames overlap by half: two count as some 1.5 independent ones.
        deviation = np.sqrt((4.0 + 4.0 * np.maximum(mean, 0.0)) / np.maximum(0.75 * number, 1.0))
        enough = number >= MIN_BIN_FRAMES
        square[i] = np.where(enough, mean * variance, np.nan)
        error[i] = np.where(enough, deviation * variance, np.nan)
        frames[i] = number
    return xr.Dataset(
        {
            "square": (("pair", "range"), square, {"units": "1"}),
            "error": (("pair", "range"), error, {"units": "1"}),
            "frames": (("pair", "range"), frames),
        },
        {
            "pair": list(branches.pairs),
            "range": ("range", 0.5 * (edges_m[1:] + edges_m[:-1]), {"units": "m"}),
        },
    )


def fit(stacked: xr.Dataset, start: Amplitudes) -> tuple[Amplitudes, tuple[str, ...]]:
    """Skew normal of each pair through its stacked amplitudes, and the names of the pairs that were heard.

    The squares are fitted, since they are unbiased where the amplitude drowns, with the errors of the stack
    and a tenth of the amplitude for ships that differ; `start` guides where there are no data, with a weight
    of less than one bin each kilometre. A pair that is not heard in at least five bins keeps its curve in
    `start`.
    """
    curves, heard = dict(start.curves), []
    range_m = stacked["range"].values
    for pair in start.pairs:
        if pair not in stacked["pair"].values:
            continue
        square, error = (stacked[name].sel(pair=pair).values for name in ("square", "error"))
        known = np.isfinite(square)
        strong = known & (square > 3.0 * error)
        if known.sum() < 8 or strong.sum() < 5:
            continue
        curves[pair] = _fit_pair(range_m[known], square[known], error[known], start.curves[pair])
        heard.append(pair)
    return Amplitudes(curves, start.depth_m), tuple(heard)


def _fit_pair(range_m: np.ndarray, square: np.ndarray, error: np.ndarray, start: SkewNormal) -> SkewNormal:
    level = np.sqrt(max(float(np.max(square)), 1e-12))
    guide_m = np.arange(0.0, range_m.max() + 20e3, 2000.0)
    peak = start.evaluate(guide_m).max()
    gain = level / peak
    guide = (gain * start.evaluate(guide_m)) ** 2
    scale = np.array([max(start.k, 1e-9) * gain, 1.0, start.omega_m, start.omega_m])
    deviation = np.hypot(error, 0.2 * np.maximum(square, 0.1 * level**2))

    def curve(x: np.ndarray) -> SkewNormal:
        return SkewNormal(
            abs(x[0]) * scale[0], float(x[1]), float(x[2] * scale[2]), float(abs(x[3]) * scale[3] + 200.0)
        )

    def residuals(x: np.ndarray) -> np.ndarray:
        found = curve(x)
        data = (found.evaluate(range_m) ** 2 - square) / deviation
        prior = 0.3 * (found.evaluate(guide_m) ** 2 - guide) / level**2
        return np.concatenate([data, prior])

    fits = []
    for shift in (0.0, -0.4, 0.4):
        for alpha in (-start.alpha, 0.5, start.alpha):
            first = np.array([1.0, alpha, start.xi_m / scale[2] + shift, 1.0])
            bounds = ([0.02, -10.0, -3.0, 0.02], [50.0, 15.0, 10.0, 6.0])
            fits.append(least_squares(residuals, np.clip(first, *bounds), bounds=bounds, loss="soft_l1"))
    return curve(min(fits, key=lambda found: found.cost).x)


def score_offsets(
    branches: Branches,
    excess: np.ndarray,
    weights: np.ndarray,
    east: np.ndarray,
    north: np.ndarray,
    blocks: np.ndarray,
) -> np.ndarray:
    """Score of each offset, summed over the frames of each block: (block, east, north)."""
    total = np.zeros((int(blocks.max()) + 1, east.size, north.size))
    for pair, weight in enumerate(weights):
        counts = np.flatnonzero(weight > UNHEARD * weights.max())
        mine = excess[counts]
        ship_east, ship_north = branches.east_m[pair, counts], branches.north_m[pair, counts]
        for i, e in enumerate(east):
            for j, n in enumerate(north):
                value = branches.read(mine, pair, np.hypot(ship_east - e, ship_north - n))
                score = np.nan_to_num(weight[counts] * value)
                total[:, i, j] += np.bincount(blocks[counts], score, total.shape[0])
    return total


def _peak(scores: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """East and north [m] of the highest score, between nodes by the parabola through its neighbours."""
    i, j = (int(k) for k in np.unravel_index(scores.argmax(), scores.shape))
    return np.array([_vertex(scores[:, j], i, east), _vertex(scores[i], j, north)])


def _vertex(values: np.ndarray, at: int, grid: np.ndarray) -> float:
    return float(np.interp(at + vertex(values, at), np.arange(grid.size), grid))
