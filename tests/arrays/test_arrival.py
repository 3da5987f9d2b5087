import numpy as np
import pytest

from obsnet.arrays.arrival import confidence_ellipse, directions
from obsnet.arrays.compact import CompactArray, angles, unit_vector
from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import wrap180

QUANTISATION_S = 1.0 / (96_000.0 * np.sqrt(12.0))
FIVE = CompactArray((0.0, 1.3, -0.7, 0.2, 0.9), (0.0, 0.4, 1.1, -0.9, 0.3), (100.0, 100.2, 99.1, 99.6, 98.7))
PLANE = CompactArray((0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0), (50.0, 50.0, 50.0, 50.0))


def sphere(rng, count, lowest_deg=-90.0):
    azimuth = rng.uniform(0.0, 360.0, count)
    elevation = np.rad2deg(np.arcsin(rng.uniform(np.sin(np.deg2rad(lowest_deg)), 1.0, count)))
    return azimuth, elevation


def apart_deg(azimuth, elevation, other_azimuth, other_elevation):
    cosine = (unit_vector(azimuth, elevation) * unit_vector(other_azimuth, other_elevation)).sum(axis=-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.mark.parametrize(
    ("array", "lowest"), [(CompactArray.tetrahedron(), -90.0), (FIVE, -90.0), (PLANE, 5.0)]
)
def test_exact_tdoas_give_back_the_direction(array, lowest):
    azimuth, elevation = sphere(np.random.default_rng(1), 300, lowest)
    elevation[:3] = 90.0, 89.999, max(lowest, -90.0)
    pairs = array.pairs()
    covariance = array.tdoa_covariance(pairs, 1e-6, 1e-6)
    found = directions(array.tdoa(azimuth, elevation, pairs), array, pairs, covariance)
    assert apart_deg(azimuth, elevation, found.azimuth_deg, found.elevation_deg).max() < 1e-4
    assert found.accepted.all()
    assert found.mirrored.all() == (array is PLANE)


def test_the_nearer_hydrophone_hears_first_and_azimuths_count_from_north_clockwise():
    array = CompactArray.tetrahedron()
    pairs = np.array([[0, 1], [0, 3]])
    assert array.tdoa(0.0, 0.0, pairs)[0] < 0
    assert array.tdoa(0.0, 90.0, pairs)[1] > 0
    east = angles(np.array([1.0, 0.0, 0.0]))
    assert (float(east[0]), float(east[1])) == (90.0, 0.0)
    assert float(angles(np.array([0.0, 1.0, -1.0]))[1]) == pytest.approx(45.0)


def test_gradient_is_the_derivative():
    azimuth, elevation = sphere(np.random.default_rng(2), 20, -80.0)
    pairs = FIVE.pairs()
    gradient = FIVE.tdoa_gradient(azimuth, elevation, pairs)
    step = 1e-4
    by_azimuth = FIVE.tdoa(azimuth + step, elevation, pairs) - FIVE.tdoa(azimuth - step, elevation, pairs)
    by_elevation = FIVE.tdoa(azimuth, elevation + step, pairs) - FIVE.tdoa(azimuth, elevation - step, pairs)
    np.testing.assert_allclose(gradient[..., 0], by_azimuth / (2 * step), atol=1e-12)
    np.testing.assert_allclose(gradient[..., 1], by_elevation / (2 * step), atol=1e-12)


def test_levenberg_marquardt_finds_the_minimum_of_a_brute_force_grid():
    rng = np.random.default_rng(3)
    pairs = FIVE.pairs(every=False)
    covariance = FIVE.tdoa_covariance(pairs, 40e-6, 10e-6)
    azimuth, elevation = sphere(rng, 40)
    tdoa = FIVE.tdoa(azimuth, elevation, pairs) + rng.multivariate_normal(
        np.zeros(len(pairs)), covariance, 40
    )
    found = directions(tdoa, FIVE, pairs, covariance)
    grid_azimuth, grid_elevation = np.meshgrid(
        np.arange(0.0, 360.0, 0.5), np.arange(-90.0, 90.5, 0.5), indexing="ij"
    )
    predicted = FIVE.tdoa(grid_azimuth.ravel(), grid_elevation.ravel(), pairs)
    inverse = np.linalg.inv(covariance)
    for k in range(40):
        residual = tdoa[k] - predicted
        cost = np.einsum("gp,pq,gq->g", residual, inverse, residual)
        best = int(cost.argmin())
        assert found.chi_squared[k] <= cost[best] + 1e-9
        off = apart_deg(
            found.azimuth_deg[k],
            found.elevation_deg[k],
            *(g.ravel()[best] for g in (grid_azimuth, grid_elevation)),
        )
        assert off < 0.75


def test_a_pair_without_weight_counts_as_a_missing_one():
    rng = np.random.default_rng(4)
    pairs = FIVE.pairs()
    tdoa = FIVE.tdoa(*sphere(rng, 30), pairs) + rng.normal(0.0, 2e-6, (30, len(pairs)))
    variance = np.full(len(pairs), (2e-6) ** 2)
    missing, loose = tdoa.copy(), variance.copy()
    missing[:, 3] = np.nan
    loose[3] = 1.0
    tdoa[:, 3] += 1e-3
    without = directions(missing, FIVE, pairs, np.diag(variance))
    weightless = directions(tdoa, FIVE, pairs, np.diag(loose))
    np.testing.assert_allclose(wrap180(without.azimuth_deg - weightless.azimuth_deg), 0.0, atol=1e-4)
    np.testing.assert_allclose(without.chi_squared, weightless.chi_squared, atol=1e-3)
    assert (without.degrees_of_freedom == weightless.degrees_of_freedom - 1).all()


@pytest.mark.parametrize("every", [True, False])
def test_the_gate_refuses_one_right_click_in_a_hundred(every):
    array = CompactArray.tetrahedron()
    rng = np.random.default_rng(5)
    pairs = array.pairs(every)
    covariance = array.tdoa_covariance(pairs, 2e-6, 1e-6)
    count = 40_000
    noise = rng.multivariate_normal(np.zeros(len(pairs)), covariance, count)
    found = directions(array.tdoa(*sphere(rng, count), pairs) + noise, array, pairs, covariance, 0.01)
    assert 1.0 - found.accepted.mean() == pytest.approx(0.01, abs=4.0 * np.sqrt(0.01 / count))


def test_the_gate_refuses_clutter():
    array = CompactArray.tetrahedron()
    pairs = array.pairs()
    clutter = np.random.default_rng(6).uniform(-1.5e-3, 1.5e-3, (5000, len(pairs)))
    found = directions(clutter, array, pairs, np.eye(len(pairs)) * QUANTISATION_S**2)
    assert found.accepted.mean() < 1e-3


@pytest.mark.parametrize("probability", [0.5, 0.95])
def test_the_ellipse_holds_the_truth_as_often_as_it_says(probability):
    array = CompactArray.tetrahedron()
    rng = np.random.default_rng(7)
    pairs = array.pairs()
    covariance = np.eye(len(pairs)) * QUANTISATION_S**2
    count = 20_000
    azimuth, elevation = sphere(rng, count, -70.0)
    elevation = np.minimum(elevation, 70.0)
    tdoa = array.tdoa(azimuth, elevation, pairs) + rng.normal(0.0, QUANTISATION_S, (count, len(pairs)))
    found = directions(tdoa, array, pairs, covariance)
    major, minor, tilt = confidence_ellipse(found.covariance, probability)
    turn, rise = wrap180(found.azimuth_deg - azimuth), found.elevation_deg - elevation
    along = turn * np.cos(np.deg2rad(tilt)) + rise * np.sin(np.deg2rad(tilt))
    across = rise * np.cos(np.deg2rad(tilt)) - turn * np.sin(np.deg2rad(tilt))
    inside = (along / major) ** 2 + (across / minor) ** 2 < 1.0
    assert inside.mean() == pytest.approx(
        probability, abs=4.0 * np.sqrt(probability * (1 - probability) / count)
    )


def test_turning_the_array_turns_the_azimuth():
    rng = np.random.default_rng(8)
    pairs = FIVE.pairs()
    angle = np.deg2rad(37.0)
    east, north, depth = FIVE.positions.T
    turned = CompactArray(
        tuple(east * np.cos(angle) + north * np.sin(angle)),
        tuple(north * np.cos(angle) - east * np.sin(angle)),
        tuple(depth),
    )
    tdoa = FIVE.tdoa(*sphere(rng, 50), pairs) + rng.normal(0.0, 5e-6, (50, len(pairs)))
    covariance = FIVE.tdoa_covariance(pairs, 5e-6, 1e-6)
    before, after = (directions(tdoa, array, pairs, covariance) for array in (FIVE, turned))
    np.testing.assert_allclose(wrap180(after.azimuth_deg - before.azimuth_deg - 37.0), 0.0, atol=1e-5)
    np.testing.assert_allclose(after.elevation_deg, before.elevation_deg, atol=1e-6)


def test_tdoas_that_determine_no_direction_are_nan_and_refused():
    pairs = FIVE.pairs(every=False)
    tdoa = np.full((2, len(pairs)), np.nan)
    tdoa[1, 0] = 1e-4
    found = directions(tdoa, FIVE, pairs, np.eye(len(pairs)) * 1e-12)
    assert np.isnan(found.azimuth_deg).all() and not found.accepted.any()
    assert directions(tdoa[:0], FIVE, pairs, np.eye(len(pairs))).azimuth_deg.shape == (0,)


def test_impossible_requests_are_named():
    array = CompactArray.tetrahedron()
    pairs = array.pairs()
    with pytest.raises(LayoutError, match=r"6 pairs, found shape \(1, 5\)"):
        directions(np.zeros(5), array, pairs, np.eye(6))
    with pytest.raises(ConfigError, match="not positive definite"):
        directions(np.zeros(6), array, pairs, array.tdoa_covariance(pairs, 1e-6) - 1e-12 * np.eye(6))
    with pytest.raises(LayoutError, match=r"covariance must be \(6, 6\)"):
        directions(np.zeros(6), array, pairs, np.eye(5))
    with pytest.raises(ConfigError, match="at least 3 hydrophones, found 2"):
        CompactArray((0.0, 1.0), (0.0, 0.0), (5.0, 5.0))
    with pytest.raises(ConfigError, match="lie in one line"):
        CompactArray((0.0, 1.0, 2.0), (0.0, 1.0, 2.0), (5.0, 5.0, 5.0))
    with pytest.raises(ConfigError, match="one value a hydrophone"):
        CompactArray((0.0, 1.0, 2.0), (0.0, 1.0), (5.0, 5.0, 5.0))
    with pytest.raises(ConfigError, match="finite"):
        CompactArray((0.0, 1.0, np.nan), (0.0, 1.0, 5.0), (5.0, 5.0, 5.0))


def test_an_array_is_read_from_yaml(tmp_path):
    path = tmp_path / "array.yaml"
    path.write_text("east_m: [0, 1, 0]\nnorth_m: [0, 0, 1]\ndepth_m: [20, 20, 21]\nsound_speed_mps: 1480\n")
    array = CompactArray.read(path)
    assert array.count == 3 and array.sound_speed_mps == 1480.0 and array.depth_m[2] == 21.0
    assert CompactArray.of(path) == array == CompactArray.of(array)
    assert CompactArray.of(array.positions).depth_m == array.depth_m
    with pytest.raises(ConfigError, match="an array's geometry is a CompactArray"):
        CompactArray.of(np.zeros((4, 2)))
    path.write_text("east: [0, 1, 0]\n")
    with pytest.raises(ConfigError, match="unknown key"):
        CompactArray.read(path)
