"""Detections and tracks against the ships of an AIS file: the core paper's Table I and what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from obsnet.ais.tracks import DelayFunction, ReferenceTrack
from obsnet.errors import LayoutError
from obsnet.evaluation.detections import (
    Comparison,
    DetectionCriteria,
    Statistics,
    compare,
    heard_span,
    minute_scores,
    smad,
    step_s,
)
from obsnet.evaluation.table import Evaluation, ShipScore
from obsnet.evaluation.tracks import MatchGates, coverage, match_tracks, track_errors, turned_to, utc
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import iso, to_posix
from obsnet.trackers.track import Track

DETECTIONS = ("time", "coverage", "azimuth_deg", "range_m", "range_rate_mps")
TRACKS = ("cpa_time", "cpa_distance_m", "course_deg", "speed_mps")
TRACKER_ERRORS = (
    "cpa_time_error_s",
    "course_error_deg",
    "cpa_distance_error_m",
    "speed_error_mps",
    "cpa_azimuth_error_deg",
)
WORKING_HALF_SPAN_S = 1800.0


def evaluate(
    detections: pd.DataFrame,
    tracks: pd.DataFrame | Sequence[Track],
    reference: list[ReferenceTrack],
    delay: DelayFunction | None = None,
    criteria: DetectionCriteria = DetectionCriteria(),
    gates: MatchGates = MatchGates(),
    expected_cpa_m: float | None = None,
) -> Evaluation:
    """Score a run against AIS.

    Parameters
    ----------
    detections : DataFrame
        Columns of detections.csv: what was heard at each minute.
    tracks : DataFrame or sequence of Track
        Columns of tracks.csv: where the ships were, the sound's travel time undone. Those whose `ambiguity_deg`, where there
        is such a column, is 180 may lie on the other side of the station.
    reference : list of ReferenceTrack
        The ships. Those that the station did not hear within the record are left out.
    delay : function of range [m] giving the sound's travel time [s], optional
        Detections are compared with the ships as heard through it; without it sound is taken to need no time.
    expected_cpa_m : float, optional
        Ships that come no closer may be found, but are not missed and have no row otherwise.

    Returns
    -------
    Evaluation
        Errors of the tracker are against each ship's course at its CPA (AIS of half an hour), which is what a track
        states; and, as the core paper has them, against the straight line through all its AIS positions. A ship is
        missed when its CPA lies within the working record and no track is assigned to it within `gates`.
    """
    detections, tracks = _checked(detections, DETECTIONS, "detections"), _track_table(tracks)
    times = to_posix(detections["time"].to_numpy("datetime64[ns]"))
    if len(times):
        spans = [heard_span(track, delay) for track in reference]
        reference = [
            t
            for t, (start, end) in zip(reference, spans, strict=True)
            if end >= times.min() and start <= times.max()
        ]
    lines = [track.course_at_cpa() for track in reference]
    compared = compare(detections, reference, delay, criteria)
    half_known = tracks["ambiguity_deg"] == 180.0 if "ambiguity_deg" in tracks else False
    tracks = turned_to(tracks, lines, gates, half_known | (criteria.azimuth_period_deg == 180.0))
    matches = match_tracks(tracks, lines, gates)
    nearest = np.inf if expected_cpa_m is None else expected_cpa_m
    ships = tuple(
        _ship(i, track, lines[i], compared, tracks, matches.get(i), detections, delay, nearest)
        for i, track in enumerate(reference)
        if i in matches or abs(lines[i].cpa_range_m) <= nearest
    )
    numbers = tracks["track"].tolist() if "track" in tracks else list(range(1, len(tracks) + 1))
    return Evaluation(
        ships=ships,
        total=_total(ships, compared.total),
        missed=tuple(row.number for row in ships if row.number and row.track is None and row.expected),
        false_tracks=tuple(int(numbers[i]) for i in range(len(tracks)) if i not in matches.values()),
        tracks=len(tracks),
        minutes=minute_scores(detections, compared),
        coverage=coverage(tracks, lines, matches),
        against_lines=_against_lines(tracks, matches, [track.line() for track in reference]),
        notes=_notes(ships, detections, criteria),
    )


def _ship(
    index: int,
    track: ReferenceTrack,
    line: StraightCourse,
    compared: Comparison,
    tracks: pd.DataFrame,
    match: int | None,
    detections: pd.DataFrame,
    delay: DelayFunction | None,
    expected_cpa_m: float,
) -> ShipScore:
    minutes = to_posix(detections["time"].to_numpy("datetime64[ns]"))
    heard = minutes[compared.heard[index]]
    travel = 0.0 if delay is None else float(np.asarray(delay(np.array([abs(line.cpa_range_m)])))[0])
    about = np.abs(minutes - line.cpa_time - travel) <= WORKING_HALF_SPAN_S
    wanted = 2 * WORKING_HALF_SPAN_S / step_s(detections)
    working = float(np.nansum(detections["coverage"].to_numpy(float)[about])) / wanted
    tracker: dict[str, Any] = {} if match is None else _tracker_errors(tracks, match, line)
    return ShipScore(
        index + 1,
        track.mmsi,
        track.name,
        iso(float(round(line.cpa_time))),
        abs(line.cpa_range_m),
        *compared.ships[index],
        **tracker,
        interpolated=float(track.at(heard)[2].mean()) if len(heard) else float("nan"),
        expected=bool(working >= 0.5 and abs(line.cpa_range_m) <= expected_cpa_m),
    )


def _tracker_errors(tracks: pd.DataFrame, match: int, line: StraightCourse) -> dict[str, Any]:
    row = tracks.iloc[match]
    time, distance, course, speed = (
        float(error) for error in track_errors(tracks.iloc[[match]], [line])[0, 0]
    )
    azimuth = float(row.get("cpa_azimuth_deg", np.nan))
    return {
        "track": int(row.get("track", match + 1)),
        "cpa_time_error_s": time,
        "course_error_deg": course,
        "cpa_distance_error_m": distance,
        "speed_error_mps": speed,
        "cpa_azimuth_error_deg": float(wrap180(azimuth - line.cpa_azimuth_deg)),
    }


def _against_lines(
    tracks: pd.DataFrame, matches: dict[int, int], lines: list[StraightCourse]
) -> dict[str, float]:
    """SMAD of the matched tracks' errors against other courses of the ships."""
    found = [_tracker_errors(tracks, row, lines[ship]) for ship, row in matches.items()]
    return {name: smad(np.array([errors[name] for errors in found], float)) for name in TRACKER_ERRORS}


