"""The loops of the analytic detectors, compiled: wrapped-Cauchy products and slant stacks of cepstral scores."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def tonal(real, imag, null, edges, per_window, cosine, sine, concentration, out):
    """Sum over frequency of the product over a window of wrapped Cauchy over null density (eqs 7–11).

    Parameters
    ----------
    real, imag : (n_frequency, n_frames) phasors of any modulus; NaN is no data.
    null : (n_frequency, n_frames) null density of each cell over the uniform one.
    edges : (n_blocks + 1) frame index at which each block of a window starts; window w holds blocks w … w+per_window−1.
    cosine, sine : (n_azimuth). concentration : mean resultant length R.
    out : (n_windows, n_azimuth) float64, added to.
    """
    n_frequency = real.shape[0]
    n_azimuth = cosine.shape[0]
    n_blocks = edges.shape[0] - 1
    block = np.empty((n_blocks, n_azimuth))
    for f in range(n_frequency):
        for b in range(n_blocks):
            product = block[b]
            for i in range(n_azimuth):
                product[i] = 1.0
            scale = 1.0
            for t in range(edges[b], edges[b + 1]):
                x = np.float64(real[f, t])
                if np.isnan(x):
                    continue
                y = np.float64(imag[f, t])
                scale_to_unit = -2.0 * concentration / np.sqrt(x * x + y * y)
                x *= scale_to_unit
                y *= scale_to_unit
                constant = 1.0 + concentration * concentration
                scale *= (1.0 - concentration * concentration) / null[f, t]
                for i in range(n_azimuth):
                    product[i] *= constant + x * cosine[i] + y * sine[i]
            for i in range(n_azimuth):
                product[i] = scale / product[i]
        for w in range(out.shape[0]):
            total = out[w]
            for i in range(n_azimuth):
                ratio = block[w, i]
                for k in range(1, per_window):
                    ratio *= block[w + k, i]
                total[i] += ratio


@njit(cache=True, nogil=True)
def impulsive(real, imag, null, start, stop, cosine, sine, concentration, exponent, probability, out):
    """Log of the product over a window of the mixture (1 − Pd) + Pd · Π_f ratio^exponent, per window and azimuth.

    Frames first, frequencies inside: an impulsive source lights up all frequencies of one frame at once.
    """
    n_frequency, n_frames = real.shape
    n_azimuth = cosine.shape[0]
    per_frame = np.zeros((n_frames, n_azimuth))
    constant = 1.0 + concentration * concentration
    product = np.empty(n_azimuth)
    for t in range(start[0], stop[-1]):
        total = per_frame[t]
        scale = 0.0
        product[:] = 1.0
        pending = 0
        seen = 0
        for f in range(n_frequency):
            x = np.float64(real[f, t])
            if np.isnan(x):
                continue
            seen += 1
            y = np.float64(imag[f, t])
            scale_to_unit = -2.0 * concentration / np.sqrt(x * x + y * y)
            x *= scale_to_unit
            y *= scale_to_unit
            scale += np.log((1.0 - concentration * concentration) / null[f, t])
            for i in range(n_azimuth):
                product[i] *= constant + x * cosine[i] + y * sine[i]
            pending += 1
            if pending == 32:
                for i in range(n_azimuth):
                    total[i] -= np.log(product[i])
                    product[i] = 1.0
                pending = 0
        if seen == 0:
            total[:] = 0.0
            continue
        for i in range(n_azimuth):
            log_ratio = exponent * (total[i] - np.log(product[i]) + scale)
            if log_ratio > 0.0:
                total[i] = log_ratio + np.log(probability + (1.0 - probability) * np.exp(-log_ratio))
            else:
                total[i] = np.log((1.0 - probability) + probability * np.exp(log_ratio))
    for w in range(out.shape[0]):
        for t in range(start[w], stop[w]):
            for i in range(n_azimuth):
                out[w, i] += per_frame[t, i]


@njit(cache=True, nogil=True)
def slant_stack(scores, active, pad, start, stop, frame_time, minutes, range_step, range_rate, kernel, out):
    """Stack cepstral scores along r + v·δt, let the range wander a little, sum the path pairs (eq. 19).

    Parameters
    ----------
    scores : (n_pairs, n_frames, n_range + 2·pad) float32 log-likelihood ratio of each frame, zero in the pads.
    active : (n_pairs, 2) first and one-past-last range bin where the pair can be heard.
    start, stop : (n_windows) frames of each window. frame_time, minutes : s. range_step : m. range_rate : (n_rates) m/s.
    kernel : (2·radius + 1) weights of the wandering in range, odd length, sum 1.
    out : (n_windows, n_range, n_rates) float32, overwritten.
    """
    n_pairs = scores.shape[0]
    n_range = scores.shape[2] - 2 * pad
    radius = kernel.shape[0] // 2
    beam = np.empty(n_range + 2 * radius, np.float32)
    raised = np.empty(n_range + 2 * radius)
    smooth = np.empty(n_range)
    for w in range(out.shape[0]):
        out[w] = 0.0
        for k in range(range_rate.shape[0]):
            for p in range(n_pairs):
                lo = max(active[p, 0] - radius - pad, 0)
                hi = min(active[p, 1] + radius + pad, n_range)
                if hi <= lo:
                    continue
                first = max(lo - radius, 0)
                last = min(hi + radius, n_range)
                for i in range(first, last):
                    beam[i] = 0.0
                for t in range(start[w], stop[w]):
                    shift = range_rate[k] * (frame_time[t] - minutes[w]) / range_step
                    whole = np.int64(np.floor(shift))
                    right = np.float32(shift - whole)
                    left = np.float32(1.0) - right
                    row = scores[p, t]
                    offset = pad + whole
                    for i in range(first, last):
                        beam[i] += left * row[i + offset] + right * row[i + offset + 1]
                _wander(beam, raised, smooth, kernel, lo, hi, first, last)
                for i in range(lo, hi):
                    out[w, i, k] += np.float32(smooth[i])


@njit(cache=True, nogil=True)
def _wander(beam, raised, smooth, kernel, lo, hi, first, last):
    """smooth = log of the kernel-weighted mean of exp(beam), the kernel renormalised at the grid's ends."""
    radius = kernel.shape[0] // 2
    for i in range(first, last):
        raised[i] = np.exp(min(max(np.float64(beam[i]), -600.0), 600.0))
    for i in range(lo, hi):
        a = max(i - radius, first)
        b = min(i + radius + 1, last)
        total = 0.0
        weight = 0.0
        for j in range(a, b):
            total += kernel[j - i + radius] * raised[j]
            weight += kernel[j - i + radius]
        smooth[i] = np.log(total / weight)
