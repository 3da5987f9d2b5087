"""The learned azimuth detector: a network over the azigram's cells, run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from obsnet.config import build
from obsnet.detectors.analytic import AzimuthDetectorConfig, azimuth_maps
from obsnet.detectors.azimuth_features import (
    BIN_S,
    CHANNELS,
    LOOK_AHEAD_S,
    AzimuthFeatures,
    Cells,
    FeatureConfig,
    cell_index,
)
from obsnet.detectors.model_card import ModelCard, ModelFile, check_shapes, run, shipped
from obsnet.errors import ModelError
from obsnet.signals.spectra import SpectraConfig

WINDOW_S, STEP_S = 180.0, 60.0
UNUSED = {
    "azigram": ("fmin_hz", "fmax_hz"),
    "azimuth": (
        "mean_resultant_length",
        "mode",
        "frequency_overlap_exponent",
        "null",
        "background_window_s",
        "background_step_s",
        "background_prior_s",
    ),
}
"""Parameters by section that are the analytic detector's alone; the network has learned what they say."""


def without_floor(llr: np.ndarray) -> np.ndarray:
    """Azimuth maps (minute, azimuth) whose median is no evidence for a ship.

    A ship raises a few tens of degrees. What raises half of all azimuths at once tells none of them from the others, yet a
    tracker would add it up for every course: it is taken off the whole row. A floor below 0 stays.
    """
    floor = np.median(llr, axis=1, keepdims=True)
    return llr - np.maximum(floor, np.float32(0.0))


