"""The learned range detector: a small network scores the hypotheses that a cheap linear stage points out.

Every hypothesis of the grid gets the cheap score: the energy of the cepstrum along its predicted delays. Around that
score's highest peaks the network gives the likelihood ratio; everywhere else a line through the cheap score does, fitted
on validation records and bounded. A minute depends on the frames of its own window alone, so that maps do not depend on
how a record is cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.detectors import range_kernels as kernels
from obsnet.detectors.analytic import RangeDetectorConfig, range_maps
from obsnet.detectors.maps import coverage
from obsnet.detectors.range_features import Look, RangeFeatures, RangeFeaturesConfig
from obsnet.errors import ConfigError

Scorer = Callable[[np.ndarray], np.ndarray]
"""Feature vectors (n, size) float32 in, log likelihood ratios (n) float32 out."""


@dataclass(frozen=True)
class RangeCalibration:
    """How scores become natural-log likelihood ratios against no ship.

    Parameters
    ----------
    peaks : highest peaks of the cheap score, of each minute, at which the network looks.
    spread : ranges to either side of a peak at which it looks too.
    slope, offset : of the network's score. cheap_slope, cheap_offset, cheap_bound : of the cheap one, and its largest value.
    bound : of either sign, what validation supports.
    exponent : of the ratio, because windows overlap.
    """

    peaks: int = 10
    spread: int = 2
    slope: float = 1.0
    offset: float = 0.0
    cheap_slope: float = 0.1
    cheap_offset: float = -2.0
    cheap_bound: float = 0.0
    bound: float = 12.0
    exponent: float = 1.0

    def __post_init__(self) -> None:
        if (
            self.peaks < 1
            or self.spread < 0
            or not (self.slope > 0 and self.bound > 0 and 0 < self.exponent <= 1)
        ):
            raise ConfigError(
                f"a calibration needs peaks, slope, bound > 0 and an exponent up to 1, found {self}"
            )


class LearnedRangeDetector:
    """Likelihood ratio of a ship's range and range rate by a network over cepstral patches.

    Parameters
    ----------
    propagation : Dataset of `obsnet.ocean.rays.propagation`.
    scorer : the network.
    calibration, features : as the network was trained and calibrated.
    config : RangeDetectorConfig, of which the grids and the windows hold.
    """

    name = "learned"

    def __init__(
        self,
        propagation: xr.Dataset,
        scorer: Scorer,
        calibration: RangeCalibration = RangeCalibration(),
        features: RangeFeaturesConfig = RangeFeaturesConfig(),
        config: RangeDetectorConfig = RangeDetectorConfig(),
    ) -> None:
        if config.window_s != features.window_s:
            raise ConfigError(
                f"the range model was trained on windows of {features.window_s:g} s, range.window_s is {config.window_s:g}"
            )
        self.config, self.calibration = config, calibration
        self.window_s = config.window_s
        self._scorer = scorer
        self._front = RangeFeatures(propagation, features)

    def maps(self, cepstrogram: xr.DataArray, minutes: np.ndarray) -> xr.Dataset:
        """Log-likelihood ratio against range and range rate, and its coverage, at `minutes`.

        Parameters
        ----------
        cepstrogram : DataArray float32 (quefrency, time), clutter removed.
        minutes : s since 1970.

        Returns
        -------
        Dataset of range_llr (time, range, range_rate) float32, range_coverage (time) float32.
        """
        config, grid = self.config, self._front.config
        look = self._front.look(cepstrogram, minutes)
        coarse = self._coarse(look)
        llr = np.empty((len(minutes), len(config.range_m), len(config.range_rate)), np.float32)
        kernels.resample(
            coarse,
            *_weights(config.range_m, grid.range_m),
            *_weights(config.range_rate, grid.range_rate),
            llr,
        )
        hop = float(np.median(np.diff(look.frame_time))) if look.frame_time.size > 1 else 1.0
        covered = coverage(look.valid, look.start, look.stop, minutes, config.window_s, hop)
        llr[covered == 0] = np.nan
        return range_maps(llr, covered, minutes, config.range_m, config.range_rate)

    def _coarse(self, look: Look) -> np.ndarray:
        """Calibrated ratio on the features' own grid, (window, rate, range) float32."""
        cal, front = self.calibration, self._front
        columns = kernels.peak_columns(look.score, cal.peaks, cal.spread)
        ratio = np.minimum(cal.cheap_slope * look.score + cal.cheap_offset, cal.cheap_bound)
        place, column = np.nonzero(columns)
        rates = front.config.range_rate
        block = max(8192 // len(rates), 1)
        for at in range(0, len(place), block):
            rows, cells = place[at : at + block], column[at : at + block]
            found = front.features(
                look, np.repeat(rows, len(rates)),
                np.repeat(front.config.range_m[cells], len(rates)), np.tile(rates, len(rows)),
            )  # fmt: skip
            said = cal.slope * self._scorer(found) + cal.offset
            ratio[rows, :, cells] = said.reshape(len(rows), len(rates))
        return cal.exponent * np.clip(ratio, -cal.bound, cal.bound)


def _weights(wanted: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the grid point below each wanted value and the weight of the one above; constant beyond the ends."""
    place = np.clip((wanted - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.0)
    below = np.minimum(place.astype(np.int64), len(grid) - 2)
    return below, (place - below).astype(np.float32)
