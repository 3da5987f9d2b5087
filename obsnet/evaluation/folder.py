"""A run's folder and an AIS file in, the run's evaluation out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from obsnet.ais import ReferenceTrack, read, reference_tracks
from obsnet.ais.tracks import DelayFunction, is_merchant
from obsnet.config import build
from obsnet.console import counted
from obsnet.errors import ConfigError, LayoutError
from obsnet.evaluation.detections import DetectionCriteria
from obsnet.evaluation.score import DETECTIONS, TRACKS, evaluate
from obsnet.evaluation.table import Evaluation
from obsnet.evaluation.tracks import utc
from obsnet.layout import to_posix


def evaluate_folder(
    folder: str | Path,
    ais: str | Path | list[ReferenceTrack],
    *,
    max_range_m: float = 100e3,
    max_cpa_m: float = 25e3,
    merchant_only: bool = False,
) -> Evaluation:
    """Score the run in a folder written by ``obsnet track`` against an AIS file.

    The station and the ocean, hence the sound's travel time, are those of the folder's run.json.

    Parameters
    ----------
    max_range_m, merchant_only : as for `obsnet.ais.reference_tracks`; a note says how many ships the latter left out.
    max_cpa_m : ships that come no closer need not be found; a track of such a ship is not false.

    Raises
    ------
    LayoutError
        The folder is not one of a run. AISError: the AIS file cannot serve. ConfigError: a distance is not above 0.
    """
    if not (max_range_m > 0 and max_cpa_m > 0):
        raise ConfigError(
            f"ships are followed and expected to distances above 0, found {max_range_m / 1e3:g} km and {max_cpa_m / 1e3:g} km"
        )
    detections, tracks, info = _read_tables(folder)
    try:
        station = {key: float(info["station"][key]) for key in ("latitude", "longitude", "depth_m")}
        place = station["latitude"], station["longitude"]
        kept = Path(folder, Path(info["propagation_table"]).name) if "propagation_table" in info else None
        delay = _delay_of_run(info["config"], station["depth_m"], kept)
        ambiguous = info.get("azimuth_ambiguity_deg", 360) == 180
        half_known = tracks["track"].isin(info.get("ambiguous_tracks", []))
    except (KeyError, TypeError, ValueError) as error:
        raise LayoutError(
            f"{folder}/run.json does not describe a run of obsnet ({error}); run obsnet track again"
        ) from None
    said: list[str] = []
    if not isinstance(ais, list):
        positions = read(ais, near=place, within_m=max_range_m + 400e3)
        said += positions.attrs["report"].complaint()
        ais = reference_tracks(positions, place, max_range_m=max_range_m, max_cpa_m=None)
    if merchant_only:
        merchants = [track for track in ais if is_merchant(track.attributes.get("ship_type"))]
        said += _left_out([track for track in ais if track not in merchants], detections, max_cpa_m)
        ais = merchants
    tracks = tracks.assign(ambiguity_deg=half_known.map({True: 180.0, False: 360.0}))
    criteria = DetectionCriteria(azimuth_period_deg=180.0 if ambiguous else 360.0)
    found = evaluate(detections, tracks, ais, delay, criteria, expected_cpa_m=max_cpa_m)
    return replace(found, notes=(*said, *found.notes))


def _left_out(others: list[ReferenceTrack], detections: pd.DataFrame, max_cpa_m: float) -> list[str]:
    """What to say of ships that are no merchants, or not known to be, and passed while the station recorded."""
    times = to_posix(detections["time"].to_numpy("datetime64[ns]"))
    about = [
        track.attributes.get("ship_type")
        for track in others
        if times.size and track.endtime >= times.min() and track.starttime <= times.max()
        if track.cpa().range_m <= max_cpa_m
    ]
    if not about:
        return []
    unknown = sum(kind in (None, "0") for kind in about)
    return [
        f"{counted(len(about), 'ship')} left out as no merchant ({unknown} of unknown type); a track of such a ship counts as false"
    ]


def _read_tables(folder: str | Path) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Any]]:
    """Detections, tracks and run.json of a folder written by ``obsnet track``.

    Raises
    ------
    LayoutError
        A file is missing, is no table, lacks a column or holds an unreadable value.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise LayoutError(f"{folder} is not a folder; give one that obsnet track has written")
    detections = _read_table(folder / "detections.csv", DETECTIONS, ("time",))
    tracks = _read_table(folder / "tracks.csv", TRACKS, ("cpa_time",))
    try:
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LayoutError(
            f"cannot read {folder / 'run.json'}: {_reason(error)}; run obsnet track again"
        ) from None
    return detections, tracks, info if isinstance(info, dict) else {}


def _read_table(path: Path, columns: tuple[str, ...], times: tuple[str, ...]) -> pd.DataFrame:
    try:
        table = pd.read_csv(path)
        missing = [column for column in columns if column not in table]
        if missing:
            found = ", ".join(map(str, table.columns))
            raise LayoutError(f"{path} lacks the column {', '.join(missing)}; found {found[:200]}")
        for column in columns:
            if column in times:
                table[column] = utc(table[column])
            else:
                table[column] = pd.to_numeric(table[column]).astype(float)
    except OSError as error:
        raise LayoutError(
            f"cannot read {path}: {_reason(error)}; give a folder that obsnet track has written"
        ) from None
    except (ValueError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        if isinstance(error, LayoutError):
            raise
        raise LayoutError(f"{path} is not a table of obsnet: {_reason(error)}") from None
    return table


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())[:200]


def _delay_of_run(config: dict[str, Any], depth_m: float, kept: Path | None = None) -> DelayFunction:
    from obsnet.ocean.rays import propagation_table, travel_time
    from obsnet.pipeline import RunConfig

    try:
        return travel_time(propagation_table(build(RunConfig, config).ocean, depth_m, kept))
    except ConfigError as error:
        raise LayoutError(
            f"run.json is of another version of obsnet: {error}; run obsnet track again"
        ) from None
