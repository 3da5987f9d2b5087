"""Where no range is heard a track comes of the azimuths alone, if they move as a ship's do and for long enough."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from obsnet import tracking
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import from_posix
from obsnet.pipeline import RunConfig
from obsnet.run import Run
from obsnet.trackers.search_config import GridSearchConfig
from obsnet.trackers.steady import outdoes_steady_sources
from obsnet.trackers.track import Segment, Track
from obsnet.tracking import segment_tracks

T0 = 1_369_123_200.0
SHIP = StraightCourse(T0 + 3600.0, 6000.0, 40.0, 7.5)


def no_delay(range_m):
    return np.zeros_like(np.asarray(range_m, float))


def run_of(azimuth_deg, range_llr=-2.0):
    """A run that heard these azimuths minute by minute, and no range."""
    times = T0 + 60.0 * np.arange(len(azimuth_deg))
    turn = wrap180(np.arange(360.0) - np.asarray(azimuth_deg)[:, None])
    llr = (6.0 * np.exp(-0.5 * (turn / 8.0) ** 2) - 2.0).astype(np.float32)
    coords = {"time": from_posix(times), "azimuth": np.arange(360.0)}
    maps = xr.Dataset({"azimuth_llr": (("time", "azimuth"), llr)}, coords)
    presence = pd.DataFrame({"azimuth": 8.0, "range": range_llr}, index=times)
    detections = pd.DataFrame({"azimuth_deg": azimuth_deg})
    return Run(None, RunConfig(), maps, xr.Dataset(), detections, presence, [], [], None)


def tracks_of(run, monkeypatch):
    monkeypatch.setattr(tracking, "search", lambda *given: [])
    times = run.presence.index
    return segment_tracks(run, Segment(times[0], times[-1]), no_delay, [])


def heard(minutes, first=0):
    times = T0 + 60.0 * np.arange(first, first + minutes)
    return (SHIP.observables(times)[0] + 2.0 * np.random.default_rng(3).standard_normal(minutes)) % 360.0


def test_azimuths_alone_give_a_track_that_says_so(monkeypatch):
    (track,) = tracks_of(run_of(heard(120)), monkeypatch)
    assert "bearings" in track.method
    assert track.motion.cpa_time == pytest.approx(SHIP.cpa_time, abs=180.0)
    assert abs(track.motion.cpa_range_m - SHIP.cpa_range_m) < 3 * track.std[1]


def test_a_source_that_stays_where_it_is_gives_none(monkeypatch):
    still = (70.0 + 2.0 * np.random.default_rng(3).standard_normal(120)) % 360.0
    assert tracks_of(run_of(still), monkeypatch) == []


def test_two_lobes_of_noise_that_take_turns_give_none(monkeypatch):
    """A ship that passes overhead would come from one and go to the other; these come and go."""
    rng = np.random.default_rng(3)
    lobes = np.where(np.repeat(rng.random(24) < 0.5, 5), 345.0, 160.0) + 5.0 * rng.standard_normal(120)
    made = run_of(lobes % 360.0)
    assert tracks_of(made, monkeypatch) == []
    times = made.presence.index.to_numpy()
    for distance in (300.0, 9000.0):
        ship = StraightCourse(T0 + 3600.0, distance, 163.0, 7.5)
        track = Track(times[0], times[-1], ship, np.eye(4), 50.0)
        assert not outdoes_steady_sources(made.maps, track, no_delay, GridSearchConfig())
        maps = run_of(ship.observables(times)[0]).maps
        assert outdoes_steady_sources(maps, track, no_delay, GridSearchConfig())


def test_less_than_an_hour_of_azimuths_gives_none(monkeypatch):
    assert tracks_of(run_of(heard(45, first=38)), monkeypatch) == []


def test_where_ranges_are_heard_bearings_alone_are_not_asked(monkeypatch):
    assert tracks_of(run_of(heard(120), range_llr=3.0), monkeypatch) == []
