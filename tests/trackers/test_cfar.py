import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.trackers.cfar import CfarConfig, detection_llr, exceedance, merge


def slow_exceedance(power, guard, reach, past, factor):
    found = np.zeros(power.shape, bool)
    for k in range(power.shape[0]):
        for j in range(power.shape[1]):
            rows = range(max(0, k - past), k + 1)
            columns = [i for i in range(power.shape[1]) if guard < abs(i - j) <= reach]
            cells = power[np.ix_(rows, columns)]
            found[k, j] = power[k, j] > cells.mean() + factor * cells.std()
    return found


def test_detections_are_those_of_the_definition():
    power = np.random.default_rng(1).exponential(size=(12, 30))
    config = CfarConfig(false_alarm_rate=0.25, guard_deg=4.0, training_deg=10.0, past=3)
    expected = slow_exceedance(power, guard=2, reach=7, past=3, factor=0.6744897501960817)
    np.testing.assert_array_equal(exceedance(power, 2.0, config), expected)


@pytest.mark.parametrize("rate", [0.05, 0.25])
def test_the_false_alarm_rate_holds_on_gaussian_cells_of_any_level(rate):
    rng = np.random.default_rng(2)
    power = 7e3 * (50.0 + rng.normal(size=(400, 181)))
    found = exceedance(power, 1.0, CfarConfig(false_alarm_rate=rate))
    assert found.mean() == pytest.approx(rate, rel=0.03)


def test_a_source_does_not_hide_in_its_own_training_cells():
    rng = np.random.default_rng(3)
    power = 100.0 + rng.normal(size=(60, 181))
    power[:, 88:93] += 10.0
    assert exceedance(power, 1.0)[:, 88:93].all()


def test_adjacent_cells_merge_within_a_batch_only():
    cells = np.zeros((3, 10), bool)
    cells[0, [2, 3, 4, 8]] = cells[1, 4] = cells[2, 9] = True
    batch, azimuth = merge(cells, np.arange(0.0, 100.0, 10.0))
    assert batch.tolist() == [0, 0, 1, 2]
    assert azimuth.tolist() == [30.0, 80.0, 40.0, 90.0]
    assert [values.tolist() for values in merge(np.zeros((2, 3), bool), np.arange(3.0))] == [[], []]


def test_merging_is_dbscan_in_every_batch():
    cluster = pytest.importorskip("sklearn.cluster")
    rng = np.random.default_rng(4)
    cells = rng.random((20, 40)) < 0.4
    grid = np.linspace(-60.0, 60.0, 40)
    batch, azimuth = merge(cells, grid)
    for k in range(20):
        index = np.flatnonzero(cells[k])
        labels = cluster.DBSCAN(eps=1.0, min_samples=1).fit_predict(index[:, None])
        expected = [grid[index[labels == label]].mean() for label in np.unique(labels)]
        np.testing.assert_allclose(np.sort(azimuth[batch == k]), np.sort(expected))


def test_the_ratio_is_that_of_the_set_densities():
    """Eqs 13 and 14, with the densities of the whole set of detections."""
    detected, clutter, width, probability, std = np.array([3.0, 40.0]), 1.7, 120.0, 0.7, 3.0
    azimuth = np.array([-20.0, 2.0, 41.0])

    def false_alarms(points):
        return np.exp(-clutter) * (clutter / width) ** len(points)

    for j, here in enumerate(azimuth):
        density = np.exp(-0.5 * ((detected - here) / std) ** 2) / (std * np.sqrt(2 * np.pi))
        target = (1 - probability) * false_alarms(detected)
        target += probability * sum(g * false_alarms(np.delete(detected, i)) for i, g in enumerate(density))
        expected = np.log(target / false_alarms(detected))
        rows = detection_llr(np.array([1, 1]), detected, azimuth, 2, probability, std, clutter, width)
        assert rows[1, j] == pytest.approx(expected)
        assert rows[0, j] == pytest.approx(np.log(1 - probability))


@pytest.mark.parametrize("settings", [{"false_alarm_rate": 0.0}, {"training_deg": 0.0}, {"past": -1}])
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigError, match=next(iter(settings))):
        CfarConfig(**settings)


def test_too_few_beams_and_impossible_detections_are_refused():
    with pytest.raises(ConfigError, match="no training cells"):
        exceedance(np.ones((2, 10)), 1.0)
    with pytest.raises(ConfigError, match="0 < p_d < 1"):
        detection_llr(np.array([0]), np.array([0.0]), np.zeros(1), 1, 1.0, 3.0, 1.0, 120.0)
