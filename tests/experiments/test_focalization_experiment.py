import json
from dataclasses import replace

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.experiments.focalization import (
    MAX_TDOA_S,
    MIN_DETECTED_S,
    SCENARIOS,
    SOUND_SPEED_MPS,
    TDOA_STD_S,
    Setting,
    ToldFilter,
    filter_config,
    fitted,
    follow,
    information_nats,
    mixed,
    reproduce,
    settled,
)
from obsnet.experiments.passage_sound import Sound, detect, record
from obsnet.trackers.tdoa_association import association_log_likelihood


@pytest.fixture(scope="module")
def result():
    return reproduce(runs=3, seed=1, particles=2500, scenarios=("kraken", "marfret_listed"))


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
    heard = np.concatenate([scenario.heard(setting, rng) for _ in range(10)])
    scans = mixed(heard, setting.false_alarms, rng)
    expected = sum(setting.detection_probability) + setting.false_alarms
    counts = np.array([len(scan) for scan in scans])
    assert counts.mean() == pytest.approx(expected, abs=4 * counts.std() / np.sqrt(len(counts)))
    errors = heard - np.tile(scenario.delays(), (10, 1))
    assert np.nanstd(errors) == pytest.approx(TDOA_STD_S, rel=0.05)
    assert np.isfinite(heard).mean(axis=0) == pytest.approx(setting.detection_probability, abs=0.04)


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
        name: np.log(100) / information_nats(SCENARIOS[name].settings["i"])
        for name in ("kraken_listed", "marfret_listed")
    }
    assert scans["kraken_listed"] * 3.0 > 60.0 and scans["marfret_listed"] * 3.0 < 15.0


def test_range_settles_within_seconds_from_sound_with_every_listed_setting(result):
    for row in result.to_json()["kraken"].values():
        # Eight pairs fit a boat's first scans at more places than the paper's three, which settle within 15 s.
        assert row["settled_s"] is not None and row["settled_s"] <= 30.0
        assert row["three_paths_settled_s"] is not None and row["three_paths_settled_s"] <= 15.0
        assert row["range_rmse_m"] < 10.0 and row["simulated"] is True
    shares, count = result.heard("kraken")
    assert (shares > 0.5).all() and 3.0 < count < 12.0


def test_range_settles_at_listed_rates_and_sooner_with_the_labels(result):
    for row in result.to_json()["marfret_listed"].values():
        assert row["settled_s"] is not None and row["settled_s"] < 120.0
        assert row["told_settled_s"] <= row["settled_s"]
        assert row["told_rmse_m"] < 1.5 * row["range_rmse_m"] < 150.0


def test_false_alarms_are_what_the_scans_hold_beyond_the_expected():
    scans = [np.zeros(5), None, np.zeros(3)]
    made = fitted(Setting((0.4, 0.3, 0.2), 1.0), 5, scans)
    assert made.detection_probability == (0.4, 0.3, 0.2, 0.1, 0.1)
    assert made.false_alarms == pytest.approx(4.0 - 1.1)
    assert fitted(Setting((0.9,), 1.0), 1, [np.zeros(0)]).false_alarms == pytest.approx(0.1)


def test_a_second_bounce_holds_the_ship_where_the_direct_sound_is_lost():
    """Source, depths and seed of no run of the experiment."""
    ship = SCENARIOS["marfret"]
    sound = replace(ship.sound, source_level_db=128.0, source_depth_m=3.5)
    part = replace(ship, along_m=(300.0, 2000.0), receiver_depth_m=(22.0, 16.0), sound=sound)
    heard, setting = part.recorded(41), part.settings["ii"]
    model = part.model(heard)
    config = filter_config(fitted(setting, len(model.pairs), heard.scans), 3000, 0, MIN_DETECTED_S)
    found, _ = follow(part, heard.scans, config, model=model)
    three, _ = follow(part, heard.scans, filter_config(setting, 3000, 0, MIN_DETECTED_S))
    late = part.time_s > 30.0
    error, other = (np.abs(track - part.range_m)[late] for track in (found, three))
    assert np.median(error) < 60.0 and error.max() < 300.0
    assert error.mean() < 0.5 * other.mean()


