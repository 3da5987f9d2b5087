"""Tracks against ships: which is which, how far off, and whether the stated uncertainties hold."""

from __future__ import annotations

from dataclasses import dataclass, fields
from statistics import NormalDist

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import to_posix

PARAMETERS = ("cpa_time_s", "cpa_distance_m", "course_deg", "speed_mps")
STDS = ("cpa_time_std_s", "cpa_distance_std_m", "course_std_deg", "speed_std_mps")
LEVELS = (0.5, 0.9)


@dataclass(frozen=True)
class MatchGates:
    """How far off a track may be from a ship's straight course and still be that ship's.

    Parameters
    ----------
    cpa_time_s, cpa_distance_m, course_deg, speed_mps : float
        Greatest error in each. What a track does not observe is not held against it.
    """

    cpa_time_s: float = 1800.0
    cpa_distance_m: float = 10e3
    course_deg: float = 45.0
    speed_mps: float = 5.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ConfigError(
                    f"the gate {field.name} must be positive, found {getattr(self, field.name)}"
                )


def track_errors(tracks: pd.DataFrame, lines: list[StraightCourse]) -> np.ndarray:
    """Errors (track, ship, 4) of tracks in `PARAMETERS` against straight courses; NaN where not observed."""
    found = np.column_stack(
        [
            to_posix(utc(tracks["cpa_time"]).to_numpy()),
            *(tracks[name].to_numpy(float) for name in ("cpa_distance_m", "course_deg", "speed_mps")),
        ]
    ).reshape(len(tracks), 1, 4)
    truth = np.array(
        [[line.cpa_time, abs(line.cpa_range_m), line.course_deg, line.speed_mps] for line in lines]
    )
    errors = found - truth.reshape(1, len(lines), 4)
    errors[..., 2] = wrap180(errors[..., 2])
    return errors


def turned_to(
    tracks: pd.DataFrame, lines: list[StraightCourse], gates: MatchGates, half_known: pd.Series | bool
) -> pd.DataFrame:
    """Tracks, those known up to half a turn about the station on the side on which they come nearer to a ship's straight course."""
    if not len(tracks) or not lines or not np.any(half_known):
        return tracks
    columns = [name for name in ("course_deg", "cpa_azimuth_deg") if name in tracks]
    other = tracks.assign(**{name: (tracks[name].to_numpy(float) + 180.0) % 360.0 for name in columns})
    as_is, opposite = (
        np.nansum(_scaled(side, lines, gates) ** 2, axis=2).min(axis=1) for side in (tracks, other)
    )
    return tracks.where(
        pd.Series(as_is <= opposite, tracks.index) | ~pd.Series(half_known, tracks.index), other
    )


def _scaled(tracks: pd.DataFrame, lines: list[StraightCourse], gates: MatchGates) -> np.ndarray:
    """Sizes of errors in units of the gates."""
    return np.abs(track_errors(tracks, lines)) / [getattr(gates, field.name) for field in fields(gates)]


def utc(column: pd.Series) -> pd.Series:
    """Times without time zone (datetime64[ns], UTC) of a column of ISO 8601 text or of times."""
    return pd.to_datetime(column, format="ISO8601", utc=True).dt.tz_localize(None).astype("datetime64[ns]")


def match_tracks(
    tracks: pd.DataFrame, lines: list[StraightCourse], gates: MatchGates = MatchGates()
) -> dict[int, int]:
    """Assign tracks to ships one to one, with the least sum of squared errors in units of the gates.

    Parameters
    ----------
    tracks : DataFrame with the columns of tracks.csv.
    lines : straight courses of the ships.

    Returns
    -------
    dict
        Row of the track for each ship matched. As many ships as possible are matched before the sum is made
        small.
    """
    if not len(tracks) or not lines:
        return {}
    scaled = _scaled(tracks, lines, gates)
    allowed = ~(scaled > 1.0).any(axis=2) & np.isfinite(scaled[..., 0])
    forbidden = 1e6
    cost = np.where(allowed, np.nansum(scaled**2, axis=2), forbidden)
    rows, columns = linear_sum_assignment(cost)
    return {int(ship): int(row) for row, ship in zip(rows, columns, strict=True) if allowed[row, ship]}


def coverage(
    tracks: pd.DataFrame, lines: list[StraightCourse], matches: dict[int, int]
) -> dict[str, dict[str, float]]:
    """Share of matched tracks whose stated 50 % and 90 % intervals hold the truth, for each parameter.

    Where the table carries a ``covariance`` column (4×4 over time, signed CPA range, course, speed),
    ``joint`` is the share whose error lies in the ellipsoid of that probability, χ² with four degrees of
    freedom.
    """
    inside: dict[str, list[float]] = {name: [] for name in PARAMETERS}
    joint: list[float] = []
    for ship, row in matches.items():
        track, line = tracks.iloc[row], lines[ship]
        errors = track_errors(tracks.iloc[[row]], [line])[0, 0]
        for name, column, error in zip(PARAMETERS, STDS, errors, strict=True):
            std = float(track.get(column, np.nan))
            if np.isfinite(error) and np.isfinite(std) and std > 0:
                inside[name].append(abs(error) / std)
        covariance = track.get("covariance")
        if covariance is not None and np.isfinite(covariance).all():
            errors[1] = track["signed_cpa_m"] - line.cpa_range_m
            joint.append(float(errors @ np.linalg.solve(covariance, errors)))
    limits = [NormalDist().inv_cdf(0.5 + level / 2) for level in LEVELS]
    held = {name: _shares(deviations, limits) for name, deviations in inside.items()}
    if joint:
        held["joint"] = _shares(joint, [float(chi2.ppf(level, 4)) for level in LEVELS])
    return held


def _shares(values: list[float], limits: list[float]) -> dict[str, float]:
    """Number of tracks, and the share of them below each limit."""
    shares = [float(np.mean(np.array(values) <= limit)) if values else float("nan") for limit in limits]
    return {"tracks": len(values), "50_percent": shares[0], "90_percent": shares[1]}
