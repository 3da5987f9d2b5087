"""Likelihood maps of one segment in, straight courses out: coarse-to-fine grid search and the posterior around its best.

A hypothesis is a straight course at constant speed. Its score is the sum, over the tiles (minutes a whole window apart, so
that no frame counts twice), of the log mixtures (1 − Pd) + Pd·likelihood ratio read off the maps where the hypothesis puts
the ship when the sound left it (paper's eq. 26, the travel time undone). The search keeps the best hypotheses of every level.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter1d
from scipy.special import gammaln

from obsnet import netcdf
from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import to_posix
from obsnet.trackers import search_kernels
from obsnet.trackers.track import Segment, Track


@dataclass(frozen=True)
class GridSearchConfig:
    """Prior, likelihood and levels of the grid search.

    `tile_bound` is the most that one tile may say (log-likelihood ratio; maps that say more are lowered, keeping their shape), `exponent` the power to which the whole likelihood is raised, `min_log_bayes_factor` what a track must reach against no ship
    and against a source whose azimuth drifts by `still_deg_per_hour` at most; a further ship beside or soon after a first must
    reach `min_log_bayes_factor_next`, since what is left of the first is not noise. A track must be heard for `shortest_s`.
    """

    azimuth_detection_probability: float = 0.9
    range_detection_probability: float = 0.6
    tile_s: float = 180.0
    tile_bound: float = 12.0
    exponent: float = 1.0
    max_cpa_range_m: float = 50_000.0
    min_speed_mps: float = 3.0
    max_speed_mps: float = 13.0
    candidates: int = 6
    max_ships: int = 4
    min_log_bayes_factor: float = 10.0
    min_log_bayes_factor_next: float = 60.0
    still_deg_per_hour: float = 4.0
    shortest_s: float = 3600.0
    samples: int = 3000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("azimuth_detection_probability", "range_detection_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ConfigError(f"{name} must lie in (0, 1), found {getattr(self, name)}")
        if not 0.0 < self.min_speed_mps < self.max_speed_mps:
            raise ConfigError(
                f"min_speed_mps must lie below max_speed_mps, found {self.min_speed_mps}, {self.max_speed_mps}"
            )
        for name in (
            "tile_s",
            "tile_bound",
            "exponent",
            "max_cpa_range_m",
            "candidates",
            "max_ships",
            "samples",
        ):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")


@dataclass(frozen=True)
class _Level:
    """Steps and half-widths of one level in CPA time [s], CPA range [m], course [deg], speed [m/s]."""

    step: tuple[float, float, float, float]
    half: tuple[float, float, float, float]


MEDIUM = _Level((20.0, 200.0, 2.0, 0.1), (180.0, 1000.0, 10.0, 0.5))
FINE = _Level((4.0, 40.0, 0.4, 0.02), (20.0, 200.0, 2.0, 0.1))


@dataclass(frozen=True)
class _Scores:
    """Score maps of the tiles: smoothed, mixed with the chance of a miss, ready for the kernels."""

    range_score: np.ndarray
    geometry: np.ndarray
    azimuth_score: np.ndarray
    azimuth_step: float
    jointly: bool


def search(
    maps: xr.Dataset,
    segment: Segment,
    delay: Callable[[np.ndarray], np.ndarray],
    config: GridSearchConfig = GridSearchConfig(),
    threads: int = 1,
    known: Sequence[Track] = (),
) -> list[Track]:
    """Tracks of the ships heard within a segment, strongest first; none if nothing speaks for a ship.

    Parameters
    ----------
    maps : LikelihoodMaps covering the segment; azimuth_llr (time, azimuth) and/or range_llr (time, range, range_rate).
    segment : Segment, s since 1970.
    delay : travel time [s] of the sound against range [m].
    config : GridSearchConfig
    known : tracks found before, in neighbouring segments; what they explain is left out.

    Returns
    -------
    list of Track. Without azimuth maps the course is not observed (infinite variance).

    Source: Trabattoni et al. 2023, section III.E.
    """
    tiles = _tiles(maps, segment, config)
    if tiles is None:
        return []
    times, azimuth_llr, range_llr = tiles
    finder = _Finder(maps, times, segment, delay, config, threads)
    for track in known:
        azimuth_llr, range_llr = finder.without(track, azimuth_llr, range_llr)
    tracks: list[Track] = []
    # Without azimuths nothing tells a second ship from the first one's ghost ranges.
    for number in range(config.max_ships if "azimuth_llr" in maps else 1):
        found = finder.find(azimuth_llr, range_llr, jointly=number > 0 and "azimuth_llr" in maps)
        least = config.min_log_bayes_factor_next if tracks or known else config.min_log_bayes_factor
        if found is None or found.log_bayes_factor < least:
            break
        if finder.believable(found):
            tracks.append(found)
        azimuth_llr, range_llr = finder.without(found, azimuth_llr, range_llr)
    return tracks


class _Finder:
    """The search over one segment's tiles."""

    def __init__(
        self,
        maps: xr.Dataset,
        times: np.ndarray,
        segment: Segment,
        delay: Callable[[np.ndarray], np.ndarray],
        config: GridSearchConfig,
        threads: int,
    ) -> None:
        self.config, self.threads, self.segment = config, threads, segment
        self.origin = times[0]
        self.tiles = times - self.origin
        self.azimuth = maps["azimuth"].values if "azimuth_llr" in maps else np.arange(0.0, 360.0, 1.0)
        self.range_m = maps["range"].values if "range_llr" in maps else np.array([0.0, 1.0, 2.0])
        self.rate = maps["range_rate"].values if "range_llr" in maps else np.array([-1.0, 0.0, 1.0])
        self.sees_course = "azimuth_llr" in maps
        self.sees_range = "range_llr" in maps
        self.delay_step = 250.0
        self.delay = np.asarray(delay(np.arange(0.0, 150_001.0, self.delay_step)), float)

    def find(
        self, azimuth_llr: np.ndarray | None, range_llr: np.ndarray | None, jointly: bool = False
    ) -> Track | None:
        """The best track of the tiles, or none if no hypothesis scores above 0.

        A second ship is looked for `jointly`: the first one's ghost ranges have no azimuth of their own.
        """
        coarse = self._scores(azimuth_llr, range_llr, jointly, pool=7, stds=(2.0, 10.0, 1.0))
        fine = self._scores(azimuth_llr, range_llr, jointly, pool=1, stds=(4.0, 3.0, 1.0))
        best: tuple[float, np.ndarray] | None = None
        for start in self._coarse(coarse):
            value, point = self._level(start, MEDIUM, fine)
            if best is None or value > best[0]:
                best = (value, point)
        if best is None or best[0] <= 0.0:
            return None
        value, point = self._level(best[1], FINE, fine)
        return self._posterior(point, fine)

    def _coarse(self, scores: _Scores) -> list[np.ndarray]:
        """The best hypotheses of the whole prior, apart from each other, best first."""
        config = self.config
        step = config.tile_s
        edge = self.tiles[-1]
        cpa_time = np.arange(-1800.0, edge + 1800.0 + step, step)
        if self.segment.cpa is not None:
            near = abs(cpa_time - (self.segment.cpa - self.origin)) <= 3600.0
            cpa_time = cpa_time[near] if near.any() else cpa_time
        half = 1000.0 * int(config.max_cpa_range_m / 1000.0)
        cpa_range = np.arange(-half, half + 1.0, 1000.0)
        if not self.sees_course:
            cpa_range = cpa_range[cpa_range >= 0]
        speed = np.arange(config.min_speed_mps, config.max_speed_mps + 1e-9, 0.5)
        course = np.arange(0.0, 360.0, 10.0) if self.sees_course else np.zeros(1)
        values = self._grid(cpa_time, cpa_range, speed, course, scores)
        found = []
        for _ in range(config.candidates):
            t, i, j, q = np.unravel_index(values.argmax(), values.shape)
            if values[t, i, j, q] <= 0:
                break
            found.append(np.array([cpa_time[t], cpa_range[i], course[q], speed[j]]))
            courses = np.arange(q - 2, q + 3) % len(course)
            around = np.ix_(
                _near(t, 3, len(cpa_time)), _near(i, 3, len(cpa_range)), _near(j, 2, len(speed)), courses
            )
            values[around] = -1.0
        return found

    def _level(self, centre: np.ndarray, level: _Level, scores: _Scores) -> tuple[float, np.ndarray]:
        """Best score and hypothesis of a grid around `centre`."""
        axes = [
            c + np.arange(-h, h + s / 2, s) for c, h, s in zip(centre, level.half, level.step, strict=True)
        ]
        cpa_time, cpa_range, course, speed = axes
        speed = speed[speed > 0.5]
        course = course if self.sees_course else centre[2:3]
        values = self._grid(cpa_time, cpa_range, speed, course, scores)
        t, i, j, q = np.unravel_index(values.argmax(), values.shape)
        return float(values[t, i, j, q]), np.array([cpa_time[t], cpa_range[i], course[q] % 360.0, speed[j]])

    def _grid(
        self,
        cpa_time: np.ndarray,
        cpa_range: np.ndarray,
        speed: np.ndarray,
        course: np.ndarray,
        scores: _Scores,
    ) -> np.ndarray:
        """Score of every hypothesis of a grid, (n_cpa_time, n_cpa_range, n_speed, n_course) float32."""
        offset, index = np.unique(np.round(self.tiles[None, :] - cpa_time[:, None], 3), return_inverse=True)
        index = index.reshape(len(cpa_time), len(self.tiles))
        shape = (len(cpa_range), len(speed), len(offset))
        across, along = np.empty(shape, np.float32), np.empty(shape, np.float32)
        row = np.empty(shape, np.int32)
        out = np.empty((len(cpa_time), len(cpa_range), len(speed), len(course)), np.float32)
        course_step = float(course[1] - course[0]) if len(course) > 1 else 360.0
        rows, step = _polyphase(scores.azimuth_score, scores.azimuth_step, course_step, len(course))
        phases, length = rows.shape[1:]
        flat = rows.reshape(len(rows), -1)

        def table(part: slice) -> None:
            search_kernels.tabulate(
                offset, cpa_range[part], speed, self.delay, self.delay_step, scores.geometry, step, course[0], phases, length,
                across[part], along[part], row[part],
            )  # fmt: skip

        def total(part: slice) -> None:
            search_kernels.sum_scores(
                index[part], across, along, row, scores.range_score, flat, scores.jointly, out[part]
            )

        self._share(table, len(cpa_range))
        self._share(total, len(cpa_time))
        return out

    def _share(self, task: Callable, count: int) -> None:
        bounds = np.linspace(0, count, self.threads + 1).astype(int)
        parts = [slice(lo, hi) for lo, hi in itertools.pairwise(bounds)]
        if self.threads == 1:
            task(parts[0])
            return
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(task, parts))

    def _score_points(
        self, points: np.ndarray, scores: _Scores, keep_tiles: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Score of each hypothesis, and each tile's share of it where asked for."""
        out = np.empty(len(points))
        per_tile = np.zeros((len(self.tiles), len(points) if keep_tiles else 0))
        search_kernels.score_points(
            np.ascontiguousarray(points), self.tiles, self.delay, self.delay_step, scores.range_score, scores.geometry,
            scores.azimuth_score, scores.azimuth_step, scores.jointly, per_tile, out,
        )  # fmt: skip
        return out, per_tile

    def _posterior(self, best: np.ndarray, scores: _Scores) -> Track:
        """Mean, covariance and evidence by adaptive importance sampling around the best hypothesis."""
        config = self.config
        rng = np.random.default_rng(config.seed)
        seen = np.array([True, True, self.sees_course, True])
        mean, cov = best.copy(), np.diag([60.0, 500.0, 3.0, 0.3]) ** 2
        log_evidence = -np.inf
        for _ in range(5):
            points, log_proposal = _student(rng, mean, cov, config.samples, seen)
            inside = self._inside(points)
            log_target = np.where(inside, config.exponent * self._score_points(points, scores)[0], -np.inf)
            log_weight = log_target - log_proposal
            top = log_weight.max()
            weight = np.exp(log_weight - top)
            log_evidence = top + np.log(weight.mean())
            weight /= weight.sum()
            mean = best + weight @ _difference(points, best)
            deviation = _difference(points, mean)
            cov = (weight * deviation.T) @ deviation + np.diag([1.0, 10.0, 0.05, 0.005]) ** 2
        score, per_tile = self._score_points(best[None], scores, keep_tiles=True)
        lo, hi = _best_run(per_tile[:, 0])
        fixed = self._fixed_source(scores, lo, hi)
        n = len(self.tiles)
        span = self.tiles[-1] + 3600.0
        volume = span * 2 * config.max_cpa_range_m * (config.max_speed_mps - config.min_speed_mps)
        volume *= 360.0 if self.sees_course else 0.5
        log_bayes_factor = float(log_evidence - np.log(volume) - np.log(n * (n + 1) / 2))
        if not self.sees_course:
            cov[2, :] = cov[:, 2] = 0.0
            cov[2, 2] = np.inf
        motion = StraightCourse(self.origin + mean[0], float(mean[1]), float(mean[2] % 360.0), float(mean[3]))
        method = "grid search" if self.sees_course and self.sees_range else _blind(self.sees_course)
        start, end = self.origin + self.tiles[lo], self.origin + self.tiles[hi]
        extra = {
            "score": float(score[0]),
            "log_bayes_factor_fixed": config.exponent * (float(score[0]) - fixed),
        }
        return Track(float(start), float(end), motion, cov, log_bayes_factor, method, extra)

    def _fixed_source(self, scores: _Scores, lo: int, hi: int) -> float:
        """Best score over the tiles lo … hi of a source that hardly moves in azimuth, such as a singing whale."""
        if not self.sees_course:
            return 0.0
        tiles = np.arange(lo, hi + 1)
        hours = (self.tiles[tiles] - self.tiles[tiles].mean()) / 3600.0
        bins = scores.azimuth_score.shape[1]
        azimuth = np.arange(bins)
        best = -np.inf
        for drift in np.linspace(-self.config.still_deg_per_hour, self.config.still_deg_per_hour, 9):
            shift = np.round(drift * hours / scores.azimuth_step).astype(int)
            best = max(best, scores.azimuth_score[tiles, (azimuth[:, None] + shift) % bins].sum(axis=1).max())
        return float(best)

    def believable(self, track: Track) -> bool:
        """Whether a track moves as a ship does, and lies within the prior rather than against its edge."""
        config = self.config
        slack = 0.02 * (config.max_speed_mps - config.min_speed_mps)
        within_speed = config.min_speed_mps + slack < track.motion.speed_mps < config.max_speed_mps - slack
        long_enough = track.end - track.start >= config.shortest_s - config.tile_s
        within_range = abs(track.motion.cpa_range_m) < 0.98 * config.max_cpa_range_m
        return (
            long_enough
            and within_speed
            and within_range
            and track.extra["log_bayes_factor_fixed"] >= config.min_log_bayes_factor
        )

    def _inside(self, points: np.ndarray) -> np.ndarray:
        config = self.config
        return (
            (abs(points[:, 1]) <= config.max_cpa_range_m)
            & (points[:, 3] >= config.min_speed_mps)
            & (points[:, 3] <= config.max_speed_mps)
            & (points[:, 0] >= -1800.0)
            & (points[:, 0] <= self.tiles[-1] + 1800.0)
        )

    def _scores(
        self,
        azimuth_llr: np.ndarray | None,
        range_llr: np.ndarray | None,
        jointly: bool,
        pool: int,
        stds: tuple[float, float, float],
    ) -> _Scores:
        """Score maps at one smoothing: range bins (of `pool` grid steps), azimuth [deg], range rate bins."""
        config = self.config
        n = len(self.tiles)
        step = float(self.azimuth[1] - self.azimuth[0])
        if azimuth_llr is None:
            azimuth_score = np.zeros((n, len(self.azimuth)), np.float32)
        else:
            ratio, top = _bounded(azimuth_llr, config.tile_bound)
            ratio = gaussian_filter1d(ratio, stds[1] / step, axis=1, mode="wrap")
            azimuth_score = _mixed(ratio, top, config.azimuth_detection_probability)
        spacing = float(self.range_m[1] - self.range_m[0]) * pool
        rate_step = float(self.rate[1] - self.rate[0])
        if range_llr is None:
            range_score = np.zeros((n, 2, 2), np.float32)
        else:
            ratio, top = _bounded(range_llr, config.tile_bound)
            if pool > 1:
                bins = ratio.shape[1] // pool
                ratio = ratio[:, : bins * pool].reshape(n, bins, pool, -1).mean(axis=2)
            ratio = gaussian_filter1d(ratio, stds[0], axis=1, mode="nearest", truncate=3.0)
            ratio = gaussian_filter1d(ratio, stds[2], axis=2, mode="nearest", truncate=3.0)
            range_score = _mixed(ratio, top, config.range_detection_probability)
        first = float(self.range_m[0]) + (spacing - spacing / pool) / 2
        geometry = np.array([first, spacing, float(self.rate[0]), rate_step])
        return _Scores(range_score, geometry, azimuth_score, step, jointly)

    def without(
        self, track: Track, azimuth_llr: np.ndarray | None, range_llr: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The maps with what a track explains made silent, for the search of the next ship."""
        emitted = self.origin + self.tiles
        for _ in range(3):
            _, distance, _ = track.motion.observables(emitted)
            emitted = (
                self.origin
                + self.tiles
                - np.interp(distance, self.delay_step * np.arange(len(self.delay)), self.delay)
            )
        azimuth, distance, rate = track.motion.observables(emitted)
        if azimuth_llr is not None:
            near = abs(wrap180(self.azimuth[None, :] - azimuth[:, None])) <= 30.0
            azimuth_llr = np.where(near, np.minimum(azimuth_llr, 0.0), azimuth_llr)
        if range_llr is not None:
            near = abs(self.range_m[None, :] - distance[:, None]) <= 3000.0
            rates = abs(self.rate[None, :] - rate[:, None]) <= 3.0
            range_llr = np.where(near[:, :, None] & rates[:, None, :], np.minimum(range_llr, 0.0), range_llr)
        return azimuth_llr, range_llr


def _tiles(
    maps: xr.Dataset, segment: Segment, config: GridSearchConfig
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None] | None:
    """Tile times and the maps there, read from disk no further than that; none if there are fewer than three."""
    times = to_posix(maps["time"].values)
    inside = (times >= segment.start - 1e-6) & (times <= segment.end + 1e-6)
    inside &= np.abs(times / config.tile_s - np.round(times / config.tile_s)) * config.tile_s < 0.5
    chosen = np.flatnonzero(inside)
    if len(chosen) < 3:
        return None

    def llr(name: str) -> np.ndarray | None:
        return netcdf.rows(maps[name], chosen) if name in maps else None

    return times[chosen], llr("azimuth_llr"), llr("range_llr")


def _bounded(llr: np.ndarray, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """exp(llr − max) and the log at which the maximum counts, at most `bound`; tiles without data are 1 and NaN."""
    top = llr.max(axis=tuple(range(1, llr.ndim)), keepdims=True)
    ratio = np.exp(llr - top)
    return np.nan_to_num(ratio, nan=1.0), np.minimum(top, bound)


def _mixed(ratio: np.ndarray, top: np.ndarray, probability: float) -> np.ndarray:
    """Log of (1 − Pd) + Pd·ratio·exp(top) (see `segmentation.mixture`); 0 where there is no data."""
    share = np.float32(probability) * np.exp(np.nan_to_num(top)).astype(np.float32)
    mixed = np.log(ratio * share + np.float32(1.0 - probability))
    return np.where(np.isnan(top), np.float32(0.0), mixed)


def _polyphase(rows: np.ndarray, step: float, course_step: float, courses: int) -> tuple[np.ndarray, float]:
    """Azimuth rows laid out so that the courses of one hypothesis are neighbours in memory."""
    if course_step < step:
        finer = round(step / course_step)
        count = rows.shape[1]
        position = np.arange(count * finer) / finer
        low = np.floor(position).astype(int)
        mu = (position - low).astype(np.float32)
        rows = (1 - mu) * rows[:, low] + mu * rows[:, (low + 1) % count]
        step = step / finer
    phases = max(1, round(course_step / step))
    bins = rows.shape[1]
    if bins % phases:
        phases = 1 if courses == 1 else phases
    wrapped = np.concatenate([rows, rows[:, np.arange(courses * phases) % bins]], axis=1)
    length = wrapped.shape[1] // phases
    laid = wrapped[:, : length * phases].reshape(len(rows), length, phases).transpose(0, 2, 1)
    return np.ascontiguousarray(laid, dtype=np.float32), step


def _student(
    rng: np.random.Generator,
    mean: np.ndarray,
    cov: np.ndarray,
    count: int,
    seen: np.ndarray,
    dof: float = 5.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws from a multivariate t over the parameters that are seen, and the log density of each."""
    d = int(seen.sum())
    root = np.linalg.cholesky(cov[np.ix_(seen, seen)] * 1.5)
    z = rng.standard_normal((count, d)) / np.sqrt(rng.chisquare(dof, (count, 1)) / dof)
    points = np.tile(mean, (count, 1))
    points[:, seen] += z @ root.T
    points[:, 2] %= 360.0
    constant = (
        gammaln((dof + d) / 2)
        - gammaln(dof / 2)
        - 0.5 * d * np.log(dof * np.pi)
        - np.log(np.diag(root)).sum()
    )
    return points, constant - 0.5 * (dof + d) * np.log1p((z**2).sum(axis=1) / dof)


def _difference(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    difference = points - centre
    difference[:, 2] = wrap180(difference[:, 2])
    return difference


def _best_run(values: np.ndarray) -> tuple[int, int]:
    """First and last index of the run of greatest sum."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    lowest = np.minimum.accumulate(total[:-1])
    end = int(np.argmax(total[1:] - lowest))
    start = int(np.argmin(total[: end + 1]))
    return start, end


def _near(index: Any, reach: int, count: int) -> np.ndarray:
    return np.arange(max(index - reach, 0), min(index + reach + 1, count))


def _blind(sees_course: bool) -> str:
    return (
        "grid search, no range maps" if sees_course else "grid search, no azimuth maps: course not observed"
    )
