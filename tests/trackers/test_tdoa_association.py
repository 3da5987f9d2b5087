from itertools import product

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm

from obsnet.errors import ConfigError, LayoutError
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.trackers.tdoa_association import TableModel, association_log_likelihood


def enumerate_associations(predicted, measured, detection, std, density, window):
    """Sum and mean count over all association vectors, one source, written out."""
    total, served = 0.0, 0.0
    for vector in product(range(len(measured) + 1), repeat=len(predicted)):
        used = [m for m in vector if m]
        if len(set(used)) < len(used):
            continue
        term = 1.0
        for pair, m in enumerate(vector):
            exists = np.isfinite(predicted[pair])
            probability = detection[pair] if exists else 0.0
            if m:
                term *= (
                    probability * norm.pdf(measured[m - 1], predicted[pair], std[pair]) / density[m - 1]
                    if exists
                    else 0.0
                )
            elif exists:
                inside = np.diff(norm.cdf(window, predicted[pair], std[pair]))[0]
                term *= 1.0 - probability * inside
        total += term
        served += len(used) * term
    return np.log(total), served / total


@pytest.mark.parametrize("n_pair", [1, 2, 3, 4])
@pytest.mark.parametrize("n_measured", [0, 1, 2, 4])
def test_sum_over_associations_is_that_of_the_enumeration(n_pair, n_measured):
    rng = np.random.default_rng([n_pair, n_measured])
    window = (0.1, 1.1)
    predicted = rng.uniform(0.05, 1.15, (6, n_pair))
    predicted[rng.random(predicted.shape) < 0.15] = np.nan
    std = rng.uniform(0.02, 0.3, n_pair)
    detection = rng.uniform(0.0, 1.0, n_pair)
    measured = rng.uniform(*window, n_measured)
    density = rng.uniform(0.5, 4.0, n_measured)
    found, served = association_log_likelihood(predicted, measured, detection, std, density, window)
    slow = np.array([enumerate_associations(p, measured, detection, std, density, window) for p in predicted])
    np.testing.assert_allclose(found, slow[:, 0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(served, slow[:, 1], rtol=1e-12, atol=1e-12)


def test_a_measurement_serves_one_pair_only():
    # Two pairs of the same delay, one measurement on it: (1-d)² + 2 d (1-d) N/λ, without the term (d N/λ)².
    d, std, rate, window = 0.6, 0.01, 2.0, (0.0, 1.0)
    ratio = d * norm.pdf(0.0, 0.0, std) / rate
    found, _ = association_log_likelihood(
        np.array([[0.5, 0.5]]), np.array([0.5]), np.array([d, d]), np.array([std]), rate, window
    )
    assert found[0] == pytest.approx(np.log((1 - d) ** 2 + 2 * (1 - d) * ratio), rel=1e-12)


def test_order_of_measurements_and_of_pairs_does_not_matter():
    rng = np.random.default_rng(1)
    predicted, measured = rng.uniform(0, 1, (20, 3)), rng.uniform(0, 1, 5)
    detection, std = np.array([0.3, 0.6, 0.9]), np.array([0.05, 0.1, 0.2])
    first, _ = association_log_likelihood(predicted, measured, detection, std, 3.0, (0.0, 1.0))
    order = np.array([2, 0, 1])
    second, _ = association_log_likelihood(
        predicted[:, order], measured[::-1], detection[order], std[order], 3.0, (0.0, 1.0)
    )
    np.testing.assert_allclose(first, second, rtol=1e-12, atol=1e-12)


def test_certain_detection_that_is_missed_is_impossible():
    found, served = association_log_likelihood(
        np.array([[0.5]]), np.array([]), np.array([1.0]), np.array([0.01]), 1.0, (0.0, 1.0)
    )
    assert found[0] == -np.inf and served[0] == 0.0


def table(depth=4340.0, speed=1500.0, reach_m=None):
    """Propagation table in water of one sound speed; path 1 ends at `reach_m`."""
    ranges, paths = np.arange(0.0, 60e3, 70.0), np.array([1, 3, 5, 7])
    length = np.hypot(paths[:, None] * depth, ranges)
    delay = length / speed
    if reach_m is not None:
        delay[0, ranges > reach_m] = np.nan
    exists = np.where(np.isnan(delay), np.nan, 1.0)
    variables = {
        "delay": delay,
        "pressure": exists / length + 0j,
        "slowness": exists * ranges / length / speed,
    }
    return xr.Dataset(
        {name: (("path", "range"), values) for name, values in variables.items()},
        coords={"path": paths, "range": ranges},
    )


def test_table_delays_are_the_closed_form_between_grid_points():
    # Between points d apart, a line departs from a curve by d²/8 times its curvature, at most 1/(c h) here.
    ranges = np.random.default_rng(0).uniform(0, 59e3, 200)
    found = TableModel(table()).tdoas(ranges)
    lengths = np.hypot(np.array([1, 3, 5, 7]) * 4340.0, ranges[:, None])
    np.testing.assert_allclose(found, np.diff(lengths, axis=1) / 1500.0, atol=20.0**2 / 8 / (1500.0 * 4340.0))


def test_a_pair_does_not_count_where_its_path_cannot_exist():
    model = TableModel(table(reach_m=30e3))
    delays = model.tdoas(np.array([20e3, 40e3, 61e3, -5.0]))
    np.testing.assert_array_equal(np.isnan(delays), [[0, 0, 0], [1, 0, 0], [1, 1, 1], [1, 1, 1]])
    measured, rest = np.array([1.0, 2.0, 3.0]), (np.array([0.1]), 1.0, (0.3, 6.0))
    both, _ = association_log_likelihood(delays[1:2], measured, np.array([0.9, 0.5, 0.4]), *rest)
    fewer, _ = association_log_likelihood(delays[1:2, 1:], measured, np.array([0.5, 0.4]), *rest)
    nowhere, _ = association_log_likelihood(delays[2:3], measured, np.array([0.9, 0.5, 0.4]), *rest)
    assert both[0] == pytest.approx(fewer[0], rel=1e-12) and nowhere[0] == 0.0


def test_visibility_follows_the_amplitude():
    amplitudes = Amplitudes.table_ii()
    seen = TableModel(table(), amplitudes=amplitudes, half_amplitude=0.02).visibility(np.array([12e3, 1e3]))
    energy = amplitudes.evaluate("1-3", np.array([12e3])) ** 2
    assert seen[0, 0] == pytest.approx(energy[0] / (energy[0] + 4e-4), rel=1e-6)
    np.testing.assert_allclose(seen[1], 0.02)


def test_a_pair_that_the_table_lacks_is_refused():
    with pytest.raises(ConfigError, match="needs path 9"):
        TableModel(table(), ("7-9",))
    with pytest.raises(ConfigError, match="no path pair"):
        TableModel(table(), ())
    with pytest.raises(LayoutError, match="lacks delay"):
        TableModel(table().drop_vars("delay"))
