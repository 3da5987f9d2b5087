"""The arithmetic of the learned range detector: cepstra gathered along the delays of hypotheses."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

HINGE_SLOPE, HINGE_ONSET, HINGE_TOP = 0.8, 1.8, 60.0
"""A pair's share of the cheap score: a line in its energy from an onset, which noise seldom reaches, to a top."""

_WINDOWS = 8
"""Windows gathered at once, pair by pair: what fits a core's cache."""
_LOWEST = -80.0
"""Least log of what is summed, relative to the largest: its exponential is still a normal float32."""


def pair_energy(
    analytic: np.ndarray,
    valid: np.ndarray,
    frame_time: np.ndarray,
    start: np.ndarray,
    stop: np.ndarray,
    minutes: np.ndarray,
    delay: np.ndarray,
    pad: int,
    fine_m: float,
    stride: int,
    rates: np.ndarray,
    n_range: int,
) -> np.ndarray:
    """Energy of the coherent stack of a window's frames along each hypothesis, for every path pair.

    Every frame is laid out over the fine ranges once, those that are `stride` apart side by side, so that a frame's part
    of a stack is a stretch of memory.

    Parameters
    ----------
    analytic : (n_frames, n_quefrency + 1) complex64 analytic cepstrum of unit noise variance, zero in frames that are not
        `valid`; the last column is zero.
    valid : (n_frames) bool. frame_time, minutes : s. start, stop : (n_windows) frames of each window.
    delay : (n_pairs, n_fine) quefrency index of a pair at ranges (i − pad)·fine_m; the last column where none.
    stride : fine steps from one range to the next. rates : (n_rates) m/s.

    Returns
    -------
    (n_windows, n_pairs, n_rates, n_range) float32; exponential of mean 1 in noise.
    """
    n_pairs, n_fine = delay.shape
    width = -(-n_fine // stride)
    laid = np.full((n_pairs, width * stride), analytic.shape[1] - 1, np.int64)
    laid[:, :n_fine] = delay
    laid = np.ascontiguousarray(laid.reshape(n_pairs, width, stride).transpose(0, 2, 1)).reshape(n_pairs, -1)
    energy = np.empty((len(minutes), n_pairs, len(rates), n_range), np.float32)
    before = np.concatenate([[0], np.cumsum(valid)])
    share = 1.0 / np.maximum(before[stop] - before[start], 1).astype(np.float32)
    for begin in range(0, len(minutes), _WINDOWS):
        windows = range(begin, min(begin + _WINDOWS, len(minutes)))
        first, last = int(start[windows].min()), int(stop[windows].max())
        read = []
        for w in windows:
            later = frame_time[start[w] : stop[w]] - minutes[w]
            place = pad + np.rint(rates[:, None] * later / fine_m).astype(np.int64)
            read.append((np.arange(start[w], stop[w]) - first, place % stride, place // stride))
        for pair in range(n_pairs):
            held = analytic[first:last].take(laid[pair], axis=1).reshape(-1, stride, width)
            stretches = sliding_window_view(held, n_range, axis=2)
            for w, frames in zip(windows, read, strict=True):
                sums = stretches[frames].view(np.float32).sum(axis=1)
                sums *= sums
                np.add(sums[:, ::2], sums[:, 1::2], out=energy[w, pair])
    energy *= share[:, None, None, None]
    return energy


def cheap_score(energy: np.ndarray) -> np.ndarray:
    """Sum over the pairs of a hinge of their energy: (n_windows, n_rates, n_range) float32."""
    return np.stack([hinge(window).sum(axis=0) for window in energy]) if len(energy) else energy[:, 0]


def hinge(energy: np.ndarray) -> np.ndarray:
    """A pair's share of the cheap score at its energy."""
    share = np.clip(energy, np.float32(HINGE_ONSET), np.float32(HINGE_TOP))
    share -= np.float32(HINGE_ONSET)
    share *= np.float32(HINGE_SLOPE)
    return share


def patches(
    frames: np.ndarray,
    sub_window: np.ndarray,
    column: np.ndarray,
    lag_step: int,
    n_sub: int,
    n_lags: int,
) -> np.ndarray:
    """Cepstra around the delays of one window's hypotheses, stacked along their drift in sub-windows.

    Parameters
    ----------
    frames : (n_frames, n_quefrency + 1) complex64, the window's of `analytic` as of `pair_energy`.
    sub_window : (n_frames) of each frame, increasing.
    column : (n_frames, n, n_pairs) quefrency index of each hypothesis; the last column where none.
    lag_step : columns from one lag to the next.

    Returns
    -------
    (n, n_pairs, n_sub, n_lags) complex64
    """
    n_columns, reach = frames.shape[1], lag_step * (n_lags // 2)
    held = np.zeros(frames.size + 2 * reach + 1, np.complex64)  # ends with a patch of zeros
    held[: frames.size] = frames.ravel()
    row = n_columns * np.arange(len(frames))[:, None, None]
    place = np.where(column == n_columns - 1, frames.size, column + (row - reach))
    found = np.empty((n_lags, *column.shape), np.complex64)
    for lag in range(n_lags):
        np.take(held, place, out=found[lag], mode="clip")
        place += lag_step
    edges = np.searchsorted(sub_window, np.arange(n_sub + 1))
    sums = np.stack([found[:, a:b].sum(axis=1) for a, b in itertools.pairwise(edges)])
    return np.ascontiguousarray(sums.transpose(2, 3, 0, 1))


def best_of_others(energy: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Cheap score without a pair's own share, the largest of a cell and its neighbours, for every path pair.

    Parameters
    ----------
    energy : (n_windows, n_pairs, n_rates, n_range) of `pair_energy`. score : of `cheap_score`.

    Returns
    -------
    array like `energy`.
    """
    best = np.empty_like(energy)
    for window, cheap, out in zip(energy, score, best, strict=True):
        np.subtract(cheap, hinge(window), out=out)
        along = out.copy()
        np.maximum(along[..., 1:], out[..., :-1], out=along[..., 1:])
        np.maximum(along[..., :-1], out[..., 1:], out=along[..., :-1])
        out[:] = along
        np.maximum(out[:, 1:], along[:, :-1], out=out[:, 1:])
        np.maximum(out[:, :-1], along[:, 1:], out=out[:, :-1])
    return best


def choose(score: np.ndarray, peaks: int, spread: int, rates: int, least: float = 0.0) -> np.ndarray:
    """Hypotheses at and around the highest peaks, over range rate, of each window's score; none where it nowhere reaches `least`.

    Parameters
    ----------
    score : (n_windows, n_rates, n_range) float32.
    peaks : how many, each with `spread` ranges to either side. rates : range rates about the best of each such range.

    Returns
    -------
    bool array like `score`.
    """
    n_windows, n_rates, n_range = score.shape
    chosen = np.zeros(score.shape, bool)
    best = score.max(axis=1)
    best[best.max(axis=1) < least] = 0.0
    first = np.clip(score.argmax(axis=1) - rates // 2, 0, max(n_rates - rates, 0))
    around, taken = np.arange(-spread, spread + 1), np.arange(min(rates, n_rates))
    for _ in range(peaks):
        top = best.argmax(axis=1)
        window = np.flatnonzero(best[np.arange(n_windows), top] > 0.0)
        place = top[window, None] + around
        inside = (place >= 0) & (place < n_range)
        window = np.broadcast_to(window[:, None], place.shape)[inside]
        rate, place = first[window, top[window]], place[inside]
        chosen[window[:, None], rate[:, None] + taken, place[:, None]] = True
        best[window, place] = -1.0
    return chosen


def carry_on(said: np.ndarray, cheap: np.ndarray, slope: float) -> None:
    """Fill the range rates of a looked-at range that were not looked at themselves, in place.

    They take the nearest looked-at one's value, less `slope` times what the cheap score falls by; (window, rate, range).
    """
    looked = ~np.isnan(said)
    window, place = np.nonzero(looked.any(axis=1))
    known, values, score = (array[window, :, place] for array in (looked, said, cheap))
    number = np.arange(said.shape[1])
    first = known.argmax(axis=1)[:, None]
    last = said.shape[1] - 1 - known[:, ::-1].argmax(axis=1)[:, None]
    edge = np.clip(number, first, last)
    fall = np.maximum(np.take_along_axis(score, edge, axis=1) - score, np.float32(0.0))
    said[window, :, place] = np.take_along_axis(values, edge, axis=1) - np.float32(slope) * fall


def resample(
    coarse: np.ndarray,
    range_below: np.ndarray,
    range_weight: np.ndarray,
    rate_below: np.ndarray,
    rate_weight: np.ndarray,
) -> np.ndarray:
    """Bilinear interpolation of (n_windows, rate, range) onto (n_windows, range, rate), float32."""
    number = np.arange(len(rate_below))
    onto = np.zeros((coarse.shape[1], len(rate_below)), np.float32)
    onto[rate_below, number] = 1.0 - rate_weight
    onto[rate_below + 1, number] += rate_weight
    fine = np.empty((len(coarse), len(range_below), len(rate_below)), np.float32)
    for window, out in zip(coarse, fine, strict=True):
        below = window[:, range_below]
        below += range_weight * (window[:, range_below + 1] - below)
        np.matmul(below.T, onto, out=out)
    return fine


def share_out(
    llr: np.ndarray, shape: np.ndarray, slope: float, reach_range: int, reach_rate: int, prior: np.ndarray
) -> None:
    """Give the ratios of each window the fine shape of another's, in place; what lies within a reach of a cell stays.

    l ← log⟨e^l⟩ + s·a − log⟨e^(s·a)⟩, ⟨⟩ the mean over cells within the reach; then all of a window are moved together so
    that its ratio of presence, the sum of e^l over the prior, is what it was.

    Parameters
    ----------
    llr, shape : (n_windows, n_range, n_rate) float32, of which `shape` is overwritten; windows with NaN are left alone.
    slope : s. reach_range, reach_rate : cells to either side. prior : (n_range) weight of each range, even over range rate.
    """
    held = np.zeros((llr.shape[1] + 2 * reach_range, llr.shape[2] + 2 * reach_rate), np.float32)
    inner = held[reach_range : len(held) - reach_range, reach_rate : held.shape[1] - reach_rate]
    prior = prior.astype(np.float32)
    for ratio, fine in zip(llr, shape, strict=True):
        if np.isnan(ratio[0, 0]) or np.isnan(fine[0, 0]):
            continue
        fine *= np.float32(slope)
        top = _exp(ratio, inner)
        before = np.log((prior @ inner).sum(dtype=float)) + top
        within = _within(held, reach_range, reach_rate)
        _exp(fine, inner)
        within /= _within(held, reach_range, reach_rate)
        np.log(within, out=within)
        np.add(fine, within, out=ratio)
        top = _exp(ratio, inner)
        ratio += np.float32(before - np.log((prior @ inner).sum(dtype=float)) - top)


def _exp(values: np.ndarray, out: np.ndarray) -> np.float32:
    """Exponentials over that of the largest, and the largest."""
    top = values.max()
    np.subtract(values, top, out=out)
    np.exp(np.maximum(out, np.float32(_LOWEST), out=out), out=out)
    return top


def _within(held: np.ndarray, reach_range: int, reach_rate: int) -> np.ndarray:
    """Sums within the reach of each cell, edges cut off: `held` has a margin of zeros as wide as the reach.

    Sums are made anew for each cell: a running one would lose what is small beside a peak that it has left.
    """
    return _sums(_sums(held.T, 2 * reach_rate + 1).T, 2 * reach_range + 1)


def _sums(values: np.ndarray, width: int) -> np.ndarray:
    """Sums of `width` consecutive rows, of pairs of pairs."""
    count = len(values) - width + 1
    total, at, power, span = np.zeros_like(values[:count]), 0, values, 1
    while True:
        if width & span:
            total += power[at : at + count]
            at += span
        if 2 * span > width:
            return total
        power = power[:-span] + power[span:]
        span *= 2
