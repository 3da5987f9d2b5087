"""Simulated passages with a random orientation that the metadata do not know: what calibration recovers."""

from dataclasses import replace

import numpy as np
import pytest

import obsnet
from obsnet.ais import reference_tracks
from obsnet.calibration import Calibration, calibrate, calibrate_waveforms
from obsnet.calibration.result import moved
from obsnet.kinematics import StraightCourse
from obsnet.ocean.rays import propagation_table, travel_time
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.run import RunConfig
from obsnet.signals.azigram import azigram
from obsnet.signals.spectra import spectra
from obsnet.signals.station import Station
from obsnet.twin.instrument import Recorder
from obsnet.twin.scenario import MAX_RANGE_M
from obsnet.twin.sea import Ambient
from obsnet.twin.ship import Ship
from obsnet.twin.station import Passage, Scenario, simulate

OFFSET = (350.0, -240.0)
START = 1369130400.0


def passage(seed, cpa_m, polarity, directed=0.3):
    """Simulation of one ship, and the station as its metadata wrongly have it."""
    generator = np.random.default_rng(seed)
    recorder = Recorder.random(
        generator, hydrophone_polarity=polarity, declare_orientation=False, declare_polarity=False
    )
    course = StraightCourse(START + 2.5 * 3600.0, cpa_m, float(generator.uniform(0, 360)), 8.0)
    scenario = Scenario(
        start=START,
        hours=5.0,
        passages=(Passage(Ship.random(seed, source_level_db=194.0), course),),
        recorder=recorder,
        ambient=Ambient(
            directional_fraction=directed, directional_azimuth_deg=float(generator.uniform(0, 360))
        ),
        seed=seed,
    )
    simulation = simulate(scenario)
    station = Station.from_stationxml(simulation.inventory)
    latitude, longitude = moved(station, -OFFSET[0], -OFFSET[1])
    return simulation, station.calibrated(latitude=latitude, longitude=longitude)


@pytest.mark.parametrize("azimuth", [None, 0.0])
def test_an_orientation_that_the_metadata_do_not_give_is_found(azimuth):
    simulation, _ = passage(6, -14e3, 1)
    for channel in simulation.inventory[0][0]:
        channel.azimuth = azimuth
    station = Station.from_stationxml(simulation.inventory)
    found = calibrate_waveforms(simulation.stream, station, reference_tracks(simulation.ais, station))
    truth = simulation.scenario.recorder.orientation_deg
    assert abs((found.orientation.azimuth_deg - truth + 180.0) % 360.0 - 180.0) < 2.0
    assert share_on_the_ship(simulation, found.apply(station)) > 0.5


@pytest.mark.parametrize(("seed", "cpa_m", "polarity"), [(3, 5000.0, -1), (6, -14e3, 1)])
def test_orientation_polarity_and_place_are_recovered(seed, cpa_m, polarity, tmp_path):
    simulation, station = passage(seed, cpa_m, polarity)
    recorder = simulation.scenario.recorder
    tracks = reference_tracks(simulation.ais, station)
    done = []
    found = calibrate_waveforms(simulation.stream, station, tracks, progress=lambda *at: done.append(at))
    error = (found.orientation.azimuth_deg - recorder.orientation_deg + 180.0) % 360.0 - 180.0
    assert abs(error) < 2.0
    assert found.orientation.std_deg < 2.0
    assert found.polarity.sign == polarity
    assert found.polarity.significance * polarity > 3.0
    assert found.position.east_m == pytest.approx(OFFSET[0], abs=100.0)
    assert found.position.north_m == pytest.approx(OFFSET[1], abs=100.0)
    assert (found.position.latitude, found.position.longitude) == pytest.approx(
        (recorder.latitude, recorder.longitude), abs=1e-3
    )
    assert "3-5" in found.fitted_pairs
    assert done[-1][0] <= done[-1][1] == pytest.approx(5 * 3600.0, rel=0.01)
    found.write(tmp_path / "calibration.yaml")
    assert Calibration.read(tmp_path / "calibration.yaml") == found
    heard_right = share_on_the_ship(simulation, found.apply(station))
    assert heard_right > 0.5 > share_on_the_ship(simulation, station)


def share_on_the_ship(simulation, station):
    """Share of the loudest tenth of cells whose azimuth is within 10° of the ship's, as it was heard."""
    frames = spectra(simulation.stream, station)
    direction = azigram(frames)
    table = propagation_table(OceanConfig(), station.depth_m)
    track = reference_tracks(simulation.ais, station)[0]
    azimuth = track.heard(frames["time"].values.astype("int64") / 1e9, travel_time(table))[0]
    difference = np.angle(direction.values * np.exp(-1j * np.deg2rad(azimuth)), deg=True)
    power = np.abs(frames["p"].sel(frequency=direction["frequency"]).values)
    loud = power > np.nanquantile(power, 0.9)
    return np.mean(np.abs(difference[loud]) < 10.0)


def test_without_horizontals_or_vertical_the_rest_is_still_found():
    simulation, station = passage(5, 6000.0, 1)
    tracks = reference_tracks(simulation.ais, station)
    table = propagation_table(OceanConfig(), station.depth_m)
    whole = spectra(simulation.stream, station)
    found = calibrate(whole.drop_vars(["east", "north", "down"]), station, tracks, table)
    assert found.orientation is None
    assert found.polarity.sign == 1 and found.polarity.significance == 0.0
    assert found.position is not None
    assert any("horizontals" in note for note in found.notes)
    assert any("vertical" in note for note in found.notes)


def test_a_floor_whose_echo_is_late_puts_ships_where_they_were_once_calibrated():
    """Two passages over a floor with a layer below it: tracks with the calibration, and without it."""
    courses = [
        StraightCourse(START + hours * 3600.0, cpa_m, course, 8.0)
        for hours, cpa_m, course in ((1.5, 9e3, 40.0), (4.0, -7e3, 160.0))
    ]
    scenario = Scenario(
        start=START,
        hours=5.5,
        passages=tuple(
            Passage(replace(Ship.random(i, source_level_db=194.0), mmsi=100000001 + i), course)
            for i, course in enumerate(courses)
        ),
        recorder=Recorder.random(np.random.default_rng(6)),
        ocean=OceanConfig(max_range_m=MAX_RANGE_M, echo_delay_s=0.12),
        seed=6,
    )
    simulation = simulate(scenario)
    station = Station.from_stationxml(simulation.inventory)
    found = calibrate_waveforms(simulation.stream, station, reference_tracks(simulation.ais, station))
    assert found.echo.delay_s == pytest.approx(0.12, abs=3.0 * found.echo.std_s)
    assert found.echo.std_s < 0.015
    assert "ms" in found.table()
    errors = {}
    for name, config in (("with", RunConfig(ocean=found.ocean(OceanConfig()))), ("without", RunConfig())):
        tracks = obsnet.track(simulation.stream, found.apply(station), config).tracks
        errors[name] = [
            abs(track.motion.cpa_range_m - course.cpa_range_m)
            for track, course in zip(tracks, courses, strict=True)
        ]
    assert max(errors["with"]) < 300.0 < min(errors["without"]), errors
