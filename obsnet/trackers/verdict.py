"""What the search has found: whether it is a ship, one ship, and no remainder of a known one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from obsnet.trackers.search_config import GridSearchConfig
from obsnet.trackers.track import Track

LOOSEST = (3600.0, 15_000.0)
"""Standard deviations of CPA time [s] and range [m] from which on nothing is located."""

LOOSEST_NEXT = (900.0, 3000.0)
"""The same of a further ship: what is left of a known one is a piece of course that fits many."""

SHARP = (120.0, 500.0)
"""Standard deviations of CPA time [s] and range [m] of what is located sharply, as what is left of a known ship is not."""

BRIEF = 0.5
"""Share of `shortest_s` for which such a ship must be heard, if it moves beyond the doubt that is allowed a ship apart."""

EDGE_STD = 4.0
"""Standard deviations from the edge of the prior at which a speed no longer lies against it."""

APART = 0.1
"""Share of the time that a ship is heard up to which others may be heard in it too for it to be apart from them."""

AGREEING = 0.5
"""Share of the tiles in which the sensor that hears a ship less hears it, in which the other one must hear it too: else the course
is one ship's range and another's azimuth."""


GHOST = 0.3
"""Share of tracks beside which range maps say nearly as much for a ghost, of simulated ships, that are the ghost."""


def believable(track: Track, config: GridSearchConfig) -> bool:
    """Whether a track moves as a ship does, is known well enough to be one, and lies within the prior, not against its edge."""
    slack = min(0.02 * (config.max_speed_mps - config.min_speed_mps), EDGE_STD * track.std[3])
    within_speed = config.min_speed_mps + slack < track.motion.speed_mps < config.max_speed_mps - slack
    moving = track.extra["log_bayes_factor_fixed"]
    brief = BRIEF if is_sharp(track) and moving >= config.min_log_bayes_factor_apart else 1.0
    long_enough = track.end - track.start >= brief * config.shortest_s - config.tile_s
    within_range = abs(track.motion.cpa_range_m) < 0.98 * config.max_cpa_range_m
    located = track.std[0] < LOOSEST[0] and track.std[1] < LOOSEST[1]
    moves = min(moving, track.extra.get("log_bayes_factor_swims", np.inf)) >= config.min_log_bayes_factor
    moves &= track.extra.get("score", 0.0) > track.extra.get("steady", -np.inf)
    return bool(long_enough and within_speed and within_range and located and moves and is_one(track))


def required(track: Track, others: Sequence[Track], config: GridSearchConfig) -> float:
    """The log Bayes factor that a track must reach beside what else is known."""
    if not others or is_sharp(track):
        return config.min_log_bayes_factor
    shared = sum(min(track.end, other.end) - max(track.start, other.start) for other in others
                 if other.start < track.end and other.end > track.start)  # fmt: skip
    alone = shared < APART * (track.end - track.start)
    return config.min_log_bayes_factor_apart if alone else config.min_log_bayes_factor_next


def as_stated(track: Track, range_scale_std: float) -> Track:
    """A track whose covariance covers what its own maps cannot tell: by how much they scale CPA range and speed alike.

    To the propagation table's own error, `range_scale_std`, comes the ghost for which range maps say nearly as much, if there is
    one: the mean square about what is stated of a ship that, with probability `GHOST`, is at `extra["other_scale"]` times the CPA
    range and speed. Verdicts are of a track before this: what all tracks share tells none from a remainder.
    """
    apart = track.extra.get("other_scale", 1.0) - 1.0
    along = np.array([0.0, track.motion.cpa_range_m, 0.0, track.motion.speed_mps])
    variance = range_scale_std**2 + GHOST * apart**2
    return replace(track, covariance=track.covariance + variance * np.outer(along, along))


def is_sharp(track: Track) -> bool:
    """Whether a track's CPA is located sharply."""
    return bool(track.std[0] < SHARP[0] and track.std[1] < SHARP[1])


def is_one(track: Track) -> bool:
    """Whether a track's range and azimuth are heard in the same tiles, as one ship's are."""
    return bool(track.extra.get("agreeing", 1.0) >= AGREEING)


def is_no_remainder(track: Track) -> bool:
    """Whether a further ship is heard, and located, as what is left of a known one is not."""
    located = track.std[0] < LOOSEST_NEXT[0] and track.std[1] < LOOSEST_NEXT[1]
    return bool(located and track.extra["heard"] >= 0.5)


def is_cut_off(track: Track, begin: float, end: float) -> bool:
    """Whether a further ship is heard to where another segment is, before `begin` or after `end` [s since 1970], and not about its
    CPA, nor located sharply: it is then that segment's, which hears it on; so short a piece of it fits many courses.
    """
    passes = track.start <= track.motion.cpa_time <= track.end
    return not (passes or is_sharp(track)) and bool(track.start <= begin or track.end >= end)
