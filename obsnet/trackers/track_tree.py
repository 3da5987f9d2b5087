"""Tree of tracks: histories of associations share the tracks on which they agree; a branch is an association.

In: filtered states after each scan. Out: one animal's smoothed track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from obsnet.trackers.kalman import smooth
from obsnet.trackers.scans import Scan

NOBODY = -1


@dataclass(frozen=True)
class AnimalTrack:
    """One animal's track, from its first click to its last one.

    Attributes
    ----------
    time : array (n,), s. clicked : bool array (n,), scans in which a click was associated.
    filtered, filtered_covariance : arrays (n, state), (n, state, state), deg and deg/s; azimuth unwrapped.
    smoothed, smoothed_covariance : the same, given all measurements of the history.
    measurements : pairs (scan, measurement) of the clicks.
    log_bayes_factor : natural log of the evidence for this animal against clutter.
    """

    time: np.ndarray
    clicked: np.ndarray
    filtered: np.ndarray
    filtered_covariance: np.ndarray
    smoothed: np.ndarray
    smoothed_covariance: np.ndarray
    measurements: list[tuple[int, int]]
    log_bayes_factor: float

    @property
    def azimuth_deg(self) -> np.ndarray:
        """Smoothed azimuth, [0, 360)."""
        return fold(self.smoothed)[0]

    @property
    def elevation_deg(self) -> np.ndarray:
        """Smoothed elevation, deg; NaN where azimuth alone is tracked."""
        return fold(self.smoothed)[1]


@dataclass(frozen=True)
class Forecast:
    """States of the tracks that are alive, carried to the time of a scan.

    Attributes
    ----------
    tracks : int array (track,), nodes; mean, covariance : (track, state), (track, state, state).
    existence : array (track,), probability that the animal is still there. transition : (state, state).
    """

    tracks: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    existence: np.ndarray
    transition: np.ndarray


@dataclass
class TrackTree:
    """Nodes, each a track after one scan: its parent, what it took there, and its state before and after."""

    parent: list[int] = field(default_factory=list)
    scan: list[int] = field(default_factory=list)
    taken: list[tuple[int, ...]] = field(default_factory=list)
    existence: list[float] = field(default_factory=list)
    gain: list[float] = field(default_factory=list)
    mean: list[np.ndarray] = field(default_factory=list)
    covariance: list[np.ndarray] = field(default_factory=list)
    predicted: list[np.ndarray] = field(default_factory=list)
    predicted_covariance: list[np.ndarray] = field(default_factory=list)
    transition: list[np.ndarray] = field(default_factory=list)

    def add(
        self,
        parent: int,
        scan: int,
        taken: tuple[int, ...],
        existence: float,
        gain: float,
        state: tuple[np.ndarray, np.ndarray],
        before: tuple[np.ndarray, np.ndarray],
        transition: np.ndarray,
    ) -> int:
        """Number of a new node; `gain` is the log factor that its association brings."""
        self.parent.append(parent)
        self.scan.append(scan)
        self.taken.append(taken)
        self.existence.append(float(existence))
        self.gain.append(float(gain))
        self.mean.append(state[0])
        self.covariance.append(state[1])
        self.predicted.append(before[0])
        self.predicted_covariance.append(before[1])
        self.transition.append(transition)
        return len(self.parent) - 1

    def states(self, tracks: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, covariances and existence probabilities of nodes."""
        mean = np.array([self.mean[u] for u in tracks]).reshape(-1, size)
        covariance = np.array([self.covariance[u] for u in tracks]).reshape(-1, size, size)
        return mean, covariance, np.array([self.existence[u] for u in tracks], float)

    def chain(self, leaf: int) -> list[int]:
        """Nodes from a track's first scan to `leaf`."""
        nodes = []
        while leaf != NOBODY:
            nodes.append(leaf)
            leaf = self.parent[leaf]
        return [u for u in nodes[::-1] if self.scan[u] >= 0]

    def track(self, leaf: int, scans: Sequence[Scan], min_clicks: int) -> AnimalTrack | None:
        """Smoothed track that ends in `leaf`, up to its last click; None where it has too little to show."""
        chain = self.chain(leaf)
        hits = [place for place, u in enumerate(chain) if self.taken[u]]
        chain = chain[: hits[-1] + 1] if hits else []
        bayes = sum(self.gain[u] for u in chain)
        if len(hits) < min_clicks or not bayes > 0:
            return None
        columns = (self.mean, self.covariance, self.predicted, self.predicted_covariance, self.transition)
        mean, covariance, before, spread_before, moves = (np.array([c[u] for u in chain]) for c in columns)
        smoothed, spread = smooth(mean, covariance, before, spread_before, moves)
        return AnimalTrack(
            time=np.array([scans[self.scan[u]].time for u in chain]),
            clicked=np.array([bool(self.taken[u]) for u in chain]),
            filtered=mean,
            filtered_covariance=covariance,
            smoothed=smoothed,
            smoothed_covariance=spread,
            measurements=[(self.scan[u], m) for u in chain for m in self.taken[u]],
            log_bayes_factor=bayes,
        )


def fold(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth [0, 360) and elevation [−90, 90] of states (..., state); a track may run across the zenith.

    >>> [float(value) for value in fold(np.array([10.0, 100.0, 0.0, 0.0]))]
    [190.0, 80.0]
    """
    if state.shape[-1] < 4:
        return state[..., 0] % 360.0, np.full(state.shape[:-1], np.nan)
    elevation = (state[..., 1] + 180.0) % 360.0 - 180.0
    over = np.abs(elevation) > 90.0
    azimuth = np.where(over, state[..., 0] + 180.0, state[..., 0]) % 360.0
    return azimuth, np.where(over, np.sign(elevation) * 180.0 - elevation, elevation)
