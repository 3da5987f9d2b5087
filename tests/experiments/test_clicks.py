import json

import numpy as np
import pytest

from obsnet.arrays.compact import CompactArray
from obsnet.errors import ConfigError
from obsnet.experiments import clicks
from obsnet.experiments.click_scenes import (
    SAMPLING_RATE_HZ,
    AnimalPath,
    simulated_click_times,
    simulated_path,
    simulated_recording,
    simulated_tdoas,
)
from obsnet.kinematics import wrap180

ARRAY = CompactArray.tetrahedron()


@pytest.fixture(scope="module")
def result():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clicks, "DURATION_S", 120.0)
        patch.setattr(clicks, "RECORDING_S", 6.0)
        steps = []
        yield clicks.reproduce(2, 5, lambda done, total: steps.append((done, total))), steps


def test_what_the_issue_asks_for_holds(result):
    values = result[0].to_json()
    assert values["clutter_rejected"] > 0.99 and values["clicks_lost"] < 0.01
    assert values["azimuth_rmse_deg"] < 0.7 * values["regression_azimuth_rmse_deg"] < 2.0
    assert values["elevation_rmse_deg"] < 0.7 * values["regression_elevation_rmse_deg"] < 2.0
    assert values["regression_in_clutter_azimuth_rmse_deg"] > values["regression_azimuth_rmse_deg"]
    assert values["tracks_per_run"] == 1.0
    assert values["two_animals"]["ospa_deg"] < 1.0 and values["two_animals"]["right_number"] > 0.95


def test_recordings_go_from_samples_to_tracks(result):
    values = result[0].to_json()["recordings"]
    assert values["clicks_found"] > 0.85 and values["false_clicks"] <= 1.0
    assert values["azimuth_rmse_deg"] < values["click_azimuth_rmse_deg"] < 0.5
    assert values["elevation_rmse_deg"] < values["click_elevation_rmse_deg"] < 0.5
    assert 0.2 < values["error_over_stated"] < 1.5
    assert values["tracks_per_animal"] == pytest.approx(1.0, abs=0.3)


def test_the_outcome_is_json_a_table_and_a_figure(result, tmp_path):
    outcome, steps = result
    values = json.loads(json.dumps(outcome.to_json()))
    assert values["simulated"] is True and values["runs"] == 2
    table = "\n".join(outcome.table())
    assert f"{values['azimuth_rmse_deg']:.3f}°" in table and "paper" in table and "simulated" in table
    outcome.plot(tmp_path / "clicks.png")
    assert (tmp_path / "clicks.png").read_bytes()[:4] == b"\x89PNG"
    assert [done for done, _ in steps] == list(range(1, 7)) and {total for _, total in steps} == {6}


def test_runs_are_reproducible_and_checked(monkeypatch):
    monkeypatch.setattr(clicks, "DURATION_S", 30.0)
    one, other = (clicks.clutter(np.random.default_rng(3)) for _ in range(2))
    assert one == other
    with pytest.raises(ConfigError, match="at least 1"):
        clicks.reproduce(runs=0)


def test_simulated_tdoas_are_quantised_and_clutter_is_uniform_poisson():
    rng = np.random.default_rng(1)
    pairs = ARRAY.pairs(every=False)
    time = np.arange(2000.0)
    path = AnimalPath(np.array([0.0, 1e4]), np.array([[500.0, 800.0, 700.0], [500.0, -800.0, 900.0]]))
    scene = simulated_tdoas(rng, ARRAY, pairs, [path], time, np.ones((1, 2000), bool), clutter=1.0)
    value, animal = np.concatenate(scene.value), np.concatenate(scene.animal)
    own, clutter = value[animal == 0] * SAMPLING_RATE_HZ, value[animal < 0]
    np.testing.assert_allclose(own, np.round(own), atol=1e-6)
    assert len(own) == 6000 and len(clutter) == pytest.approx(6000, rel=0.05)
    assert np.abs(clutter).max() <= 1.5e-3 and clutter.std() == pytest.approx(3e-3 / np.sqrt(12.0), rel=0.03)


def test_a_simulated_recording_holds_click_and_inverted_echo_where_geometry_puts_them():
    array = CompactArray((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (200.0, 200.0, 200.0))
    path = AnimalPath(np.array([0.0, 10.0]), np.array([[300.0, 0.0, 80.0]] * 2))
    samples, direct, echo = simulated_recording(
        np.random.default_rng(2), array, [path], [np.array([0.5])], 1.2, source_level=100.0
    )
    centre = array.positions.mean(axis=0)
    expected = 0.5 + np.linalg.norm([300.0, 0.0, 120.0]) / 1500.0
    raised = 0.5 + np.linalg.norm([300.0, 0.0, 280.0]) / 1500.0
    assert (direct[0][0], echo[0][0]) == (pytest.approx(expected), pytest.approx(raised))
    for arrival, sign, height in ((direct[0][0], 1.0, 120.0), (echo[0][0], -1.0, 280.0)):
        lead = (
            (array.positions[1] - centre) @ np.array([300.0, 0.0, -height]) / np.hypot(300.0, height) / 1500.0
        )
        near = int((arrival - lead) * SAMPLING_RATE_HZ)
        around = samples[1, near - 40 : near + 40]
        assert np.abs(np.abs(around).argmax() - 40) <= 1
        assert np.sign(around[np.abs(around).argmax()]) == sign


def test_simulated_animals_swim_as_stated():
    path = simulated_path(np.random.default_rng(4), 300.0)
    speed = np.linalg.norm(np.diff(path.position, axis=0), axis=1)
    assert np.median(speed) == pytest.approx(1.7, rel=1e-6) and speed.max() <= 1.7 + 1e-9
    assert path.position[:, 2].min() >= 300.0 and path.position[:, 2].max() <= 1500.0
    turned = path.turned(50.0)
    before, after = (p.direction(np.arange(0.0, 300.0, 10.0), 2000.0) for p in (path, turned))
    np.testing.assert_allclose(wrap180(after[0] - before[0] - 50.0), 0.0, atol=1e-6)
    np.testing.assert_allclose(after[1], before[1])
    times = simulated_click_times(np.random.default_rng(5), 0.0, 500.0)
    assert np.diff(times).mean() == pytest.approx(1.0, rel=0.03) and np.diff(times).std() == pytest.approx(
        0.1, rel=0.15
    )
