"""Azimuth maps of a record as it comes: azigram, background and detector by one estimator, with their memories."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from obsnet.detectors.analytic import AzimuthDetectorConfig
from obsnet.detectors.background import BackgroundDirection
from obsnet.detectors.maps import coverage
from obsnet.layout import to_posix
from obsnet.signals.azigram import AzigramConfig, azigram
from obsnet.signals.held import followed_by, laid_out, taken_up, under

if TYPE_CHECKING:
    from obsnet.detectors.learned import LearnedAzimuthDetector

HORIZONTALS = {"east", "north"}


class Azimuths:
    """Takes blocks of spectra in time order and gives azimuth maps of minutes; those without horizontals say nothing.

    Parameters
    ----------
    estimator : AzigramConfig. detector : AzimuthDetectorConfig.
    learned : the detector, where it is not the analytic one.
    order : has the analytic detector's maps made of an azigram (frequency, time), minutes [s since 1970] and the null (frequency, time).
    """

    def __init__(
        self,
        estimator: AzigramConfig,
        detector: AzimuthDetectorConfig,
        learned: LearnedAzimuthDetector | None,
        order: Callable[[xr.DataArray, np.ndarray, np.ndarray | None], list[Future]],
    ) -> None:
        self.learned = learned
        self._estimator, self._detector, self._order = estimator, detector, order
        self._background = BackgroundDirection(
            detector.background_window_s, detector.background_step_s, detector.background_prior_s
        )
        self.azigram: xr.DataArray | None = None
        self._null: np.ndarray | None = None

    def take(self, spectra: xr.Dataset) -> None:
        """The next block of spectra, dims (frequency, time)."""
        if not set(spectra) >= HORIZONTALS:
            return
        azimuths = azigram(spectra, self._estimator)
        if self.learned is not None:
            axes = self._estimator.method == "polarisation"
            self.learned.take(spectra[sorted(HORIZONTALS)] if axes else spectra)
        elif self._detector.null == "directional":
            null = self._background(azimuths)
            self._null = null if self._null is None else np.concatenate([self._null, null], axis=1)
        self.azigram = followed_by(self.azigram, azimuths)

    def finish(self) -> None:
        """The record has ended: what is still open shall be used as it is."""
        if self.learned is not None:
            self.learned.finish()

    def maps(self, minutes: np.ndarray) -> list[Future]:
        """Maps of consecutive minutes [s since 1970], part by part; none where there are no horizontals."""
        held = self.azigram
        if held is None or not len(minutes):
            return []
        if self.learned is None:
            return self._order(held, minutes, self._null)
        window_s = self._detector.window_s
        heard = ~np.isnan(held.values).all(axis=0)
        covered = coverage(heard, to_posix(held["time"].values), minutes, window_s)
        made: Future = Future()
        made.set_result(self.learned.maps(minutes, covered))
        return [made]

    def forget(self, before: float) -> None:
        """Let go of the frames that no window from `before` [s since 1970] on holds."""
        if self.learned is not None:
            self.learned.forget(before)
        if self.azigram is not None:
            keep = to_posix(self.azigram["time"].values) >= before
            self.azigram = self.azigram[:, keep]
            self._null = None if self._null is None else self._null[:, keep]

    def restart(self) -> None:
        """Begin anew after a long silence; what has been learned slowly stays."""
        self.azigram = self._null = None
        if self.learned is not None:
            self.learned.reset()

    def state(self) -> dict[str, np.ndarray]:
        """All that the next minute depends on, arrays by name, none changed in place."""
        parts = {"background": self._background.state()}
        if self.learned is not None:
            parts["learned"] = self.learned.state()
        if self.azigram is not None:
            parts["azigram"] = laid_out(self.azigram)
        arrays = {f"{part}/{key}": value for part, held in parts.items() for key, value in held.items()}
        return arrays if self._null is None else arrays | {"null": self._null}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        self._background.restore(under(state, "background"))
        if self.learned is not None:
            self.learned.restore(under(state, "learned"))
        self.azigram, self._null = taken_up(under(state, "azigram")), state.get("null")


def unheard(spectra: xr.Dataset) -> np.ndarray:
    """Frames (time) in which a hydrophone that the station has is silent, and the horizontals are not."""
    if not set(spectra) >= {*HORIZONTALS, "p"}:
        return np.zeros(spectra.sizes["time"], bool)
    return np.isnan(spectra["p"].values[0]) & ~np.isnan(spectra["east"].values[0])


def horizontals(spectra: xr.Dataset, frames: np.ndarray) -> xr.Dataset:
    """The horizontals alone, NaN but in some frames (bool, time)."""
    return spectra[sorted(HORIZONTALS)].where(xr.DataArray(frames, dims="time"))
