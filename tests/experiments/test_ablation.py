"""The ablation: minutes against the truth, thresholds, recalibration, and studies that go on where they stopped."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from obsnet.errors import ConfigError
from obsnet.experiments import ablation, ablation_report
from obsnet.experiments.ablation import Plan, Row
from obsnet.experiments.ablation_minutes import CELL_PRIOR, minute_table, samples
from obsnet.experiments.ablation_records import KINDS, twin_scenario, write_twin
from obsnet.layout import from_posix

TIMES = 1.6e9 - 1.6e9 % 60 + 60.0 * np.arange(4)
AZIMUTH, RANGE, RATE = np.arange(360.0), np.arange(715) * 70.0, np.arange(-26, 27) * 0.5


def truth(azimuth=(90.0, 90.0, 90.0, 90.0), distance=(10e3, 10e3, 10e3, 70e3)):
    stamps = [f"{t}Z" for t in np.datetime_as_string(from_posix(TIMES), unit="s")]
    columns = {"time": stamps, "mmsi": 1, "azimuth_deg": azimuth, "range_m": distance, "range_rate_mps": 0.0}
    return pd.DataFrame(columns)


def maps(azimuth, distance, height=20.0):
    """Maps with one peak a minute over a floor of -10."""
    pointing = np.full((4, 360), -10.0, np.float32)
    ranging = np.full((4, 715, 53), -10.0, np.float32)
    for i in range(4):
        pointing[i, int(azimuth[i])] = height
        ranging[i, round(distance[i] / 70.0), 26] = height
    covered = ("time", np.ones(4, np.float32))
    return xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), pointing),
            "range_llr": (("time", "range", "range_rate"), ranging),
            "azimuth_coverage": covered,
            "range_coverage": covered,
        },
        {"time": from_posix(TIMES), "azimuth": AZIMUTH, "range": RANGE, "range_rate": RATE},
    )


def test_a_minute_is_right_within_ten_degrees_and_within_three_percent():
    table = minute_table(maps((95, 101, 90, 90), (10.3e3, 10.6e3, 9.6e3, 20e3)), truth())
    assert table["azimuth_right"].tolist() == [1, 0, 1, 1]
    assert table["azimuth_error"].tolist() == [5.0, 11.0, 0.0, 0.0]
    assert table["range_right"].tolist() == [1, 0, 1, 0]
    assert table["near"].tolist() == [1, 1, 1, 0]
    assert table["range_true_m"].tolist() == [10e3, 10e3, 10e3, 70e3]


def test_nats_are_few_for_a_sure_right_cell_and_many_for_a_sure_wrong_one():
    here, there = maps((90,) * 4, (10e3,) * 4), maps((200,) * 4, (30e3,) * 4)
    right, wrong = minute_table(here, truth()), minute_table(there, truth())
    assert right["azimuth_nll"][0] < 0.01 < 0.3 < wrong["azimuth_nll"][0]
    assert right["range_nll"][0] < 0.5 < 5.0 < wrong["range_nll"][0]
    silent = minute_table(maps((90,) * 4, (10e3,) * 4, height=-10.0), truth().iloc[:0])
    assert silent["azimuth_nll"][0] == pytest.approx(CELL_PRIOR * np.exp(-10.0), rel=1e-3)
    assert silent["range_nll"][0] < 1e-3


def test_north_is_no_edge():
    table = minute_table(maps((359,) * 4, (10e3,) * 4), truth(azimuth=(2.0,) * 4))
    assert table["azimuth_right"].all()


def test_without_ships_every_estimate_is_false():
    table = minute_table(maps((90,) * 4, (10e3,) * 4), truth().iloc[:0])
    assert not table["azimuth_right"].any() and not table["range_right"].any()
    assert table["range_true_m"].isna().all()


def test_the_threshold_lets_pass_as_many_wrong_minutes_as_allowed():
    minutes = pd.DataFrame(
        {"covered": 1, "range_true_m": 1e4, "azimuth_right": 0, "azimuth_llr": np.arange(600.0)}
    )
    chosen = ablation_report.thresholds([("twin", "ordinary", minutes, {})], wrong_per_hour=2.0)
    assert (minutes["azimuth_llr"] > chosen["azimuth"]).sum() == 20


def test_the_threshold_keeps_every_record_without_a_ship_quiet():
    minutes = pd.DataFrame(
        {"covered": 1, "range_true_m": 1e4, "azimuth_right": 1, "azimuth_llr": np.arange(600.0)}
    )
    quiet, loud = (
        minutes.assign(range_true_m=np.nan, azimuth_right=0, azimuth_llr=np.arange(600.0) + shift) for shift in (-700, 50)
    )  # fmt: skip
    records = [
        ("twin", kind, part, {}) for kind, part in (("faint", minutes), ("no_ship", quiet), ("no_ship", loud))
    ]
    chosen = ablation_report.thresholds(records, wrong_per_hour=100.0, false_per_hour=0.5)
    assert (loud["azimuth_llr"] > chosen["azimuth"]).sum() == 5


def test_reliability_of_honest_ratios_is_the_diagonal():
    rng = np.random.default_rng(3)
    there = rng.random(40_000) < 0.3
    llr = rng.normal(np.where(there, 1.0, -1.0), np.sqrt(2.0))
    minutes = pd.DataFrame(
        {"range_true_m": np.where(there, 1e4, np.nan), "azimuth_llr": llr, "range_llr": 3.0 * llr}
    )
    honest, bold = (ablation_report.reliability(minutes, sensor) for sensor in ("azimuth", "range"))
    assert honest["minutes"].sum() == 40_000
    assert (honest["said"] - honest["seen"]).abs().max() < 0.03
    assert (
        bold["said"].iloc[0] < bold["seen"].iloc[0] - 0.02
        and bold["said"].iloc[-1] > bold["seen"].iloc[-1] + 0.05
    )


def test_recalibration_recovers_the_slope_of_overconfident_ratios(tmp_path):
    rng = np.random.default_rng(0)
    minutes, cells, shift = 4000, 72, 3.0
    llr = rng.normal(0.0, shift, (minutes, cells)) - shift**2 / 2
    holds = np.zeros((minutes, cells), bool)
    with_ship = np.flatnonzero(rng.random(minutes) < 72 * CELL_PRIOR / (1 + 72 * CELL_PRIOR))
    where = rng.integers(0, cells, len(with_ship))
    holds[with_ship, where] = True
    llr[holds] += shift**2
    (tmp_path / "twin" / "ordinary_1000").mkdir(parents=True)
    np.savez(
        tmp_path / "twin" / "ordinary_1000" / "samples.npz",
        azimuth_llr=(llr - 1.0) / 0.2,
        azimuth_holds=holds,
    )
    slope, offset = ablation.recalibration(tmp_path)["azimuth"]
    assert slope == pytest.approx(0.2, rel=0.05)
    assert offset == pytest.approx(1.0, abs=0.15)


def test_samples_hold_the_cells_and_where_the_ship_is():
    made = samples(maps((90,) * 4, (10e3,) * 4), truth())
    assert made["azimuth_llr"].shape == (4, 72) and made["azimuth_holds"].sum() == 4
    assert made["range_llr"].shape == (1, 715, 53)
    assert made["range_near"].tolist() == [True] and made["range_holds"].sum() == 15


def test_reach_ends_at_the_first_bin_that_is_mostly_wrong():
    distance = np.repeat([2e3, 7e3, 12e3, 17e3], 20)
    right = np.repeat([True, True, False, True], 20)
    assert ablation_report._reach(distance, right) == 10.0


@pytest.mark.parametrize("kind", KINDS)
def test_the_twin_makes_every_kind(kind):
    scenario = twin_scenario(kind, 1, 3.0)
    assert len(scenario.passages) == {"no_ship": 0, "two_ships": 2}.get(kind, 1)
    assert scenario == twin_scenario(kind, 1, 3.0)
    assert twin_scenario(kind, 2, 3.0).seed != scenario.seed


@pytest.mark.parametrize("kind", KINDS)
def test_no_ship_sounds_as_one_of_a_training_record_does(kind):
    seeds = {p.ship.seed for number in (0, 1, 1000) for p in twin_scenario(kind, number, 3.0).passages}
    # Those of training are a thousand times the record's seed and a few.
    assert min(seeds, default=np.inf) >= 1000 * 100_000
    assert len(seeds) == {"no_ship": 0, "two_ships": 6}.get(kind, 3)


def test_an_unknown_kind_is_refused():
    with pytest.raises(ConfigError, match="no kind of record 'odd'"):
        twin_scenario("odd", 0, 1.0)


def test_thresholds_may_be_of_more_kinds_than_are_tested():
    plan = Plan({"twin": write_twin}, ("faint",), 2, 1)
    assert plan.cases(validation=True) == [("twin", "faint", 1000)]
    plan = replace(plan, validation_kinds=KINDS)
    assert [kind for _, kind, _ in plan.cases(validation=True)] == list(KINDS)
    assert plan.cases(validation=False) == [("twin", "faint", 0), ("twin", "faint", 1)]


@pytest.mark.slow
def test_a_study_goes_on_where_it_stopped(tmp_path, monkeypatch):
    made = []

    def maker(kind, seed, hours, folder):
        made.append((kind, seed))
        write_twin(kind, seed, hours, folder)

    monkeypatch.setitem(ablation.ROWS, "turned", Row("analytic", "analytic", recalibrated=True))
    plan = Plan({"twin": maker}, ("ordinary",), 1, 1, 0.7, ("analytic", "turned", "learned both"))
    ablation.run(plan, tmp_path)
    first = ablation_report.write(plan, tmp_path, tmp_path / "out")
    ablation.run(plan, tmp_path)
    assert made == [("ordinary", 1000), ("ordinary", 0)]
    assert {"analytic", "turned"} <= set(first["row"])
    assert first.loc[first["kind"] == "ordinary", "azimuth_right"].iloc[0] > 0.3
    assert (tmp_path / "out" / "ablation.png").stat().st_size > 10_000
    pd.testing.assert_frame_equal(first, ablation_report.write(plan, tmp_path, tmp_path / "out"))
