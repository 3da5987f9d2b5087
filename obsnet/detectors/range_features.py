"""What the learned range detector sees of a hypothesis: the cepstrum around the delays that its range predicts.

Depth, sound speed, bottom and rate enter here, through the propagation table, and nowhere in the network: every
hypothesis of every station becomes a patch of path pairs × sub-windows × quefrencies around predicted delays, in units
of the noise. Training and runtime both take their features from this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
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
        shape = (len(config.pairs), fine.size)
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
                seconds[p] = two["delay"].values - one["delay"].values
                both = loudness[numbers.index(first)] * loudness[numbers.index(second)]
                self.strength[p] = np.log(np.maximum(2.0 * both, np.exp(FAINTEST)))
                phase[p] = np.exp(1j * np.angle(one["pressure"].values * two["pressure"].values.conj()))
        reach = config.lag_step_s * (config.lags // 2)
        longest = (n_quefrency - 1) * quefrency_step_s - reach
        exists = (seconds >= max(config.shortest_delay_s, reach)) & (seconds <= longest)
        self.phase = np.where(np.isfinite(phase), phase, 1.0).astype(np.complex64)
        self.index = np.where(exists, np.rint(np.nan_to_num(seconds) / quefrency_step_s), n_quefrency)
        self.index = self.index.astype(np.int32)
        self.seconds = np.where(exists, seconds, 1.0)
        self.slope = np.where(exists, np.nan_to_num(np.gradient(seconds, FINE_M, axis=1)), 0.0)
        self.inverse = _inverse(seconds, exists, fine, config, quefrency_step_s, n_quefrency)


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
        shape = (len(minutes), len(config.pairs), len(config.range_rate), len(config.range_m))
        energy = np.empty(shape, np.float32)
        kernels.pair_energy(
            analytic, valid, times, start, stop, minutes, table.index, table.pad, FINE_M,
            round(config.range_step_m / FINE_M), config.range_rate, energy,
        )  # fmt: skip
        score = np.empty((shape[0], *shape[2:]), np.float32)
        kernels.cheap_score(energy, score)
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
        found = np.empty((len(range_m), config.size), np.float32)
        kernels.describe(
            look.analytic, look.valid, look.frame_time, look.start, look.stop, look.minutes, look.energy, look.score,
            look.once, np.ascontiguousarray(index, np.int64), np.ascontiguousarray(range_m, float),
            np.ascontiguousarray(rate, float), table.index, table.seconds, table.strength, table.slope, table.phase, table.inverse,
            table.pad, FINE_M, config.range_step_m, config.range_rate, self._lag_step,
            config.window_s / config.sub_windows, config.sub_windows, config.lags, table.depth_m, found,
        )  # fmt: skip
        return found


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
        sub = np.clip(np.floor((times[lo:hi] - minutes[w]) / length + 0.5 * n_sub).astype(int), 0, n_sub - 1)
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
    spectrum = scipy.fft.dct(scaled.astype(np.float32, copy=False), type=1, axis=1)
    frequency = np.arange(n) / (2.0 * quefrency_s[-1])
    weight = np.interp(frequency, band_hz, (0.0, 1.0, 1.0, 0.0))
    size = 2 * (n - 1)
    gain = weight / np.sqrt(2.0 * np.sum(weight**2) / (n - 1)) * 2.0 / size
    padded = np.zeros((len(frames), OVERSAMPLING * size), np.complex64)
    padded[:, :n] = spectrum * gain.astype(np.float32)
    values = scipy.fft.ifft(padded, axis=1, overwrite_x=True, norm="forward")
    out = np.zeros((len(frames), OVERSAMPLING * (n - 1) + 2), np.complex64)
    out[:, :-1] = values[:, : out.shape[1] - 1]
    return out


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
