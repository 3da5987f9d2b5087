"""Straight courses and the score maps of a segment in, the courses' scores out: bounds for a whole grid, exact where asked.

A course's score is the greatest sum of its tiles' shares over any run of consecutive tiles: the stretch over which it is
heard; a ship need not be heard for the whole segment. A tile's share is what the maps say where the course puts the ship
when the sound left it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from obsnet.trackers.score_maps import ScoreMaps, polyphase

_CELLS_AT_ONCE, _PLACES_AT_ONCE = 1 << 16, 1 << 14
_FIRST_BATCH, _LARGEST_BATCH = 512, 1 << 18
_TILES_AT_ONCE = 8
_SECTOR = 6
"""Courses that are left out or scored together."""
_MANY = 10_000_000
"""Cells times tiles scored from which on a compiled kernel is worth its loading."""
_SCALES, _SCALE_STEP, _APART = 55, 0.02, 0.12
"""Scales looked at to either side, and their step and the least that counts as another, in natural logarithms."""
NEARLY = 0.75
"""Share of what range maps say for a track from which on a ghost of it counts as nearly as likely."""


@dataclass(frozen=True)
class Delay:
    """Travel time [s] of the sound every `step_m` of range from 0."""

    seconds: np.ndarray
    step_m: float

    def __call__(self, range_m: np.ndarray) -> np.ndarray:
        """Travel time at ranges, linear; the last beyond the table."""
        position = np.minimum(range_m / self.step_m, len(self.seconds) - 1)
        below = np.minimum(position.astype(np.int64), len(self.seconds) - 2)
        seconds = self.seconds.astype(position.dtype, copy=False)
        low = seconds[below]
        return low + (position - below.astype(position.dtype)) * (seconds[below + 1] - low)

    def emitted(self, heard: np.ndarray, cpa_range: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """When what is heard `heard` s after CPA left the ship, s after CPA: solves e + τ(R(e)) = heard."""
        emitted = heard
        for _ in range(3):
            emitted = heard - self(np.sqrt(cpa_range * cpa_range + (speed * emitted) ** 2))
        return emitted


class CourseGrid:
    """Every combination of CPA times, CPA ranges, speeds and courses.

    Parameters
    ----------
    cpa_time : (n) s on the clock of `tiles`. cpa_range : m, signed. speed : m/s. course : deg, in equal steps.
    tiles : times of the tiles, s. scores : ScoreMaps at the tiles.

    Notes
    -----
    A cell is one CPA time, CPA range and speed, in this order in memory; all courses of a cell read the range map at
    one place, and the azimuth map at as many neighbouring ones.
    """

    def __init__(
        self,
        cpa_time: np.ndarray,
        cpa_range: np.ndarray,
        speed: np.ndarray,
        course: np.ndarray,
        tiles: np.ndarray,
        delay: Delay,
        scores: ScoreMaps,
    ) -> None:
        self.shape = (len(cpa_time), len(cpa_range), len(speed))
        self._course_step = float(course[1] - course[0]) if len(course) > 1 else 360.0
        self._courses = len(course)
        offset, index = np.unique(np.round(tiles[None, :] - cpa_time[:, None], 3), return_inverse=True)
        self._index = index.reshape(len(cpa_time), len(tiles))
        # Both sides of the station are equally far: a place in the range map serves two cells.
        far, side = np.unique(np.abs(cpa_range), return_inverse=True)
        self._far = (side.reshape(-1, 1) * len(speed) + np.arange(len(speed))).reshape(-1)
        starboard = np.repeat(cpa_range < 0, len(speed))
        self._scored = 0
        layout, step = self._read(scores)
        self._place(offset, far, speed, starboard, delay, scores, step, float(course[0]), layout)

    def reading(self, scores: ScoreMaps) -> CourseGrid:
        """The same courses over other score maps of the same tiles and grids: where they read them is found once."""
        made = copy.copy(self)
        made._read(scores)
        return made

    def _read(self, scores: ScoreMaps) -> tuple[tuple[int, ...], float]:
        """Take score maps; returns how azimuth rows are laid out (phases, length) and their step, deg."""
        rows, step = polyphase(scores.azimuth_score, scores.azimuth_step, self._course_step, self._courses)
        self._rows = rows.reshape(len(rows), -1)
        self._pointing = sliding_window_view(self._rows, self._courses, axis=1)
        self._sectors: np.ndarray | None = None
        self._range_score, self._best_corner = scores.flat, scores.best_corner
        self._rates, self._jointly = scores.range_score.shape[2], scores.jointly
        return rows.shape[1:], step

    def _place(
        self,
        offset: np.ndarray,
        cpa_range: np.ndarray,
        speed: np.ndarray,
        starboard: np.ndarray,
        delay: Delay,
        scores: ScoreMaps,
        azimuth_step: float,
        course_start: float,
        layout: tuple[int, ...],
    ) -> None:
        """Where each (time heard after CPA, CPA range and speed) reads the score maps: the range map by distance, the azimuth map by side too."""
        across, pace = (axis.reshape(-1) for axis in np.meshgrid(cpa_range, speed, indexing="ij"))
        shape = (len(offset), len(across))
        self._cell, self._row = np.empty(shape, np.int64), np.empty((len(offset), len(self._far)), np.int64)
        self._right, self._up = np.empty(shape, np.float32), np.empty(shape, np.float32)
        bins = int(360.0 / azimuth_step + 0.5)
        phases, length = layout
        step = max(_PLACES_AT_ONCE // len(across), 1)
        for part in (slice(first, first + step) for first in range(0, len(offset), step)):
            path = pace * delay.emitted(offset[part, None], across, pace)
            distance = np.sqrt(across * across + path * path)
            self._cell[part], self._right[part], self._up[part] = scores.corner(
                distance, pace * path / np.maximum(distance, 1.0)
            )
            azimuth = np.rad2deg(np.arctan2(across, path))[:, self._far]
            np.negative(azimuth, out=azimuth, where=starboard)
            azimuth += course_start
            c = np.floor(azimuth / azimuth_step + 0.5).astype(np.int64) % bins
            self._row[part] = (c % phases) * length + c // phases

    def bounds(self, threads: int = 1) -> np.ndarray:
        """What no course of a cell exceeds, (n_cpa_time, n_cpa_range, n_speed) float32.

        Every tile counts with the best of its courses, or of all azimuths where courses go all round, and with the best corner
        of the range map.
        """
        pointing = self._pointing.max(axis=2)
        if abs(self._courses * self._course_step - 360.0) < 1e-6 and self._courses > 1:
            pointing = pointing.max(axis=1, keepdims=True)
        everywhere = bool((pointing == pointing[:, :1]).all())
        share = self._best_corner
        # Where the azimuth does not tell cells apart, those of one distance have one bound.
        columns = self._cell.shape[1] if everywhere else len(self._far)
        out = np.empty((self.shape[0], columns), np.float32)

        def fill(lo: int, hi: int) -> None:
            run, best = np.zeros((2, hi - lo, columns), np.float32)
            for m in range(len(share)):
                offset = self._index[lo:hi, m]
                heard = share[m].take(self._cell[offset])
                if everywhere:
                    _lengthen(run, best, pointing[m, :1], heard, self._jointly)
                else:
                    ahead = pointing[m].take(self._row[offset])
                    _lengthen(run, best, ahead, heard[:, self._far], self._jointly)
            out[lo:hi] = best

        step = min(max(_CELLS_AT_ONCE // columns, 1), -(-len(out) // threads))
        with ThreadPoolExecutor(threads) as pool:
            edges = [*range(0, len(out), step), len(out)]
            list(pool.map(fill, edges[:-1], edges[1:]))
        return (out[:, self._far] if everywhere else out).reshape(self.shape)

    def scores(self, cells: np.ndarray) -> np.ndarray:
        """Scores of all courses of chosen cells (flat indices), (n, n_course) float32."""
        return self._scores(cells, self._rows, self._courses)

    def scores_above(self, cells: np.ndarray, least: float, threads: int = 1) -> np.ndarray:
        """`scores` of the courses that may exceed `least`; minus infinity for the others.

        Courses are left out a sector at a time: every tile counts with the best azimuth of the sector.
        """
        count, rest = divmod(self._courses, _SECTOR)
        if rest or count < 2:
            return self.scores(cells)
        if self._sectors is None:
            ahead = sliding_window_view(self._rows, _SECTOR, axis=1).max(axis=2)
            laid = sliding_window_view(ahead, self._courses - _SECTOR + 1, axis=1)[:, :, ::_SECTOR]
            self._sectors = np.ascontiguousarray(laid).reshape(len(laid), -1)
        bounds = self._scores(cells, self._sectors, count, count, threads=threads)
        cell, sector = np.nonzero(bounds > least)
        found = np.full((len(cells), count, _SECTOR), -np.inf, np.float32)
        first = _SECTOR * sector
        found[cell, sector] = self._scores(cells[cell], self._rows, _SECTOR, 1, first, threads)
        return found.reshape(len(cells), -1)

    def _scores(
        self,
        cells: np.ndarray,
        rows: np.ndarray,
        count: int,
        pace: int = 1,
        first: np.ndarray | int = 0,
        threads: int = 1,
    ) -> np.ndarray:
        """Greatest runs (n_cells, count) float32, azimuths read from place `pace` · row + `first` of `rows` (n_tiles, n_place) on."""
        time, where = np.divmod(cells, len(self._far))
        first = np.broadcast_to(first, cells.shape)
        best = np.zeros((len(cells), count), np.float32)
        self._scored += len(cells)
        if self._scored * len(rows) > _MANY:
            self._compiled(time, where, first, rows, pace, best, threads)
            return best
        run, pointing = np.zeros_like(best), sliding_window_view(rows, count, axis=1)
        for m, score in enumerate(self._range_score):
            offset = self._index[time, m]
            at = offset * self._cell.shape[1] + self._far[where]
            share = _between(score, self._cell.take(at), self._rates, self._right.take(at), self._up.take(at))
            row = pace * self._row.take(offset * len(self._far) + where) + first
            _lengthen(run, best, pointing[m][row], share[:, None], self._jointly)
        return best

    def _compiled(
        self,
        time: np.ndarray,
        where: np.ndarray,
        first: np.ndarray,
        rows: np.ndarray,
        pace: int,
        best: np.ndarray,
        threads: int,
    ) -> None:
        """The same by a kernel, whose compiler takes as long to load as an ordinary search."""
        from obsnet.trackers.course_kernels import greatest_runs

        places = (self._index, self._far, self._cell, self._right, self._up, self._row)

        def fill(part: slice) -> None:
            greatest_runs(
                time[part], where[part], first[part], *places, self._range_score, self._rates, rows, pace,
                self._jointly, best[part],
            )  # fmt: skip

        step = max(-(-len(time) // threads), 1)
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(fill, (slice(lo, lo + step) for lo in range(0, len(time), step))))


def _lengthen(
    run: np.ndarray, best: np.ndarray, pointing: np.ndarray, share: np.ndarray, jointly: bool
) -> None:
    """Take the next tile into the best run that ends there, and that into the best of all; both in place.

    Where `jointly`, range speaks for a course only in tiles where azimuth does too.
    """
    run += pointing
    run += np.where(pointing > 0, share, np.minimum(share, 0.0)) if jointly else share
    np.maximum(run, 0.0, out=run)
    np.maximum(best, run, out=best)


def _between(
    score: np.ndarray, corner: np.ndarray, rates: int, right: np.ndarray, up: np.ndarray
) -> np.ndarray:
    """Bilinear interpolation of flattened range maps of so many `rates`, from a corner `right` in range and `up` in rate."""
    low = score.take(corner) * (1 - up) + score.take(corner + 1) * up
    high = score.take(corner + rates) * (1 - up) + score.take(corner + rates + 1) * up
    return low * (1 - right) + high * right


def best_first(bounds: np.ndarray) -> Iterator[np.ndarray]:
    """Batches of a grid's cells (flat indices), the greatest bounds first."""
    order = np.argsort(-bounds, axis=None)
    first, size = 0, _FIRST_BATCH
    while first < len(order):
        yield np.sort(order[first : first + size])  # neighbours are read together
        first, size = first + size, min(2 * size, _LARGEST_BATCH)