class LearnedAzimuthDetector:
    """Likelihood ratio of a ship's azimuth by a network over the azigram's cells.

    Takes spectra block by block with `take` and gives maps of minutes with `maps`. What it says of a minute depends on the
    frames before it and 40 s beyond its window alone, not on how the record is cut.

    Parameters
    ----------
    config : AzimuthDetectorConfig, of which the azimuth grid holds.
    spectra : SpectraConfig of the frames to come.
    model : ONNX file; by default the one that is shipped. threads : of onnxruntime.

    Raises
    ------
    ModelError : the file is not a model of ours or was altered, or it does not fit windows, frames or rate.
    """

    name = "learned"
    look_ahead_s = LOOK_AHEAD_S

    def __init__(
        self,
        config: AzimuthDetectorConfig = AzimuthDetectorConfig(),
        spectra: SpectraConfig = SpectraConfig(),
        model: str | Path | None = None,
        threads: int | None = None,
    ) -> None:
        self.config, self.window_s = config, config.window_s
        self.file = ModelFile.read(model or shipped("azimuth"), "azimuth")
        card = self.card
        _check_fits(card, config, spectra)
        self._minutes = int(card.grids["minutes"])
        self._frequencies = int(card.grids["frequencies"])
        cells = 3 * (self._minutes + 2)
        self._session = self.file.session(threads or 1)
        shapes: dict[str, tuple[int | None, ...]] = {
            "invariants": (None, cells, len(CHANNELS), self._frequencies),
            "phasor": (None, 2, cells, self._frequencies),
            "doubled": (None,),
        }
        check_shapes(self._session, shapes, (None, self._minutes, int(card.grids["azimuths"])))
        self._features = AzimuthFeatures(build(FeatureConfig, card.representation["features"]))
        self._onto = {fold: _spline(int(card.grids["azimuths"]), fold * config.azimuth) for fold in (1, 2)}
        self._held: Cells | None = None

    @property
    def card(self) -> ModelCard:
        """What the model says of itself."""
        return self.file.card

    def take(self, spectra: xr.Dataset) -> None:
        """Take the next block of spectra, dims (frequency, time), with east and north, and p where there is one."""
        self._hold(self._features.push(spectra))

    def finish(self) -> None:
        """The record has ended: what is still open shall be used as it is."""
        self._hold(self._features.flush())

    def _hold(self, new: Cells) -> None:
        if not len(new.index):
            return
        if new.phasor.shape[1] != self._frequencies:
            raise ModelError(
                f"the azimuth model takes {self._frequencies} frequencies, the spectra have {new.phasor.shape[1]} in its band"
            )
        self._held = new if self._held is None else self._held.joined(new)

    def maps(self, minutes: np.ndarray, covered: np.ndarray) -> xr.Dataset:
        """Log-likelihood ratio against azimuth at `minutes`.

        Parameters
        ----------
        minutes : s since 1970, consecutive multiples of 60 s.
        covered : share of each window's frames that hold data, from `obsnet.detectors.maps.coverage`.

        Returns
        -------
        Dataset of azimuth_llr (time, azimuth) float32, azimuth_coverage (time) float32.
        """
        ambiguity = 360 if self._held is None else self._held.ambiguity_deg
        llr = np.full((len(minutes), len(self.config.azimuth)), np.nan, np.float32)
        row, place = np.divmod(np.rint(minutes / STEP_S).astype(np.int64), self._minutes)
        for number in np.unique(row):
            inside = row == number
            if self._held is not None and covered[inside].any():
                llr[inside] = self._row(int(number))[place[inside]]
        llr = without_floor(llr)
        llr[covered == 0] = np.nan
        return azimuth_maps(llr, covered, minutes, self.config.azimuth, ambiguity)

    def _row(self, number: int) -> np.ndarray:
        """Ratios of a row of minutes, (minute, azimuth); rows begin at fixed times, so that a minute has the
        same place in its row however the record is cut.
        """
        assert self._held is not None
        first = int(cell_index(STEP_S * self._minutes * number - WINDOW_S / 2))
        cells = self._held.between(first, first + 3 * (self._minutes + 2))
        feeds = {
            "invariants": np.ascontiguousarray(cells.invariants, np.float32)[None],
            "phasor": np.stack([cells.phasor.real, cells.phasor.imag])[None].astype(np.float32),
            "doubled": np.array([float(cells.ambiguity_deg == 180)], np.float32),
        }
        return run(self._session, feeds)[0] @ self._onto[360 // cells.ambiguity_deg]

    def forget(self, before: float) -> None:
        """Let go of the cells that no window from `before` [s since 1970] on holds."""
        if self._held is not None:
            self._held = self._held.since(int(cell_index(before)))

    def reset(self) -> None:
        """Begin anew after a long silence; the slow memory stays."""
        self._held = None
        self._features.restart()

    def state(self) -> dict[str, np.ndarray]:
        """Arrays by name on which the next minute depends."""
        held = {} if self._held is None else {f"held/{k}": v for k, v in self._held.state().items()}
        return held | {f"features/{key}": value for key, value in self._features.state().items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        parts: dict[str, dict[str, np.ndarray]] = {"held": {}, "features": {}}
        for key, value in state.items():
            part, _, name = key.partition("/")
            parts[part][name] = value
        self._held = Cells.restored(parts["held"]) if parts["held"] else None
        self._features.restore(parts["features"])


def _check_fits(card: ModelCard, config: AzimuthDetectorConfig, spectra: SpectraConfig) -> None:
    if (config.window_s, config.step_s) != (WINDOW_S, STEP_S):
        raise ModelError(
            f"the azimuth model was trained on windows of {WINDOW_S:g} s every {STEP_S:g} s, found "
            f"{config.window_s:g} and {config.step_s:g} s; use --detector analytic"
        )
    trained = card.representation["spectra"]
    for name in ("window_s", "hop_s"):
        if getattr(spectra, name) != trained[name]:
            raise ModelError(
                f"the azimuth model was trained on frames with {name} {trained[name]:g}, found {getattr(spectra, name):g}; "
                "use --detector analytic"
            )
    highest = card.representation["features"]["fmax_hz"]
    if spectra.analysis_rate_hz < 2 * highest:
        raise ModelError(
            f"the azimuth model listens up to {highest:g} Hz, the spectra end at {spectra.analysis_rate_hz / 2:g} Hz; "
            "use --detector analytic"
        )
    if card.representation["channels"] != list(CHANNELS) or card.representation["bin_s"] != BIN_S:
        raise ModelError(
            "the azimuth model was trained on other features than this obsnet makes; export it again"
        )


def _spline(count: int, azimuth_deg: np.ndarray) -> np.ndarray:
    """Matrix (count, azimuth) of the periodic cubic spline from the model's azimuths onto others."""
    place = azimuth_deg % 360.0 * count / 360.0
    low = np.floor(place).astype(int)
    right = place - low
    left = 1.0 - right
    unit, following = np.eye(count), np.roll(np.eye(count), 1, axis=1)
    # Second derivatives from the first derivatives' continuity, in steps of the model's azimuths.
    bend = np.linalg.solve(following + 4.0 * unit + following.T, 6.0 * (following - 2.0 * unit + following.T))
    low, high = low % count, (low + 1) % count
    values = left * unit[:, low] + right * unit[:, high]
    values += ((left**3 - left) * bend[low].T + (right**3 - right) * bend[high].T) / 6.0
    return values.astype(np.float32)
