"""Finished minutes in; out, the ship that is heard now, and the tracks of the segments that have closed."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from pyproj import Proj

from obsnet import netcdf
from obsnet.detectors.maps import LikelihoodMaps, known_sides
from obsnet.errors import FilterError
from obsnet.kinematics import BentCourse, StraightCourse
from obsnet.layout import from_posix, iso, to_posix
from obsnet.live.config import WatchConfig
from obsnet.live.store import LIVE_COLUMNS, Store
from obsnet.ocean.rays import travel_time
from obsnet.pipeline import Minutes
from obsnet.run import Run
from obsnet.signals.station import Station
from obsnet.tables import DETECTION_COLUMNS, TRACK_COLUMNS
from obsnet.trackers.bernoulli_range import StationTracker
from obsnet.trackers.segmentation import quiet_until, segments
from obsnet.trackers.track import Segment, Track
from obsnet.tracking import NEIGHBOUR_S, segment_tracks


class LiveEstimate:
    """The ship that is heard now: a Bernoulli filter over the maps, minute by minute.

    Without full azimuths (a station with one horizontal, or without a hydrophone) there is no estimate.
    """

    def __init__(self, station: Station) -> None:
        self._tracker: StationTracker | None = None
        self._local = Proj(proj="aeqd", lat_0=station.latitude, lon_0=station.longitude, datum="WGS84")
        self._last: float | None = None

    def step(self, maps: LikelihoodMaps) -> list[dict[str, Any]]:
        """A row of `LIVE_COLUMNS` for every minute of the maps."""
        if "azimuth_llr" not in maps or maps["azimuth"].attrs.get("ambiguity_deg", 360) != 360:
            return []
        ranged = "range_llr" in maps
        if self._tracker is None:
            axes = (maps["range"].values, maps["range_rate"].values) if ranged else (_RANGE_M, _RATE_MPS)
            self._tracker = StationTracker(maps["azimuth"].values, *axes)
        rows = []
        azimuth_llr = known_sides(maps["azimuth_llr"].values)
        for i, time in enumerate(to_posix(maps["time"].values)):
            chart = maps["range_llr"].values[i] if ranged else None
            rows.append(self._row(float(time), self._tracker, azimuth_llr[i], chart))
        return rows

    def _row(self, time: float, tracker: StationTracker, azimuth: np.ndarray, chart: Any) -> dict[str, Any]:
        if self._last is not None:
            for _ in range(min(round((time - self._last) / tracker.config.interval_s) - 1, 60)):
                tracker.step(None, None)
        self._last = time
        try:
            existence = tracker.step(azimuth, chart)
        except FilterError:
            self._tracker, self._last = None, None
            return {"time": iso(time), "existence": 0.0}
        (east, north, east_rate, north_rate), _ = tracker.state
        bearing, bearing_std = tracker.azimuth
        distance, distance_std = tracker.range_m
        longitude, latitude = self._local(east, north, inverse=True)
        values = (
            round(existence, 4), round(bearing, 2) % 360.0, round(bearing_std, 2), round(distance, 1), round(distance_std, 1),
            round(math.degrees(math.atan2(east_rate, north_rate)) % 360.0, 1) % 360.0, round(math.hypot(east_rate, north_rate), 2),
            round(longitude, 6), round(latitude, 6),
        )  # fmt: skip
        return dict(zip(LIVE_COLUMNS, (iso(time), *values), strict=True))

    def state(self) -> dict[str, np.ndarray]:
        """All that the next minute depends on."""
        if self._tracker is None:
            return {}
        return self._tracker.state_dict() | {"last": np.array(self._last, float)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        if state:
            self._tracker = StationTracker.from_state_dict(state)
            self._last = None if np.isnan(state["last"]) else float(state["last"])


_RANGE_M, _RATE_MPS = np.arange(0.0, 50_001.0, 500.0), np.arange(-13.0, 13.5, 1.0)


class Ships:
    """Segments and their tracks, as they close.

    Presence of the last `memory_h` hours and the maps since the last quiet minute are kept in the store.
    """

    def __init__(self, store: Store, station: Station, config: WatchConfig, table: xr.Dataset) -> None:
        self._store, self._station, self._config, self._table = store, station, config, table
        self.reread()

    def reread(self) -> None:
        """Take up what the store holds."""
        self._presence = self._store.presence()
        self._closed = float(self._store.noted("closed", -math.inf))
        self._behind = self._store.noted("behind", {"track": 0, "live": 0})

    def forget(self) -> None:
        """Drop what segments to come would need of the minutes so far; within a transaction."""
        for table in ("presence", "tiles"):
            self._store.execute(f"DELETE FROM {table}")
        self._store.forget_arrays("grid")
        self._store.execute("DELETE FROM state WHERE name = 'grid'")
        self.reread()

    def leave_behind(self) -> None:
        """Times begin anew: what was said so far is neither before nor beside what comes; within a transaction."""
        ((track,),) = self._store.rows("SELECT coalesce(max(track), 0) FROM tracks")
        ((live,),) = self._store.rows("SELECT coalesce(max(rowid), 0) FROM live")
        self._store.note("behind", {"track": track, "live": live})
        self._store.execute("DELETE FROM state WHERE name = 'closed'")
        self.reread()

    def heard_now(self) -> dict[str, Any] | None:
        """The last row of `live`, by when it was written: a clock that was set back leaves later times before it."""
        rows = self._store.rows(
            f"SELECT {', '.join(LIVE_COLUMNS)} FROM live WHERE rowid > ? ORDER BY rowid DESC LIMIT 1",
            (self._behind["live"],),
        )
        return dict(zip(LIVE_COLUMNS, rows[0], strict=True)) if rows else None

    def keep(self, minutes: Minutes) -> None:
        """Write what a segment to come may need; within a transaction."""
        store, config = self._store, self._config
        store.put_presence(minutes.presence)
        self._presence = pd.concat([self._presence, minutes.presence])
        self._presence = self._presence[~self._presence.index.duplicated(keep="last")].sort_index()
        oldest = float(self._presence.index[-1]) - 3600.0 * config.live.memory_h
        self._presence = self._presence[self._presence.index >= oldest]
        store.execute("DELETE FROM presence WHERE seconds < ?", (oldest,))
        store.put("tiles", ("seconds", "arrays"), _tiles(minutes.maps, config.grid_search.tile_s))
        quiet = quiet_until(self._presence, config.segmentation)
        needed = max(oldest, self._closed, -math.inf if quiet is None else quiet)
        # What is quiet again has closed a segment: its maps are needed until it has been searched.
        needed = min([needed, *(segment.start for segment in self.close())])
        store.execute("DELETE FROM tiles WHERE seconds < ?", (needed,))
        said, axes = _grid(minutes.maps)
        held = store.noted("grid", {"variables": {}, "axes": {}})
        if not said["variables"].keys() <= held["variables"].keys():
            store.put_arrays("grid", store.arrays("grid") | axes)
            store.note("grid", {part: held[part] | said[part] for part in said})

    def close(self, ended: bool = False) -> list[Segment]:
        """Segments that have closed and were not searched yet, in time order."""
        found = segments(self._presence, self._config.segmentation, ended)
        return [segment for segment in found if segment.start >= self._closed]

    def search(self, segment: Segment) -> list[Track]:
        """Tracks in a segment, in order of their CPA."""
        run = self._run(segment)
        near, delay = self.neighbours(segment), travel_time(self._table)
        found = segment_tracks(run, segment, delay, near, self._config.live.threads)
        return sorted(found, key=lambda track: track.motion.cpa_time)

    def say(self, segment: Segment, tracks: list[Track]) -> None:
        """Write a segment's tracks, and that it is done; within a transaction."""
        ((last,),) = self._store.rows("SELECT coalesce(max(track), 0) FROM tracks")
        rows = [tuple(_empty(track.row(number)).values()) for number, track in enumerate(tracks, last + 1)]
        self._store.put("tracks", TRACK_COLUMNS, rows)
        said = [(number, json.dumps(_said(track))) for number, track in enumerate(tracks, last + 1)]
        self._store.put("courses", ("track", "said"), said)
        self._store.note("closed", segment.end)
        self._closed = segment.end

    def tracks(self, after: int = 0) -> list[Track]:
        """Tracks said so far, after a number, in order of their numbers."""
        rows = self._store.rows("SELECT said FROM courses WHERE track > ? ORDER BY track", (after,))
        return [_track(json.loads(said)) for (said,) in rows]

    def neighbours(self, segment: Segment) -> list[Track]:
        """Tracks that may still be heard in a segment."""
        return [t for t in self.tracks(self._behind["track"]) if t.end > segment.start - NEIGHBOUR_S]

    def _run(self, segment: Segment) -> Run:
        store, config = self._store, self._config
        span = (segment.start - 1e-6, segment.end + 1e-6)
        rows = store.rows(
            "SELECT seconds, arrays FROM tiles WHERE seconds BETWEEN ? AND ? ORDER BY seconds", span
        )
        maps = _maps(store.noted("grid"), store.arrays("grid"), rows)
        inside = (self._presence.index >= span[0]) & (self._presence.index <= span[1])
        texts = (iso(segment.start)[:19], iso(segment.end)[:19] + "Z")
        detections = store.table("detections", DETECTION_COLUMNS, "WHERE time BETWEEN ? AND ?", texts)
        detections = detections.astype(dict.fromkeys(DETECTION_COLUMNS[1:], float))
        return Run(
            self._station, config, maps, xr.Dataset(), detections, self._presence[inside], [segment], [], self._table
        )  # fmt: skip


