"""Simulated cepstra of a sea floor whose echo is late: what is found of it, and that nothing is made up."""

import numpy as np
import pytest

from obsnet.calibration.echo import echo_delay
from obsnet.calibration.envelope import Branches, locate
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import delay_echoes, propagation
from obsnet.ocean.sound_speed import SoundSpeed
from tests.calibration.test_envelope import DEPTH, PAIRS, simulated

LIMITS = (-0.1, 0.4)


@pytest.fixture(scope="module")
def table():
    return propagation(SoundSpeed.constant(1505.0), DEPTH, Bottom(), np.arange(0.0, 80e3, 70.0))


def found(given, table, search_m=600.0):
    branches = Branches(given, table, PAIRS)
    return branches, echo_delay(branches, Amplitudes.table_ii(), LIMITS, search_m, 100.0)


@pytest.mark.parametrize("delay_s", [-0.05, 0.03, 0.2])
def test_a_late_echo_is_found_with_the_place(table, delay_s):
    offset = np.array([320.0, -210.0])
    branches, echo = found(simulated(delay_echoes(table, delay_s), offset), table)
    assert abs(echo.delay_s - delay_s) < min(3.0 * echo.std_s, 0.01)
    assert echo.std_s < 0.01
    (place,) = locate(branches.late(echo.delay_s), Amplitudes.table_ii(), 600.0, 100.0)
    assert np.hypot(place.east_m - offset[0], place.north_m - offset[1]) < 90.0


@pytest.mark.parametrize("courses", [((7000.0, 0.0), (12e3, 70.0)), ((7000.0, 0.0),)])
def test_where_echoes_are_on_time_none_is_claimed(table, courses):
    for seed in range(3):
        assert found(simulated(table, (200.0, 100.0), seed, courses=courses), table)[1] is None


def test_noise_and_too_few_frames_say_nothing(table):
    late = delay_echoes(table, 0.1)
    assert found(simulated(late, (0.0, 0.0), gain=0.0), table)[1] is None
    given = simulated(late, (0.0, 0.0))
    given.heard.alone[10:] = False
    assert found(given, table)[1] is None


def test_one_passage_alone_does_not_tell_a_late_echo_from_another_place(table):
    given = simulated(delay_echoes(table, 0.1), (0.0, 0.0), courses=((7000.0, 0.0),))
    assert found(given, table)[1] is None


def test_a_delay_at_the_edge_of_the_search_is_not_taken(table):
    branches = Branches(simulated(delay_echoes(table, 0.2), (0.0, 0.0)), table, PAIRS)
    assert echo_delay(branches, Amplitudes.table_ii(), (-0.1, 0.15), 600.0, 100.0) is None
