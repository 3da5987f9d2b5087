"""The direction that background noise comes from, per frequency, learned from the past of the azigram alone.

Noise from one side (surf, a distant shipping lane, a storm) pulls weak cells towards itself. Told what that pull is, the
azimuth detector asks whether a cell points to a ship rather than whether it points anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from obsnet.layout import to_posix


class BackgroundDirection:
    """Mean phasor of each frequency over a window before now, renewed at UTC multiples of a step.

    A ship that comes in keeps its azimuth for the better part of an hour, and where nothing older has been heard it looks like
    a background. So the mean includes `prior_s` without any direction.

    Parameters
    ----------
    window_s, step_s : s. The output for a frame depends on whole steps before the frame's own alone, so that any split of a
        record gives the same; it is 0 (no direction known) until one step has been heard.
    prior_s : s. What has been heard for so long counts half.
    bandwidth_hz : the mean is taken over this band too, because noise is broad and a ship's tones are narrow.
    """

    def __init__(self, window_s: float, step_s: float, prior_s: float, bandwidth_hz: float = 2.0) -> None:
        self.window_s, self.step_s, self.bandwidth_hz = window_s, step_s, bandwidth_hz
        self.prior_s = prior_s
        self._sums: dict[int, np.ndarray] = {}
        self._counts: dict[int, int] = {}

    def __call__(self, azigram: xr.DataArray) -> np.ndarray:
        """Background phasor (frequency, time) for the next block of an azigram; blocks must come in time order."""
        steps = np.floor(to_posix(azigram["time"].values) / self.step_s).astype(np.int64)
        values = azigram.values
        background = np.zeros(values.shape, np.complex64)
        edges = np.flatnonzero(np.diff(steps, prepend=steps[:1] - 1))
        smooth_bins = self._smooth_bins(azigram["frequency"].values)
        for lo, hi in zip(edges, [*edges[1:], len(steps)], strict=True):
            step = int(steps[lo])
            background[:, lo:hi] = self._mean_before(step, values.shape[0], smooth_bins)[:, None]
            self._remember(step, values[:, lo:hi])
        return background

    def state(self) -> dict[str, np.ndarray]:
        """All that the next frame depends on, as arrays that are never changed in place."""
        counts = np.array(list(self._counts.items()), np.int64).reshape(-1, 2)
        return {"counts": counts} | {f"sum/{step}": total for step, total in self._sums.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        self._counts = {int(step): int(count) for step, count in state["counts"]}
        self._sums = {step: state[f"sum/{step}"] for step in self._counts}

    def _smooth_bins(self, frequency: np.ndarray) -> int:
        if len(frequency) < 2:
            return 1
        return max(1, min(len(frequency), round(self.bandwidth_hz / (frequency[1] - frequency[0]))))

    def _mean_before(self, step: int, n_frequency: int, smooth_bins: int) -> np.ndarray:
        oldest = step - round(self.window_s / self.step_s)
        for key in [key for key in self._sums if key < oldest]:
            del self._sums[key], self._counts[key]
        total = np.zeros(n_frequency, complex)
        count = heard = 0
        for key in sorted(self._sums):
            if key < step:
                total += self._sums[key]
                count += self._counts[key]
                heard += 1
        if count == 0:
            return total
        mean = total / count * (heard / (heard + self.prior_s / self.step_s))
        held = np.pad(mean, (smooth_bins // 2, (smooth_bins - 1) // 2), mode="edge")
        return np.convolve(held, np.full(smooth_bins, 1.0 / smooth_bins), "valid")

    def _remember(self, step: int, values: np.ndarray) -> None:
        valid = ~np.isnan(values).all(axis=0)
        if valid.any():
            self._sums[step] = self._sums.get(step, 0) + np.nansum(values[:, valid], axis=1, dtype=complex)
            self._counts[step] = self._counts.get(step, 0) + int(valid.sum())
