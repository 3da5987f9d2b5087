"""The scores of very many courses at once, compiled: what `course_grid` works out array by array, cell by cell."""

from __future__ import annotations

import numba
import numpy as np

_BLOCK = 64


@numba.njit(cache=True, nogil=True)
def greatest_runs(
    time: np.ndarray,
    where: np.ndarray,
    first: np.ndarray,
    index: np.ndarray,
    far: np.ndarray,
    corner: np.ndarray,
    right: np.ndarray,
    up: np.ndarray,
    row: np.ndarray,
    range_score: np.ndarray,
    rates: int,
    rows: np.ndarray,
    pace: int,
    jointly: bool,
    out: np.ndarray,
) -> None:  # pragma: no cover - compiled
    """Greatest sums of consecutive tiles' shares into `out` (n_cells, n), cells and places as `CourseGrid` holds them.

    A cell is a CPA time and where its CPA range and speed are; its azimuths are read from place `pace` · row + `first` on.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    width = out.shape[1]
    run = np.empty((_BLOCK, width), np.float32)
    for begin in range(0, len(time), _BLOCK):
        end = min(begin + _BLOCK, len(time))
        run[:] = zero
        out[begin:end] = zero
        for m in range(index.shape[1]):
            score, line = range_score[m], rows[m]
            for i in range(begin, end):
                offset, distance = index[time[i], m], far[where[i]]
                at, aside, above = corner[offset, distance], right[offset, distance], up[offset, distance]
                low = score[at] * (one - above) + score[at + 1] * above
                high = score[at + rates] * (one - above) + score[at + rates + 1] * above
                share = low * (one - aside) + high * aside
                begins = pace * row[offset, where[i]] + first[i]
                pointing, now, best = line[begins : begins + width], run[i - begin], out[i]
                alone = min(share, zero) if jointly else share
                for k in range(width):
                    value = now[k] + pointing[k]
                    value += share if pointing[k] > zero else alone
                    value = value if value > zero else zero
                    now[k] = value
                    best[k] = value if value > best[k] else best[k]
