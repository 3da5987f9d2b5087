import json
from dataclasses import replace

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.experiments import tkbd, tkbd_result
from obsnet.experiments.approach import Approach
from obsnet.experiments.tkbd_result import outcome, single_target_ospa
from obsnet.trackers.metrics import angular_distances, ospa
from obsnet.trackers.track_before_detect import BearingTrack

NEAR = Approach(start_range_m=340.0, start_azimuth_deg=-15.0, end_azimuth_deg=0.0, target_free_s=10.0)
CONTENDERS = {contender.name: contender for contender in tkbd.CONTENDERS}
PAIR = (CONTENDERS["TVAR14"], CONTENDERS["CFAR"])


def test_the_course_is_the_papers():
    truth = Approach(target_free_s=60.0).truth()
    there = truth.present
    moving = truth.time_s[there] - truth.time_s[there][0]
    assert moving[-1] == pytest.approx(829.0, abs=1.0)
    assert np.isnan(truth.snr_db[~there]).all() and (~there).sum() * 64 / 375 == pytest.approx(60.0, abs=0.2)
    assert truth.azimuth_deg[there][[0, -1]] == pytest.approx([-50.0, 50.0], abs=0.2)
    assert truth.range_m[there][[0, -1]] == pytest.approx([2000.0, 300.0], abs=1.0)
    at = np.argmin(np.abs(moving - 700.0))
    assert truth.range_m[there][at] == pytest.approx(366.0, abs=2.0)
    assert truth.snr_db[there][at] == pytest.approx(-4.7, abs=0.1)
    assert truth.snr_db[there].min() == pytest.approx(-18.0, abs=0.01)


def test_simulated_samples_have_the_stated_noise_snr_and_tails():
    approach = replace(Approach(), degrees_of_freedom=12.0)
    noise, rng = approach.noise(), np.random.default_rng(1)
    quiet = approach.target_free(500.0)
    loud = replace(
        quiet, azimuth_deg=np.full(len(quiet.time_s), 10.0), snr_db=np.full(len(quiet.time_s), 3.0)
    )
    without, with_target = (approach.simulate(truth, noise, rng) for truth in (quiet, loud))
    tails = 12.0 / 10.0
    power = np.trace(noise.autocovariance()) / 8
    assert (without**2).mean() == pytest.approx(tails * power, rel=0.05)
    level = np.linalg.det(noise.autocovariance()) ** (1 / 8)
    added = (with_target**2).mean() - (without**2).mean()
    assert added == pytest.approx(tails * level * 10**0.3, rel=0.1)
    energy = (without**2).mean(axis=(1, 2))
    gaussian = (noise.simulate(len(energy) * 64, rng).reshape(without.shape) ** 2).mean(axis=(1, 2))
    spread = np.var(energy) / energy.mean() ** 2
    one_over_chi2 = 2 / (12 - 4)
    within = np.var(gaussian) / gaussian.mean() ** 2
    assert spread == pytest.approx((1 + one_over_chi2) * (1 + within) - 1, rel=0.2)


def test_the_target_adds_power_at_its_azimuth():
    truth = NEAR.truth()
    samples = NEAR.simulate(truth, NEAR.noise(), np.random.default_rng(2))
    beams = NEAR.beamformer()
    power = beams.power(samples)
    power /= power.mean(axis=1, keepdims=True)
    gain = power[truth.present].mean(axis=0) - power[~truth.present].mean(axis=0)
    assert beams.azimuth_deg[gain.argmax()] == pytest.approx(np.nanmean(truth.azimuth_deg), abs=4.0)


def test_whitening_raises_the_snr_away_from_the_sea_and_lowers_it_in_its_direction():
    approach = Approach()
    noise = approach.noise()
    azimuth = np.array([-55.0, -20.0])
    truth = replace(approach.target_free(0.5), azimuth_deg=azimuth, snr_db=np.zeros(2))
    snr = approach.whitened_snr_db(truth, noise)
    beams = approach.beamformer()
    transfer = noise.transfer((beams.frequency_hz - 750.0) / 375.0)
    level = np.linalg.det(noise.autocovariance()) ** (1 / 8)
    for found, here in zip(snr, azimuth, strict=True):
        waves = beams.phases(here)
        gain = [np.linalg.norm(t @ waves[:, f]) ** 2 / 8 for f, t in enumerate(transfer)]
        assert found == pytest.approx(10 * np.log10(level * np.mean(gain)))
    assert snr[0] > 2.0 and snr[1] < -1.0


def test_the_single_target_metric_is_ospa():
    truth = np.array([np.nan, np.nan, 10.0, 10.0, 10.0])
    azimuth = np.array([0.0, 5.0, 12.0, 80.0, 10.0])
    confirmed = np.array([False, True, True, True, False])
    targets = [[] if np.isnan(t) else [t] for t in truth]
    found = [[a] if c else [] for a, c in zip(azimuth, confirmed, strict=True)]
    expected = [ospa(angular_distances(t, f), 30.0) for t, f in zip(targets, found, strict=True)]
    np.testing.assert_allclose(single_target_ospa(truth, azimuth, confirmed), expected)
    assert expected == [0.0, 30.0, 2.0, 30.0, 30.0]


