"""Positions of ships in, those out that a ship can have reached.

A wrong position, or a second ship under the same MMSI, implies a jump faster than any ship; it does not say
which end is wrong. Of each MMSI the largest set of reports is kept that needs no such jump.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

MAX_SPEED_MPS = 60 * 1852 / 3600
SLACK_M = 1000.0
WINDOW = 512
EARTH_RADIUS_M = 6371e3


def distance_m(
    lat1: np.ndarray | float, lon1: np.ndarray | float, lat2: np.ndarray | float, lon2: np.ndarray | float
) -> np.ndarray:
    """Great-circle distance [m] of points in degrees on a sphere.

    >>> round(float(distance_m(0.0, 0.0, 1.0, 0.0)))
    111195
    """
    phi1, phi2, half = np.deg2rad(lat1), np.deg2rad(lat2), np.deg2rad(np.subtract(lon2, lon1)) / 2
    square = np.sin((phi2 - phi1) / 2) ** 2 + np.cos(phi1) * np.cos(phi2) * np.sin(half) ** 2
    return 2 * EARTH_RADIUS_M * np.arcsin(np.sqrt(np.minimum(square, 1.0)))


def drop_jumps(ais: pd.DataFrame) -> np.ndarray:
    """Mask of the reports of a table sorted by ship and time that fit a motion below 60 knots.

    A slack of 1 km allows for stamps to the minute and for rounded positions.
    """
    mmsi, lat, lon = (ais[name].to_numpy() for name in ("mmsi", "lat", "lon"))
    seconds = ais["time"].to_numpy("datetime64[ns]").astype("int64") / 1e9
    keep = np.ones(len(ais), bool)
    same = mmsi[1:] == mmsi[:-1]
    reach = MAX_SPEED_MPS * np.diff(seconds) + SLACK_M
    jumps = same & (distance_m(lat[:-1], lon[:-1], lat[1:], lon[1:]) > reach)
    for ship in np.unique(mmsi[1:][jumps]):
        start, stop = np.searchsorted(mmsi, [ship, ship + 1])
        keep[start:stop] = _longest_chain(seconds[start:stop], lat[start:stop], lon[start:stop])
    return keep


def _longest_chain(seconds: np.ndarray, lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
    """Mask of the longest sequence of reports whose every step a ship can make; of equals, the shortest way.

    Dynamic programming: score(i) = 1 + max of score(j) - distance(j, i)/1e9 over the reachable j before i,
    looked for among the last `WINDOW` reports first.
    """
    score = np.ones(len(seconds))
    before = np.full(len(seconds), -1)
    for i in range(1, len(seconds)):
        for start in dict.fromkeys((max(i - WINDOW, 0), 0)):
            part = slice(start, i)
            apart = distance_m(lat[part], lon[part], lat[i], lon[i])
            value = np.where(
                apart <= MAX_SPEED_MPS * (seconds[i] - seconds[part]) + SLACK_M, score[part] - apart / 1e9, 0
            )
            best = int(value.argmax())
            if value[best] > 0:
                score[i], before[i] = 1 + value[best], start + best
                break
    keep = np.zeros(len(seconds), bool)
    i = int(score.argmax())
    while i >= 0:
        keep[i] = True
        i = int(before[i])
    return keep
