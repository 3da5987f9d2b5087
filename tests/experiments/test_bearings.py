import json

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.experiments.bearings import Setting, reproduce, settings

REQUIRED = {
    "cpa_distance_m",
    "correlation_s",
    "bearing_std_deg",
    "observation_s",
    "speed_std_mps",
    "rmse_range_m",
    "crb_range_m",
    "rmse_course_deg",
    "crb_course_deg",
}


@pytest.fixture(scope="module")
def result():
    points = [
        Setting(500.0, 0.0),
        Setting(500.0, 150.0, figures=(1, 2, 3)),
        Setting(500.0, 150.0, 400.0, 0.0, (2,)),
        Setting(500.0, 150.0, 200.0, 1.0, (3,)),
        Setting(2000.0, 50.0),
    ]
    return reproduce(runs=400, seed=3, points=points)


def test_points_are_those_of_the_three_figures():
    points = settings()
    assert len(points) == len(
        {(p.cpa_distance_m, p.correlation_s, p.observation_s, p.speed_std_mps) for p in points}
    )
    assert {p.cpa_distance_m for p in points} >= {500, 1000, 1500, 2000}
    assert {p.correlation_s for p in points if 1 in p.figures} == {0.0, 50.0, 100.0, 150.0}
    for figure in (1, 2, 3):
        assert sum(figure in p.figures for p in points) == 28


def test_efficient_points_reach_the_whole_bound(result):
    efficient = [row for row in result.rows if row["efficient"]]
    assert len(efficient) == 4
    for row in efficient:
        assert row["rmse_range_m"] == pytest.approx(row["crb_range_m"], rel=0.1)
        assert row["rmse_course_deg"] == pytest.approx(row["crb_course_deg"], rel=0.1)
        assert row["rmse_range_ignoring_m"] == pytest.approx(row["theory_range_ignoring_m"], rel=0.1)
        assert row["rmse_start_position_m"] == pytest.approx(row["crb_start_position_m"], rel=0.1)
        assert row["right_side"] == 1.0


def test_a_far_ship_is_beyond_the_bound_by_its_curvature(result):
    (row,) = [row for row in result.rows if not row["efficient"]]
    assert row["rmse_range_m"] > 1.5 * row["crb_range_m"]
    assert row["rmse_range_m"] == pytest.approx(row["expected_range_m"], rel=0.12)


def test_block_bound_is_too_low_for_the_start_position(result):
    for row in result.rows:
        if row["speed_std_mps"] == 0:
            assert row["rmse_start_position_m"] > 1.1 * row["block_start_position_m"]


def test_speed_errors_reach_range_and_not_course(result):
    known, wrong = result.select(3)
    assert wrong["crb_range_m"] ** 2 - known["crb_range_m"] ** 2 == pytest.approx(
        (500.0 / 7.0) ** 2, rel=1e-6
    )
    assert wrong["crb_course_deg"] == pytest.approx(known["crb_course_deg"], rel=1e-6)
    assert wrong["rmse_range_ships_m"] == pytest.approx(wrong["theory_range_ships_m"], rel=0.15)


def test_json_holds_what_is_promised(result):
    told = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert told["simulated"] is True
    assert all(set(row) >= REQUIRED for row in told["rows"])
    assert told["rows"][0]["bearing_std_deg"] == 2.0
    seen = told["estimated_correlation"]
    assert abs(seen["correlation_s"] - 150.0) < 3 * seen["correlation_uncertainty_s"]


def test_table_names_the_papers_statements_and_figure_is_drawn(result, tmp_path):
    text = "\n".join(result.table())
    assert "simulated" in text
    assert "Figure 2: observation time" in text
    assert "171 vessels at sea" in text
    full = reproduce(runs=2, seed=0, points=[p for p in settings() if p.cpa_distance_m in (500, 2000)][:20])
    full.plot(tmp_path / "bearings.png")
    assert (tmp_path / "bearings.png").stat().st_size > 20_000


def test_seed_and_jobs():
    points = [Setting(500.0, 150.0), Setting(750.0, 0.0)]
    seen = []
    one = reproduce(runs=5, seed=1, points=points, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    assert reproduce(runs=5, seed=1, points=points, jobs=2).rows == one.rows
    assert reproduce(runs=5, seed=2, points=points).rows[0]["rmse_range_m"] != one.rows[0]["rmse_range_m"]
    assert np.isfinite([row["rmse_range_m"] for row in one.rows]).all()


def test_what_is_refused():
    with pytest.raises(ConfigError, match="runs"):
        reproduce(runs=0)
