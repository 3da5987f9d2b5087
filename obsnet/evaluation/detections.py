"""Detections against ships: errors of each minute, their spread (SMAD), and the share of minutes that are
right.

A detection says what the station heard at a minute, so it is compared with each ship as heard then. Where
several ships are about, each detection is compared with each of them, as the core paper's authors did.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd

from obsnet.ais.tracks import DelayFunction, ReferenceTrack
from obsnet.errors import ConfigError
from obsnet.layout import to_posix

SMAD_FACTOR = 1.4826


@dataclass(frozen=True)
class DetectionCriteria:
    """When a detection counts as one of a ship (core paper's Table I), and when a minute is right.

    Parameters
    ----------
    azimuth_gate_deg, range_gate_m, range_rate_gate_mps : float
        Detections within these of a ship count for it.
    right_azimuth_deg : float
        An azimuth closer than this to a ship's is right.
    right_range_m, right_range_share : float
        A range closer than the greater of these (metres, share of the range) to a ship's is right.
    range_limit_m : float
        Beyond it no range is expected.
    azimuth_period_deg : float
        180 where the station cannot tell an azimuth from its opposite (no hydrophone).
    """

    azimuth_gate_deg: float = 45.0
    range_gate_m: float = 5000.0
    range_rate_gate_mps: float = 3.0
    right_azimuth_deg: float = 10.0
    right_range_m: float = 500.0
    right_range_share: float = 0.03
    range_limit_m: float = 50e3
    azimuth_period_deg: float = 360.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ConfigError(f"{field.name} must be positive, found {getattr(self, field.name)}")
        if self.azimuth_period_deg not in (180.0, 360.0):
            raise ConfigError(f"azimuth_period_deg must be 180 or 360, found {self.azimuth_period_deg}")


Statistics = tuple[int, float, int, float, float]
"""Azimuths counted, their SMAD [deg], ranges counted, SMAD of range [m] and of range rate [m/s]."""


@dataclass(frozen=True)
class Comparison:
    """Detections against ships.

    Attributes ---------- ships : Statistics of each ship. total : those of all, each detection counted
    once, for the ship it fits best. heard : minutes (indices) at which each ship is heard within the disc.
    present, near : minutes with a ship in the disc, and with one within the range detector's reach.
    right_azimuth, right_range : minutes whose estimate is right for some ship.
    """

    ships: list[Statistics]
    total: Statistics
    heard: list[np.ndarray]
    present: np.ndarray
    near: np.ndarray
    right_azimuth: np.ndarray
    right_range: np.ndarray


def smad(errors: np.ndarray) -> float:
    """Standardised median absolute deviation about zero: 1.4826 × median |error|; NaN of nothing.

    >>> smad(np.array([-1.0, 2.0, np.nan, 3.0]))
    2.9652
    """
    errors = np.abs(errors[np.isfinite(errors)])
    return float(SMAD_FACTOR * np.median(errors)) if errors.size else float("nan")


def compare(
    detections: pd.DataFrame,
    reference: list[ReferenceTrack],
    delay: DelayFunction | None,
    criteria: DetectionCriteria,
) -> Comparison:
    """Compare every detection with every ship, as the station heard it."""
    times = to_posix(detections["time"].to_numpy("datetime64[ns]"))
    estimates = detections[["azimuth_deg", "range_m", "range_rate_mps"]].to_numpy(float).T
    best = np.full((3, len(times)), np.inf)
    flags = np.zeros((4, len(times)), bool)
    ships, minutes = [], []
    for track in reference:
        start, end = heard_span(track, delay)
        heard = np.flatnonzero((times >= start) & (times <= end))
        truth = np.array(track.heard(times[heard], delay))
        errors, right = _errors(estimates[:, heard], truth, criteria)
        ships.append(_statistics(errors))
        minutes.append(heard)
        flags[:, heard] |= [np.ones(len(heard), bool), truth[1] <= criteria.range_limit_m, *right]
        for rows in ([0], [1, 2]):
            closer = heard[np.abs(errors[rows[0]]) < np.abs(best[rows[0], heard])]
            best[np.ix_(rows, closer)] = errors[np.ix_(rows, np.searchsorted(heard, closer))]
    return Comparison(ships, _statistics(best), minutes, *flags)


def _errors(
    estimates: np.ndarray, truth: np.ndarray, criteria: DetectionCriteria
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Errors that count for a ship, NaN elsewhere; where azimuth and range are right."""
    errors = estimates - truth
    half = criteria.azimuth_period_deg / 2
    errors[0] = (errors[0] + half) % (2 * half) - half
    tolerance = np.maximum(criteria.right_range_m, criteria.right_range_share * truth[1])
    right = np.abs(errors[0]) <= criteria.right_azimuth_deg, np.abs(errors[1]) <= tolerance
    ranged = np.abs(errors[1]) < criteria.range_gate_m
    ranged &= np.abs(errors[2]) < criteria.range_rate_gate_mps
    counted = np.array([np.abs(errors[0]) < criteria.azimuth_gate_deg, ranged, ranged])
    return np.where(counted, errors, np.nan), right


def _statistics(errors: np.ndarray) -> Statistics:
    azimuth, distance = (int(np.isfinite(errors[row]).sum()) for row in (0, 1))
    return azimuth, smad(errors[0]), distance, smad(errors[1]), smad(errors[2])


def heard_span(track: ReferenceTrack, delay: DelayFunction | None) -> tuple[float, float]:
    """Times at which the station hears a ship enter and leave the disc, s since 1970."""
    if delay is None:
        return track.starttime, track.endtime
    east, north, _ = track.at(np.array([track.starttime, track.endtime]))
    start, end = np.array([track.starttime, track.endtime]) + np.asarray(delay(np.hypot(east, north)), float)
    return float(start), float(end)


def minute_scores(detections: pd.DataFrame, found: Comparison) -> dict[str, dict[str, float]]:
    """How often the minutes are right: for azimuth and for range.

    Returns
    -------
    dict
        For each: ``minutes`` with a ship to be heard and a working station, ``right`` share of them,
        ``estimates`` in all, ``right_estimates`` share of these, and ``wrong_or_false_per_hour`` of record:
        estimates that fit no ship, be there one or none.
    """
    covered = detections["coverage"].to_numpy(float) > 0
    hours = float(covered.sum()) * step_s(detections) / 3600.0
    cases = {
        "azimuth": (found.right_azimuth, found.present, "azimuth_deg"),
        "range": (found.right_range, found.near, "range_m"),
    }
    scores = {}
    for name, (right, expected, column) in cases.items():
        wanted = expected & covered
        estimated = detections[column].notna().to_numpy()
        scores[name] = {
            "minutes": int(wanted.sum()),
            "right": _ratio((right & wanted).sum(), wanted.sum()),
            "estimates": int(estimated.sum()),
            "right_estimates": _ratio((right & estimated).sum(), estimated.sum()),
            "wrong_or_false_per_hour": _ratio((estimated & ~right).sum(), hours),
        }
    return scores


def step_s(detections: pd.DataFrame) -> float:
    """Time between rows, s: their median distance (60 s of a single row)."""
    steps = np.diff(np.sort(to_posix(detections["time"].to_numpy("datetime64[ns]"))))
    return float(np.median(steps)) if len(steps) else 60.0


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else float("nan")
