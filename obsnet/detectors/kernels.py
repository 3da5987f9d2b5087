"""The arithmetic of the analytic detectors: wrapped-Cauchy products, slant stacks of cepstral scores, wandering means.

What is summed is laid out as matrix products over pieces that fit a core's cache.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view

LARGEST_LOG = 600.0
"""Scores are bounded to this before exp, which float64 then holds with room for sums."""

_CELLS = 120
_PER_PRODUCT = 16
_RATES = 9
_TILE = 32


def tonal(
    real: np.ndarray,
    imag: np.ndarray,
    null: np.ndarray,
    edges: np.ndarray,
    per_window: int,
    angle: np.ndarray,
    concentration: float,
) -> np.ndarray:
    """Sum over frequency of the product over a window of wrapped Cauchy over null density (eqs 7–11).

    Parameters
    ----------
    real, imag : (n_frequency, n_frames) phasors of any modulus; NaN is no data.
    null : (n_frequency, n_frames) null density of each cell over the uniform one.
    edges : (n_blocks + 1) frame index at which each block of a window starts; window w holds blocks w … w+per_window−1.
    angle : (n_azimuth) rad. concentration : mean resultant length R.

    Returns
    -------
    (n_windows, n_azimuth) float64.
    """
    pairs, basis = _pair_polynomials(real, imag, null, edges, concentration), _pair_basis(angle)
    n_blocks = len(edges) - 1
    total = np.zeros((n_blocks - per_window + 1, len(angle)))
    bands = max(_CELLS // n_blocks, 1)
    for lo in range(0, len(total), _CELLS):
        hi = min(lo + _CELLS, len(total))
        for band in range(0, len(real), bands):
            part = pairs[:, band : band + bands, lo : hi + per_window - 1]
            block = part[0] @ basis
            for pair in part[1:]:
                block *= pair @ basis
            window = block[:, : hi - lo].copy()
            for later in range(1, per_window):
                window *= block[:, later : later + hi - lo]
            total[lo:hi] += np.reciprocal(window, out=window).sum(axis=0)
    return total


def _pair_polynomials(
    real: np.ndarray, imag: np.ndarray, null: np.ndarray, edges: np.ndarray, concentration: float
) -> np.ndarray:
    """Inverse density ratios of a block's frames, two by two, as coefficients over `_pair_basis`.

    Two frames make a trigonometric polynomial of second degree, whose rounding stays below 1e-6 where both point at one
    azimuth; of more frames it would not.

    Returns
    -------
    (n_pairs, n_frequency, n_blocks, 5)
    """
    slots = int(np.diff(edges).max(initial=0))
    frame = edges[:-1, None] + np.arange(slots + slots % 2)
    inside = frame < edges[1:, None]
    frame[~inside] = 0
    x, y = real[:, frame].astype(float), imag[:, frame].astype(float)
    known = inside & ~np.isnan(x)
    with np.errstate(invalid="ignore", divide="ignore"):
        gain = null[:, frame].astype(float) / (1.0 - concentration**2)
        turn = -2.0 * concentration * gain / np.sqrt(x * x + y * y)
    constant = np.where(known, (1.0 + concentration**2) * gain, 1.0)
    x, y = (np.where(known, part * turn, 0.0) for part in (x, y))
    a0, a1, a2 = (part[..., ::2] for part in (constant, x, y))
    b0, b1, b2 = (part[..., 1::2] for part in (constant, x, y))
    terms = (
        a0 * b0 + a2 * b2,
        a0 * b1 + a1 * b0,
        a0 * b2 + a2 * b0,
        a1 * b1 - a2 * b2,
        a1 * b2 + a2 * b1,
    )
    laid = np.empty((constant.shape[2] // 2, *constant.shape[:2], len(terms)))
    for number, term in enumerate(terms):
        laid[..., number] = np.moveaxis(term, 2, 0)
    return laid


def _pair_basis(angle: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([np.ones_like(angle), cosine, sine, cosine**2, cosine * sine])


def impulsive(
    real: np.ndarray,
    imag: np.ndarray,
    null: np.ndarray,
    angle: np.ndarray,
    concentration: float,
    exponent: float,
    probability: float,
) -> np.ndarray:
    """Log of the mixture (1 − Pd) + Pd · Π_f ratio^exponent of every frame; 0 where it has no data.

    Frames first, frequencies inside: an impulsive source lights up all frequencies of one frame at once.

    Parameters
    ----------
    real, imag, null : (n_frequency, n_frames), as of `tonal`. angle : (n_azimuth) rad.

    Returns
    -------
    (n_frames, n_azimuth) float64.
    """
    known = ~np.isnan(real)
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    with np.errstate(invalid="ignore", divide="ignore"):
        gain = null.astype(float) / (1.0 - concentration**2)
        turn = -2.0 * concentration * gain / np.hypot(real.astype(float), imag)
    cells = np.stack([(1.0 + concentration**2) * gain, real * turn, imag * turn], axis=-1)
    cells = np.where(known[..., None], cells, [1.0, 0.0, 0.0])
    out = np.zeros((real.shape[1], len(angle)))
    for first in range(0, len(cells), _PER_PRODUCT):
        out -= np.log(np.multiply.reduce(cells[first : first + _PER_PRODUCT] @ basis, axis=0))
    out *= exponent
    mixed = np.logaddexp(np.log1p(-probability), np.log(probability) + out)
    return np.where(known.any(axis=0)[:, None], mixed, 0.0)


def stack_margin(range_rate: np.ndarray, window_s: float, range_step: float) -> int:
    """Ranges that `slant_stack` reads beyond either end, at most."""
    group = (_RATES - 1) * (range_rate[1] - range_rate[0])
    return int(np.ceil((np.abs(range_rate).max() + group) * window_s / 2 / range_step)) + 3


def slant_stack(
    scores: np.ndarray,
    margin: int,
    start: np.ndarray,
    stop: np.ndarray,
    frame_time: np.ndarray,
    minutes: np.ndarray,
    range_step: float,
    range_rate: np.ndarray,
) -> np.ndarray:
    """Stack cepstral scores along r + v·δt (the sum over time of eq. 19), linear between ranges.

    Range rates go in groups: the frames move together by whole ranges with the middle of their group, and one matrix
    product over frames makes what is left of every rate's shift, a few ranges apart.

    Parameters
    ----------
    scores : (n_frames, n + 2·margin) float32 log-likelihood ratio of each frame on consecutive ranges, of any number of
        pairs side by side.
    margin : ranges beyond either end, as of `stack_margin`.
    start, stop : (n_windows) frames of each window. frame_time, minutes : s. range_step : m. range_rate : (n_rates) m/s.

    Returns
    -------
    (n_windows, n_rates, n) float32.
    """
    count = scores.shape[1] - 2 * margin
    frame = start[:, None] + np.arange(int((stop - start).max(initial=0)))
    inside = frame < stop[:, None]
    frame[~inside] = 0
    later = np.where(inside, frame_time[frame] - minutes[:, None], 0.0) / range_step
    groups = np.pad(range_rate, (0, -len(range_rate) % _RATES), mode="edge").reshape(-1, _RATES)
    whole = np.rint(groups.mean(axis=1)[:, None, None] * later).astype(np.int64)
    shift = groups[:, None, :, None] * later[:, None, :] - whole[:, :, None, :]
    below = np.floor(shift).astype(np.int64)
    right = np.where(inside[:, None, :], shift - below, 0.0)
    nearest = int(below.min())
    below -= nearest
    taps = int(below.max()) + 2
    weight = np.zeros((*below.shape[:3], taps, below.shape[3]), np.float32)
    place = np.ix_(*(np.arange(n) for n in below.shape))
    weight[(*place[:3], below, place[3])] = inside[:, None, :] - right
    weight[(*place[:3], below + 1, place[3])] = right
    weight = weight.reshape(len(groups), len(minutes), _RATES * taps, -1)
    stretches = sliding_window_view(scores, count + taps - 1, axis=1)
    beam = np.empty((len(minutes), groups.size, count), np.float32)
    parts = np.empty((len(minutes), _RATES * taps, count + taps - 1), np.float32)
    apart = parts.reshape(len(minutes), _RATES, taps, -1)
    for g in range(len(groups)):
        np.matmul(weight[g], stretches[frame, margin + nearest + whole[g]], out=parts)
        made = beam[:, g * _RATES : (g + 1) * _RATES]
        np.add(apart[:, :, 0, :count], apart[:, :, 1, 1 : count + 1], out=made)
        for tap in range(2, taps):
            made += apart[:, :, tap, tap : tap + count]
    return beam[:, : len(range_rate)]


def wander(raised: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Mean over a little wandering in range: every row convolved with a symmetric kernel, where that fits.

    Parameters
    ----------
    raised : (n_rows, n + 2·radius) float64, contiguous. kernel : (2·radius + 1).

    Returns
    -------
    (n_rows, n) float64.
    """
    rows, length = raised.shape
    count = length - len(kernel) + 1
    whole = count // _TILE
    out = np.empty((rows, count))
    row, cell = raised.strides
    for first, tiles, width in ((0, whole, _TILE), (whole * _TILE, 1, count - whole * _TILE)):
        if not tiles * width:
            continue
        reach = width + len(kernel) - 1
        held = as_strided(raised[:, first:], (tiles, rows, reach), (width * cell, row, cell))
        band = np.subtract.outer(np.arange(reach), np.arange(width))
        weights = np.where((band >= 0) & (band < len(kernel)), kernel[np.clip(band, 0, len(kernel) - 1)], 0.0)
        np.matmul(
            held,
            weights,
            out=as_strided(out[:, first:], (tiles, rows, width), (width * cell, count * cell, cell)),
        )
    return out
