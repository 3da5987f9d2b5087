"""The loops of the grid search, compiled: where a hypothesis puts the ship at each tile, and what the maps say there."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, inline="always")
def _lookup(table, step, x):
    position = x / step
    i = int(position)
    if i >= table.shape[0] - 1:
        return table[table.shape[0] - 1]
    mu = position - i
    return (1.0 - mu) * table[i] + mu * table[i + 1]


@njit(cache=True, nogil=True, inline="always")
def _emitted(heard, cpa_range, speed, delay, delay_step):
    """Emission time, relative to CPA, of what is heard `heard` seconds after CPA: solves e + τ(R(e)) = heard."""
    emitted = heard
    for _ in range(3):
        distance = np.sqrt(cpa_range * cpa_range + speed * speed * emitted * emitted)
        emitted = heard - _lookup(delay, delay_step, distance)
    return emitted


@njit(cache=True, nogil=True)
def tabulate(
    offset,
    cpa_range,
    speed,
    delay,
    delay_step,
    geometry,
    azimuth_step,
    course_start,
    phases,
    length,
    across,
    along,
    row,
):
    """Where each (CPA range, speed, time heard after CPA) reads the score maps.

    Parameters
    ----------
    offset : time heard after CPA [s]. delay : travel time [s] every `delay_step` m of range.
    geometry : range origin, range step, rate origin, rate step of the range scores.
    azimuth_step, course_start : deg. phases, length : layout of the azimuth rows (see `sum_scores`).
    across, along : (n_cpa_range, n_speed, n_offset) float32, overwritten with positions on the range and rate axes.
    row : the same shape, int32, overwritten with the start of the courses in the flattened azimuth row.
    """
    bins = int(360.0 / azimuth_step + 0.5)
    for i in range(cpa_range.shape[0]):
        for j in range(speed.shape[0]):
            for k in range(offset.shape[0]):
                emitted = _emitted(offset[k], cpa_range[i], speed[j], delay, delay_step)
                path = speed[j] * emitted
                r = np.sqrt(cpa_range[i] * cpa_range[i] + path * path)
                across[i, j, k] = (r - geometry[0]) / geometry[1]
                along[i, j, k] = (speed[j] * path / max(r, 1.0) - geometry[2]) / geometry[3]
                azimuth = np.rad2deg(np.arctan2(cpa_range[i], path)) + course_start
                c = int(np.floor(azimuth / azimuth_step + 0.5)) % bins
                row[i, j, k] = (c % phases) * length + c // phases


@njit(cache=True, nogil=True)
def sum_scores(index, across, along, row, range_score, azimuth_score, jointly, out):
    """Score of every (CPA time, CPA range, speed, course): the greatest sum over any run of consecutive tiles.

    The best run is the stretch over which the hypothesis is heard; a ship need not be heard for the whole segment.

    Parameters
    ----------
    index : (n_cpa_time, n_tiles) position of each tile on the offset axis of the tables.
    across, along, row : tables of `tabulate`.
    range_score : (n_tiles, n_range, n_rate); off the grid is 0.
    azimuth_score : (n_tiles, n_phases · length) polyphase rows: azimuth bin b is at (b % n_phases, b // n_phases), wrapped on
        so that the courses of one hypothesis lie side by side.
    jointly : range speaks for a hypothesis only in tiles where azimuth does too.
    out : (n_cpa_time, n_cpa_range, n_speed, n_course) float32, overwritten.
    """
    n_tiles = index.shape[1]
    n_range, n_rate = range_score.shape[1], range_score.shape[2]
    n_course = out.shape[3]
    run = np.empty(n_course, np.float32)
    best = np.empty(n_course, np.float32)
    one, zero = np.float32(1.0), np.float32(0.0)
    for t in range(out.shape[0]):
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                best[:] = zero
                run[:] = zero
                for m in range(n_tiles):
                    k = index[t, m]
                    x, y = across[i, j, k], along[i, j, k]
                    share = zero
                    if x >= zero and y >= zero:
                        a, b = int(x), int(y)
                        if a < n_range - 1 and b < n_rate - 1:
                            u, v = x - np.float32(a), y - np.float32(b)
                            share = (one - u) * (
                                (one - v) * range_score[m, a, b] + v * range_score[m, a, b + 1]
                            ) + u * ((one - v) * range_score[m, a + 1, b] + v * range_score[m, a + 1, b + 1])
                    alone = min(share, zero) if jointly else share
                    source = azimuth_score[m]
                    first = row[i, j, k]
                    for q in range(n_course):
                        pointing = source[first + q]
                        total = run[q] + pointing + (share if pointing > zero else alone)
                        total = total if total > zero else zero
                        run[q] = total
                        best[q] = total if total > best[q] else best[q]
                out[t, i, j] = best


@njit(cache=True, nogil=True, inline="always")
def _range_share(score, x, y):
    """Score of one tile (n_range, n_rate) at a place between its nodes; off the grid is 0."""
    a, b = int(np.floor(x)), int(np.floor(y))
    if a < 0 or b < 0 or a >= score.shape[0] - 1 or b >= score.shape[1] - 1:
        return 0.0
    u, v = x - a, y - b
    return (1 - u) * ((1 - v) * score[a, b] + v * score[a, b + 1]) + u * (
        (1 - v) * score[a + 1, b] + v * score[a + 1, b + 1]
    )


@njit(cache=True, nogil=True)
def score_points(
    points,
    tiles,
    delay,
    delay_step,
    range_score,
    geometry,
    azimuth_score,
    azimuth_step,
    jointly,
    per_tile,
    out,
):
    """Score of each hypothesis of a list (as in `sum_scores`), both maps interpolated linearly.

    Parameters
    ----------
    points : (n, 4) CPA time [s on the clock of `tiles`], signed CPA range [m], course [deg], speed [m/s].
    azimuth_score : (n_tiles, n_azimuth). per_tile : (n_tiles, n) filled with each tile's share if it has n columns.
    out : (n) float64, overwritten.
    """
    bins = azimuth_score.shape[1]
    for p in range(points.shape[0]):
        cpa_time, cpa_range, course, speed = points[p, 0], points[p, 1], points[p, 2], points[p, 3]
        out[p] = 0.0
        run = 0.0
        for m in range(tiles.shape[0]):
            emitted = _emitted(tiles[m] - cpa_time, cpa_range, speed, delay, delay_step)
            along = speed * emitted
            r = np.sqrt(cpa_range * cpa_range + along * along)
            x = (r - geometry[0]) / geometry[1]
            y = (speed * along / max(r, 1.0) - geometry[2]) / geometry[3]
            share = _range_share(range_score[m], x, y)
            z = ((course + np.rad2deg(np.arctan2(cpa_range, along))) % 360.0) / azimuth_step
            c = int(np.floor(z))
            w = z - c
            pointing = (1 - w) * azimuth_score[m, c % bins] + w * azimuth_score[m, (c + 1) % bins]
            if jointly and pointing <= 0:
                share = min(share, 0.0)
            share += pointing
            if per_tile.shape[1] > p:
                per_tile[m, p] = share
            run = max(run + share, 0.0)
            out[p] = max(out[p], run)


@njit(cache=True, nogil=True)
def score_bent_points(
    points,
    reach,
    tiles,
    delay,
    delay_step,
    range_score,
    geometry,
    azimuth_score,
    azimuth_step,
    jointly,
    per_tile,
    out,
):
    """Score of each hypothesis of a list whose courses bend (`kinematics.BentCourse`); otherwise as `score_points`.

    Parameters
    ----------
    points : (n, 12) CPA time [s on the clock of `tiles`], signed CPA range [m], course [deg], speed [m/s], then the two terms of
        the bends: across before and after CPA, along before and after; the same of the second term.
    reach : (2) s before and after CPA over which the velocity departs.
    """
    bins = azimuth_score.shape[1]
    for p in range(points.shape[0]):
        cpa_time, cpa_range, course, speed = points[p, 0], points[p, 1], points[p, 2], points[p, 3]
        out[p] = 0.0
        run = 0.0
        for m in range(tiles.shape[0]):
            heard = tiles[m] - cpa_time
            emitted = heard
            side, ahead, r, sideways, forwards = 0.0, 0.0, 0.0, 0.0, 0.0
            for step in range(4):
                k = 1 if emitted >= 0.0 else 0
                elapsed = abs(emitted)
                angle = 0.5 * np.pi * min(elapsed / reach[k], 1.0)
                co, si = np.cos(angle), np.sin(angle)
                beyond = max(elapsed - reach[k], 0.0)
                # The second term's angle is three times the first's.
                way = 2.0 * reach[k] / np.pi * (1.0 - co) + beyond
                way2 = 2.0 * reach[k] / (3.0 * np.pi) * (1.0 - (4.0 * co**3 - 3.0 * co)) - beyond
                if k == 0:
                    way, way2 = -way, -way2
                side = cpa_range + speed * (points[p, 4 + k] * way + points[p, 8 + k] * way2)
                ahead = speed * (emitted + points[p, 6 + k] * way + points[p, 10 + k] * way2)
                r = np.sqrt(side * side + ahead * ahead)
                if step < 3:
                    emitted = heard - _lookup(delay, delay_step, r)
                else:
                    si2 = 3.0 * si - 4.0 * si**3
                    sideways = speed * (points[p, 4 + k] * si + points[p, 8 + k] * si2)
                    forwards = speed * (1.0 + points[p, 6 + k] * si + points[p, 10 + k] * si2)
            rate = (side * sideways + ahead * forwards) / max(r, 1.0)
            share = _range_share(
                range_score[m], (r - geometry[0]) / geometry[1], (rate - geometry[2]) / geometry[3]
            )
            z = ((course + np.rad2deg(np.arctan2(side, ahead))) % 360.0) / azimuth_step
            c = int(np.floor(z))
            w = z - c
            pointing = (1 - w) * azimuth_score[m, c % bins] + w * azimuth_score[m, (c + 1) % bins]
            if jointly and pointing <= 0:
                share = min(share, 0.0)
            share += pointing
            if per_tile.shape[1] > p:
                per_tile[m, p] = share
            run = max(run + share, 0.0)
            out[p] = max(out[p], run)
