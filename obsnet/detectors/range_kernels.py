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
def gather(analytic, valid, frame_time, start, stop, minutes, window, range_m, rate, delay, phase, pad, fine_m,
           lag_step, sub_s, patch, energy):  # fmt: skip
    """Patches of analytic cepstrum around the delays of hypotheses, stacked along their drift in sub-windows.

    Parameters
    ----------
    window : (n) index into `minutes` of each hypothesis. range_m, rate : (n) m and m/s.
    phase : (n_pairs, n_fine) complex64 unit phasor by which a pair's predicted phase is taken off.
    lag_step : quefrency samples from one lag to the next. sub_s : length of a sub-window, s.
    patch : (n, n_pairs, n_sub, n_lags, 2) float32, overwritten: in phase and in quadrature, of unit variance together.
    energy : (n, n_pairs) float32, overwritten: of the whole window at the predicted delay.
    """
    n_pairs, n_sub, n_lags = patch.shape[1:4]
    last = analytic.shape[1] - 1
    sums = np.empty((n_sub, n_lags), np.complex64)
    count = np.empty(n_sub)
    for h in range(range_m.shape[0]):
        w = window[h]
        centre = pad + int(np.rint(range_m[h] / fine_m))
        for p in range(n_pairs):
            patch[h, p] = 0.0
            energy[h, p] = 0.0
            if delay[p, centre] == last:
                continue
            sums[:] = 0.0
            count[:] = 0.0
            for t in range(start[w], stop[w]):
                if not valid[t]:
                    continue
                later = frame_time[t] - minutes[w]
                j = delay[p, pad + int(np.rint((range_m[h] + rate[h] * later) / fine_m))]
                s = min(max(int(np.floor(later / sub_s + 0.5 * n_sub)), 0), n_sub - 1)
                count[s] += 1.0
                if j == last:
                    continue
                j -= lag_step * (n_lags // 2)
                row = analytic[t]
                for q in range(n_lags):
                    sums[s, q] += row[j + q * lag_step]
            turn = phase[p, centre]
            total = np.complex64(0.0)
            for s in range(n_sub):
                total += sums[s, n_lags // 2]
                scale = np.float32(1.0 / np.sqrt(max(count[s], 1.0)))
                for q in range(n_lags):
                    value = sums[s, q] * turn
                    patch[h, p, s, q, 0] = value.real * scale
                    patch[h, p, s, q, 1] = value.imag * scale
            energy[h, p] = (total.real**2 + total.imag**2) / max(count.sum(), 1.0)


@njit(cache=True, nogil=True)
def ghosts(energy, score, window, range_m, rate, delay, slope, inverse, pad, fine_m, coarse_m, rates, out):
    """Cheap score that other pairs give to the ranges at which another pair has this pair's delay.

    A ridge at pair p's delay may be pair q's, of a ship at another range; that ship's other pairs then show elsewhere.

    Parameters
    ----------
    energy, score : of `pair_energy` and `cheap_score`.
    slope : (n_pairs, n_fine) dτ/dr [s/m].
    inverse : (n_pairs, n_quefrency + 1) int32, coarse range at which a pair has a delay, −1 where none.
    rates : grid of `energy`, evenly spaced, m/s.
    out : (n, n_pairs) float32, overwritten: the largest over q of the score at that range without pair q's own share.
    """
    n_pairs, n_rates, n_range = energy.shape[1:]
    step = rates[1] - rates[0]
    for h in range(range_m.shape[0]):
        w = window[h]
        centre = pad + int(np.rint(range_m[h] / fine_m))
        for p in range(n_pairs):
            best = np.float32(0.0)
            j = delay[p, centre]
            for q in range(n_pairs):
                i = inverse[q, j]
                if q == p or i < 0:
                    continue
                there = slope[q, pad + int(np.rint(i * coarse_m / fine_m))]
                if there == 0.0:
                    continue
                k = int(np.rint((rate[h] * slope[p, centre] / there - rates[0]) / step))
                if k < 0 or k >= n_rates:
                    continue
                for kk in range(max(k - 1, 0), min(k + 2, n_rates)):
                    for ii in range(max(i - 1, 0), min(i + 2, n_range)):
                        best = max(best, score[w, kk, ii] - hinge(energy[w, q, kk, ii]))
            out[h, p] = best
