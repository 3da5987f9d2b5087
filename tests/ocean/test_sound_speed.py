import numpy as np
import pytest

from obsnet.config import build
from obsnet.errors import ConfigError
from obsnet.ocean.sound_speed import Munk, OceanConfig, SoundSpeed

CANONICAL = Munk(1500.0, 1300.0, 1300.0, 0.00737, 0.0)


def test_munk_has_the_values_of_the_canonical_profile():
    # Munk's profile with c1 = 1500 m/s: 1548.5 at the surface, 1551.9 at 5 km (Jensen et al., fig. 1.9).
    np.testing.assert_allclose(CANONICAL.speed([0.0, 1300.0, 5000.0]), [1548.52, 1500.0, 1551.91], atol=0.01)
    depths = np.linspace(0, 5000, 5001)
    assert depths[CANONICAL.speed(depths).argmin()] == 1300.0


def test_nodes_follow_the_curve():
    profile = SoundSpeed.munk(CANONICAL, 5000.0)
    depths = np.linspace(0, 5000, 20001)
    error = profile.speed(depths) - CANONICAL.speed(depths)
    assert profile.depth_m.size < 250
    assert error.min() > -1e-9
    assert error.max() < 0.00102


def test_mixed_layer_grows_with_pressure_alone():
    speed = Munk(mixed_layer_m=50.0).speed(np.array([0.0, 20.0, 50.0]))
    np.testing.assert_allclose(np.diff(speed) / [20.0, 30.0], 0.0163, rtol=1e-6)


@pytest.mark.parametrize(
    "text",
    ["depth_m,speed_mps\n0,1530\n1000,1490\n5000,1540\n", "# WOA\n0 1530\n1000\t1490 # axis\n\n5000;1540\n"],
)
def test_table_is_read_in_any_dialect_and_linear_between_rows(tmp_path, text):
    path = tmp_path / "winter.csv"
    path.write_text(text)
    profile = OceanConfig(profile="table", table_file=str(path)).sound_speed()
    assert profile.name == "winter"
    np.testing.assert_allclose(profile.speed([0.0, 500.0, 3000.0]), [1530.0, 1510.0, 1515.0])
    nodes, speeds = profile.column(3000.0)
    np.testing.assert_allclose(nodes, [0.0, 1000.0, 3000.0])
    np.testing.assert_allclose(speeds, [1530.0, 1490.0, 1515.0])


def test_below_its_last_node_speed_grows_with_pressure():
    profile = SoundSpeed("short", np.array([5.0, 4000.0]), np.array([1530.0, 1525.0]))
    nodes, speeds = profile.column(4340.0)
    np.testing.assert_allclose(nodes, [0.0, 5.0, 4000.0, 4340.0])
    np.testing.assert_allclose(speeds, [1530.0, 1530.0, 1525.0, 1525.0 + 0.0163 * 340.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "must hold two rows"),
        ("0,1500\n100,abc\n", r"line 2 .*found '100,abc'"),
        ("depth,speed\nmore,names\n", "line 2"),
        ("0,1500,3\n1,2,3\n", "line 2"),
        ("0,1.50\n100,1.49\n", "give them in m/s"),
        ("100,1500\n0,1490\n", "must increase"),
        ("0,1500\n100,nan\n", "between 1300 and 1800"),
    ],
)
def test_bad_tables_are_refused(tmp_path, content, message):
    path = tmp_path / "table.csv"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        SoundSpeed.read(path)


def test_unreadable_tables_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        SoundSpeed.read(tmp_path / "absent.csv")
    (tmp_path / "noise.bin").write_bytes(bytes(range(128, 256)))
    with pytest.raises(ConfigError, match="not text"):
        SoundSpeed.read(tmp_path / "noise.bin")


@pytest.mark.parametrize("depth", [0.0, -12.0, np.nan])
def test_a_station_must_lie_below_the_surface(depth):
    with pytest.raises(ConfigError, match="below the surface"):
        SoundSpeed.constant(1500.0).column(depth)


def test_a_profile_must_reach_half_the_depth():
    profile = SoundSpeed("shallow", np.array([0.0, 1000.0]), np.array([1530.0, 1490.0]))
    with pytest.raises(ConfigError, match="ends at 1000 m"):
        profile.column(4000.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"profile": "table"}, "needs table_file"),
        ({"profile": "mink"}, "must be one of"),
        ({"sound_speed_mps": 1.5}, "between 1300 and 1800"),
        ({"range_step_m": 0.0}, "range_step_m"),
        ({"bottom": {"p_sped_mps": 1.0}}, "did you mean 'p_speed_mps'"),
        ({"bottom": {"s_speed_mps": 1990.0}}, "below 0.866"),
        ({"bottom": {"density_kgm3": -1.0}}, "density_kgm3"),
        ({"munk": {"scale_m": 0.0}}, "scale_m"),
        ({"munk": {"epsilon": -0.1}}, "epsilon"),
    ],
)
def test_bad_configurations_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        build(OceanConfig, values, "ocean")
