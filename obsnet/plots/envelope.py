"""The cepstrum's envelope against range, observed along known or found courses and modelled: the core paper's figure 5."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from obsnet.detectors.analytic import cepstral_model
from obsnet.layout import to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import parse_pair, tdoa, travel_time
from obsnet.plots import style
from obsnet.plots.overlay import heard
from obsnet.plots.panels import analytic_signal, longest_quefrency, squared_envelope, without
from obsnet.run import Run

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack

RANGE_STEP_M = 500.0
"""A ship at 8 m/s moves on by as much in a minute."""
ALONE = 1.5
"""A minute counts where the second ship is this many times farther than the first."""
_LOWEST_S = 0.5
"""Below this quefrency lies the source's own spectrum."""


def envelope_figure(run: Run, reference: list[ReferenceTrack], title: str) -> Figure:
    """Observed and modelled envelope, side by side."""
    made = style.figure(12.4, 5.2)
    style.title(made, title)
    farthest = run.config.range.max_range_m
    left, right = (style.box(made, 0.75 + 6.0 * i, 0.7, 4.6, 3.9) for i in (0, 1))
    observed = observed_envelope(run, reference, np.arange(0.0, farthest + 1.0, RANGE_STEP_M))
    quefrency = np.arange(0.0, longest_quefrency(run) + 0.5, 0.02)
    if observed is None:
        without(
            left,
            "quefrency [s]",
            "no hydrophone" if "cepstrogram" not in run.features else "no ship to stack",
        )
        left.set_title("(a) observed", fontsize=10, loc="left")
    else:
        quefrency = observed["quefrency"].values
        _image(left, run, observed, "root mean square envelope", lowest=20.0)
        _delays(left, run)
        along = "AIS" if reference else "the tracks found"
        left.set_title(f"(a) observed along {along}; delays of path pairs dashed", fontsize=10, loc="left")
    _image(right, run, modelled_envelope(run, quefrency), "modelled envelope")
    _names(right, run)
    right.set_title("(b) modelled", fontsize=10, loc="left")
    for ax in (left, right):
        ticks = style.nice_ticks(0.0, farthest / 1e3)
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=8)
        ax.set_xlim(0.0, farthest / 1e3)
        ax.set_xlabel("range [km]", fontsize=9)
    return made


def observed_envelope(run: Run, reference: list[ReferenceTrack], range_m: np.ndarray) -> xr.DataArray | None:
    """Root mean square of the cepstrum's envelope, dims (range, quefrency); NaN where no ship passed.

    Every minute in which one ship is alone near the station is stacked at its range as heard, known from AIS or else
    from the run's own tracks.

    Parameters
    ----------
    range_m : array, m, in steps of `RANGE_STEP_M`.

    Returns
    -------
    DataArray, or none without a cepstrum or a ship.

    Source: Trabattoni et al. 2023, figure 5(a).
    """
    cepstra = run.features.get("cepstrogram")
    if cepstra is None or not (reference or run.tracks):
        return None
    away = np.sort(_ranges(run, reference, to_posix(cepstra["time"].values)), axis=0)
    alone = away[0] <= range_m[-1]
    if len(away) > 1:
        alone &= away[1] > ALONE * away[0]
    chosen = np.flatnonzero(alone)
    quefrency = cepstra["quefrency"].values
    total, number = np.zeros((len(range_m), len(quefrency))), np.zeros((len(range_m), 1))
    for part in np.array_split(chosen, len(chosen) // 2000 + 1):
        values = cepstra.isel(time=part).transpose("time", "quefrency").values
        valid = ~np.isnan(values).any(axis=1)
        cell = np.rint((away[0][part[valid]] - range_m[0]) / RANGE_STEP_M).astype(int)
        np.add.at(total, cell, squared_envelope(values[valid]))
        np.add.at(number, cell, 1.0)
    mean = np.sqrt(np.where(number > 0, total / np.maximum(number, 1.0), np.nan))
    return xr.DataArray(mean, {"range": range_m, "quefrency": quefrency}, ("range", "quefrency"))


def modelled_envelope(run: Run, quefrency_s: np.ndarray) -> xr.DataArray:
    """Envelope of the range detector's cepstral model, dims (range, quefrency).

    Source: Trabattoni et al. 2023, figure 5(b).
    """
    given = run.info.get("amplitudes")
    amplitudes = (
        Amplitudes.from_dict(given) if given else Amplitudes.table_ii().scaled_to(run.station.depth_m)
    )
    pulses = cepstral_model(quefrency_s, run.table, amplitudes, run.config.range).sum(axis=0)
    coordinates = {"range": run.config.range.range_m, "quefrency": quefrency_s}
    return xr.DataArray(np.abs(analytic_signal(pulses)), coordinates, ("range", "quefrency"))


def _ranges(run: Run, reference: list[ReferenceTrack], time: np.ndarray) -> np.ndarray:
    """Range [m] of each ship as heard at `time`, infinite where there is none, (ship, time)."""
    delay = travel_time(run.table)
    if reference:
        away = [ship.heard(time, delay)[1] for ship in reference]
    else:
        found = [heard(track, delay) for track in run.tracks]
        away = [np.interp(time, c.time, c.range_m, left=np.nan, right=np.nan) for c in found]
    return np.nan_to_num(np.stack(away), nan=np.inf)


def _image(ax: Axes, run: Run, envelope: xr.DataArray, label: str, lowest: float = 0.0) -> None:
    """An envelope in km and s, in colours from its `lowest` percentile on."""
    range_km, quefrency = envelope["range"].values / 1e3, envelope["quefrency"].values
    half = (range_km[1] - range_km[0]) / 2
    values = envelope.values[:, quefrency > _LOWEST_S]
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [lowest, 99.8]) if known.size else (0.0, 1.0)
    picture = ax.imshow(
        envelope.values.T, origin="lower", aspect="auto", cmap=style.SEQUENTIAL, interpolation="nearest",
        norm=Normalize(low, high if high > low else low + 1.0),
        extent=(range_km[0] - half, range_km[-1] + half, quefrency[0], quefrency[-1]),
    )  # fmt: skip
    style.y_axis(ax, "quefrency [s]", 0.0, longest_quefrency(run))
    style.bar(ax, picture, label)


def _delays(ax: Axes, run: Run) -> None:
    for pair in _pairs(run):
        range_km, delay = run.table["range"].values / 1e3, tdoa(run.table, pair).values
        ax.plot(range_km, delay, color="white", lw=0.9, ls=(0, (4, 6)))


def _names(ax: Axes, run: Run) -> None:
    """Each modelled pair's name where it is strongest."""
    amplitudes, range_m = _amplitudes(run), run.config.range.range_m
    for pair in _pairs(run):
        delay = tdoa(run.table, pair).interp(range=range_m).values
        if pair not in amplitudes.pairs or np.isnan(delay).all():
            continue
        at = int(np.argmax(np.where(np.isnan(delay), -1.0, amplitudes.evaluate(pair, range_m))))
        ax.annotate(
            pair,
            (range_m[at] / 1e3, delay[at]),
            (5, 6),
            textcoords="offset points",
            color="white",
            fontsize=9,
        )


def _amplitudes(run: Run) -> Amplitudes:
    given = run.info.get("amplitudes")
    return Amplitudes.from_dict(given) if given else Amplitudes.table_ii().scaled_to(run.station.depth_m)


def _pairs(run: Run) -> list[str]:
    known = set(run.table["path"].values.tolist())
    return [pair for pair in run.config.range.pairs if set(parse_pair(pair)) <= known]
