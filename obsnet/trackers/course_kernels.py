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
    Places are unsigned: a negative one would be looked for from the end, at twice the time.
    """
    zero, one, next_to = np.float32(0.0), np.float32(1.0), np.uint64(1)
    width, tiles, faster = out.shape[1], index.shape[1], np.uint64(rates)
    run, best = np.empty((width, _BLOCK), np.float32), np.empty((width, _BLOCK), np.float32)
    share, alone = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    begins = np.empty(_BLOCK, np.uint32)
    for begin in range(0, len(time), _BLOCK):
        count = min(_BLOCK, len(time) - begin)
        run[:] = zero
        best[:] = zero
        for m in range(tiles):
            score, line = range_score[m], rows[m]
            for j in range(count):
                place = np.uint64(where[begin + j])
                offset, distance = np.uint64(index[time[begin + j], m]), np.uint64(far[place])
                at = np.uint64(corner[offset, distance])
                aside, above = right[offset, distance], up[offset, distance]
                low = score[at] * (one - above) + score[at + next_to] * above
                high = score[at + faster] * (one - above) + score[at + faster + next_to] * above
                share[j] = low * (one - aside) + high * aside
                alone[j] = min(share[j], zero) if jointly else share[j]
                begins[j] = pace * row[offset, place] + first[begin + j]
            for k in range(width):
                now, top, shift = run[k], best[k], np.uint32(k)
                for j in range(count):
                    pointing = line[begins[j] + shift]
                    value = now[j] + pointing
                    value += share[j] if pointing > zero else alone[j]
                    value = value if value > zero else zero
                    now[j] = value
                    top[j] = value if value > top[j] else top[j]
        for j in range(count):
            out[begin + j] = best[:, j]
