"""What the learned range detector sees of a hypothesis: the cepstrum around the delays that its range predicts.

Depth, sound speed, bottom and rate enter here, through the propagation table, and nowhere in the network: every
hypothesis of every station becomes a patch of path pairs × sub-windows × quefrencies around predicted delays, in units
of the noise. Training and runtime both take their features from this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.detectors import range_kernels as kernels
from obsnet.detectors.maps import hop, range_axis, range_rate_axis, window_bounds
from obsnet.errors import ConfigError
from obsnet.layout import CEPSTROGRAM, require, to_posix
from obsnet.ocean.rays import interpolate, parse_pair
from obsnet.signals.cepstrogram import noise_std

FINE_M = 10.0
FAINTEST = -7.0
"""Natural log of the least strength of a pair that is told apart from none."""
OVERSAMPLING = 4
CONTEXT = ("exists", "energy", "ghost", "slope", "delay", "drift", "strength")
"""What is said of each pair besides its patch; its strength is what the believed table expects of its interference."""
GLOBALS = ("range_over_depth", "before", "centre", "after", "level", "clutter")
"""What is said once: range over depth, coverage of the sub-windows, and how loud the window's cepstrum is."""


@dataclass(frozen=True)
class RangeFeaturesConfig:
    """Shape of a hypothesis's patch and the grid of hypotheses.

    Lags reach `lags // 2 · lag_step_s` to either side of the predicted delay; `band_hz` is the band of the log
    spectrum (edges 0, 1, 1, 0) of which the cepstrum is made anew, so that rates above 50 Hz see the same.
    """

    pairs: tuple[str, ...] = ("1-3", "3-5", "5-7", "7-9", "9-11")
    window_s: float = 180.0
    sub_windows: int = 3
    lags: int = 9
    lag_step_s: float = 0.04
    band_hz: tuple[float, ...] = (3.0, 7.0, 20.0, 24.0)
    shortest_delay_s: float = 0.2
    max_range_m: float = 50_050.0
    range_step_m: float = 140.0
    max_range_rate_mps: float = 12.0
    range_rate_step_mps: float = 2.0

    def __post_init__(self) -> None:
        for pair in self.pairs:
            parse_pair(pair)
        if self.lags % 2 == 0 or self.sub_windows < 1:
            raise ConfigError(
                f"lags must be odd and sub_windows positive, found {self.lags}, {self.sub_windows}"
            )
        if len(self.band_hz) != 4 or not np.all(np.diff(self.band_hz) > 0):
            raise ConfigError(f"band_hz must hold four increasing frequencies, found {self.band_hz}")
        if abs(self.range_step_m / FINE_M - round(self.range_step_m / FINE_M)) > 1e-9:
            raise ConfigError(f"range_step_m must be a multiple of {FINE_M:g} m, found {self.range_step_m:g}")

    @property
    def range_m(self) -> np.ndarray:
        """Ranges of the grid of hypotheses [m]."""
        return range_axis(self.max_range_m, self.range_step_m)

    @property
    def range_rate(self) -> np.ndarray:
        """Range rates of the grid of hypotheses [m/s], symmetric about 0."""
        return range_rate_axis(self.max_range_rate_mps, self.range_rate_step_mps)

    @property
    def patch_shape(self) -> tuple[int, int, int, int]:
        """Pairs, sub-windows, lags, and in phase or in quadrature."""
        return len(self.pairs), self.sub_windows, self.lags, 2

    @property
    def size(self) -> int:
        """Features of a hypothesis."""
        return int(np.prod(self.patch_shape)) + len(self.pairs) * len(CONTEXT) + len(GLOBALS)


