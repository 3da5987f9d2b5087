import numpy as np
import pytest
from pyproj import Geod

from obsnet.errors import ConfigError
from obsnet.kinematics import StraightCourse
from obsnet.twin.course import TurningCourse, WaypointCourse, local_projection, presence

START = 1369130400.0


@pytest.mark.parametrize(("turn", "final"), [(60.0, 100.0), (-120.0, 280.0), (200.0, 240.0)])
def test_a_turn_keeps_the_speed_and_ends_on_the_new_course(turn, final):
    course = TurningCourse(StraightCourse(START, 5000.0, 40.0, 8.0), START + 100.0, turn, radius_m=1200.0)
    time = START + np.arange(-500.0, 1500.0, 0.5)
    east, north = course.position(time)
    speed = np.hypot(np.diff(east), np.diff(north)) / 0.5
    np.testing.assert_allclose(speed, 8.0, rtol=1e-4)
    heading = np.rad2deg(np.arctan2(np.diff(east), np.diff(north))) % 360.0
    assert heading[0] == pytest.approx(40.0, abs=1e-6)
    assert heading[-1] == pytest.approx(final, abs=1e-6)
    np.testing.assert_allclose(
        east[time <= START + 100.0], course.before.position(time[time <= START + 100.0])[0]
    )


def test_waypoints_are_passed_and_left_straight_on():
    time = START + np.array([0.0, 600.0, 1500.0])
    course = WaypointCourse(time, np.array([0.0, 4000.0, 9000.0]), np.array([1000.0, 1000.0, -2000.0]))
    for smooth in (False, True):
        course = WaypointCourse(time, course.east, course.north, smooth)
        east, north = course.position(time)
        np.testing.assert_allclose([east, north], [course.east, course.north], atol=1e-6)
    east, north = course.position(np.array([START + 1800.0]))
    assert east[0] == pytest.approx(9000.0 + 300 * 5000 / 900) and north[0] == pytest.approx(
        -2000 - 300 * 3000 / 900
    )


def test_ais_positions_become_azimuth_and_range_of_the_geodesic():
    geod = Geod(ellps="WGS84")
    lon, lat, _ = geod.fwd([54.1294] * 3, [-21.3732] * 3, [30.0, 140.0, 260.0], [5e3, 40e3, 90e3])
    seconds = START + np.array([0.0, 3600.0, 7200.0])
    course = WaypointCourse.from_ais(seconds, lon, lat, (-21.3732, 54.1294))
    np.testing.assert_allclose(np.hypot(course.east, course.north), [5e3, 40e3, 90e3], rtol=1e-6)
    np.testing.assert_allclose(
        np.rad2deg(np.arctan2(course.east, course.north)) % 360, [30, 140, 260], atol=1e-4
    )


def test_projection_is_centred_on_the_station():
    assert local_projection(10.0, 20.0)(20.0, 10.0) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_repeated_ais_times_are_dropped():
    times, lon, lat = [START, START, START + 60], [54.0, 54.0, 54.01], [-21.0, -21.0, -21.0]
    assert WaypointCourse.from_ais(times, lon, lat, (-21.0, 54.0)).time.size == 2


def test_presence_fades_within_ten_minutes_of_the_span():
    course = WaypointCourse(START + np.array([0.0, 600.0]), np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    time = START + np.array([-700.0, -300.0, 0.0, 300.0, 900.0, 1300.0])
    np.testing.assert_allclose(presence(course, time), [0, 0.5, 1, 1, 0.5, 0], atol=1e-9)
    np.testing.assert_array_equal(presence(StraightCourse(START, 1.0, 1.0, 1.0), time), np.ones(6))


def test_bad_waypoints_are_refused():
    one = np.array([1.0])
    with pytest.raises(ConfigError, match="two positions at least"):
        WaypointCourse(one, one, one)
    with pytest.raises(ConfigError, match="finite positions at increasing times"):
        WaypointCourse(np.array([1.0, 0.0]), np.zeros(2), np.zeros(2))
    with pytest.raises(ConfigError, match="a turn needs radius and speed > 0, found -5"):
        TurningCourse(StraightCourse(START, 1.0, 1.0, 1.0), START, 10.0, -5.0)
