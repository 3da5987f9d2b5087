"""A run's maps in, its tracks out: segments of what was heard, the grid search in each, bearings alone where no range was heard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.detectors.maps import LikelihoodMaps, known_sides, two_sided
from obsnet.errors import ConfigError
from obsnet.layout import to_posix
from obsnet.ocean.rays import travel_time
from obsnet.pipeline import NEEDS_FULL_AZIMUTHS, RunConfig
from obsnet.trackers.grid_search import search
from obsnet.trackers.remainder import Ghosts
from obsnet.trackers.segmentation import segments
from obsnet.trackers.steady import outdoes_steady_sources
from obsnet.trackers.track import USUAL_MPS, Segment, Track

NEIGHBOUR_S = 3600.0
"""A track that ended no longer than this before a segment may explain what is heard in it."""
BEARINGS_SHORTEST_S = 3600.0
"""Bearings over less say too little of where a ship is, and that it is one."""


class Heard(Protocol):
    """What tracks are looked for in: the part of a `Run` that is there when all is heard."""

    config: RunConfig
    maps: LikelihoodMaps
    detections: pd.DataFrame
    presence: pd.DataFrame
    table: xr.Dataset
    live: pd.DataFrame


def find_tracks(run: Heard, threads: int = 1) -> tuple[list[Segment], list[Track]]:
    """Segments of a run's presence and the tracks within them, in time order."""
    delay = travel_time(run.table)
    found = (
        _followed(run)
        if run.config.tracker == "bernoulli"
        else segments(run.presence, run.config.segmentation)
    )
    tracks: list[Track] = []
    for segment in found:
        near = [known for known in tracks if known.end > segment.start - NEIGHBOUR_S]
        tracks += segment_tracks(run, segment, delay, near, threads)
    return found, sorted(tracks, key=lambda found: found.motion.cpa_time)


def segment_tracks(
    run: Heard,
    segment: Segment,
    delay: Callable[[np.ndarray], np.ndarray],
    near: list[Track],
    threads: int = 1,
) -> list[Track]:
    """Tracks of one segment, given those found up to `NEIGHBOUR_S` before it; strongest first."""
    ghosts = Ghosts(run.table, run.config.range.pairs) if "range_llr" in run.maps else None
    new = search(run.maps, segment, delay, run.config.grid_search, threads, near, ghosts)
    if not new and not near and not _range_heard(run, segment):
        new = _by_bearings(run, segment, delay)
    return [_said_ambiguous(found) if _two_sided(run, found) else found for found in new]


def _said_ambiguous(track: Track) -> Track:
    method = f"{track.method}; course ambiguous by 180°"
    return replace(track, method=method, extra=track.extra | {"ambiguity_deg": 180.0})


def _two_sided(run: Heard, track: Track) -> bool:
    """Whether none of a track's minutes with an azimuth tells it from the opposite one."""
    if "azimuth_llr" not in run.maps:
        return False
    if ambiguity_deg(run) == 180:
        return True
    times = to_posix(run.maps["time"].values)
    said = (
        run.maps["azimuth_llr"]
        .isel(time=np.flatnonzero((times >= track.start) & (times <= track.end)))
        .values
    )
    said = said[np.nan_to_num(said).max(axis=1) > 0]
    return bool(len(said) and two_sided(said).all())


def ambiguity_deg(run: Heard) -> int:
    """180 where no azimuth of the run is told from its opposite, else 360."""
    return int(run.maps["azimuth"].attrs.get("ambiguity_deg", 360)) if "azimuth" in run.maps else 360


def _followed(run: Heard) -> list[Segment]:
    """Segments in which the Bernoulli filter, minute by minute, holds a ship for sure (existence over 0.9)."""
    from obsnet.trackers.bernoulli import track_azimuth

    if "azimuth_llr" not in run.maps or ambiguity_deg(run) != 360:
        raise ConfigError(NEEDS_FULL_AZIMUTHS)
    times = to_posix(run.maps["time"].values)
    held = track_azimuth(times, known_sides(run.maps["azimuth_llr"].values), run.maps["azimuth"].values)
    run.live = pd.DataFrame(
        {
            "time": run.maps["time"].values,
            "existence": held.existence,
            "azimuth_deg": held.azimuth_deg,
            "azimuth_std_deg": held.azimuth_std_deg,
        }
    )
    sure = np.flatnonzero(np.diff(np.concatenate([[False], held.existence > 0.9, [False]]).astype(np.int8)))
    stretches = [
        Segment(float(times[lo]), float(times[hi - 1])) for lo, hi in zip(sure[::2], sure[1::2], strict=True)
    ]
    return [s for s in stretches if s.end - s.start >= 60.0 * run.config.segmentation.shortest_min]


def _range_heard(run: Heard, segment: Segment) -> bool:
    """Whether the range detector heard anything in a tenth of a segment's minutes."""
    if "range" not in run.presence:
        return False
    inside = run.presence.loc[segment.start : segment.end, "range"]
    return bool((inside > 0).mean() > 0.1)


def _by_bearings(run: Heard, segment: Segment, delay: Callable[[np.ndarray], np.ndarray]) -> list[Track]:
    """Track from the azimuths alone, for a segment in which no range was heard; speed is then a prior's."""
    from obsnet.trackers.bearings_only import track_bearings

    inside = (run.presence.index >= segment.start) & (run.presence.index <= segment.end)
    azimuth = run.detections["azimuth_deg"].to_numpy(float)[inside]
    if np.isfinite(azimuth).sum() < 30 or run.maps["azimuth"].attrs.get("ambiguity_deg", 360) != 360:
        return []
    config = run.config.azimuth
    found = track_bearings(
        run.presence.index.to_numpy(float)[inside],
        azimuth,
        5.0,
        correlation_s=config.window_s,
        speed_mps=USUAL_MPS[0],
        speed_std_mps=USUAL_MPS[1],
        delay=delay,
    )
    if found is None or found.end - found.start < BEARINGS_SHORTEST_S:
        return []
    return [found] if outdoes_steady_sources(run.maps, found, delay, run.config.grid_search) else []
