"""Likelihood maps of one segment in, courses out: coarse-to-fine grid search and the posterior around its best.

A hypothesis is a straight course at constant speed. Its score is the sum, over the tiles (minutes a whole window apart, so
that no frame counts twice), of the log mixtures (1 − Pd) + Pd·likelihood ratio read off the maps where the hypothesis puts
the ship when the sound left it (paper's eq. 26, the travel time undone). The search keeps the best hypotheses of every level.
Around the best one the course may bend (`bends`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from obsnet.detectors.maps import two_sided
from obsnet.kinematics import BentCourse, StraightCourse
from obsnet.trackers.bends import BENDS, MARGIN_S, TURN, bends
from obsnet.trackers.course_grid import (
    CourseGrid,
    Delay,
    apart,
    best_first,
    best_run,
    other_scale,
    score_points,
    shares,
)
from obsnet.trackers.line_doppler import Lines
from obsnet.trackers.posterior import Posterior, posterior
from obsnet.trackers.remainder import Ghosts, Remainder
from obsnet.trackers.score_maps import ScoreMaps, azimuth_scores, range_scores, tiles
from obsnet.trackers.search_config import COARSE, FINE, MEDIUM, SMOOTHING, GridSearchConfig, Level
from obsnet.trackers.steady import SWIMS, fixed_source, swimming_source, two_steady
from obsnet.trackers.track import USUAL_MPS, Segment, Track, usual
from obsnet.trackers.verdict import (
    as_stated,
    believable,
    is_cut_off,
    is_no_remainder,
    is_one,
    is_sharp,
    required,
)

LINGERS = 2.0
"""How much farther than it was heard a ship of an earlier segment may still explain what is heard."""

COARSE_SHARE = 0.6
"""What the bound of a coarse cell is at least of the best score in it."""

POINTED = 4.0
"""What azimuth maps must say for a further ship that is heard by its range where azimuths are a louder one's, and located sharply."""

SLOW = 1.5
"""Times the least speed of a ship below which a track must outdo a source that swims."""

SILENT = 3.0
"""What range maps say for a ship at least whose range is heard; else what they say against others says little of other seas."""


def search(
    maps: xr.Dataset,
    segment: Segment,
    delay: Callable[[np.ndarray], np.ndarray],
    config: GridSearchConfig = GridSearchConfig(),
    threads: int = 1,
    known: Sequence[Track] = (),
    ghosts: Ghosts | None = None,
) -> list[Track]:
    """Tracks of the ships heard within a segment, strongest first; none if nothing speaks for a ship.

    Parameters
    ----------
    maps : LikelihoodMaps covering the segment; azimuth_llr (time, azimuth) and/or range_llr (time, range, range_rate).
    segment : Segment, s since 1970.
    delay : travel time [s] of the sound against range [m].
    config : GridSearchConfig
    known : tracks found before, in neighbouring segments; what they explain is left out.
    ghosts : of the table of the range maps; with them a ship is also found that is heard by its range alone for the most part,
        while the azimuths are a louder one's.

    Returns
    -------
    list of Track. Without azimuth maps, or with none but empty ones, the course is not observed (infinite variance).

    Source: Trabattoni et al. 2023, section III.E.
    """
    read = tiles(maps, segment, config.tile_s)
    if read is None:
        return []
    times, azimuth_llr, range_llr, level = read
    given = {"azimuth_llr": azimuth_llr, "range_llr": range_llr}
    maps = maps.drop_vars([name for name in given if name in maps and given[name] is None])
    lines = None if level is None or not config.lines else Lines.of(level, maps["line_frequency"].values)
    both = None if azimuth_llr is None else two_sided(azimuth_llr)
    finder = _Finder(maps, times, delay, config, threads, lines, both, segment.cut)
    left = azimuth_llr, range_llr
    for track in known:
        # Long after it has gone, the next ship on its lane comes from or goes to the same azimuth.
        left = finder.remainder.without(track, *left, finder.heard_m(track))
    tracks: list[Track] = []
    left = finder.one_by_one(tracks, known, *left)
    if ghosts is not None and finder.sees_course and left[1] is not None and (tracks or known):
        finder.one_by_one(tracks, known, left[0], finder.remainder.without_ghosts(ghosts, left[1]), ghosts)
    return tracks


