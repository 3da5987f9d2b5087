import numpy as np
import pytest

from obsnet.errors import ConfigError, FilterError
from obsnet.trackers.bernoulli_filter import BernoulliConfig, BernoulliFilter, move
from obsnet.trackers.particles import systematic_resampling

LENGTH = 20.0


def still(states):
    return states


def uniform(rng, count):
    return rng.uniform(0.0, LENGTH, (1, count))


def test_a_ratio_that_is_the_same_everywhere_gives_the_scalar_recursion():
    config = BernoulliConfig(survival=0.95, birth=0.02, particles=50, births=20)
    rng = np.random.default_rng(1)
    filter_ = BernoulliFilter(config, uniform(rng, 50), existence=0.1)
    q = 0.1
    for llr in rng.normal(0.0, 2.0, 40):
        filter_.step(still, uniform(rng, 20), lambda states, llr=llr: np.full(states.shape[1], llr), rng)
        predicted = 0.02 * (1 - q) + 0.95 * q
        q = predicted * np.exp(llr) / (1 - predicted + predicted * np.exp(llr))
        assert filter_.existence == pytest.approx(q, rel=1e-12)
    filter_.step(still, uniform(rng, 20), None, rng)
    assert filter_.existence == pytest.approx(0.02 * (1 - q) + 0.95 * q, rel=1e-12)


class Grid:
    """The same filter with the state on a fine grid of a circle: eqs 3 and 4 as sums, no particles."""

    def __init__(self, cells, step_std, survival, birth):
        self.x = (np.arange(cells) + 0.5) * LENGTH / cells
        apart = (self.x[:, None] - self.x + LENGTH / 2) % LENGTH - LENGTH / 2
        kernel = np.exp(-0.5 * (apart / step_std) ** 2)
        self.kernel = kernel / kernel.sum(axis=0)
        self.survival, self.birth = survival, birth
        self.q, self.s = 0.0, np.full(cells, 1.0 / cells)

    def step(self, llr, birth_density):
        predicted = self.birth * (1 - self.q) + self.survival * self.q
        s = self.birth * (1 - self.q) * birth_density + self.survival * self.q * (self.kernel @ self.s)
        s *= np.exp(llr) / predicted
        self.q = predicted * s.sum() / (1 - predicted + predicted * s.sum())
        self.s = s / s.sum()


def test_particles_agree_with_the_same_recursion_on_a_grid():
    truth, std, step_std = 7.0, 1.5, 0.3
    config = BernoulliConfig(survival=0.9, birth=0.05, particles=20_000, births=10_000)
    grid = Grid(400, step_std, 0.9, 0.05)
    rng = np.random.default_rng(2)
    filter_ = BernoulliFilter(config, uniform(rng, 20_000))

    def llr(x, seen):
        away = (x - seen + LENGTH / 2) % LENGTH - LENGTH / 2
        return np.log(0.6 + 0.4 * np.exp(-0.5 * (away / std) ** 2) * LENGTH / std / np.sqrt(2 * np.pi))

    previous = None
    for batch in range(30):
        seen = truth + std * rng.normal() if 8 <= batch < 22 else rng.uniform(0, LENGTH)
        density = np.ones(400) if previous is None else np.exp(llr(grid.x, previous))
        births = uniform(rng, 10_000)
        weights = None if previous is None else llr(births[0], previous)
        filter_.step(
            lambda states: (states + step_std * rng.normal(size=states.shape)) % LENGTH,
            births,
            lambda states, seen=seen: llr(states[0], seen),
            rng,
            weights,
        )
        grid.step(llr(grid.x, seen), density / density.sum())
        previous = seen
        assert filter_.existence == pytest.approx(grid.q, abs=0.015)
        turn = np.exp(2j * np.pi * filter_.states[0] / LENGTH).mean()
        assert abs(turn - grid.s @ np.exp(2j * np.pi * grid.x / LENGTH)) < 0.03
    assert 0.005 < grid.q < 0.9, "the case must exercise appearance and disappearance"


