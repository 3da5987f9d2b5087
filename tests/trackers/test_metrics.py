import itertools

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.trackers import metrics


def ospa_by_enumeration(distances, cutoff, order):
    """The definition, over all permutations."""
    d = np.minimum(distances, cutoff) ** order
    d = d if d.shape[0] <= d.shape[1] else d.T
    small, large = d.shape
    best = min(
        sum(d[i, j] for i, j in enumerate(chosen)) for chosen in itertools.permutations(range(large), small)
    )
    return ((best + cutoff**order * (large - small)) / large) ** (1 / order)


def gospa_by_enumeration(distances, cutoff, order):
    """Minimum over partial assignments: a target is assigned or missed, an estimate assigned or false."""
    truths, estimates = distances.shape
    best = np.inf
    for size in range(min(truths, estimates) + 1):
        for rows in itertools.combinations(range(truths), size):
            for columns in itertools.permutations(range(estimates), size):
                localisation = sum(distances[i, j] ** order for i, j in zip(rows, columns, strict=True))
                best = min(best, localisation + cutoff**order / 2 * (truths + estimates - 2 * size))
    return best ** (1 / order)


@pytest.mark.parametrize("order", [1.0, 2.0])
@pytest.mark.parametrize("sizes", [(1, 1), (3, 2), (2, 4), (4, 4)])
def test_distances_are_those_of_the_definitions(order, sizes):
    distances = np.random.default_rng(sum(sizes)).uniform(0, 40, sizes)
    assert metrics.ospa(distances, 25.0, order) == pytest.approx(ospa_by_enumeration(distances, 25.0, order))
    assert metrics.gospa(distances, 25.0, order).distance == pytest.approx(
        gospa_by_enumeration(distances, 25.0, order)
    )


def test_a_single_bearing_target_costs_its_error_or_the_cutoff():
    assert metrics.ospa(metrics.angular_distances([1.0], [358.0]), 30.0) == pytest.approx(3.0)
    assert metrics.ospa(metrics.angular_distances([1.0], [120.0]), 30.0) == 30.0
    assert metrics.ospa(metrics.angular_distances([1.0], []), 30.0) == 30.0
    assert metrics.ospa(metrics.angular_distances([], []), 30.0) == 0.0


def test_gospa_says_what_was_missed_and_what_was_false():
    distances = metrics.euclidean_distances(
        [[0.0, 0.0], [100.0, 0.0]], [[3.0, 4.0], [0.0, 90.0], [0.0, 95.0]]
    )
    parts = metrics.gospa(distances, cutoff=20.0, order=1.0)
    assert (parts.localisation, parts.missed, parts.false) == (5.0, 10.0, 20.0)
    assert parts.distance == 35.0


def test_ospa_is_a_metric_on_random_sets():
    rng = np.random.default_rng(6)
    for _ in range(100):
        a, b, c = (rng.uniform(0, 50, (rng.integers(1, 4), 2)) for _ in range(3))
        ab, bc, ac = (
            metrics.ospa(metrics.euclidean_distances(x, y), 20.0, 2.0) for x, y in ((a, b), (b, c), (a, c))
        )
        assert ac <= ab + bc + 1e-9
        assert metrics.ospa(metrics.euclidean_distances(a, a), 20.0, 2.0) == 0.0


@pytest.mark.parametrize(
    ("distances", "cutoff", "order", "message"),
    [
        ([1.0], 30.0, 1.0, "dims"),
        ([[np.nan]], 30.0, 1.0, "numbers of at least 0"),
        ([[1.0]], 0.0, 1.0, "cut-off"),
        ([[1.0]], 30.0, 0.5, "order"),
    ],
)
def test_bad_requests_are_refused(distances, cutoff, order, message):
    with pytest.raises(ConfigError, match=message):
        metrics.ospa(distances, cutoff, order)
    with pytest.raises(ConfigError, match=message):
        metrics.gospa(distances, cutoff, order)
