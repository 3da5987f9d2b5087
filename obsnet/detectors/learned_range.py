"""The learned range detector: a small network scores the hypotheses that a cheap linear stage points out.

Every hypothesis of the grid gets the cheap score: the energy of the cepstrum along its predicted delays. Around that
score's highest peaks the network gives the likelihood ratio; everywhere else a line through the cheap score does, fitted
on validation records and bounded. The network was trained with tables in error, so it says which lobe is the ship and
hardly where in it: that the analytic likelihood says, within the reach of the network's blur. A minute depends on the frames
of its own window alone, so that maps do not depend on how a record is cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from obsnet.config import build
from obsnet.detectors import range_kernels as kernels
from obsnet.detectors.analytic import AnalyticRangeDetector, RangeDetectorConfig, range_maps
from obsnet.detectors.maps import coverage, window_bounds
from obsnet.detectors.model_card import ModelCard, ModelFile, check_shapes, run, shipped
from obsnet.detectors.range_features import CONTEXT, GLOBALS, RangeFeatures, RangeFeaturesConfig
from obsnet.errors import ConfigError, ModelError
from obsnet.layout import to_posix
from obsnet.signals.spectra import SpectraConfig

BATCH = 1024
STRETCH = 30
"""Minutes of a record at a time."""
CARRIED_SLOPE = 0.3
"""Fall of the ratio with the cheap score's, towards range rates at which the network did not look."""
END_SLOPE = 0.1
"""Slope of a minute's ratio of presence beyond the strongest evidence that validation held."""
SHAPE_SLOPE, SHAPE_REACH_M, SHAPE_REACH_MPS = 0.4, 280.0, 2.0
"""Power of the analytic likelihood ratio that shares out what the network gives to a lobe, and how far it moves it, in minutes
in which the network's ratio of presence speaks for a ship."""
Scorer = Callable[[np.ndarray], np.ndarray]
"""Feature vectors (n, size) float32 in, log likelihood ratios (n) float32 out."""


@dataclass(frozen=True)
class RangeCalibration:
    """How scores become natural-log likelihood ratios against no ship.

    Parameters
    ----------
    peaks : highest peaks of the cheap score, of each minute, at which the network looks.
    spread : ranges to either side of a peak at which it looks too. rates : range rates about the best one, at each range.
    least : of a minute's greatest cheap score; below it, as mostly in noise, the network does not look at all.
    slope, offset : of the network's score. cheap_slope, cheap_offset, cheap_bound : of the cheap one, and its largest value.
    presence_said, presence_seen : increasing knots between which a minute's marginal ratio of presence is put right.
    lowest, highest : of the ratio, what validation supports.
    exponent : for sums over minutes, whose windows overlap; the maps are without it.
    """

    peaks: int = 6
    spread: int = 2
    rates: int = 7
    least: float = 0.0
    slope: float = 1.0
    offset: float = 0.0
    cheap_slope: float = 0.1
    cheap_offset: float = -2.0
    cheap_bound: float = 0.0
    presence_said: tuple[float, ...] = (-100.0, 100.0)
    presence_seen: tuple[float, ...] = (-100.0, 100.0)
    lowest: float = -8.0
    highest: float = 12.0
    exponent: float = 1.0

    def __post_init__(self) -> None:
        knots = self.presence_said, self.presence_seen
        if len(knots[0]) != len(knots[1]) or len(knots[0]) < 2 or any(np.any(np.diff(k) <= 0) for k in knots):
            raise ConfigError(
                f"presence needs as many increasing knots said as seen, two at least; found {knots}"
            )
        counts, signs = min(self.peaks, self.rates, self.spread + 1) >= 1, self.lowest < 0 < self.highest
        if not (counts and signs and self.slope > 0 and 0 < self.exponent <= 1):
            raise ConfigError(
                f"a calibration needs peaks, rates and slope > 0, bounds about 0, exponent up to 1; found {self}"
            )


