import numpy as np
import pytest

from obsnet.trackers.false_alarms import LOWEST_COUNT, FalseAlarms

WINDOW = (0.3, 6.3)


def test_rate_and_density_of_uniform_false_alarms_are_learned():
    rng = np.random.default_rng(0)
    for resolution in (0.0, 0.05):
        clutter = FalseAlarms(1.0, WINDOW, memory_s=6000.0, resolution_s=resolution)
        for _ in range(1000):
            delays = rng.uniform(*WINDOW, rng.poisson(3.0))
            clutter.learn(delays, np.ones(len(delays)), 60.0)
        assert clutter.count == pytest.approx(3.0, rel=0.15)
        grid = np.linspace(*WINDOW, 2000)
        assert clutter.density(grid).mean() == pytest.approx(0.5, rel=0.15)


def test_lines_that_stay_put_are_known_where_they_are():
    clutter = FalseAlarms(1.0, WINDOW, memory_s=600.0, resolution_s=0.05)
    for _ in range(60):
        clutter.learn(np.array([2.13]), np.ones(1), 60.0)
    on, beside = clutter.density(np.array([2.13, 3.5]))
    # One a scan within a node's reach, half of the density kept uniform.
    assert on > 0.5 / 0.1 and beside == pytest.approx(0.5 / 6.0, rel=0.05)


def test_what_a_source_explains_is_no_false_alarm():
    clutter = FalseAlarms(1.0, WINDOW, memory_s=60.0, resolution_s=0.05)
    for _ in range(100):
        clutter.learn(np.array([2.13]), np.zeros(1), 60.0)
    assert clutter.count < 1e-6
    np.testing.assert_allclose(clutter.density(np.array([1.0, 2.13])), LOWEST_COUNT / 6.0)


def test_nothing_is_learned_where_memory_is_infinite():
    clutter = FalseAlarms(4.0, (0.0, 0.1), np.inf)
    clutter.learn(np.array([0.01, 0.02]), np.ones(2), 3.0)
    assert clutter.count == 4.0
    np.testing.assert_array_equal(clutter.density(np.array([0.0, 0.05])), 40.0)
