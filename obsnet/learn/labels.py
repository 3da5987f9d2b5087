"""AIS in, what a detector should have said out: every ship's azimuth, range and range rate as they are heard.

What AIS does not tell is unknown, not absent: positions far from any report, ships that belong to another split, and the
minutes before and after a ship's reports.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from obsnet.ais import reference_tracks

FADE_S = 1200.0
"""A ship whose reports end is taken to be about for so long, nobody knows where."""


def labels(
    ais: pd.DataFrame | None,
    station: tuple[float, float],
    minutes: np.ndarray,
    delay: Callable[[np.ndarray], np.ndarray],
    *,
    max_range_m: float = 130e3,
    max_interpolation_s: float = 1800.0,
    ours: Callable[[int], bool] = lambda mmsi: True,
) -> dict[str, np.ndarray]:
    """Labels of a record.

    Parameters
    ----------
    ais : DataFrame mmsi, time, lon, lat; none is a sea without ships.
    station : latitude and longitude, degrees.
    minutes : s since 1970.
    delay : travel time [s] against range [m].
    max_range_m : of the ships to look at.
    max_interpolation_s : positions farther in time from any report are unknown.
    ours : whether a ship (mmsi) belongs to the split; others are unknown.

    Returns
    -------
    dict of azimuth_deg, range_m, range_rate_mps float32 and known bool, dims (minute, ship).
    """
    columns: dict[str, list[np.ndarray]] = {
        name: [] for name in ("azimuth_deg", "range_m", "range_rate_mps", "known")
    }
    tracks = [] if ais is None or not len(ais) else reference_tracks(
        ais, station, max_range_m=max_range_m, max_cpa_m=None, max_interpolation_s=max_interpolation_s
    )  # fmt: skip
    for track in tracks:
        azimuth, distance, rate = track.heard(minutes, delay)
        emitted = minutes - delay(np.nan_to_num(distance, nan=max_range_m))
        latest = track.time[-1] + FADE_S + float(delay(np.array(max_range_m)))
        known = np.isfinite(distance) & ~track.at(emitted)[2]
        about = (minutes > track.time[0] - FADE_S) & (minutes < latest)
        about &= ~(distance > max_range_m)
        if not about.any():
            continue
        values = (azimuth, distance, rate, known & bool(ours(track.mmsi)))
        for name, value in zip(columns, values, strict=True):
            columns[name].append(np.where(about, value, np.nan if name != "known" else True))
    empty = np.empty((len(minutes), 0))
    stacked = {name: np.stack(found, axis=1) if found else empty for name, found in columns.items()}
    return {name: values.astype(bool if name == "known" else np.float32) for name, values in stacked.items()}
