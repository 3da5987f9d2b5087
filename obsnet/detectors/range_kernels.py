"""The loops of the learned range detector, compiled: cepstra gathered along the delays of hypotheses."""

from __future__ import annotations

import numpy as np
from numba import njit

HINGE_SLOPE, HINGE_ONSET, HINGE_TOP = 0.8, 1.8, 60.0
"""A pair's share of the cheap score: a line in its energy from an onset, which noise seldom reaches, to a top."""


@njit(cache=True, nogil=True)
def pair_energy(analytic, valid, frame_time, start, stop, minutes, delay, pad, fine_m, stride, rates, energy):
    """Energy of the coherent stack of a window's frames along each hypothesis, for every path pair.

    Parameters
    ----------
    analytic : (n_frames, n_quefrency + 1) complex64 analytic cepstrum of unit noise variance; the last column is zero.
    valid : (n_frames) bool. frame_time, minutes : s. start, stop : (n_windows) frames of each window.
    delay : (n_pairs, n_fine) int32 quefrency index of a pair at ranges (i − pad)·fine_m; the last column where none.
    stride : fine steps from one range to the next. rates : (n_rates) m/s.
    energy : (n_windows, n_pairs, n_rates, n_range) float32, overwritten; exponential of mean 1 in noise.
    """
    n_range = energy.shape[3]
    sums = np.empty(n_range, np.complex64)
    for w in range(energy.shape[0]):
        for p in range(delay.shape[0]):
            for k in range(rates.shape[0]):
                sums[:] = 0.0
                count = 0
                for t in range(start[w], stop[w]):
                    if not valid[t]:
                        continue
                    count += 1
                    first = pad + int(np.rint(rates[k] * (frame_time[t] - minutes[w]) / fine_m))
                    row = analytic[t]
                    for i in range(n_range):
                        sums[i] += row[delay[p, first + i * stride]]
                scale = np.float32(1.0 / max(count, 1))
                for i in range(n_range):
                    energy[w, p, k, i] = scale * (sums[i].real ** 2 + sums[i].imag ** 2)


@njit(cache=True, nogil=True)
def cheap_score(energy, score):
    """Sum over the pairs of a hinge of their energy: (n_windows, n_rates, n_range) float32, overwritten."""
    for w in range(score.shape[0]):
        score[w] = 0.0
        for p in range(energy.shape[1]):
            for k in range(score.shape[1]):
                for i in range(score.shape[2]):
                    score[w, k, i] += hinge(energy[w, p, k, i])


@njit(cache=True, nogil=True, inline="always")
def hinge(energy):
    """A pair's share of the cheap score at its energy."""
    return np.float32(HINGE_SLOPE) * max(
        min(energy, np.float32(HINGE_TOP)) - np.float32(HINGE_ONSET), np.float32(0.0)
    )


