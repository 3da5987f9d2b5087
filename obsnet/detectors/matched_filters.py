"""The pulses of every path pair and range as matched filters over frames of the cepstrogram."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from obsnet.detectors import kernels
from obsnet.signals.cepstrogram import noise_std

if TYPE_CHECKING:
    from obsnet.detectors.analytic import RangeDetectorConfig

_RANGES = 64
"""Ranges matched at once: what their pulses have in common."""


class MatchedFilters:
    """Log-likelihood ratio of every pair and range in a frame, where a pair may be heard, and the mean over its wandering.

    The ranges at which a pair is heard, and what a slant stack and the wandering reach beyond them, lie side by side,
    pair after pair, as the columns of one array.

    Parameters
    ----------
    quefrency : s. nfft : samples of the frames that the cepstra are of.
    pulses : (n_range, n_quefrency) of each pair, as of `cepstral_model`.
    """

    def __init__(
        self, quefrency: np.ndarray, nfft: int, pulses: Iterable[np.ndarray], config: RangeDetectorConfig
    ) -> None:
        self.quefrency, self._config = quefrency, config
        self._kernel = _gaussian(config.wander_bins)
        self._radius = radius = len(self._kernel) // 2
        self.margin = kernels.stack_margin(config.range_rate, config.window_s, config.range_step_m)
        n_range = len(config.range_m)
        precision = 1.0 / noise_std(quefrency, nfft) ** 2
        self._tiles: list[tuple[slice, slice, np.ndarray, np.ndarray]] = []
        self._heard: list[tuple[slice, slice]] = []
        cells = []
        column = self.margin
        for pulse in pulses:
            heard = np.flatnonzero(pulse.any(axis=1))
            if not heard.size:
                continue
            lo = max(int(heard[0]) - radius - self.margin, 0)
            hi = min(int(heard[-1]) + 1 + radius + self.margin, n_range)
            for first in range(int(heard[0]), int(heard[-1]) + 1, _RANGES):
                part = slice(first, min(first + _RANGES, int(heard[-1]) + 1))
                lags = np.flatnonzero(pulse[part].any(axis=0))
                if lags.size:
                    self._add_tile(
                        pulse, part, slice(int(lags[0]), int(lags[-1]) + 1), precision, column + radius - lo
                    )
            self._heard.append((slice(lo, hi), slice(column - self.margin, column - self.margin + hi - lo)))
            cells.append(np.arange(lo - radius, hi + radius + self.margin))
            cells[-1][hi - lo + 2 * radius :] = -1
            column += len(cells[-1])
        self._columns = column
        cell = np.concatenate(cells)[: column - 2 * self.margin] if cells else np.empty(0, int)
        on_grid = (cell >= 0) & (cell < n_range)
        self._off_grid = np.flatnonzero(~on_grid)
        share = np.convolve(on_grid, self._kernel, "valid")
        self._cut = np.flatnonzero(np.abs(share - 1.0) > 1e-12)
        self._share = np.where(share > 0, share, 1.0)[self._cut]

    def _add_tile(
        self, pulse: np.ndarray, part: slice, lags: slice, precision: np.ndarray, offset: int
    ) -> None:
        weight = pulse[part, lags] * precision[lags]
        energy = 0.5 * np.sum(weight * pulse[part, lags], axis=1)
        columns = slice(part.start + offset, part.stop + offset)
        self._tiles.append(
            (columns, lags, np.ascontiguousarray(weight.T, np.float32), energy.astype(np.float32))
        )

    def scores(self, frames: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Log-likelihood ratios (n_frames, n_columns) float32 of cepstra (n_frames, n_quefrency); 0 where not `valid`."""
        made = np.zeros((len(frames), self._columns), np.float32)
        for columns, lags, weight, energy in self._tiles:
            np.matmul(frames[:, lags], weight, out=made[:, columns])
            made[:, columns] -= energy
        made[~valid] = 0.0
        return made

    def wandering(self, beam: np.ndarray) -> np.ndarray:
        """Sum over the pairs of the log of the wandering mean of exp(beam): (window, range rate, range) float32.

        Parameters
        ----------
        beam : (n_windows, n_rates, n) float32 of `kernels.slant_stack`; overwritten.
        """
        total = np.zeros((*beam.shape[:2], len(self._config.range_m)), np.float32)
        np.clip(beam, -kernels.LARGEST_LOG, kernels.LARGEST_LOG, out=beam)
        raised = np.exp(beam, dtype=float)
        raised[..., self._off_grid] = 0.0
        mean = kernels.wander(raised.reshape(-1, raised.shape[2]), self._kernel).reshape(*beam.shape[:2], -1)
        mean[..., self._cut] /= self._share
        logs = np.empty(mean.shape, np.float32)
        with np.errstate(divide="ignore"):
            np.log(mean, out=logs, casting="same_kind")
        for ranges, columns in self._heard:
            total[:, :, ranges] += logs[:, :, columns]
        return total


def _gaussian(std_bins: float) -> np.ndarray:
    radius = int(np.ceil(4 * std_bins))
    if radius == 0:
        return np.ones(1)
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / std_bins) ** 2)
    return weights / weights.sum()