def _total(ships: tuple[ShipScore, ...], statistics: Statistics) -> ShipScore:
    spreads: dict[str, Any] = {
        name: smad(np.array([getattr(ship, name) for ship in ships], float)) for name in TRACKER_ERRORS
    }
    return ShipScore(None, None, "All", "", float("nan"), *statistics, **spreads)


def _notes(
    ships: tuple[ShipScore, ...], detections: pd.DataFrame, criteria: DetectionCriteria
) -> tuple[str, ...]:
    notes = []
    if not ships:
        notes.append(
            "no ship to compare with was about during the record: all detections and tracks count as false"
        )
    if not len(detections):
        notes.append("the run holds no minute")
    stale = [str(ship.number) for ship in ships if ship.interpolated > 0.5]
    if stale:
        notes.append(f"AIS is sparse for ship {', '.join(stale)}: most minutes are far from any report")
    if criteria.azimuth_period_deg == 180.0:
        notes.append("azimuths are ambiguous by 180° and were compared so")
    return tuple(notes)


def _track_table(tracks: pd.DataFrame | Sequence[Track]) -> pd.DataFrame:
    if isinstance(tracks, pd.DataFrame):
        return _checked(tracks, TRACKS, "tracks") if len(tracks) else pd.DataFrame(columns=list(TRACKS))
    rows = [
        {
            **track.row(i),
            "covariance": track.covariance,
            "signed_cpa_m": track.motion.cpa_range_m,
            "ambiguity_deg": track.ambiguity_deg,
        }
        for i, track in enumerate(tracks, 1)
    ]
    return _checked(pd.DataFrame(rows), TRACKS, "tracks") if rows else pd.DataFrame(columns=list(TRACKS))


def _checked(table: pd.DataFrame, columns: tuple[str, ...], name: str) -> pd.DataFrame:
    missing = [column for column in columns if column not in table]
    if missing:
        found = ", ".join(map(str, table.columns)) or "no column"
        raise LayoutError(f"the {name} lack {', '.join(missing)}; found {found}")
    return table.assign(**{name: utc(table[name]) for name in columns if name.endswith("time")})