class DelayTable:
    """Delays of the path pairs against range, as the kernels want them: quefrency indices on a fine grid of ranges.

    Parameters
    ----------
    propagation : Dataset of `obsnet.ocean.rays.propagation`.
    config : RangeFeaturesConfig
    quefrency_step_s, n_quefrency : of the oversampled cepstrum.

    Attributes
    ----------
    index, seconds, slope, phase, strength, exists : (n_fine, n_pairs) at ranges (i − pad)·`FINE_M`: quefrency index, n_quefrency
        where a pair does not exist; delay [s], its derivative [s/m], phasor against the pulse, log strength.
    inverse : (n_pairs, n_quefrency + 1) range of the grid, as an index, at which a pair has a delay, −1 where none.
    there, drift : (n_fine, n_pairs p, n_pairs q) range of the grid at which pair q has p's delay, and the range rate there over
        p's, NaN where q has not or is p.
    """

    def __init__(
        self, propagation: xr.Dataset, config: RangeFeaturesConfig, quefrency_step_s: float, n_quefrency: int
    ) -> None:
        self.depth_m = float(propagation.attrs.get("depth_m", np.nan))
        if not self.depth_m > 0:
            raise ConfigError("the propagation table does not say its depth_m, which the range features need")
        margin = config.max_range_rate_mps * config.window_s + config.range_step_m
        self.pad = int(np.ceil(margin / FINE_M))
        fine = (np.arange(int(config.max_range_m / FINE_M) + 1 + 2 * self.pad) - self.pad) * FINE_M
        table = interpolate(propagation, np.abs(fine))
        numbers = table["path"].values.tolist()
        shape = (fine.size, len(config.pairs))
        seconds, phase, self.strength = (
            np.full(shape, np.nan),
            np.ones(shape, np.complex64),
            np.full(shape, FAINTEST),
        )
        loudness = _loudness(table)
        for p, pair in enumerate(config.pairs):
            first, second = parse_pair(pair)
            if first in numbers and second in numbers:
                one, two = table.sel(path=first), table.sel(path=second)
                seconds[:, p] = two["delay"].values - one["delay"].values
                both = loudness[numbers.index(first)] * loudness[numbers.index(second)]
                self.strength[:, p] = np.log(np.maximum(2.0 * both, np.exp(FAINTEST)))
                phase[:, p] = np.exp(1j * np.angle(one["pressure"].values * two["pressure"].values.conj()))
        reach = config.lag_step_s * (config.lags // 2)
        longest = (n_quefrency - 1) * quefrency_step_s - reach
        self.exists = (seconds >= max(config.shortest_delay_s, reach)) & (seconds <= longest)
        self.phase = np.where(np.isfinite(phase), phase, 1.0).astype(np.complex64)
        self.index = np.where(self.exists, np.rint(np.nan_to_num(seconds) / quefrency_step_s), n_quefrency)
        self.index = self.index.astype(np.int32)
        self.seconds = np.where(self.exists, seconds, 1.0)
        self.slope = np.where(self.exists, np.nan_to_num(np.gradient(seconds, FINE_M, axis=0)), 0.0)
        self.inverse = _inverse(seconds.T, self.exists.T, fine, config, quefrency_step_s, n_quefrency)
        self.there, self.drift = self._others(config)

    def _others(self, config: RangeFeaturesConfig) -> tuple[np.ndarray, np.ndarray]:
        there = np.moveaxis(self.inverse[:, self.index], 0, -1)
        pair = np.arange(len(config.pairs))
        found = np.maximum(there, 0)
        place = self.pad + found * round(config.range_step_m / FINE_M)
        slope = self.slope[place, pair]
        known = (there >= 0) & (slope != 0.0) & (pair[:, None] != pair)
        drift = np.divide(self.slope[:, :, None], slope, out=np.full(slope.shape, np.nan), where=known)
        return found, drift


@dataclass(frozen=True)
class Look:
    """A stretch of record as the kernels take it, the windows that its frames fall into, and a first look at them.

    Attributes
    ----------
    analytic : complex64 (frame, quefrency), of `analytic_cepstrum`. valid : bool (frame). frame_time : s since 1970.
    minutes : s since 1970. start, stop : frames of each minute's window.
    energy : float32 (minute, pair, rate, range), of each pair at every hypothesis of the grid; mean 1 in noise.
    score : float32 (minute, rate, range), the cheap score of every hypothesis of the grid, ≥ 0.
    once : float32 (minute, n), `GLOBALS` without the first.
    """

    analytic: np.ndarray
    valid: np.ndarray
    frame_time: np.ndarray
    start: np.ndarray
    stop: np.ndarray
    minutes: np.ndarray
    energy: np.ndarray
    score: np.ndarray
    once: np.ndarray


class RangeFeatures:
    """Features of range hypotheses at one station.

    Parameters
    ----------
    propagation : Dataset of `obsnet.ocean.rays.propagation`: what is believed of the station's delays.
    config : RangeFeaturesConfig
    """

    def __init__(self, propagation: xr.Dataset, config: RangeFeaturesConfig = RangeFeaturesConfig()) -> None:
        self.config = config
        self._propagation = propagation
        self._quefrency = np.empty(0)
        self._table: DelayTable | None = None
        self._lag_step = 0

    def look(self, cepstrogram: xr.DataArray, minutes: np.ndarray) -> Look:
        """Take a first look at a stretch of record: the energy of every hypothesis of the grid.

        Parameters
        ----------
        cepstrogram : DataArray float32 (quefrency, time), clutter removed; NaN in gaps.
        minutes : centres of the windows, s since 1970.
        """
        require(cepstrogram, CEPSTROGRAM)
        config, quefrency = self.config, cepstrogram["quefrency"].values
        nfft = int(cepstrogram.attrs.get("nfft", 2 * (quefrency.size - 1)))
        if self._table is None or not np.array_equal(quefrency, self._quefrency):
            self._prepare(quefrency)
        table, minutes = self.table, np.asarray(minutes, float)
        times = to_posix(cepstrogram["time"].values)
        frames = np.ascontiguousarray(cepstrogram.values.T)
        valid = ~np.isnan(frames[:, 0])
        analytic = analytic_cepstrum(frames, quefrency, nfft, config.band_hz)
        start, stop = window_bounds(times, minutes, config.window_s)
        energy = kernels.pair_energy(
            analytic, valid, times, start, stop, minutes, table.index.T, table.pad, FINE_M,
            round(config.range_step_m / FINE_M), config.range_rate, len(config.range_m),
        )  # fmt: skip
        score = kernels.cheap_score(energy)
        once = _once(analytic, valid, times, start, stop, minutes, energy, config)
        return Look(analytic, valid, times, start, stop, minutes, energy, score, once)

    def _prepare(self, quefrency: np.ndarray) -> None:
        step = float(quefrency[-1] / (quefrency.size - 1) / OVERSAMPLING)
        self._lag_step = max(round(self.config.lag_step_s / step), 1)
        n = OVERSAMPLING * (quefrency.size - 1) + 1
        self._table = DelayTable(self._propagation, self.config, step, n)
        self._quefrency = quefrency

    @property
    def table(self) -> DelayTable:
        """Delays on the fine grid, once a window was made."""
        if self._table is None:
            raise ConfigError("take a look first: the delay table follows its quefrencies")
        return self._table

    def features(self, look: Look, index: np.ndarray, range_m: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Feature vectors of hypotheses.

        Parameters
        ----------
        index : (n) which minute of the look each hypothesis belongs to. range_m, rate : (n) hypotheses, m and m/s.

        Returns
        -------
        array float32 (n, size): patch (pair, sub-window, lag, in phase and quadrature), `CONTEXT` of each pair,
        `GLOBALS`.
        """
        config, table = self.config, self.table
        index, range_m, rate = np.asarray(index), np.asarray(range_m, float), np.asarray(rate, float)
        centre = table.pad + np.rint(range_m / FINE_M).astype(np.int64)
        exists = table.exists[centre]
        sums = np.empty((len(index), *config.patch_shape[:3]), np.complex64)
        count = np.empty((len(index), config.sub_windows), np.float32)
        order = np.argsort(index, kind="stable")
        windows, first = np.unique(index[order], return_index=True)
        for window, rows in zip(windows, np.split(order, first[1:]), strict=True):
            sums[rows], count[rows] = self._stacked(look, window, range_m[rows], rate[rows])
        total = sums[..., config.lags // 2].sum(axis=2)
        sums *= np.where(exists, table.phase[centre], 0.0)[:, :, None, None]
        sums /= np.sqrt(np.maximum(count, 1.0))[:, None, :, None]
        found = np.empty((len(index), config.size), np.float32)
        said = int(np.prod(config.patch_shape))
        found[:, :said] = sums.view(np.float32).reshape(len(index), -1)
        slope = table.slope[centre]
        context = np.stack(
            [
                np.ones_like(slope),
                np.log1p((total.real**2 + total.imag**2) / np.maximum(count.sum(axis=1), 1.0)[:, None]),
                np.log1p(self._ghosts(look, index, centre, rate)),
                1e4 * slope,
                np.log(table.seconds[centre]),
                np.abs(1e3 * slope * rate[:, None]),
                table.strength[centre],
            ],
            axis=-1,
        )
        found[:, said : -len(GLOBALS)] = np.where(exists[..., None], context, 0.0).reshape(len(index), -1)
        found[:, -len(GLOBALS)] = range_m / table.depth_m
        found[:, 1 - len(GLOBALS) :] = look.once[index]
        return found

    def _stacked(
        self, look: Look, window: int, range_m: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Cepstra around the delays of one window's hypotheses, (n, pair, sub-window, lag), and frames of its sub-windows."""
        config, table = self.config, self.table
        frame = slice(look.start[window], look.stop[window])
        later = look.frame_time[frame] - look.minutes[window]
        sub = _sub_window(later, config)
        place = table.pad + np.rint((range_m + rate * later[:, None]) / FINE_M).astype(np.int64)
        sums = kernels.patches(
            look.analytic[frame], sub, table.index[place], self._lag_step, config.sub_windows, config.lags
        )
        return sums, np.bincount(sub, look.valid[frame], config.sub_windows)

    def _ghosts(self, look: Look, index: np.ndarray, centre: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Cheap score that other pairs give to the ranges at which another pair q has pair p's delay, the largest over q.

        A ridge at pair p's delay may be pair q's, of a ship at another range; that ship's other pairs then show elsewhere.
        q's own share of the score there is left out. (n, pair) float32.
        """
        config, table = self.config, self.table
        rates = config.range_rate
        windows, row = np.unique(index, return_inverse=True)
        others = kernels.best_of_others(look.energy[windows], look.score[windows])
        drift = table.drift[centre]
        drift *= rate[:, None, None] / (rates[1] - rates[0])
        drift -= rates[0] / (rates[1] - rates[0])
        number = np.rint(drift, out=drift)
        known = (number >= 0) & (number < len(rates))  # False for NaN
        pair = np.arange(len(config.pairs))
        ravelled = np.where(known, number, 0.0).astype(np.int64)
        ravelled += len(rates) * (pair + len(pair) * row[:, None, None])
        ravelled *= len(config.range_m)
        ravelled += table.there[centre]
        return np.where(known, others.ravel()[ravelled], np.float32(0.0)).max(axis=2)


def _sub_window(later: np.ndarray, config: RangeFeaturesConfig) -> np.ndarray:
    """Sub-window of frames so much later than the window's minute."""
    length = config.window_s / config.sub_windows
    number = np.floor(later / length + 0.5 * config.sub_windows).astype(np.int64)
    return np.clip(number, 0, config.sub_windows - 1)


def _once(
    analytic: np.ndarray,
    valid: np.ndarray,
    times: np.ndarray,
    start: np.ndarray,
    stop: np.ndarray,
    minutes: np.ndarray,
    energy: np.ndarray,
    config: RangeFeaturesConfig,
) -> np.ndarray:
    """Of each minute: coverage of its sub-windows, log power of its frames, log mean energy at range rate 0."""
    n_sub, length = config.sub_windows, config.window_s / config.sub_windows
    hop_s = hop(times)
    thinned = analytic[:, round(0.03 * analytic.shape[1]) : -1 : OVERSAMPLING]
    power = np.where(valid, (thinned.real**2 + thinned.imag**2).mean(axis=1), 0.0)
    out = np.zeros((len(minutes), n_sub + 2), np.float32)
    for w, (lo, hi) in enumerate(zip(start, stop, strict=True)):
        sub = _sub_window(times[lo:hi] - minutes[w], config)
        out[w, :n_sub] = np.minimum(np.bincount(sub, valid[lo:hi], n_sub) * hop_s / length, 1.0)
        out[w, n_sub] = np.log(max(power[lo:hi].sum() / max(valid[lo:hi].sum(), 1), 1e-3))
    still = energy[:, :, energy.shape[2] // 2]
    out[:, n_sub + 1] = np.log(np.maximum(still.mean(axis=(1, 2)), 1e-3))
    return out


def analytic_cepstrum(
    frames: np.ndarray, quefrency_s: np.ndarray, nfft: int, band_hz: tuple[float, ...]
) -> np.ndarray:
    """Analytic signal of cepstra over quefrency, band-limited, oversampled, and of unit variance in noise.

    Parameters
    ----------
    frames : array float32 (n_frames, n_quefrency), even in quefrency; frames with NaN count as zero.
    quefrency_s : s, from 0 evenly. nfft : of the spectra. band_hz : trapezoid of the log spectrum kept.

    Returns
    -------
    array complex64 (n_frames, OVERSAMPLING·(n_quefrency − 1) + 2): quefrencies from 0 to the same end, and a last
    column of zeros for delays that do not exist.
    """
    n = quefrency_s.size
    scaled = np.nan_to_num(frames) / noise_std(quefrency_s, nfft).astype(np.float32)
    whole = np.concatenate([scaled, scaled[:, -2:0:-1]], axis=1, dtype=np.float32)
    spectrum = np.fft.rfft(whole, axis=1).real.astype(np.float32, copy=False)
    frequency = np.arange(n) / (2.0 * quefrency_s[-1])
    weight = np.interp(frequency, band_hz, (0.0, 1.0, 1.0, 0.0))
    size = 2 * (n - 1)
    gain = weight / np.sqrt(2.0 * np.sum(weight**2) / (n - 1)) * 2.0 / size
    spectrum *= gain.astype(np.float32)
    out = np.zeros((len(frames), OVERSAMPLING * (n - 1) + 2), np.complex64)
    # Of a real spectrum, the transform forward is the one backward conjugated.
    out[:, :-1] = np.fft.rfft(spectrum, OVERSAMPLING * size, axis=1)
    return np.conjugate(out, out=out)


def _loudness(table: xr.Dataset) -> np.ndarray:
    """Amplitude of each path, of a source just below the surface, over that of all together: (path, range)."""
    slowest = 1.0 / float(table.attrs.get("surface_speed_mps", 1500.0)) ** 2
    steepness = np.sqrt(np.maximum(slowest - table["slowness"].values ** 2, 1e-3 * slowest))
    amplitude = np.nan_to_num(np.abs(table["pressure"].values) * steepness)
    return amplitude / np.maximum(np.sqrt((amplitude**2).sum(axis=0)), 1e-30)


def _inverse(
    seconds: np.ndarray,
    exists: np.ndarray,
    fine: np.ndarray,
    config: RangeFeaturesConfig,
    step: float,
    n_quefrency: int,
) -> np.ndarray:
    """Range of the grid (as an index) at which a pair has a delay, −1 where none: (n_pairs, n_quefrency + 1) int32."""
    found = np.full((len(seconds), n_quefrency + 1), -1, np.int32)
    lags = np.arange(n_quefrency) * step
    for p, (row, there) in enumerate(zip(seconds, exists, strict=True)):
        there = there & (fine >= 0) & (fine <= config.range_m[-1])
        if there.sum() < 2:
            continue
        order = np.flatnonzero(there)[::-1]  # a pair's delay falls with range
        at = np.interp(lags, row[order], fine[order], left=np.nan, right=np.nan)
        known = np.isfinite(at)
        found[p, :-1][known] = np.rint(at[known] / config.range_step_m)
    return found