class LearnedRangeDetector:
    """Likelihood ratio of a ship's range and range rate by a network over cepstral patches.

    Parameters
    ----------
    propagation : Dataset of `obsnet.ocean.rays.propagation`.
    scorer : the network.
    calibration, features : as the network was trained and calibrated.
    config : RangeDetectorConfig, of which the grids and the windows hold.
    shape : detector of the fine shape; None leaves the network's blur.
    """

    name = "learned"

    def __init__(
        self,
        propagation: xr.Dataset,
        scorer: Scorer,
        calibration: RangeCalibration = RangeCalibration(),
        features: RangeFeaturesConfig = RangeFeaturesConfig(),
        config: RangeDetectorConfig = RangeDetectorConfig(),
        shape: AnalyticRangeDetector | None = None,
    ) -> None:
        self.config, self.calibration, self._shape = config, calibration, shape
        self.window_s = config.window_s
        self.file: ModelFile | None = None
        self._scorer = scorer
        self._front = RangeFeatures(propagation, features)

    @classmethod
    def from_model(
        cls,
        propagation: xr.Dataset,
        model: str | Path | None = None,
        config: RangeDetectorConfig = RangeDetectorConfig(),
        spectra: SpectraConfig = SpectraConfig(),
        shape: AnalyticRangeDetector | None = None,
    ) -> LearnedRangeDetector:
        """Detector of an ONNX file; by default of the one that is shipped.

        Parameters
        ----------
        spectra : of the frames to come. shape : detector of the fine shape.

        Raises
        ------
        ModelError : the file is not a model of ours or was altered, or it does not fit windows, frames or rate.
        """
        file = ModelFile.read(model or shipped("range"), "range")
        features = build(RangeFeaturesConfig, file.card.representation["features"])
        _check_fits(file.card, features, config, spectra)
        session = file.session()
        check_shapes(session, {"features": (None, features.size)}, (None,))
        calibration = build(RangeCalibration, file.card.calibration)

        def score(found: np.ndarray) -> np.ndarray:
            return run(session, {"features": found})

        made = cls(propagation, score, calibration, features, config, shape)
        made.file = file
        return made

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
        config = self.config
        times = to_posix(cepstrogram["time"].values)
        start, stop = window_bounds(times, minutes, config.window_s)
        llr = np.empty((len(minutes), len(config.range_m), len(config.range_rate)), np.float32)
        told = np.empty(len(minutes), bool)
        for lo in range(0, len(minutes), STRETCH):
            part = slice(lo, lo + STRETCH)
            heard = cepstrogram[:, max(start[part].min() - 1, 0) : stop[part].max() + 1]
            coarse = self.ratios(heard, minutes[part])
            told[part] = presence_ratio(coarse, self._front.config) > 0
            llr[part] = self._on_grid(coarse)
        if self._shape is not None:
            self._share_out(llr, self._shape, cepstrogram, minutes, np.flatnonzero(told))
        covered = coverage(~np.isnan(cepstrogram.values[0]), times, minutes, config.window_s)
        llr[covered == 0] = np.nan
        return range_maps(llr, covered, minutes, config.range_m, config.range_rate)

    def _on_grid(self, coarse: np.ndarray) -> np.ndarray:
        """Ratios of the features' grid on the configuration's, (minute, range, rate)."""
        config, grid = self.config, self._front.config
        return kernels.resample(
            coarse, *_weights(config.range_m, grid.range_m), *_weights(config.range_rate, grid.range_rate)
        )

    def _share_out(
        self,
        llr: np.ndarray,
        shape: AnalyticRangeDetector,
        cepstrogram: xr.DataArray,
        minutes: np.ndarray,
        chosen: np.ndarray,
    ) -> None:
        """Give the ratios of chosen minutes the fine shape of `shape`'s, in place."""
        config = self.config
        reach = round(SHAPE_REACH_M / config.range_step_m), round(SHAPE_REACH_MPS / _step(config.range_rate))
        for lo in range(0, len(chosen), STRETCH):
            part = chosen[lo : lo + STRETCH]
            shared, fine = llr[part], shape.maps(cepstrogram, minutes[part])["range_llr"].values
            kernels.share_out(shared, fine, SHAPE_SLOPE, *reach, config.range_m)
            llr[part] = shared

    def ratios(self, cepstrogram: xr.DataArray, minutes: np.ndarray) -> np.ndarray:
        """Calibrated log-likelihood ratios on the features' own grid, (minute, rate, range) float32."""
        return calibrated(*self.scores(cepstrogram, minutes), self.calibration, self._front.config)

    def scores(self, cepstrogram: xr.DataArray, minutes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the network said, NaN where it did not look, and the cheap score: (minute, rate, range) float32 both."""
        front, cal = self._front, self.calibration
        look = front.look(cepstrogram, minutes)
        chosen = kernels.choose(look.score, cal.peaks, cal.spread, cal.rates, cal.least)
        place, rate, column = np.nonzero(chosen)
        said = np.full(look.score.shape, np.nan, np.float32)
        for at in range(0, len(place), BATCH):
            part = slice(at, at + BATCH)
            cells = place[part], rate[part], column[part]
            found = front.features(
                look, cells[0], front.config.range_m[cells[2]], front.config.range_rate[cells[1]]
            )
            said[cells] = self._scorer(found)
        kernels.carry_on(said, look.score, CARRIED_SLOPE)
        return said, look.score


def _step(grid: np.ndarray) -> float:
    return float(grid[1] - grid[0]) if len(grid) > 1 else 1.0


def calibrated(
    said: np.ndarray, cheap: np.ndarray, calibration: RangeCalibration, features: RangeFeaturesConfig
) -> np.ndarray:
    """Log-likelihood ratios from what the network said, NaN where it did not look, and the cheap score.

    All are arrays (minute, rate, range). A minute's ratios are shifted together so that its marginal ratio of presence
    becomes what validation saw; how they share it out is the network's.
    """
    cal = calibration
    ratio = np.minimum(cal.cheap_slope * cheap + cal.cheap_offset, cal.cheap_bound)
    looked = np.isfinite(said)
    ratio[looked] = cal.slope * said[looked] + cal.offset
    marginal = presence_ratio(ratio, features)
    said_at, seen_at = np.array(cal.presence_said), np.array(cal.presence_seen)
    slope = np.where(marginal < said_at[0], 1.0, END_SLOPE)
    beyond = slope * (marginal - np.clip(marginal, said_at[0], said_at[-1]))
    ratio += (np.interp(marginal, said_at, seen_at) + beyond - marginal)[:, None, None]
    return np.clip(ratio, cal.lowest, cal.highest)


def presence_ratio(ratio: np.ndarray, features: RangeFeaturesConfig) -> np.ndarray:
    """Log marginal ratio of presence of ratios (minute, rate, range), by the prior of `range_prior`."""
    weighted = (ratio + range_prior(features)).reshape(len(ratio), -1)
    top = weighted.max(axis=1, initial=-np.inf)
    return np.log(np.exp(weighted - top[:, None]).sum(axis=1)) + top


def range_prior(features: RangeFeaturesConfig) -> np.ndarray:
    """Log prior of the features' grid, in proportion to range and even over range rate: (rate, range) float32."""
    grid, rates = np.maximum(features.range_m, features.range_m[1]), len(features.range_rate)
    return np.broadcast_to(np.log(grid / grid.sum() / rates), (rates, len(grid))).astype(np.float32)


def _check_fits(
    card: ModelCard, features: RangeFeaturesConfig, config: RangeDetectorConfig, spectra: SpectraConfig
) -> None:
    if config.window_s != features.window_s:
        raise ModelError(
            f"the range model was trained on windows of {features.window_s:g} s, found {config.window_s:g} s; "
            "use --detector analytic"
        )
    for name, wanted, grid in (
        ("max_range_m", config.max_range_m, features.range_m[-1]),
        ("max_range_rate_mps", config.max_range_rate_mps, features.range_rate[-1]),
    ):
        if wanted > 1.1 * grid:
            raise ModelError(
                f"the range model knows nothing beyond {name} {grid:g}, found {wanted:g}; lower it or use --detector analytic"
            )
    for name in ("window_s", "hop_s", "analysis_rate_hz"):
        trained = card.representation["spectra"][name]
        if getattr(spectra, name) != trained:
            raise ModelError(
                f"the range model was trained on frames with {name} {trained:g}, found {getattr(spectra, name):g}; "
                "use --detector analytic"
            )
    if tuple(card.representation["context"]) != CONTEXT or tuple(card.representation["globals"]) != GLOBALS:
        raise ModelError(
            "the range model was trained on other features than this obsnet makes; export it again"
        )


def _weights(wanted: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the grid point below each wanted value and the weight of the one above; constant beyond the ends."""
    place = np.clip((wanted - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.0)
    below = np.minimum(place.astype(np.int64), len(grid) - 2)
    return below, (place - below).astype(np.float32)