def judged(existence, azimuth_error):
    truth = replace(Approach(), target_free_s=20.0).truth()
    count = len(truth.time_s)
    azimuth = np.where(truth.present, truth.azimuth_deg, 0.0) + azimuth_error(truth.time_s)
    q = np.broadcast_to(existence(truth.time_s), count).astype(float)
    return truth, outcome(truth, BearingTrack(q, azimuth, np.ones(count), np.full(count, -7.0)))


def test_a_track_confirmed_and_held_is_counted_so():
    truth, found = judged(lambda t: t > 400.0, lambda t: 2.0 + 0 * t)
    assert found.confirmation_db == pytest.approx(np.interp(401.0, truth.time_s, truth.snr_db), abs=0.02)
    assert found.held == 1.0 and not found.false
    assert found.azimuth_rmse_deg == pytest.approx(2.0)


def test_a_track_before_the_target_or_beside_it_is_false_and_a_blip_is_none():
    assert judged(lambda t: (t > 5.0) & (t < 7.0), lambda t: 0 * t)[1].false
    assert judged(lambda t: t > 400.0, lambda t: 11.0 + 0 * t)[1].false
    _, blip = judged(lambda t: (t > 5.0) & (t < 5.8), lambda t: 0 * t)
    assert not blip.false
    assert blip.confirmation_db == np.inf and blip.held == 0.0 and np.isnan(blip.azimuth_rmse_deg)


def test_a_track_that_is_lost_is_held_for_its_share():
    _, found = judged(lambda t: (t > 449.0) & (t < 649.0), lambda t: 0 * t)
    assert found.held == pytest.approx(199.0 / 399.0, abs=0.01)


@pytest.fixture(scope="module", autouse=True)
def short_training():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tkbd, "TRAINING_S", 60.0)
        yield


@pytest.fixture(scope="module")
def small():
    return tkbd.reproduce(runs=2, seed=3, approach=NEAR, contenders=PAIR)


def test_the_result_holds_what_the_report_needs(small, tmp_path):
    report = json.loads(json.dumps(small.to_json(), allow_nan=False))
    assert set(report["snr_at_confirmation_db"]) == set(report["false_tracks"]) == {"TVAR14", "CFAR"}
    assert report["simulated"] is True and report["runs"] == 2
    assert report["snr_at_confirmation_db"]["TVAR14"] == pytest.approx(-4.1, abs=0.1)
    assert report["held"]["TVAR14"] > 0.95 and report["false_tracks"]["TVAR14"] == 0.0
    assert report["azimuth_rmse_deg"]["TVAR14"] < 3.0
    assert report["snr_bias_db"]["CFAR"] is None
    assert report["beyond_the_paper"]["false_tracks"] == {}
    assert "paper" in small.table() and "simulated" in small.table()
    small.plot(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000


def test_runs_repeat_with_their_seed_and_differ_without(small):
    again = tkbd.reproduce(runs=1, seed=3, approach=NEAR, contenders=PAIR)
    for name in again.trackers:
        np.testing.assert_array_equal(again.outcomes[0][name].existence, small.outcomes[0][name].existence)
    first, second = small.outcomes
    assert not np.array_equal(first["TVAR14"].existence, second["TVAR14"].existence)


def test_a_tracker_that_never_confirms_is_null(small):
    deaf = replace(small.outcomes[0]["CFAR"], confirmation_db=np.inf, azimuth_rmse_deg=np.nan)
    silent = replace(small, outcomes=tuple(run | {"CFAR": deaf} for run in small.outcomes))
    report = json.loads(json.dumps(silent.to_json(), allow_nan=False))
    assert report["snr_at_confirmation_db"]["CFAR"] is None and report["gain_db"] is None
    assert "never" in silent.table()


def test_track_before_detect_hears_the_target_at_least_4_db_below_cfar():
    far = Approach(start_range_m=900.0, start_azimuth_deg=-45.0, end_azimuth_deg=10.0, target_free_s=20.0)
    result = tkbd.reproduce(runs=2, seed=4, approach=far, contenders=PAIR)
    assert result.gain_db >= 4.0
    assert result.held("TVAR14") > 0.95


def test_calibration_finds_the_most_sensitive_quiet_setting(monkeypatch):
    monkeypatch.setattr(tkbd, "RECORD_S", 30.0)
    contenders = (CONTENDERS["TVAR14"], CONTENDERS["GVAR14"])
    found = tkbd.calibrate(seed=5, hours=30.0 / 3600.0, contenders=contenders)
    assert found["TVAR14"] == -20.0, "heavy tails are in its likelihood"
    assert found["GVAR14"] > found["TVAR14"], "heavy tails look like a target to a Gaussian"


def test_bad_requests_are_refused():
    with pytest.raises(ConfigError, match="number of runs"):
        tkbd.reproduce(runs=0, seed=1)
    with pytest.raises(ConfigError, match="positive speed"):
        Approach(speed_mps=0.0)


def test_trackers_confirm_at_the_threshold_that_judges_them():
    assert tkbd.BernoulliConfig().confirmation == tkbd_result.CONFIRMED