class _Finder:
    """The search over one segment's tiles."""

    def __init__(
        self,
        maps: xr.Dataset,
        times: np.ndarray,
        delay: Callable[[np.ndarray], np.ndarray],
        config: GridSearchConfig,
        threads: int,
        lines: Lines | None = None,
        both: np.ndarray | None = None,
        cut: tuple[bool, bool] = (False, False),
    ) -> None:
        self.config, self.threads, self.lines = config, threads, lines
        self.origin = times[0]
        self._cuts = times[0] if cut[0] else -np.inf, times[-1] if cut[1] else np.inf
        self.tiles = times - self.origin
        self.azimuth = maps["azimuth"].values if "azimuth_llr" in maps else np.arange(0.0, 360.0, 1.0)
        self.range_m = maps["range"].values if "range_llr" in maps else np.array([0.0, 1.0, 2.0])
        self.rate = maps["range_rate"].values if "range_llr" in maps else np.array([-1.0, 0.0, 1.0])
        self.sees_course = "azimuth_llr" in maps
        self.sees_range = "range_llr" in maps
        self._runs = float(np.log(len(times) * (len(times) + 1) / 2))
        self.delay = Delay(np.asarray(delay(np.arange(0.0, 150_001.0, 250.0)), float), 250.0)
        self.remainder = Remainder(times, self.delay, self.azimuth, self.range_m, self.rate, both)
        self._everywhere: CourseGrid | None = None

    def one_by_one(
        self,
        tracks: list[Track],
        known: Sequence[Track],
        azimuth_llr: np.ndarray | None,
        range_llr: np.ndarray | None,
        ghosts: Ghosts | None = None,
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Add what is found to `tracks`, strongest first, until there is no more; the maps without it come back.

        With `ghosts`, of which the maps are free, range speaks for a further ship where azimuth does not, too.
        """
        config = self.config
        least = config.min_log_bayes_factor
        # Without azimuths nothing tells a second ship from the first one's ghost ranges.
        for number in range(config.max_ships - len(tracks) if self.sees_course else 1):
            others = [*tracks, *known]
            if ghosts is not None and self._most_pointed(azimuth_llr) < POINTED:
                break
            jointly = bool(number or known) and self.sees_course and ghosts is None
            found = self.find(azimuth_llr, range_llr, least, jointly)
            mixed = not jointly and ghosts is None and found is not None and not is_one(found)
            if mixed:
                found = self.find(azimuth_llr, range_llr, least, True)
            if found is None or found.log_bayes_factor < required(found, others, config):
                break
            pointed = ghosts is None or (found.extra["pointed"] >= POINTED and is_sharp(found))
            one_of_many = bool(others) or mixed
            whole = not one_of_many or (is_no_remainder(found) and not is_cut_off(found, *self._cuts))
            if pointed and believable(found, config) and whole:
                tracks.append(as_stated(found, config.range_scale_std if self.sees_range else 0.0))
            azimuth_llr, range_llr = self.remainder.without(found, azimuth_llr, range_llr)
            if ghosts is not None and range_llr is not None:
                range_llr = self.remainder.without_ghosts(ghosts, range_llr)
        return azimuth_llr, range_llr

    def _most_pointed(self, azimuth_llr: np.ndarray | None) -> float:
        """The most that azimuth maps can say for any course."""
        best = self._score_maps(azimuth_llr, None, False, 1, SMOOTHING).azimuth_score
        return float(np.maximum(best.max(axis=1), 0.0).sum())

    def find(
        self,
        azimuth_llr: np.ndarray | None,
        range_llr: np.ndarray | None,
        least: float,
        jointly: bool = False,
    ) -> Track | None:
        """The best track of the tiles, or none if none can have a log Bayes factor of `least`.

        A second ship is looked for `jointly`: the first one's ghost ranges have no azimuth of their own.
        """
        coarse = self._score_maps(azimuth_llr, range_llr, jointly, pool=7, stds=(980.0, 10.0, 0.5))
        starts = self._coarse(coarse, (least + self._runs) / self.config.exponent)
        if not starts:
            return None
        fine = self._score_maps(azimuth_llr, range_llr, jointly, pool=1, stds=SMOOTHING)
        best, point = 0.0, None
        for start in starts:
            best, point = self._level(start, MEDIUM, fine, best, point)
        if point is None:
            return None
        best, point = self._level(point, FINE, fine)
        # The evidence is less than the greatest likelihood, by far more than what a finer grid would find.
        if point is None or self.config.exponent * best - self._runs < least:
            return None
        return self._track(*self._by_lines(point, fine, least), fine)

    def _by_lines(
        self, point: np.ndarray, scores: ScoreMaps, least: float
    ) -> tuple[np.ndarray, tuple[float, float] | None]:
        """The hypothesis, or the one that fits best at another scale of CPA range and speed if the lines' shift asks for it.

        With the other one come mean and standard deviation of the speed that it asks for, m/s.
        """
        rescaled = None
        if self.lines is not None and self.sees_course:
            rescaled = self.lines.rescaled(point, self._scales(point), self.tiles, self.delay, scores)
        if rescaled is None:
            return point, None
        start, speed = rescaled
        best, found = -np.inf, None
        for nudge in (0.92, 1.0, 1.08):
            centre = start * np.array([1.0, nudge, 1.0, nudge])
            best, found = self._level(centre, MEDIUM, scores, best, found)
        if found is not None:
            best, found = self._level(found, FINE, scores)
        if found is None or self.config.exponent * best - self._runs < least:
            return point, None
        return found, speed

    def _scales(self, point: np.ndarray) -> np.ndarray:
        """Scales of CPA range and speed that the prior allows."""
        config, scales = self.config, np.exp(np.arange(-24, 25) * 0.05)
        allowed = (scales * point[3] >= config.min_speed_mps) & (scales * point[3] <= config.max_speed_mps)
        return scales[allowed & (scales * abs(point[1]) <= config.max_cpa_range_m)]

    def _coarse(self, scores: ScoreMaps, needed: float) -> list[np.ndarray]:
        """The best hypotheses of the whole prior from which a score of `needed` may be reached, apart from each other, best first."""
        config = self.config
        step = config.tile_s
        edge = self.tiles[-1]
        cpa_time = np.arange(-1800.0, edge + 1800.0 + step, step)
        range_step, course_step, speed_step = COARSE
        half = range_step * int(config.max_cpa_range_m / range_step)
        cpa_range = np.arange(-half, half + 1.0, range_step)
        if not self.sees_course:
            cpa_range = cpa_range[cpa_range >= 0]
        speed = np.arange(config.min_speed_mps, config.max_speed_mps + 1e-9, speed_step)
        course = np.arange(0.0, 360.0, course_step) if self.sees_course else np.zeros(1)
        if self._everywhere is None:
            self._everywhere = CourseGrid(cpa_time, cpa_range, speed, course, self.tiles, self.delay, scores)
        grid = self._everywhere.reading(scores)
        bounds = grid.bounds(self.threads)
        values, headings = np.full(bounds.shape, -np.inf, np.float32), np.zeros(bounds.shape, int)
        found: list[tuple[int, int, int]] = []
        least = COARSE_SHARE * needed
        for cells in best_first(bounds):
            if len(found) == config.candidates:
                least = max(least, float(values[found[-1]]))
            cells = cells[bounds.flat[cells] > least]
            if not cells.size:
                break
            scored = grid.scores_above(cells, least, self.threads)
            values.flat[cells], headings.flat[cells] = scored.max(axis=1), scored.argmax(axis=1)
            found = apart(values, config.candidates)
        return [
            np.array([cpa_time[t], cpa_range[i], course[headings[t, i, j]], speed[j]]) for t, i, j in found
        ]

    def _level(
        self,
        centre: np.ndarray,
        level: Level,
        scores: ScoreMaps,
        best: float = -np.inf,
        point: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray | None]:
        """Best score and hypothesis of a grid around `centre`, or `best` and `point` where none is better."""
        axes = [
            c + np.arange(-h, h + s / 2, s) for c, h, s in zip(centre, level.half, level.step, strict=True)
        ]
        cpa_time, cpa_range, course, speed = axes
        speed = speed[(speed >= self.config.min_speed_mps) & (speed <= self.config.max_speed_mps)]
        if not len(speed):
            return best, point
        if not self.sees_course:
            cpa_range, course = cpa_range[cpa_range >= 0.0], centre[2:3]
        grid = CourseGrid(cpa_time, cpa_range, speed, course, self.tiles, self.delay, scores)
        bounds = grid.bounds(self.threads)
        for cells in best_first(bounds):
            cells = cells[bounds.flat[cells] > best]
            if not cells.size:
                break
            scored = grid.scores(cells)
            cell, q = np.unravel_index(scored.argmax(), scored.shape)
            if scored[cell, q] > best:
                best = float(scored[cell, q])
                t, i, j = np.unravel_index(cells[cell], bounds.shape)
                point = np.array([cpa_time[t], cpa_range[i], course[q] % 360.0, speed[j]])
        return best, point

    def _track(self, best: np.ndarray, speed: tuple[float, float] | None, scores: ScoreMaps) -> Track:
        """The posterior around the best hypothesis, with what lines say of its speed, as a track."""
        config = self.config
        seen = np.array([True, True, self.sees_course, True])
        heard = shares(best, self.tiles, self.delay, scores)
        # Where range maps deny what lines tell, they would lead back to the ghost that lines overruled.
        denied = speed is not None and heard.net_ranged <= 0.0
        silent = self.sees_course and (heard.ranged < SILENT or denied)
        if silent:
            scores = scores.without_range()

        why = " from the Doppler shift of its lines"
        if silent and speed is None:
            if self.lines is not None:
                speed = self.lines.speed(best, self._scales(best), self.tiles, self.delay, scores)
            speed, why = (USUAL_MPS, "") if speed is None else (speed, why)
        log_likelihood = self._log_likelihood(scores, speed)
        known = posterior(best, log_likelihood, self._inside, seen, samples=config.samples, seed=config.seed)
        mean, cov = known.mean, known.covariance
        score, per_tile = score_points(best[None], self.tiles, self.delay, scores)
        lo, hi = best_run(per_tile[:, 0])
        volume = (
            (self.tiles[-1] + 3600.0) * config.max_cpa_range_m * (config.max_speed_mps - config.min_speed_mps)
        )
        volume *= 720.0 if self.sees_course else 1.0
        log_bayes_factor = float(known.log_evidence - np.log(volume) - self._runs)
        if not self.sees_course:
            cov[2, :] = cov[:, 2] = 0.0
            cov[2, 2] = np.inf
        fixed = (
            fixed_source(self.tiles, scores, lo, hi, config.still_deg_per_hour) if self.sees_course else 0.0
        )
        swims = -np.inf
        if not silent and mean[3] < SLOW * config.min_speed_mps:
            fastest = SWIMS * config.min_speed_mps
            swims = swimming_source(best, self.tiles, self.delay, scores, lo, hi, fastest)
        method = "grid search" if self.sees_course else "grid search, no azimuth maps: course not observed"
        if silent:
            method = f"grid search, no range {'heard' if self.sees_range else 'maps'}"
        if speed is not None:
            method += f": speed taken as {speed[0]:.3g} ± {speed[1]:.2g} m/s{why}"
        ghost = None
        if self.sees_course and not silent:
            ghost = other_scale(
                best, self.tiles, self.delay, scores, config.min_speed_mps, config.max_speed_mps
            )
            if ghost is not None:
                method += (
                    f"; nearly as likely {ghost * abs(mean[1]) / 1e3:.1f} km at {ghost * mean[3]:.1f} m/s"
                )
        extra = {
            "score": float(score[0]),
            "heard": float((per_tile[lo : hi + 1, 0] > 0).mean()),
            "pointed": heard.pointed,
            "agreeing": heard.agreeing if self.sees_course and not silent else 1.0,
            "other_scale": 1.0 if ghost is None else ghost,
            "steady": two_steady(scores.azimuth_score[lo : hi + 1]) if silent else -np.inf,
            "log_bayes_factor_fixed": config.exponent * (float(score[0]) - fixed),
            "log_bayes_factor_swims": config.exponent * (float(score[0]) - swims),
        }
        start, end = float(self.origin + self.tiles[lo]), float(self.origin + self.tiles[hi])
        track = Track(start, end, self._course(mean), cov, log_bayes_factor, method, extra)
        worth = log_bayes_factor >= config.min_log_bayes_factor and believable(track, config)
        if worth and self.sees_course and self.sees_range:
            track = self._bent(track, known, scores, speed)
        return track

    def _log_likelihood(
        self, scores: ScoreMaps, speed: tuple[float, float] | None, reach_s: np.ndarray | None = None
    ) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Log-likelihood of points and each tile's share of it; of a ship whose range is not heard with what is known of its speed."""
        exponent, spread = self.config.exponent, self.config.max_speed_mps - self.config.min_speed_mps

        def log_likelihood(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            total, per_tile = score_points(points, self.tiles, self.delay, scores, reach_s)
            prior = 0.0 if speed is None else usual(points[:, 3], spread, speed)
            return exponent * total + prior, exponent * per_tile

        return log_likelihood

    def _bent(
        self, track: Track, straight: Posterior, scores: ScoreMaps, speed: tuple[float, float] | None
    ) -> Track:
        """A believable track, its course marginalised over bends; a bent course where the data ask for it."""
        heard = (np.array([track.start, track.end]) - self.origin - straight.mean[0]) * [-1.0, 1.0]
        reach = np.maximum(heard, 0.0) + MARGIN_S
        config = self.config
        # What a turn explains may be another ship's: it must gain as much as a further ship.
        found = bends(
            straight, self._log_likelihood(scores, speed, reach), self._inside, reach,
            least_of_turn=config.min_log_bayes_factor_next, samples=config.samples, seed=config.seed,
        )  # fmt: skip
        mean = found.mean
        changes: dict[str, Any] = {"covariance": found.covariance}
        if found.bent:
            score, per_tile = score_points(mean[None], self.tiles, self.delay, scores, reach)
            lo, hi = best_run(per_tile[:, 0])
            heard_share = float((per_tile[lo : hi + 1, 0] > 0).mean())
            changes |= {
                "start": float(self.origin + self.tiles[lo]),
                "end": float(self.origin + self.tiles[hi]),
                "motion": self._course(mean, reach),
                "log_bayes_factor": track.log_bayes_factor + found.log_evidence - straight.log_evidence,
                "extra": track.extra | {"score": float(score[0]), "heard": heard_share},
            }
        return replace(track, **changes)

    def _course(self, mean: np.ndarray, reach: np.ndarray | None = None) -> StraightCourse:
        """The course of a hypothesis; bent where it has bends, over `reach` [s] before and after CPA."""
        state = (self.origin + float(mean[0]), float(mean[1]), float(mean[2] % 360.0), float(mean[3]))
        if reach is None:
            return StraightCourse(*state)
        across, along = mean[BENDS].reshape(-1, 2, 2).transpose(1, 0, 2).tolist()
        turn_s, turn_deg = mean[TURN].tolist()
        terms = tuple(map(tuple, across)), tuple(map(tuple, along))
        return BentCourse(*state, tuple(reach.tolist()), *terms, turn_s, turn_deg)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        config = self.config
        # Without azimuths both sides say the same: starboard stands for both, as in the volume of the prior.
        least = -config.max_cpa_range_m if self.sees_course else 0.0
        return (
            (points[:, 1] >= least)
            & (points[:, 1] <= config.max_cpa_range_m)
            & (points[:, 3] >= config.min_speed_mps)
            & (points[:, 3] <= config.max_speed_mps)
            & (points[:, 0] >= -1800.0)
            & (points[:, 0] <= self.tiles[-1] + 1800.0)
        )

    def heard_m(self, track: Track) -> float:
        """Distance [m] up to which a track may be heard, by where it was."""
        return LINGERS * float(track.motion.observables(np.array([track.start, track.end]))[1].max())

    def _score_maps(
        self,
        azimuth_llr: np.ndarray | None,
        range_llr: np.ndarray | None,
        jointly: bool,
        pool: int,
        stds: tuple[float, float, float],
    ) -> ScoreMaps:
        """Score maps at one smoothing: range [m], after means over `pool` grid steps, azimuth [deg], range rate [m/s]."""
        config, n = self.config, len(self.tiles)
        spacing, rate_step = (float(axis[1] - axis[0]) for axis in (self.range_m, self.rate))
        step = float(self.azimuth[1] - self.azimuth[0])
        azimuth_score = np.zeros((n, len(self.azimuth)), np.float32)
        if azimuth_llr is not None:
            azimuth_score = azimuth_scores(
                azimuth_llr, stds[1] / step, config.tile_bound, config.azimuth_detection_probability
            )
        range_score = np.zeros((n, 2, 2), np.float32)
        if range_llr is not None:
            bins = stds[0] / (spacing * pool), stds[2] / rate_step
            range_score = range_scores(
                range_llr, pool, bins, config.tile_bound, config.range_detection_probability
            )
        first = float(self.range_m[0]) + spacing * (pool - 1) / 2
        geometry = np.array([first, spacing * pool, float(self.rate[0]), rate_step])
        return ScoreMaps(range_score, geometry, azimuth_score, step, jointly)
