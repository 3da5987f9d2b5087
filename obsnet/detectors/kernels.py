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
def slant_stack(scores, pad, first, start, stop, frame_time, minutes, range_step, range_rate, beam):
    """Stack one pair's cepstral scores along r + v·δt (the sum over time of eq. 19).

    Parameters
    ----------
    scores : (n_frames, n_range + 2·pad) float32 log-likelihood ratio of each frame, zero in the pads.
    first : range bin of the beam's first sample.
    start, stop : (n_windows) frames of each window. frame_time, minutes : s. range_step : m. range_rate : (n_rates) m/s.
    beam : (n_windows, n_rates, n) float64, overwritten; bounded to what exp can hold.
    """
    count = beam.shape[2]
    total = np.empty(count, np.float32)
    for w in range(beam.shape[0]):
        for k in range(range_rate.shape[0]):
            total[:] = np.float32(0.0)
            for t in range(start[w], stop[w]):
                shift = range_rate[k] * (frame_time[t] - minutes[w]) / range_step
                whole = int(np.floor(shift))
                right = np.float32(shift - whole)
                left = np.float32(1.0) - right
                row = scores[t, pad + first + whole : pad + first + whole + count + 1]
                for i in range(count):
                    total[i] += left * row[i] + right * row[i + 1]
            for i in range(count):
                value = total[i]
                value = value if value < 600.0 else np.float32(600.0)
                beam[w, k, i] = value if value > -600.0 else np.float32(-600.0)


@njit(cache=True, nogil=True)
def wander(raised, kernel, ends, smooth):
    """Mean of exp(score) over a little wandering in range, the kernel renormalised at the ends of the range grid.

    Parameters
    ----------
    raised : (n_windows, n_rates, n + 2·radius) float64. kernel : (2·radius + 1). ends : (n) sum of the kernel on the grid.
    smooth : (n_windows, n_rates, n) float64, overwritten.
    """
    taps = kernel.shape[0]
    for w in range(raised.shape[0]):
        for k in range(raised.shape[1]):
            row, target = raised[w, k], smooth[w, k]
            target[:] = 0.0
            for j in range(taps):
                weight = kernel[j]
                for i in range(target.shape[0]):
                    target[i] += weight * row[i + j]
            for i in range(target.shape[0]):
                target[i] /= ends[i]