def _tiles(maps: LikelihoodMaps, tile_s: float) -> list[tuple[float, bytes]]:
    """The minutes that the grid search reads, as it would read them from the maps of a run."""
    times = to_posix(maps["time"].values)
    chosen = np.flatnonzero(np.abs(times / tile_s - np.round(times / tile_s)) * tile_s < 0.5)
    rows = []
    for i in chosen:
        file = io.BytesIO()
        arrays: dict[str, Any] = {
            str(name): netcdf.pack(str(name), values.values[i]) for name, values in maps.items()
        }
        np.savez_compressed(file, **arrays)
        rows.append((float(times[i]), file.getvalue()))
    return rows


def _grid(maps: LikelihoodMaps) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Everything about maps but their values: dims and attributes in plain values, the axes as arrays."""
    axes = {str(name): coord.values for name, coord in maps.coords.items() if name != "time"}
    said = {
        "variables": {str(name): [list(v.dims), dict(v.attrs)] for name, v in maps.items()},
        "axes": {name: dict(maps[name].attrs) for name in axes},
    }
    return said, axes


def _maps(
    said: dict[str, Any], axes: Mapping[str, np.ndarray], rows: list[tuple[float, bytes]]
) -> xr.Dataset:
    opened = []
    for _, arrays in rows:
        with np.load(io.BytesIO(arrays), allow_pickle=False) as tile:
            opened.append({name: tile[name] for name in tile.files})
    variables = {}
    for name, (dims, attrs) in said["variables"].items():
        shape = tuple(len(axes[dim]) for dim in dims[1:])
        # a detector whose channels had not come yet, or had gone: no data
        values = np.full((len(opened), *shape), np.nan if shape else 0.0, np.float32)
        for i, tile in enumerate(opened):
            if name in tile:
                values[i] = netcdf.unpack(name, tile[name])
        variables[name] = (dims, values, attrs)
    coords: dict[str, Any] = {name: (name, axes[name], attrs) for name, attrs in said["axes"].items()}
    return xr.Dataset(variables, coords | {"time": from_posix([seconds for seconds, _ in rows])})


def _empty(row: dict[str, Any]) -> dict[str, Any]:
    """A track's row with nothing where its numbers are not finite."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else _plain(v) for k, v in row.items()}


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _said(track: Track) -> dict[str, Any]:
    motion = track.motion
    return {
        "start": track.start,
        "end": track.end,
        "motion": [motion.cpa_time, motion.cpa_range_m, motion.course_deg, motion.speed_mps],
        "bends": [motion.reach_s, motion.across, motion.along, motion.turn_s, motion.turn_deg]
        if isinstance(motion, BentCourse)
        else None,
        "covariance": [[float(v) if math.isfinite(v) else None for v in row] for row in track.covariance],
        "log_bayes_factor": track.log_bayes_factor,
        "method": track.method,
    }


def _track(said: dict[str, Any]) -> Track:
    covariance = np.array([[math.inf if v is None else v for v in row] for row in said["covariance"]])
    motion = StraightCourse(*said["motion"])
    if said.get("bends"):
        (before, after), *terms, turn_s, turn_deg = said["bends"]
        across, along = (tuple((float(a), float(b)) for a, b in term) for term in terms)
        turn = {"turn_s": turn_s, "turn_deg": turn_deg}
        motion = replace(
            BentCourse(*said["motion"]), reach_s=(before, after), across=across, along=along, **turn
        )
    return Track(said["start"], said["end"], motion, covariance, said["log_bayes_factor"], said["method"])