@njit(cache=True, nogil=True)
def describe(
    analytic, valid, frame_time, start, stop, minutes, energy, score, once, window, range_m, rate, index, seconds, strength,
    slope, phase, inverse, pad, fine_m, coarse_m, rates, lag_step, sub_s, n_sub, n_lags, depth_m, out,
):  # fmt: skip
    """Feature vectors of hypotheses: patches stacked along their drift in sub-windows, each pair's context, globals.

    Parameters
    ----------
    analytic … minutes, energy : as of `pair_energy`. score : of `cheap_score`. once : (n_windows, n) said once a minute.
    window : (n) index into `minutes` of each hypothesis. range_m, rate : (n) m and m/s.
    index, seconds, strength, slope, phase, inverse, pad, fine_m, coarse_m : of `DelayTable`.
    lag_step : quefrency samples from one lag to the next. sub_s : length of a sub-window, s.
    out : (n, size) float32, overwritten.
    """
    n_pairs, last = index.shape[0], analytic.shape[1] - 1
    size = 2 * n_sub * n_lags
    sums = np.empty((n_sub, n_lags), np.complex64)
    count = np.empty(n_sub)
    for h in range(range_m.shape[0]):
        w = window[h]
        row = out[h]
        centre = pad + int(np.rint(range_m[h] / fine_m))
        for p in range(n_pairs):
            patch = row[p * size : (p + 1) * size]
            context = row[n_pairs * size + 7 * p : n_pairs * size + 7 * p + 7]
            if index[p, centre] == last:
                patch[:] = 0.0
                context[:] = 0.0
                continue
            sums[:] = 0.0
            count[:] = 0.0
            for t in range(start[w], stop[w]):
                if not valid[t]:
                    continue
                later = frame_time[t] - minutes[w]
                j = index[p, pad + int(np.rint((range_m[h] + rate[h] * later) / fine_m))]
                s = min(max(int(np.floor(later / sub_s + 0.5 * n_sub)), 0), n_sub - 1)
                count[s] += 1.0
                if j == last:
                    continue
                j -= lag_step * (n_lags // 2)
                frame = analytic[t]
                for q in range(n_lags):
                    sums[s, q] += frame[j + q * lag_step]
            total = np.complex64(0.0)
            for s in range(n_sub):
                total += sums[s, n_lags // 2]
                turn = phase[p, centre] * np.float32(1.0 / np.sqrt(max(count[s], 1.0)))
                for q in range(n_lags):
                    value = sums[s, q] * turn
                    patch[2 * (s * n_lags + q)] = value.real
                    patch[2 * (s * n_lags + q) + 1] = value.imag
            context[0] = 1.0
            context[1] = np.log1p((total.real**2 + total.imag**2) / max(count.sum(), 1.0))
            context[2] = np.log1p(ghost(energy, score, w, p, centre, rate[h], index, slope, inverse, pad, fine_m,
                                        coarse_m, rates))  # fmt: skip
            context[3] = 1e4 * slope[p, centre]
            context[4] = np.log(seconds[p, centre])
            context[5] = np.abs(1e3 * slope[p, centre] * rate[h])
            context[6] = strength[p, centre]
        row[n_pairs * (size + 7)] = range_m[h] / depth_m
        row[n_pairs * (size + 7) + 1 :] = once[w]


@njit(cache=True, nogil=True)
def ghost(energy, score, w, p, centre, rate, index, slope, inverse, pad, fine_m, coarse_m, rates):
    """Cheap score that other pairs give to the ranges at which another pair q has pair p's delay, the largest over q.

    A ridge at pair p's delay may be pair q's, of a ship at another range; that ship's other pairs then show elsewhere.
    `inverse` is the coarse range at which a pair has a delay; q's own share of the score there is left out.
    """
    n_pairs, n_rates, n_range = energy.shape[1:]
    best = np.float32(0.0)
    j = index[p, centre]
    for q in range(n_pairs):
        i = inverse[q, j]
        if q == p or i < 0:
            continue
        there = slope[q, pad + int(np.rint(i * coarse_m / fine_m))]
        if there == 0.0:
            continue
        k = int(np.rint((rate * slope[p, centre] / there - rates[0]) / (rates[1] - rates[0])))
        if k < 0 or k >= n_rates:
            continue
        for kk in range(max(k - 1, 0), min(k + 2, n_rates)):
            for ii in range(max(i - 1, 0), min(i + 2, n_range)):
                best = max(best, score[w, kk, ii] - hinge(energy[w, q, kk, ii]))
    return best


@njit(cache=True, nogil=True)
def choose(score, peaks, spread, rates):
    """Hypotheses at and around the highest peaks, over range rate, of each window's score.

    Parameters
    ----------
    score : (n_windows, n_rates, n_range) float32.
    peaks : how many, each with `spread` ranges to either side. rates : range rates about the best of each such range.

    Returns
    -------
    bool array like `score`.
    """
    n_windows, n_rates, n_range = score.shape
    chosen = np.zeros(score.shape, np.bool_)
    best = np.empty(n_range, np.float32)
    rate = np.empty(n_range, np.int64)
    for w in range(n_windows):
        best[:] = score[w, 0]
        rate[:] = 0
        for k in range(1, n_rates):
            for i in range(n_range):
                if score[w, k, i] > best[i]:
                    best[i] = score[w, k, i]
                    rate[i] = k
        for _ in range(peaks):
            top = np.argmax(best)
            if best[top] <= 0.0:
                break
            for i in range(max(top - spread, 0), min(top + spread + 1, n_range)):
                first = min(max(rate[top] - rates // 2, 0), max(n_rates - rates, 0))
                chosen[w, first : first + rates, i] = True
                best[i] = -1.0
    return chosen


@njit(cache=True, nogil=True)
def carry_on(said, cheap, slope):
    """Fill the range rates of a looked-at range that were not looked at themselves, in place.

    They take the nearest looked-at one's value, less `slope` times what the cheap score falls by; (window, rate, range).
    """
    n_windows, n_rates, n_range = said.shape
    for w in range(n_windows):
        for i in range(n_range):
            first, last = -1, -1
            for k in range(n_rates):
                if not np.isnan(said[w, k, i]):
                    first = k if first < 0 else first
                    last = k
            if first < 0:
                continue
            for k in range(n_rates):
                edge = first if k < first else last
                if k < first or k > last:
                    fall = max(cheap[w, edge, i] - cheap[w, k, i], np.float32(0.0))
                    said[w, k, i] = said[w, edge, i] - np.float32(slope) * fall


@njit(cache=True, nogil=True)
def resample(coarse, range_below, range_weight, rate_below, rate_weight, fine):
    """Bilinear interpolation of (n_windows, rate, range) onto (n_windows, range, rate), overwritten."""
    row = np.empty(coarse.shape[1], np.float32)
    for w in range(fine.shape[0]):
        for i in range(fine.shape[1]):
            b, a = range_below[i], range_weight[i]
            for k in range(coarse.shape[1]):
                row[k] = (np.float32(1.0) - a) * coarse[w, k, b] + a * coarse[w, k, b + 1]
            for k in range(fine.shape[2]):
                c, d = rate_below[k], rate_weight[k]
                fine[w, i, k] = (np.float32(1.0) - d) * row[c] + d * row[c + 1]


@njit(cache=True, nogil=True)
def share_out(llr, shape, slope, reach_range, reach_rate):
    """Give the ratios of each window the fine shape of another's, in place; what lies within a reach of a cell stays.

    l ← log⟨e^l⟩ + s·a − log⟨e^(s·a)⟩, ⟨⟩ the mean over cells within the reach.

    Parameters
    ----------
    llr, shape : (n_windows, n_range, n_rate) float32, of which `shape` is overwritten; windows with NaN are left alone.
    slope : s. reach_range, reach_rate : cells to either side.
    """
    n_windows, n_range, n_rate = llr.shape
    along, mean = np.empty((n_range, n_rate), np.float32), np.empty((n_range, n_rate), np.float32)
    for w in range(n_windows):
        if np.isnan(llr[w, 0, 0]) or np.isnan(shape[w, 0, 0]):
            continue
        shape[w] *= slope
        _log_mean_exp(shape[w], reach_range, reach_rate, along, mean)
        for i in range(n_range):
            for k in range(n_rate):
                shape[w, i, k] -= mean[i, k]
        _log_mean_exp(llr[w], reach_range, reach_rate, along, mean)
        for i in range(n_range):
            for k in range(n_rate):
                llr[w, i, k] = mean[i, k] + shape[w, i, k]


@njit(cache=True, nogil=True)
def _log_mean_exp(values, reach_range, reach_rate, along, mean):
    """Logarithm of the mean of the exponentials within the reach of each cell, edges cut off: into `mean`.

    Sums are made anew for each cell: a running one would lose what is small beside a peak that it has left.
    """
    n_range, n_rate = values.shape
    top = values.max()
    for i in range(n_range):
        for k in range(n_rate):
            mean[i, k] = np.exp(max(values[i, k] - top, np.float32(-80.0)))
        along[i] = 0.0
        for shift in range(-reach_rate, reach_rate + 1):
            for k in range(max(-shift, 0), n_rate - max(shift, 0)):
                along[i, k] += mean[i, k + shift]
    for i in range(n_range):
        mean[i] = 0.0
        low, high = max(i - reach_range, 0), min(i + reach_range + 1, n_range)
        for j in range(low, high):
            for k in range(n_rate):
                mean[i, k] += along[j, k]
        for k in range(n_rate):
            cells = (high - low) * (min(k + reach_rate + 1, n_rate) - max(k - reach_rate, 0))
            mean[i, k] = np.log(mean[i, k] / np.float32(cells)) + top
