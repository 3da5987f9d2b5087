"""TDOAs that agree: correlations of all pairs in, the peaks that one direction explains out.

Near the noise the highest peak of a pair's correlation is often a cycle beside the right one. One direction
must explain all pairs, and its steered response, the sum of the correlations at its TDOAs, is the
likelihood's main term.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.signal import find_peaks

from obsnet.arrays.arrival import directions
from obsnet.arrays.compact import CompactArray
from obsnet.arrays.tdoa import Interpolation, peak

PEAKS = 6
"""Peaks tried a pair, on as many pairs as determine a direction."""


def joint_tdoa(
    correlation: np.ndarray,
    rate: float,
    array: CompactArray,
    pairs: np.ndarray,
    covariance: np.ndarray,
    interpolation: Interpolation = "upsampled",
) -> tuple[np.ndarray, np.ndarray]:
    """TDOA of each pair at the peak that belongs to the direction of the largest steered response.

    Directions are tried through the combinations of the highest peaks of two or three pairs that span the
    array.

    Parameters
    ----------
    correlation, rate : of `tdoa.cross_correlations`.
    covariance : array (pair, pair), s².

    Returns
    -------
    tdoa, coefficient : arrays (pair,), NaN where a pair has no correlation.
    """
    tdoa, coefficient = np.full(len(pairs), np.nan), np.full(len(pairs), np.nan)
    usable = np.flatnonzero(np.isfinite(correlation).any(axis=1))
    chosen = _spanning(array, pairs, usable)
    if len(chosen) < 2:
        return tdoa, coefficient
    middle = correlation.shape[1] // 2
    tops = [_highest(correlation[row]) for row in chosen]
    lags = np.array(list(itertools.product(*tops)), float).reshape(-1, len(chosen))
    block = covariance[np.ix_(chosen, chosen)]
    found = directions((lags - middle) / rate, array, pairs[chosen], block)
    predicted = array.tdoa(found.azimuth_deg, found.elevation_deg, pairs)
    index = np.clip(
        np.rint(np.nan_to_num(predicted) * rate).astype(int) + middle, 0, correlation.shape[1] - 1
    )
    response = np.nansum(correlation[np.arange(len(pairs)), index], axis=1)
    best = index[int(np.argmax(np.where(np.isfinite(found.azimuth_deg), response, -np.inf)))]
    for row in usable:
        top = _climb(correlation[row], int(best[row]))
        tdoa[row], coefficient[row] = peak(correlation[row], top, rate, interpolation)
    return tdoa, coefficient


def _spanning(array: CompactArray, pairs: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Up to three pairs whose baselines span as much as possible, the longest ones first."""
    if not len(usable):
        return usable
    rest = array.baselines(pairs)[usable]
    chosen: list[int] = []
    for _ in range(min(array.dimension, len(usable))):
        length = np.linalg.norm(rest, axis=1)
        longest = int(length.argmax())
        if length[longest] < 1e-3 * array.aperture_s * array.sound_speed_mps:
            break
        chosen.append(int(usable[longest]))
        axis = rest[longest] / length[longest]
        rest = rest - np.outer(rest @ axis, axis)
    return np.array(chosen, int)


def _highest(correlation: np.ndarray) -> np.ndarray:
    """Indices of the highest local maxima of one pair."""
    filled = np.nan_to_num(correlation, nan=-1.0)
    tops, _ = find_peaks(filled)
    if not len(tops):
        return np.array([int(filled.argmax())])
    return tops[np.argsort(filled[tops])[::-1][:PEAKS]]


def _climb(correlation: np.ndarray, index: int) -> int:
    """Local maximum uphill of `index`."""
    filled = np.nan_to_num(correlation, nan=-1.0)
    while True:
        around = filled[max(index - 1, 0) : index + 2]
        step = int(around.argmax()) - min(index, 1)
        if step == 0 or around.max() <= filled[index]:
            return index
        index += step
