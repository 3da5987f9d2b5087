"""Simulated cepstrograms of ships passing a deep station: Gaussian pulses at ray delays in noise (methods, eqs 15-17)."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import StraightCourse
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.trackers.station_focalization import (
    StationFocalization,
    StationFocalizationConfig,
    focalize_station,
)

DEPTH, SPEED, HOP, NFFT = 4340.0, 1500.0, 10.24, 1024
QUEFRENCY = np.arange(513) * 0.02
PAIRS = ("1-3", "3-5", "5-7")
AMPLITUDES = Amplitudes.table_ii()
CONFIG = StationFocalizationConfig()


def delays(range_m):
    """Delays of the three pairs, dims (pair, range), in water of one sound speed."""
    return np.diff(np.hypot(np.array([1, 3, 5, 7])[:, None] * DEPTH, range_m), axis=0) / SPEED


@pytest.fixture(scope="module")
def table():
    ranges, paths = np.arange(0.0, 60e3, 70.0), np.array([1, 3, 5, 7])
    length = np.hypot(paths[:, None] * DEPTH, ranges)
    variables = {"delay": length / SPEED, "pressure": 1 / length + 0j, "slowness": ranges / length / SPEED}
    return xr.Dataset(
        {name: (("path", "range"), values) for name, values in variables.items()},
        coords={"path": paths, "range": ranges},
    )


def simulate(course, begin, end, loudness, seed):
    """Times, cepstrogram (quefrency, time) and true range of a passage; phases drift with range."""
    rng = np.random.default_rng(seed)
    times = HOP * np.arange(round(begin / HOP), round(end / HOP))
    std = (0.625 + 0.2 * np.cos(np.pi * QUEFRENCY / QUEFRENCY[-1])) / np.sqrt(NFFT)
    values = std[:, None] * rng.standard_normal((len(QUEFRENCY), len(times)))
    distance = course.observables(times)[1]
    for pair, delay in zip(PAIRS, delays(distance), strict=True):
        amplitude = loudness * AMPLITUDES.evaluate(pair, distance)
        lag = QUEFRENCY[:, None] - delay
        phase = rng.uniform(0, 2 * np.pi) + distance / 30e3
        values += amplitude * np.cos(2 * np.pi * 15.0 * lag + phase) * np.exp(-0.5 * (lag / 0.05) ** 2)
    return times, values, distance


def visible(distance, loudness):
    """How many branches stand out (amplitude above one standard deviation of a single frame's noise)."""
    return sum(loudness * AMPLITUDES.evaluate(pair, distance) > 0.02 for pair in PAIRS)


def ghosts(distance):
    """Ranges at which another pair has the delay that a pair has at `distance`."""
    grid = np.arange(0.0, 50e3, 20.0)
    curves, here = delays(grid), delays(np.array([distance]))[:, 0]
    found = []
    for own in range(3):
        for other in range(3):
            if own != other and curves[other].min() <= here[own] <= curves[other].max():
                found.append(grid[np.argmin(np.abs(curves[other] - here[own]))])
    return np.array(found)


@pytest.mark.parametrize(
    ("cpa_m", "loudness", "seed", "amplitudes"),
    [(9e3, 1.0, 0, AMPLITUDES), (12e3, 0.6, 2, AMPLITUDES), (20e3, 1.0, 1, None)],
)
def test_range_is_followed_and_ghosts_are_rejected(table, cpa_m, loudness, seed, amplitudes):
    times, values, distance = simulate(StraightCourse(0.0, cpa_m, 30.0, 7.5), -5400, 5400, loudness, seed)
    scans = focalize_station(values, QUEFRENCY, times, table, CONFIG, amplitudes)
    truth = np.interp(scans.time_s, times, distance)
    # The first ten minutes of two branches are the filter's to decide between them.
    two = visible(truth, loudness) >= 2
    two &= np.cumsum(two) > 10
    assert two.sum() > 15
    error = np.abs(scans.range_mode_m - truth)[two]
    assert np.median(error) < 120.0
    assert np.mean(error < 500.0) > 0.93
    on_ghost = [np.abs(scans.range_mode_m[i] - ghosts(truth[i])).min() < 500.0 for i in np.flatnonzero(two)]
    assert np.mean(np.array(on_ghost) & (error > 1000.0)) < 0.05
    inside = np.abs(scans.range_mean_m - truth)[two] < 3 * scans.range_std_m[two]
    assert inside.mean() > 0.93
    assert (scans.existence_llr[two] > 3.0).mean() > 0.93


def test_the_rate_and_the_maps_tell_the_same_story(table):
    times, values, distance = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), -3600, 3600, 1.0, 3)
    scans = focalize_station(values, QUEFRENCY, times, table, CONFIG, AMPLITUDES)
    late = scans.time_s > -1500
    rate = StraightCourse(0.0, 9e3, 30.0, 7.5).observables(scans.time_s)[2]
    assert np.median(np.abs(scans.range_rate_mps - rate)[late]) < 1.0
    step = CONFIG.range_step_m
    np.testing.assert_allclose(np.exp(scans.log_density.astype(float)).sum(axis=1) * step, 1.0, atol=1e-3)
    truth = np.interp(scans.time_s, times, distance)
    at_truth = scans.scan_llr[np.arange(len(truth)), np.rint(truth / step).astype(int)]
    assert np.median((at_truth - np.median(scans.scan_llr, axis=1))[late]) > 3.0


