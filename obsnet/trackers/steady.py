"""Sources that stay where they are or swim about, which a track must outdo: a singing whale, lobes of distant noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from obsnet.kinematics import StraightCourse, emission
from obsnet.trackers.course_grid import Delay, score_points
from obsnet.trackers.score_maps import ScoreMaps, azimuth_scores, tiles
from obsnet.trackers.search_config import SMOOTHING, GridSearchConfig
from obsnet.trackers.track import Segment, Track

SWIMS = 0.8
"""Of the least speed of a ship, the greatest of a source that swims about."""

SWIM_SPEEDS, SWIM_COURSES_DEG = 4, 22.5
SWIM_ABOUT_DEG, SWIM_ABOUT_M = np.arange(-4.0, 4.1, 2.0), np.arange(-1200.0, 1201.0, 400.0)
"""How finely, and how far about a course's middle, one that swims is looked for."""


def fixed_source(tiles: np.ndarray, scores: ScoreMaps, lo: int, hi: int, still_deg_per_hour: float) -> float:
    """Best score over the tiles lo … hi of a source that hardly moves in azimuth, such as a singing whale."""
    held = np.arange(lo, hi + 1)
    hours = (tiles[held] - tiles[held].mean()) / 3600.0
    bins = scores.azimuth_score.shape[1]
    azimuth = np.arange(bins)
    best = -np.inf
    for drift in np.linspace(-still_deg_per_hour, still_deg_per_hour, 9):
        shift = np.round(drift * hours / scores.azimuth_step).astype(int)
        best = max(best, scores.azimuth_score[held, (azimuth[:, None] + shift) % bins].sum(axis=1).max())
    return float(best)


def swimming_source(
    best: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps, lo: int, hi: int, fastest_mps: float
) -> float:
    """Best score over the tiles lo … hi of a source about where a course is in their middle, that moves at `fastest_mps` at most.

    Parameters
    ----------
    best : (4) CPA time [s on the clock of `tiles`], signed CPA range [m], course [deg], speed [m/s] of the course.
    """
    cpa_time, cpa_range, course, speed = (float(value) for value in best)
    middle = 0.5 * float(tiles[lo] + tiles[hi])
    azimuth, distance, _ = StraightCourse(cpa_time, cpa_range, course, speed).observables(np.array(middle))
    steps = fastest_mps / SWIM_SPEEDS * np.arange(1, SWIM_SPEEDS + 1)
    places = np.meshgrid(
        np.deg2rad(azimuth + SWIM_ABOUT_DEG),
        np.maximum(distance + SWIM_ABOUT_M, 0.0),
        np.arange(0.0, 360.0, SWIM_COURSES_DEG),
        steps,
        indexing="ij",
    )
    towards, at, courses, speeds = (place.ravel() for place in places)
    east, north, heading = at * np.sin(towards), at * np.cos(towards), np.deg2rad(courses)
    ahead, side = (
        east * np.sin(heading) + north * np.cos(heading),
        east * np.cos(heading) - north * np.sin(heading),
    )
    points = np.stack([middle - ahead / speeds, side, courses, speeds], axis=1)
    held = slice(lo, hi + 1)
    return float(score_points(points, tiles[held], delay, scores.part(held))[0].max())


def two_steady(azimuth_score: np.ndarray) -> float:
    """Best score of two sources that stay where they are, in each tile the likelier of them: lobes of noise that take turns.

    Parameters
    ----------
    azimuth_score : (n_tiles, n_azimuth) of `ScoreMaps`.
    """
    every = max(azimuth_score.shape[1] // 180, 1)
    some = azimuth_score[:, ::every]
    return max(float(np.maximum(some, one[:, None]).sum(axis=0).max()) for one in some.T)


def outdoes_steady_sources(
    maps: xr.Dataset, track: Track, delay: Callable[[np.ndarray], np.ndarray], config: GridSearchConfig
) -> bool:
    """Whether azimuth maps speak more for a track than for two sources that stay where they are."""
    read = tiles(maps, Segment(track.start, track.end), config.tile_s)
    if read is None or read[1] is None:
        return False
    times, azimuth_llr = read[0], read[1]
    azimuth = maps["azimuth"].values
    step = float(azimuth[1] - azimuth[0])
    scores = azimuth_scores(
        azimuth_llr, SMOOTHING[1] / step, config.tile_bound, config.azimuth_detection_probability
    )
    towards, _, _ = track.motion.observables(emission(track.motion, times, delay))
    place = np.round((towards - azimuth[0]) / step).astype(int) % len(azimuth)
    return float(scores[np.arange(len(times)), place].sum()) > two_steady(scores)
