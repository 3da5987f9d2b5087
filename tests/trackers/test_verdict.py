"""What a found track must be: within the prior, located, its own segment's."""

from dataclasses import replace

import numpy as np
import pytest

from obsnet.kinematics import StraightCourse
from obsnet.trackers.search_config import GridSearchConfig
from obsnet.trackers.track import Track
from obsnet.trackers.verdict import GHOST, as_stated, believable, is_cut_off

CONFIG = GridSearchConfig()
END = 7200.0


def track(start=3600.0, end=END, cpa_time=5400.0, speed=8.0, std=(200.0, 900.0, 3.0, 0.3)):
    course = StraightCourse(cpa_time, 8000.0, 40.0, speed)
    return Track(
        start,
        end,
        course,
        np.diag(np.square(std)),
        200.0,
        extra={"log_bayes_factor_fixed": 100.0, "score": 220.0},
    )


@pytest.mark.parametrize(
    ("found", "cut_off"),
    [
        (track(cpa_time=9000.0), True),
        (track(cpa_time=3000.0), True),  # the piece fits a course that has passed, too
        (track(cpa_time=5400.0), False),
        (track(end=END - 600.0, cpa_time=9000.0), False),
        (track(cpa_time=7300.0, std=(20.0, 100.0, 1.0, 0.1)), False),
    ],
)
def test_a_piece_at_a_cut_is_the_next_segments(found, cut_off):
    assert is_cut_off(found, -np.inf, END) == cut_off
    assert not is_cut_off(found, -np.inf, np.inf)
    mirrored = replace(
        found,
        start=-found.end,
        end=-found.start,
        motion=replace(found.motion, cpa_time=-found.motion.cpa_time),
    )
    assert is_cut_off(mirrored, -END, np.inf) == cut_off


@pytest.mark.parametrize(
    ("speed", "std", "ship"),
    [
        (3.15, 0.02, True),
        (3.15, 0.1, False),
        (3.3, 0.1, True),
        (14.9, 0.02, True),
        (14.9, 0.1, False),
        (3.01, 0.02, False),
    ],
)
def test_a_speed_at_the_edge_of_the_prior_must_be_known_to_lie_within(speed, std, ship):
    assert (CONFIG.min_speed_mps, CONFIG.max_speed_mps) == (3.0, 15.0)
    assert believable(track(speed=speed, std=(60.0, 400.0, 2.0, std)), CONFIG) == ship


def test_a_track_with_a_ghost_is_as_uncertain_as_not_to_know_which():
    alone = track()
    assert np.array_equal(as_stated(alone, 0.0).covariance, alone.covariance)
    found = as_stated(replace(alone, extra=alone.extra | {"other_scale": 2.0}), 0.0)
    extra = found.covariance - alone.covariance
    assert extra[1, 1] == pytest.approx(GHOST * 8000.0**2) and extra[3, 3] == pytest.approx(GHOST * 8.0**2)
    assert extra[1, 3] == pytest.approx(GHOST * 8000.0 * 8.0) and not extra[[0, 2]].any()
    assert found.motion == alone.motion
    table = as_stated(alone, 0.02).covariance - alone.covariance
    assert table[1, 1] == pytest.approx(160.0**2) and table[3, 3] == pytest.approx(0.16**2)
