import json

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.experiments.focalization import (
    MAX_TDOA_S,
    SCENARIOS,
    TDOA_STD_S,
    Setting,
    information_nats,
    reproduce,
    settled,
)
from obsnet.trackers.tdoa_association import association_log_likelihood


@pytest.fixture(scope="module")
def result():
    return reproduce(runs=3, seed=1, particles=2500, scenarios=("marfret", "kraken_clear"))


@pytest.mark.parametrize(("name", "far", "near"), [("kraken", 500.0, 100.0), ("marfret", 3000.0, 500.0)])
def test_passages_are_those_of_the_paper(name, far, near):
    scenario = SCENARIOS[name]
    assert scenario.range_m.max() == pytest.approx(far, rel=0.01)
    assert scenario.range_m.min() == pytest.approx(near, rel=0.01)
    assert scenario.receiver_m.min() >= 7.0 and scenario.receiver_m.max() <= 40.0
    speed = np.abs(np.diff(scenario.range_m)).max() / 3.0
    assert speed <= scenario.speed_mps
    assert scenario.delays().max() < MAX_TDOA_S


def test_simulated_scans_have_the_listed_rates_and_spread():
    scenario, rng = SCENARIOS["marfret"], np.random.default_rng(0)
    setting = scenario.settings["i"]
    scans = [scan for _ in range(10) for scan in scenario.measurements(setting, rng)]
    expected = sum(setting.detection_probability) + setting.false_alarms
    counts = np.array([len(scan) for scan in scans])
    assert counts.mean() == pytest.approx(expected, abs=4 * counts.std() / np.sqrt(len(counts)))
    longest = np.tile(scenario.delays()[:, 1], 10)
    near = [scan - delay for scan, delay in zip(scans, longest, strict=True)]
    errors = np.concatenate(
        [error[np.abs(error) < 4 * TDOA_STD_S] for error, d in zip(near, longest, strict=True) if d > 0.012]
    )
    assert np.std(errors) == pytest.approx(TDOA_STD_S, rel=0.15)


def test_information_of_a_scan_is_its_mean_log_likelihood_ratio():
    setting, rng = Setting((0.4, 0.2, 0.3), 2.0), np.random.default_rng(0)
    delays = np.array([[0.02, 0.05, 0.08]])
    gains = []
    for _ in range(6000):
        heard = delays[0] + TDOA_STD_S * rng.standard_normal(3)
        heard = heard[rng.random(3) < np.array(setting.detection_probability)]
        measured = np.concatenate([heard, rng.uniform(0, MAX_TDOA_S, rng.poisson(2.0))])
        llr, _ = association_log_likelihood(
            delays,
            measured,
            np.array(setting.detection_probability),
            np.array([TDOA_STD_S]),
            2.0 / MAX_TDOA_S,
            (0.0, MAX_TDOA_S),
        )
        gains.append(llr[0])
    # A pair gives one measurement at most, the Poisson formula counts any number: no equality, but near it.
    assert information_nats(setting) == pytest.approx(np.mean(gains), rel=0.12)


def test_the_boats_listed_rates_cannot_settle_within_seconds_but_the_ships_can():
    scans = {
        name: np.log(100) / information_nats(SCENARIOS[name].settings["i"]) for name in ("kraken", "marfret")
    }
    assert scans["kraken"] * 3.0 > 60.0 and scans["marfret"] * 3.0 < 15.0


def test_range_settles_and_stays_where_delays_are_heard(result):
    for settings in result.to_json().values():
        for row in settings.values():
            assert row["settled_s"] is not None and row["settled_s"] < 120.0
            assert row["median_error_m"] < 100.0 and row["simulated"] is True
    assert all(row["range_rmse_m"] < 60.0 for row in result.to_json()["kraken_clear"].values())


def test_result_reads_as_json_as_table_and_as_figure(result, tmp_path):
    numbers = json.loads(json.dumps(result.to_json()))
    assert set(numbers) == {"marfret", "kraken_clear"} and set(numbers["marfret"]) == {"i", "ii", "iii"}
    assert {"range_rmse_m", "settled_s"} <= set(numbers["marfret"]["i"])
    text = result.table()
    assert (
        "simulated" in text
        and "paper" in text
        and f"{numbers['marfret']['i']['range_rmse_m']:5.0f} m" in text
    )
    result.plot(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000


def test_jobs_do_not_change_the_result():
    one = reproduce(runs=2, seed=3, particles=50, scenarios=("kraken_clear",))
    two = reproduce(runs=2, seed=3, particles=50, scenarios=("kraken_clear",), jobs=2)
    for label, tracks in one.tracks["kraken_clear"].items():
        np.testing.assert_array_equal(tracks.range_m, two.tracks["kraken_clear"][label].range_m)


def test_what_never_settles_says_so():
    time = np.arange(0.0, 90.0, 3.0)
    assert settled(time, np.where(time % 9 == 0, 5.0, 0.5), 1.0) is None
    assert settled(time, np.where(time < 45.0, 5.0, 0.5), 1.0) == 45.0
    assert settled(time, np.where(time < 75.0, 5.0, 0.5), 1.0) is None


def test_an_unknown_scenario_is_refused():
    with pytest.raises(ConfigError, match="no scenario 'niolon'"):
        reproduce(runs=1, scenarios=("niolon",))
