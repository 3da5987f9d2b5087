"""The cepstrum's envelope against range: observed along known or found courses, and modelled (the core paper's figure 5)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy.signal import hilbert

from obsnet.ais import ReferenceTrack
from obsnet.detectors.analytic import cepstral_model
from obsnet.layout import to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.plots.overlay import heard
from obsnet.plots.panels import squared_envelope
from obsnet.run import Run, travel_time

RANGE_STEP_M = 250.0
FARTHEST_M = 60e3
ALONE = 1.5
"""A minute counts where the second ship is this many times farther than the first."""


def observed_envelope(run: Run, reference: list[ReferenceTrack], range_m: np.ndarray) -> xr.DataArray | None:
    """Root mean square of the cepstrum's envelope, dims (range, quefrency); NaN where no ship passed.

    Every minute in which one ship is alone near the station is stacked at its range as heard, from AIS or else from the
    run's own tracks.

    Returns
    -------
    DataArray, or none without cepstrum or ships.

    Source: Trabattoni et al. 2023, figure 5(a).
    """
    cepstra = run.features.get("cepstrogram")
    if cepstra is None or not (reference or run.tracks):
        return None
    time = to_posix(cepstra["time"].values)
    away = np.sort(_ranges(run, reference, time), axis=0)
    alone = away[0] < FARTHEST_M if len(away) == 1 else (away[0] < FARTHEST_M) & (away[1] > ALONE * away[0])
    chosen = np.flatnonzero(alone)
    quefrency = cepstra["quefrency"].values
    total, number = np.zeros((len(range_m), len(quefrency))), np.zeros((len(range_m), 1))
    for part in np.array_split(chosen, len(chosen) // 2000 + 1):
        values = cepstra.isel(time=part).transpose("time", "quefrency").values
        valid = ~np.isnan(values).any(axis=1)
        cell = np.clip(
            np.rint((away[0][part[valid]] - range_m[0]) / RANGE_STEP_M).astype(int), 0, len(range_m) - 1
        )
        np.add.at(total, cell, squared_envelope(values[valid]))
        np.add.at(number, cell, 1.0)
    mean = np.sqrt(np.where(number > 0, total / np.maximum(number, 1.0), np.nan))
    return xr.DataArray(mean, {"range": range_m, "quefrency": quefrency}, ("range", "quefrency"))


def modelled_envelope(run: Run, quefrency_s: np.ndarray) -> xr.DataArray:
    """Envelope of the range detector's cepstral model, dims (range, quefrency).

    Source: Trabattoni et al. 2023, figure 5(b).
    """
    amplitudes = _amplitudes(run)
    pulses = cepstral_model(quefrency_s, run.table, amplitudes, run.config.range).sum(axis=0)
    coordinates = {"range": run.config.range.range_m, "quefrency": quefrency_s}
    return xr.DataArray(np.abs(hilbert(pulses, axis=1)), coordinates, ("range", "quefrency"))


def _ranges(run: Run, reference: list[ReferenceTrack], time: np.ndarray) -> np.ndarray:
    """Range [m] of each ship as heard at `time`, infinite where there is none."""
    delay = travel_time(run.table)
    if reference:
        away = [ship.heard(time, delay)[1] for ship in reference]
    else:
        found = [heard(track, delay) for track in run.tracks]
        away = [np.interp(time, c.time, c.range_m, left=np.nan, right=np.nan) for c in found]
    return np.nan_to_num(np.stack(away), nan=np.inf)


def _amplitudes(run: Run) -> Amplitudes:
    given = run.info.get("amplitudes")
    return Amplitudes.from_dict(given) if given else Amplitudes.table_ii().scaled_to(run.station.depth_m)
