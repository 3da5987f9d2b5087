"""Density-based clusters (DBSCAN) of points in a few dimensions, on scipy alone."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from obsnet.errors import ConfigError

NOISE = -1


def dbscan(points: np.ndarray, radius: float, min_points: int = 1) -> np.ndarray:
    """Cluster label of each point; `NOISE` (−1) where it belongs to none.

    A core point has at least `min_points` points, itself included, within `radius` (inclusive). Clusters are
    the connected components of the core points; another point within `radius` of a core point joins the
    cluster found first (the one with the lowest label); the rest is noise. Labels count from 0 in the order
    in which clusters first appear among core points.

    Parameters
    ----------
    points : array, dims (point, coordinate) or (point,)
        Euclidean distance is taken as it is: scale the coordinates beforehand.
    radius : float
        In the points' units, positive.
    min_points : int
        With 1 every point is a core point and the clusters are single-linkage groups.

    Returns
    -------
    array of int, dims (point,)

    Raises
    ------
    ConfigError
        The radius is not positive and finite, `min_points` is below 1, or a coordinate is not finite.

    Source: Ester et al. 1996, KDD-96.

    >>> dbscan([1.0, 2.0, 3.0, 9.0], radius=1.0).tolist()
    [0, 0, 0, 1]
    """
    points = np.asarray(points, float)
    points = points[:, None] if points.ndim == 1 else points
    _check(points, radius, min_points)
    count = len(points)
    if count == 0:
        return np.empty(0, int)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    neighbours = np.bincount(pairs.ravel(), minlength=count) + 1
    core = neighbours >= min_points
    labels = np.full(count, NOISE)
    inner = pairs[core[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(inner)), (inner[:, 0], inner[:, 1])), shape=(count, count))
    component = connected_components(graph, directed=False)[1][core]
    _, first, inverse = np.unique(component, return_index=True, return_inverse=True)
    order = np.empty(len(first), int)
    order[np.argsort(first)] = np.arange(len(first))
    labels[core] = order[inverse]
    _join_borders(labels, core, pairs)
    return labels


def _join_borders(labels: np.ndarray, core: np.ndarray, pairs: np.ndarray) -> None:
    reaching = np.concatenate([pairs, pairs[:, ::-1]])
    reaching = reaching[core[reaching[:, 0]] & ~core[reaching[:, 1]]]
    nearest = np.full(len(labels), np.iinfo(int).max)
    np.minimum.at(nearest, reaching[:, 1], labels[reaching[:, 0]])
    border = ~core & (nearest < np.iinfo(int).max)
    labels[border] = nearest[border]


def _check(points: np.ndarray, radius: float, min_points: int) -> None:
    if not (np.isfinite(radius) and radius > 0):
        raise ConfigError(f"the clustering radius must be positive and finite, found {radius!r}")
    if min_points < 1:
        raise ConfigError(f"a cluster needs at least 1 point, found min_points={min_points!r}")
    if not np.isfinite(points).all():
        raise ConfigError("points to cluster must be finite; drop the missing ones first")