def test_weighted_births_are_worth_births_drawn_with_those_weights():
    config = BernoulliConfig(survival=0.9, birth=0.5, particles=10, births=50_000)
    rng = np.random.default_rng(3)
    candidates = uniform(rng, 50_000)
    weights = -0.5 * (candidates[0] - 5.0) ** 2
    drawn = candidates[:, systematic_resampling(weights, rng)]

    def likelihood(states):
        return np.log(3.0) - 0.5 * (states[0] - 6.0) ** 2

    existences = []
    for births, log_weights in ((candidates, weights), (drawn, None)):
        filter_ = BernoulliFilter(config, uniform(rng, 10))
        existences.append(filter_.step(still, births, likelihood, rng, log_weights))
    assert existences[0] == pytest.approx(existences[1], rel=0.01)


def test_a_replaced_share_lets_a_filter_leave_a_wrong_branch_without_changing_the_existence():
    rng = np.random.default_rng(7)
    found = []
    for replacement in (0.0, 0.05):
        config = BernoulliConfig(
            survival=0.9, birth=0.1, replacement=replacement, particles=2000, births=1000
        )
        filter_ = BernoulliFilter(config, np.full((1, 2000), 3.0), existence=0.999999)
        filter_.step(still, np.full((1, 1000), 15.0), None, rng)
        assert filter_.existence == pytest.approx(0.9, rel=1e-5)
        found.append(np.mean(filter_.states[0] == 15.0))
    assert found[0] < 1e-3
    assert found[1] == pytest.approx(0.05, abs=1e-3)


def test_certainty_neither_overflows_nor_sticks():
    config = BernoulliConfig(survival=0.999, birth=1e-5, particles=10, births=10)
    rng = np.random.default_rng(4)
    filter_ = BernoulliFilter(config, uniform(rng, 10))
    for _ in range(50):
        filter_.step(still, uniform(rng, 10), lambda states: np.full(states.shape[1], 900.0), rng)
    assert filter_.existence == 1.0 and filter_.confirmed
    for _ in range(3):
        filter_.step(still, uniform(rng, 10), lambda states: np.full(states.shape[1], -900.0), rng)
    assert filter_.existence < 1e-5 and not filter_.confirmed
    filter_.step(still, uniform(rng, 10), lambda states: np.full(states.shape[1], 20.0), rng)
    assert filter_.confirmed


@pytest.mark.parametrize(("value", "message"), [(-np.inf, "weights are zero"), (np.nan, "NaN")])
def test_dead_weights_fail_loudly_and_leave_the_filter_as_it_was(value, message):
    rng = np.random.default_rng(5)
    filter_ = BernoulliFilter(BernoulliConfig(particles=10, births=5), uniform(rng, 10), existence=0.3)
    before = filter_.states.copy()
    with pytest.raises(FilterError, match=message):
        filter_.step(still, uniform(rng, 5), lambda states: np.full(states.shape[1], value), rng)
    assert filter_.existence == 0.3
    np.testing.assert_array_equal(filter_.states, before)


def test_motion_has_the_covariance_of_white_acceleration():
    rng = np.random.default_rng(6)
    states = np.tile([[10.0], [2.0], [5.0]], 200_000)
    moved = move(states, 0.5, 0.8, rng)
    np.testing.assert_allclose(moved.mean(axis=1), [11.0, 2.0, 5.0], atol=2e-3)
    shape = np.array([0.5**2 / 2, 0.5])
    np.testing.assert_allclose(np.cov(moved[:2]), 0.64 * np.outer(shape, shape), rtol=0.02)
    np.testing.assert_array_equal(states[0], 10.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"survival": 1.0}, "survival must lie between 0 and 1, found 1.0"),
        ({"birth": 0.0}, "birth"),
        ({"confirmation": 1.5}, "confirmation"),
        ({"replacement": 1.0}, "replacement"),
        ({"particles": 0}, "particles"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        BernoulliConfig(**settings)


def test_impossible_beginnings_are_refused():
    with pytest.raises(ConfigError, match="finite states"):
        BernoulliFilter(BernoulliConfig(), np.array([[np.nan]]))
    with pytest.raises(ConfigError, match="existence"):
        BernoulliFilter(BernoulliConfig(), np.zeros((1, 3)), existence=1.0)