def test_noise_alone_is_no_ship(table):
    times, values, _ = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), 0, 2 * 3600, 0.0, 4)
    for amplitudes in (AMPLITUDES, None):
        scans = focalize_station(values, QUEFRENCY, times, table, CONFIG, amplitudes)
        assert np.mean(scans.existence_llr > 0) < 0.03
        assert np.median(scans.existence_llr) < -1.0


def test_a_gap_widens_the_posterior_and_the_ship_is_found_again(table):
    times, values, distance = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), -2700, 3600, 1.0, 5)
    values[:, (times > 600) & (times < 1200)] = np.nan
    scans = focalize_station(values, QUEFRENCY, times, table, CONFIG, AMPLITUDES)
    gap = (scans.time_s > 700) & (scans.time_s < 1100)
    assert not scans.valid[gap].any() and np.isnan(scans.scan_llr[gap]).all()
    assert (np.diff(scans.range_std_m[gap]) > 0).all()
    truth = np.interp(scans.time_s, times, distance)
    after = scans.time_s > 1500
    assert np.mean(np.abs(scans.range_mode_m - truth)[after] < 500.0) > 0.9


def test_pieces_and_restarts_give_the_scans_of_the_whole(table):
    times, values, _ = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), -1800, 1800, 1.0, 6)
    config = replace(CONFIG, filter=replace(CONFIG.filter, particles=500))
    whole = focalize_station(values, QUEFRENCY, times, table, config, AMPLITUDES)
    live = StationFocalization(table, config, AMPLITUDES)
    parts = []
    for part in np.array_split(np.arange(len(times)), 5):
        parts.append(live.push(values[:, part], QUEFRENCY, times[part]))
        resumed = StationFocalization(table, config, AMPLITUDES)
        resumed.load_state_dict(live.state_dict())
        live = resumed
    parts.append(live.flush())
    for name in ("time_s", "detections", "range_mean_m", "existence_llr", "log_density"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-5, atol=1e-7)
    assert len(parts[1].time_s) > 0


def test_what_is_heard_left_the_ship_earlier(table):
    times, values, _ = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), -1800, 1800, 1.0, 7)
    scans = focalize_station(values, QUEFRENCY, times, table, CONFIG, AMPLITUDES)
    expected = np.hypot(DEPTH, scans.range_mode_m) / SPEED
    np.testing.assert_allclose(scans.travel_time_s, expected, atol=0.01)


def test_amplitudes_come_with_the_depth_of_the_table(table):
    deep = table.assign_attrs(depth_m=DEPTH)
    at = np.array([12e3, 30e3])
    known = StationFocalization(table, CONFIG, AMPLITUDES).model.visibility(at)
    np.testing.assert_allclose(StationFocalization(deep, CONFIG).model.visibility(at), known)
    np.testing.assert_allclose(StationFocalization(table, CONFIG).model.visibility(at), 1.0)


def test_harmonics_that_stay_put_do_not_draw_the_filter_to_a_standing_ghost(table):
    times, values, distance = simulate(StraightCourse(0.0, 9e3, 30.0, 7.5), -3600, 2400, 1.0, 8)
    near = np.abs(times) < 1200
    for line in 0.72 * np.arange(1, 9):
        lag = QUEFRENCY[:, None] - line - 0.002 * np.sin(times[near] / 200.0)
        values[:, near] += 0.05 * np.cos(2 * np.pi * 15.0 * lag) * np.exp(-0.5 * (lag / 0.05) ** 2)

    def share(config):
        scans = focalize_station(values, QUEFRENCY, times, table, config, AMPLITUDES)
        truth = np.interp(scans.time_s, times, distance)
        return np.mean(np.abs(scans.range_mode_m - truth)[scans.time_s > -1200] < 500.0)

    uniform = replace(CONFIG, filter=replace(CONFIG.filter, false_alarm_resolution_s=0.0))
    assert share(CONFIG) > 0.9 > 0.6 > share(uniform)


def test_bad_input_is_refused(table):
    with pytest.raises(ConfigError, match="must look at the same delays"):
        replace(CONFIG, filter=replace(CONFIG.filter, max_tdoa_s=5.0))
    with pytest.raises(ConfigError, match="needs path 9"):
        StationFocalization(table, replace(CONFIG, pairs=("1-3", "3-5", "7-9")))
    station = StationFocalization(table, CONFIG)
    station.step(100.0, np.array([]))
    with pytest.raises(LayoutError, match="5 s before"):
        station.step(95.0, np.array([]))
    station = StationFocalization(table, CONFIG)
    station.push(np.zeros((513, 3)), QUEFRENCY, np.array([0.0, 10.24, 20.48]))
    with pytest.raises(LayoutError, match="must follow those before"):
        station.push(np.zeros((513, 1)), QUEFRENCY, np.array([10.24]))