def score_points(
    points: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps, reach_s: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Score of each course of a list, both maps interpolated linearly.

    Parameters
    ----------
    points : (n, 4) CPA time [s on the clock of `tiles`], signed CPA range [m], course [deg], speed [m/s]; of courses that
        bend (n, 14), for each of two terms its bends across before and after CPA and along before and after, then time [s]
        and angle [deg] of a turn.
    reach_s : (2) s before and after CPA over which the velocity departs, of courses that bend (`kinematics.BentCourse`).

    Returns
    -------
    scores (n), and each tile's share of them (n_tiles, n); float64.
    """
    cpa_time, course = points[:, 0], points[:, 2].astype(np.float32)
    per_tile = np.empty((len(tiles), len(points)))
    bins, rates = scores.azimuth_score.shape[1], scores.range_score.shape[2]
    azimuth_score, range_score = scores.azimuth_score.reshape(-1), scores.flat.reshape(-1)
    for first in range(0, len(tiles), _TILES_AT_ONCE):
        part = slice(first, first + _TILES_AT_ONCE)
        tile = np.arange(len(tiles))[part, None]
        side, ahead, rate = _heard(tiles[part, None] - cpa_time, points, delay, reach_s)
        distance = np.sqrt(side * side + ahead * ahead)
        corner, right, up = scores.corner(distance, rate / np.maximum(distance, 1.0))
        share = _between(range_score, corner + tile * scores.flat.shape[1], rates, right, up)
        turn = (course + np.rad2deg(np.arctan2(side, ahead))) % 360.0 / float(scores.azimuth_step)
        below = turn.astype(np.int64)
        after = turn - below.astype(turn.dtype)
        pointing = azimuth_score.take(tile * bins + below % bins) * (1 - after)
        pointing += azimuth_score.take(tile * bins + (below + 1) % bins) * after
        if scores.jointly:
            share = np.where(pointing > 0, share, np.minimum(share, 0.0))
        per_tile[part] = pointing + share
    run, best = np.zeros((2, len(points)))
    for shares in per_tile:
        run = np.maximum(run + shares, 0.0)
        best = np.maximum(best, run)
    return best, per_tile


@dataclass(frozen=True)
class Shares:
    """What each sensor says for a course in the time in which it is heard.

    Attributes
    ----------
    ranged, pointed : sums of what range maps and azimuth maps say, in the tiles in which they speak for it.
    net_ranged : sum of what range maps say in all tiles in which it is heard, below 0 where they deny it.
    agreeing : of the sensor that speaks for it in fewer tiles, the share of tiles in which the other does too; 1 where it is
        but one or two.
    """

    ranged: float
    pointed: float
    net_ranged: float
    agreeing: float


def shares(point: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps) -> Shares:
    """Sensor by sensor, what speaks for a course."""
    _, both = score_points(point[None], tiles, delay, scores)
    _, azimuth = score_points(point[None], tiles, delay, scores.without_range())
    first, last = best_run(both[:, 0])
    held = slice(first, last + 1)
    net = (both - azimuth)[held, 0]
    pointed, ranged = np.maximum(azimuth[held, 0], 0.0), np.maximum(net, 0.0)
    fewer = int(min((pointed > 0).sum(), (ranged > 0).sum()))
    together = int(((pointed > 0) & (ranged > 0)).sum())
    agreeing = together / fewer if fewer > 2 else 1.0
    return Shares(float(ranged.sum()), float(pointed.sum()), float(net.sum()), agreeing)


def other_scale(
    point: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps, slowest: float, fastest: float
) -> float | None:
    """By what to multiply a course's CPA range and speed to reach the ghost for which range maps say nearly as much, if any does.

    Bearings leave that scale open, and path pairs read as their neighbours repeat a course at another.

    Parameters
    ----------
    slowest, fastest : that a ship may be, m/s.
    """
    scales = np.exp(np.arange(-_SCALES, _SCALES + 1) * _SCALE_STEP)
    points, said = at_scales(point, scales, tiles, delay, scores)
    ridge = np.concatenate([[False], (said[1:-1] >= said[:-2]) & (said[1:-1] > said[2:]), [False]])
    ridge &= (np.abs(np.log(scales)) > _APART) & (points[:, 3] > slowest) & (points[:, 3] < fastest)
    found = np.flatnonzero(ridge & (said >= NEARLY * max(said[_SCALES], 0.0)))
    return float(scales[found[said[found].argmax()]]) if found.size else None


def at_scales(
    point: np.ndarray, scales: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps
) -> tuple[np.ndarray, np.ndarray]:
    """Courses of so many times the CPA range and speed, (n, 4), and what range maps say for each."""
    points = np.repeat(point[None], len(scales), axis=0)
    points[:, [1, 3]] *= scales[:, None]
    both, _ = score_points(points, tiles, delay, scores)
    pointing, _ = score_points(points, tiles, delay, scores.without_range())
    return points, both - pointing


def _heard(
    heard: np.ndarray, points: np.ndarray, delay: Delay, reach_s: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the ship was when what is heard `heard` s after CPA left it: m to starboard and ahead; its range times its rate."""
    # Single precision is a centimetre at 100 km, and several times as fast.
    heard, points = heard.astype(np.float32), points.astype(np.float32)
    _, cpa_range, _, speed = np.ascontiguousarray(points[:, :4].T)
    if reach_s is None:
        ahead = speed * delay.emitted(heard, cpa_range, speed)
        return cpa_range, ahead, speed * ahead
    reach_s = reach_s.astype(np.float32)
    bends, turn = points[:, 4:12].T.reshape(-1, 2, 2, len(points)), points[:, 12:].T
    emitted = heard - _travel(heard, points, delay, reach_s)
    side, ahead, _, _ = _departed(emitted, cpa_range, speed, bends, turn, reach_s)
    emitted = heard - delay(np.sqrt(side * side + ahead * ahead))
    side, ahead, sideways, forwards = _departed(emitted, cpa_range, speed, bends, turn, reach_s)
    return side, ahead, side * sideways + ahead * forwards


def _travel(heard: np.ndarray, points: np.ndarray, delay: Delay, reach_s: np.ndarray) -> np.ndarray:
    """Travel time [s] from the middle of bending courses, for each tile: a first guess for all of them.

    A ship is so much slower than sound that one round more leaves less than a hundredth of its error.
    """
    middle = np.median(points, axis=0)[:, None]
    since = np.median(heard, axis=1, keepdims=True)
    travel = np.zeros_like(since)
    for _ in range(3):
        side, ahead, _, _ = _departed(
            since - travel, middle[1], middle[3], middle[4:12].reshape(-1, 2, 2, 1), middle[12:], reach_s
        )
        travel = delay(np.sqrt(side * side + ahead * ahead))
    return travel


def _departed(
    elapsed: np.ndarray,
    cpa_range: np.ndarray,
    speed: np.ndarray,
    bends: np.ndarray,
    turn: np.ndarray,
    reach_s: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Place [m] and velocity [m/s] to starboard and ahead at `elapsed` s after CPA; bends (term, direction, side of CPA, n), turn (2, n)."""
    after = elapsed >= 0
    reach = np.where(after, reach_s[1], reach_s[0])
    angle = np.minimum(np.abs(elapsed) / reach, np.float32(1.0)) * np.float32(0.5 * np.pi)
    past = np.maximum(np.abs(elapsed) - reach, np.float32(0.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    side, ahead, sideways, forwards = 0.0, elapsed, 0.0, 1.0
    for term, (across, along) in enumerate(bends):
        order = 2 * term + 1
        if term == 1:  # the second term's angle is three times the first's
            cosine, sine = cosine * (4.0 * cosine * cosine - 3.0), sine * (3.0 - 4.0 * sine * sine)
        way = reach * np.float32(2.0 / (order * np.pi)) * (1.0 - cosine) + (past if order == 1 else -past)
        way = np.where(after, way, -way)
        across, along = np.where(after, across[1], across[0]), np.where(after, along[1], along[0])
        side, sideways = side + across * way, sideways + across * sine
        ahead, forwards = ahead + along * way, forwards + along * sine
    time, by = turn
    if by.any():
        beyond = elapsed - time
        beyond = np.where(time >= 0, np.maximum(beyond, np.float32(0.0)), np.minimum(beyond, np.float32(0.0)))
        swing, less = np.sin(np.deg2rad(by)), np.cos(np.deg2rad(by)) - 1.0
        side, sideways = side + swing * beyond, sideways + swing * (beyond != 0)
        ahead, forwards = ahead + less * beyond, forwards + less * (beyond != 0)
    return cpa_range + speed * side, speed * ahead, speed * sideways, speed * forwards


def best_run(values: np.ndarray) -> tuple[int, int]:
    """First and last index of the run of greatest sum."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    lowest = np.minimum.accumulate(total[:-1])
    end = int(np.argmax(total[1:] - lowest))
    start = int(np.argmin(total[: end + 1]))
    return start, end


def apart(values: np.ndarray, most: int) -> list[tuple[int, int, int]]:
    """Places of the greatest positive values (cpa_time, cpa_range, speed), apart in CPA range and speed, best first."""
    plane = values.max(axis=0)
    found = []
    for _ in range(most):
        i, j = np.unravel_index(plane.argmax(), plane.shape)
        if plane[i, j] <= 0:
            break
        found.append((int(values[:, i, j].argmax()), int(i), int(j)))
        plane[np.ix_(_near(i, 3, plane.shape[0]), _near(j, 2, plane.shape[1]))] = -1.0
    return found


def _near(index: int, reach: int, count: int) -> np.ndarray:
    return np.arange(max(index - reach, 0), min(index + reach + 1, count))
