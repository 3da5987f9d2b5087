"""How many delays are detected that no source explains, and where: learned as it runs."""

from __future__ import annotations

import numpy as np

LOWEST_COUNT = 0.1
UNIFORM_SHARE = 0.5
"""Part of the false alarms that may fall anywhere; the rest falls where false alarms have been."""


class FalseAlarms:
    """Density of false alarms against delay, a running mean over the scans before.

    A ship's harmonics, an instrument's lines and other things that stay put are detected scan after scan at
    the same delays. Where they were, a detection says little about a source; a branch of a moving ship does
    not stay.

    Parameters
    ----------
    count : mean number per scan to begin with, anywhere in the window.
    window_s : first and last delay that is looked at, s.
    memory_s : time constant of the running mean, s; infinite: nothing is learned.
    resolution_s : spacing of the delays between which the density is linear, s; 0: the same all over the
    window.

    >>> clutter = FalseAlarms(2.0, (0.0, 4.0), memory_s=60.0)
    >>> clutter.density(np.array([1.0, 3.0])).tolist()
    [0.5, 0.5]
    """

    def __init__(
        self, count: float, window_s: tuple[float, float], memory_s: float, resolution_s: float = 0.0
    ) -> None:
        self.window_s, self.memory_s = window_s, memory_s
        width = window_s[1] - window_s[0]
        self._lowest = min(LOWEST_COUNT, count) / width
        nodes = 1 if resolution_s == 0 else max(2, round(width / resolution_s) + 1)
        self._nodes = np.linspace(*window_s, nodes)
        self.local = np.full(nodes, count / width)

    @property
    def count(self) -> float:
        """Mean number of false alarms per scan."""
        return float(self.local.mean() * (self.window_s[1] - self.window_s[0]))

    def density(self, delays_s: np.ndarray) -> np.ndarray:
        """False alarms per second of delay, at delays within the window [1/s]."""
        if len(self._nodes) == 1:
            return np.full(len(delays_s), self.local[0])
        local = np.interp(delays_s, self._nodes, self.local)
        return np.maximum(UNIFORM_SHARE * self.local.mean() + (1.0 - UNIFORM_SHARE) * local, self._lowest)

    def learn(self, delays_s: np.ndarray, unexplained: np.ndarray, elapsed_s: float) -> None:
        """Take one scan's delays, each with the probability that no source made it."""
        forgetting = -np.expm1(-elapsed_s / self.memory_s)
        found = np.zeros_like(self.local)
        if len(self._nodes) == 1:
            found[0] = unexplained.sum() / (self.window_s[1] - self.window_s[0])
        else:
            spacing = self._nodes[1] - self._nodes[0]
            place = (delays_s - self._nodes[0]) / spacing
            left = np.clip(place.astype(int), 0, len(self._nodes) - 2)
            np.add.at(found, left, unexplained * (left + 1 - place) / spacing)
            np.add.at(found, left + 1, unexplained * (place - left) / spacing)
        self.local += forgetting * (found - self.local)
        if len(self._nodes) == 1:
            self.local = np.maximum(self.local, self._lowest)