def test_labels_leave_the_error_that_the_delays_allow():
    scenario = SCENARIOS["marfret_listed"]
    setting = Setting((1.0, 1.0, 1.0), 1.0)
    heard = scenario.heard(setting, np.random.default_rng(0))
    truth, _ = follow(scenario, list(heard), filter_config(setting, 4000, 0), ToldFilter)
    near = slice(20, 60)
    slope = np.gradient(scenario.delays(), axis=0) / np.gradient(scenario.range_m)[:, None]
    single = TDOA_STD_S / np.sqrt(np.sum(slope**2, axis=1))
    error = np.abs(truth - scenario.range_m)
    assert np.median(error[near]) < np.median(single[near])


def test_sound_holds_the_delays_of_the_image_method():
    water, time = 65.0, np.arange(0.0, 90.0, 3.0)
    distance, receiver = 300.0 - 2.0 * time, np.full(len(time), 30.0)
    loud = Sound(source_level_db=140.0, source_depth_m=1.0)
    sound = record(time, distance, receiver, water, SOUND_SPEED_MPS, loud, (1,))
    assert len(sound) == 90 * loud.sampling_rate
    scans = detect(sound, time, loud, (0.001, MAX_TDOA_S)).scans
    lengths = [np.hypot(distance, image) for image in (30.0, 2 * water - 30.0, 2 * water + 30.0)]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        delay = (lengths[second] - lengths[first]) / SOUND_SPEED_MPS
        off = [np.abs(scan - true).min() for scan, true in zip(scans, delay, strict=True) if len(scan)]
        assert len(off) > 25 and np.median(off) < 0.7 * TDOA_STD_S
    wrong = [np.abs(scan - 1.15 * true).min() for scan, true in zip(scans, delay, strict=True) if len(scan)]
    assert np.median(wrong) > 1e-3


def test_direct_sound_has_the_power_of_source_and_image():
    time = np.arange(0.0, 60.0, 3.0)
    alone = Sound(source_level_db=140.0, source_depth_m=20.0, noise_level_db=0.0, bounces=0)
    sound = record(time, np.full(20, 40.0), np.full(20, 30.0), 65.0, SOUND_SPEED_MPS, alone, (2,))
    frequency = np.arange(0.0, 3000.0)
    one, other = np.hypot(40.0, 10.0), np.hypot(40.0, 50.0)
    power = np.sum(alone.source_amplitude(frequency) ** 2) * (one**-2 + other**-2)
    assert np.mean(sound**2) == pytest.approx(power, rel=0.15)


def test_result_reads_as_json_as_table_and_as_figure(result, tmp_path):
    numbers = json.loads(json.dumps(result.to_json()))
    assert set(numbers) == {"kraken", "marfret_listed"} and set(numbers["kraken"]) == {"i", "ii", "iii"}
    assert {"range_rmse_m", "settled_s"} <= set(numbers["kraken"]["i"])
    text = result.table()
    assert (
        "simulated" in text
        and "paper" in text
        and f"{numbers['marfret_listed']['i']['range_rmse_m']:5.0f} m" in text
    )
    result.plot(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000


def test_jobs_do_not_change_the_result():
    one = reproduce(runs=2, seed=3, particles=50, scenarios=("kraken_listed",))
    two = reproduce(runs=2, seed=3, particles=50, scenarios=("kraken_listed",), jobs=2)
    for label, tracks in one.tracks["kraken_listed"].items():
        np.testing.assert_array_equal(tracks.range_m, two.tracks["kraken_listed"][label].range_m)


def test_what_never_settles_says_so():
    time = np.arange(0.0, 90.0, 3.0)
    assert settled(time, np.where(time % 9 == 0, 5.0, 0.5), 1.0) is None
    assert settled(time, np.where(time < 45.0, 5.0, 0.5), 1.0) == 45.0
    assert settled(time, np.where(time < 75.0, 5.0, 0.5), 1.0) is None


def test_an_unknown_scenario_is_refused():
    with pytest.raises(ConfigError, match="no scenario 'niolon'"):
        reproduce(runs=1, scenarios=("niolon",))
