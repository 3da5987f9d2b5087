import numpy as np
import pytest

from obsnet.arrays.echo import echo_elevation, echo_range, surface_echoes
from obsnet.errors import ConfigError, LayoutError

DEPTH, SPEED = 2000.0, 1500.0


def geometry(distance, depth):
    """Delay, elevation of the click and of its echo, from the image in the surface."""
    above = DEPTH - depth
    direct, reflected = np.hypot(distance, above), np.hypot(distance, DEPTH + depth)
    elevation, raised = (np.rad2deg(np.arctan2(z, distance)) for z in (above, DEPTH + depth))
    return (reflected - direct) / SPEED, elevation, raised


def test_the_range_agrees_with_the_image_in_the_surface_and_the_printed_formula_does_not():
    rng = np.random.default_rng(1)
    distance, depth = rng.uniform(1.0, 8000.0, 200), rng.uniform(5.0, 2100.0, 200)
    delay, elevation, raised = geometry(distance, depth)
    found, found_depth = echo_range(delay, elevation, DEPTH, SPEED)
    np.testing.assert_allclose(found, distance, rtol=1e-6)
    np.testing.assert_allclose(found_depth, depth, rtol=1e-6)
    np.testing.assert_allclose(echo_elevation(found, found_depth, DEPTH), raised, atol=1e-6)
    longer, phi = delay * SPEED, np.deg2rad(elevation)
    printed = (4 * DEPTH**2 - longer**2) * np.cos(phi) / (2 * longer - 4 * DEPTH * np.sin(phi))
    assert (np.abs(printed - distance) > 0.1 * distance)[elevation > 5.0].all()


def test_a_delay_that_no_source_below_the_surface_has_gives_no_range():
    distance, depth = echo_range(np.array([0.0, 2.7, 0.1]), np.array([30.0, 30.0, -80.0]), DEPTH, SPEED)
    assert np.isnan(distance).all() and np.isnan(depth).all()
    with pytest.raises(ConfigError, match="array below the surface"):
        echo_range(1.0, 30.0, 0.0)


def scene(rng, error_deg=0.1):
    """Clicks and echoes of two animals, in the order of time: arrays, which is an echo of which."""
    rows = []
    for azimuth, distance, depth, interval in ((40.0, 1500.0, 700.0, 1.0), (300.0, 900.0, 1200.0, 0.77)):
        delay, elevation, raised = geometry(distance, depth)
        for k in range(25):
            time = interval * k + rng.uniform(0.0, 0.05)
            rows.append((time, azimuth, elevation, len(rows), -1, distance))
            rows.append((time + delay, azimuth, raised, len(rows), len(rows) - 1, distance))
    table = np.array(rows)
    table[:, 1:3] += rng.normal(0.0, error_deg, (len(table), 2))
    return table[np.argsort(table[:, 0])]


def test_echoes_are_paired_with_their_clicks_and_give_the_range():
    table = scene(np.random.default_rng(2))
    covariance = np.broadcast_to(np.eye(2) * 0.1**2, (len(table), 2, 2))
    found = surface_echoes(table[:, 0], table[:, 1], table[:, 2], covariance, DEPTH, SPEED)
    claimed = np.flatnonzero(found.echo_of >= 0)
    said = table[found.echo_of[claimed], 3]
    assert len(claimed) > 0.9 * 50
    assert (said == table[claimed, 4]).mean() > 0.95
    ranged = np.isfinite(found.range_m)
    off = (found.range_m - table[:, 5])[ranged]
    assert np.median(np.abs(off)) < 20.0
    assert np.mean(np.abs(off) < 3.0 * found.range_std_m[ranged]) > 0.9
    assert ((found.depth_m[ranged] >= 0.0) & (found.depth_m[ranged] <= DEPTH)).all()


def test_a_train_of_clicks_without_echoes_has_none():
    time = np.arange(50) * 1.0
    angles = np.random.default_rng(3).normal(0.0, 0.1, (50, 2)) + np.array([100.0, 35.0])
    covariance = np.broadcast_to(np.eye(2) * 0.1**2, (50, 2, 2))
    found = surface_echoes(time, angles[:, 0], angles[:, 1], covariance, DEPTH, SPEED)
    assert (found.echo_of < 0).all() and np.isnan(found.range_m).all()


def test_azimuths_are_compared_across_north():
    delay, elevation, raised = geometry(1200.0, 600.0)
    covariance = np.broadcast_to(np.eye(2) * 0.2**2, (2, 2, 2))
    found = surface_echoes(
        np.array([0.0, delay]), np.array([359.9, 0.1]), np.array([elevation, raised]), covariance, DEPTH
    )
    assert found.echo_of.tolist() == [-1, 0]
    assert found.range_m[0] == pytest.approx(1200.0, rel=1e-6)


def test_unordered_clicks_are_refused():
    with pytest.raises(LayoutError, match="order of time"):
        surface_echoes(np.array([1.0, 0.0]), np.zeros(2), np.zeros(2), np.zeros((2, 2, 2)), DEPTH)
