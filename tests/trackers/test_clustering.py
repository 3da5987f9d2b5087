import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.trackers.clustering import NOISE, dbscan


def partitions_agree(ours, theirs, core):
    """Same noise, and core points grouped alike whatever the names of the groups."""
    assert (ours == NOISE).tolist() == (theirs == NOISE).tolist()
    pairs = set(zip(ours[core].tolist(), theirs[core].tolist(), strict=True))
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("min_points", [1, 2, 4, 7])
def test_clusters_are_those_of_scikit_learn(seed, min_points):
    cluster = pytest.importorskip("sklearn.cluster")
    rng = np.random.default_rng(seed)
    centres = rng.uniform(0, 10, (4, 2))
    points = np.concatenate([rng.normal(c, 0.3, (15, 2)) for c in centres] + [rng.uniform(0, 10, (20, 2))])
    oracle = cluster.DBSCAN(eps=0.5, min_samples=min_points).fit(points)
    ours = dbscan(points, 0.5, min_points)
    partitions_agree(ours, oracle.labels_, oracle.core_sample_indices_)


def test_border_points_join_a_cluster_that_reaches_them():
    points = np.array([0.0, 0.1, 0.2, 0.3, 1.2, 5.0])
    assert dbscan(points, radius=1.0, min_points=4).tolist() == [0, 0, 0, 0, 0, NOISE]


def test_the_radius_is_inclusive_and_labels_follow_the_order_of_points():
    assert dbscan(np.array([9.0, 1.0, 2.0]), radius=1.0).tolist() == [0, 1, 1]
    assert dbscan(np.array([9.0, 1.0, 2.0]), radius=0.999).tolist() == [0, 1, 2]


def test_no_points_no_clusters():
    assert dbscan(np.empty((0, 2)), 1.0).tolist() == []


@pytest.mark.parametrize(
    ("points", "radius", "min_points", "message"),
    [
        ([1.0], 0.0, 1, "radius must be positive"),
        ([1.0], np.nan, 1, "radius must be positive"),
        ([1.0], 1.0, 0, "at least 1 point"),
        ([1.0, np.nan], 1.0, 1, "must be finite"),
    ],
)
def test_bad_requests_are_refused(points, radius, min_points, message):
    with pytest.raises(ConfigError, match=message):
        dbscan(points, radius, min_points)
