from dataclasses import replace

import numpy as np
import pytest

from obsnet.calibration.envelope import Branches, fit, locate, stack
from obsnet.calibration.passages import Heard, Passages
from obsnet.ocean.amplitudes import Amplitudes, SkewNormal
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation, tdoa, travel_time
from obsnet.ocean.sound_speed import SoundSpeed
from obsnet.signals.cepstrogram import noise_std

QUEFRENCY = np.arange(513) * 0.02
DEPTH = 4340.0
PAIRS = ("1-3", "3-5", "5-7")
TRUE = Amplitudes(
    {
        "1-3": SkewNormal(800.0, 2.0, 7e3, 7e3),
        "3-5": SkewNormal(1400.0, 3.0, 15e3, 14e3),
        "5-7": SkewNormal(1500.0, 0.0, 38e3, 9e3),
    }
)


@pytest.fixture(scope="module")
def table():
    return propagation(SoundSpeed.constant(1505.0), DEPTH, Bottom(), np.arange(0.0, 80e3, 70.0))


def simulated(table, offset, seed=0, gain=1.0, amplitudes=TRUE, courses=((7000.0, 0.0), (12e3, 70.0))):
    """Simulated cepstra of ships on straight courses (CPA range, course) past a station at `offset`."""
    generator = np.random.default_rng(seed)
    time, east, north, passage = [], [], [], []
    along = np.arange(-50e3, 50e3, 90.0)
    for number, (cpa, course) in enumerate(courses):
        angle = np.deg2rad(course)
        east.append(cpa * np.cos(angle) + along * np.sin(angle))
        north.append(-cpa * np.sin(angle) + along * np.cos(angle))
        time.append(1.37e9 + 1e5 * number + along / 90.0 * 10.24)
        passage.append(np.full(along.size, number))
    time, east, north, passage = (np.concatenate(x) for x in (time, east, north, passage))
    distance = np.hypot(east - offset[0], north - offset[1])
    cepstra = generator.normal(size=(time.size, QUEFRENCY.size)) * noise_std(QUEFRENCY, 1024)
    for pair in amplitudes.pairs:
        lag = QUEFRENCY - np.interp(distance, table["range"], tdoa(table, pair))[:, None]
        wave = np.cos(2 * np.pi * 15.0 * lag + 0.7) * np.exp(-(lag**2) / (2 * 0.05**2))
        cepstra += gain * amplitudes.evaluate(pair, distance)[:, None] * wave
    far = np.full((time.size, 2), 1e9)
    alone, still = np.ones(time.size, bool), np.zeros(time.size)
    heard = Heard(
        time, np.column_stack([east, far]), np.column_stack([north, far]), passage, alone, still, still
    )
    nothing = np.zeros((1, time.size))
    return Passages(
        heard,
        np.array([15.0]),
        nothing,
        None,
        None,
        np.ones(1),
        None,
        QUEFRENCY,
        cepstra.astype(np.float32),
        1024,
    )


def test_the_station_is_where_the_branches_say(table):
    truth = np.array([420.0, -310.0])
    (found,) = locate(Branches(simulated(table, truth), table, PAIRS), Amplitudes.table_ii(), 1000.0, 100.0)
    error = np.array([found.east_m, found.north_m]) - truth
    std = np.array([found.east_std_m, found.north_std_m])
    assert found.significance > 20.0
    assert np.all(np.abs(error) < 60.0)
    assert np.all(np.abs(error) < 4.0 * std)
    assert np.all((std >= 25.0) & (std < 60.0))


def test_errors_of_the_place_are_as_large_as_said(table):
    pulls = []
    for seed in range(5):
        branches = Branches(simulated(table, (0.0, 0.0), seed, gain=0.6), table, PAIRS)
        (found,) = locate(branches, Amplitudes.table_ii(), 600.0, 100.0)
        pulls += [found.east_m / found.east_std_m, found.north_m / found.north_std_m]
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5


@pytest.mark.parametrize(("offset", "gain"), [((0.0, 0.0), 0.0), ((1500.0, 0.0), 1.0)])
def test_noise_and_offsets_beyond_the_search_determine_nothing(table, offset, gain):
    branches = Branches(simulated(table, offset, gain=gain), table, PAIRS)
    assert locate(branches, Amplitudes.table_ii(), 600.0, 100.0) == []


def test_stacked_amplitudes_are_unbiased(table):
    stacked = stack(
        Branches(simulated(table, (0.0, 0.0)), table, PAIRS), (0.0, 0.0), np.arange(0.0, 50e3, 2000.0)
    )
    for pair in PAIRS:
        square, error = stacked["square"].sel(pair=pair), stacked["error"].sel(pair=pair)
        expected = TRUE.evaluate(pair, stacked["range"].values) ** 2
        known = np.isfinite(square.values)
        assert known.sum() > 15
        # Reading between samples 0.02 s apart loses a few per cent of a pulse 0.05 s wide.
        assert np.all(np.abs(square - expected)[known] < (4 * error + 0.12 * expected)[known]), pair


def test_skew_normals_are_fitted_without_a_hand(table):
    branches = Branches(simulated(table, (0.0, 0.0)), table, PAIRS)
    start = Amplitudes.table_ii()
    fitted, heard = fit(stack(branches, (0.0, 0.0), np.arange(0.0, 60e3, 1000.0)), start)
    assert heard == PAIRS
    range_m = np.arange(8e3, 50e3, 500.0)
    for pair in PAIRS:
        truth = TRUE.evaluate(pair, range_m)
        error = np.abs(fitted.evaluate(pair, range_m) - truth).max() / truth.max()
        wrong = np.abs(start.evaluate(pair, range_m) - truth).max() / truth.max()
        assert error < 0.12 < wrong, pair


def test_a_pair_that_is_not_heard_keeps_its_curve(table):
    quiet = Amplitudes({"1-3": TRUE.curves["1-3"]})
    branches = Branches(simulated(table, (0.0, 0.0), amplitudes=quiet), table, PAIRS)
    start = Amplitudes.table_ii()
    fitted, heard = fit(stack(branches, (0.0, 0.0), np.arange(0.0, 60e3, 1000.0)), start)
    assert heard == ("1-3",)
    assert fitted.curves["5-7"] == start.curves["5-7"]


def test_paths_that_the_table_lacks_are_left_out(table):
    branches = Branches(simulated(table, (0.0, 0.0)), table.sel(path=[1, 3, 5]), PAIRS)
    assert branches.pairs == ("1-3", "3-5")


def test_pairs_that_cannot_be_told_apart_are_not_read_any_of_them(table):
    """Echoes of two pairs at one lag are of neither, whichever pair comes first."""
    pairs = ("1-3", "3-5", "5-7", "7-9", "9-11")
    delay = np.stack([tdoa(table, pair).values for pair in pairs])
    apart = np.abs(delay[:, None] - delay[None])
    apart[np.arange(len(pairs)), np.arange(len(pairs))] = np.inf
    close = (apart < 0.15).any(axis=1)
    assert close[0].any() and close[-1].any()
    for order in (slice(None), slice(None, None, -1)):
        branches = Branches(simulated(table, (0.0, 0.0)), table, pairs[order])
        np.testing.assert_array_equal(np.isnan(branches.delay[order]), close | ~(delay >= 0.3))


def test_too_few_frames_say_nothing(table):
    given = simulated(table, (0.0, 0.0))
    given.heard.alone[10:] = False
    assert locate(Branches(given, table, PAIRS), Amplitudes.table_ii(), 600.0, 100.0) == []


def test_an_echo_pairs_sound_that_left_the_ship_half_its_lag_apart(table):
    # Oracle: a click emitted at t_e arrives at t_e + τ_i and t_e + τ_j; a frame is centred between the two.
    given = simulated(table, (0.0, 0.0), courses=((7000.0, 0.0),))
    speed = 9.0
    moving = replace(given.heard, north_mps=np.full(given.heard.time.size, speed))
    branches = Branches(replace(given, heard=moving), table, PAIRS)
    frame = 600
    distance = given.heard.relative_to(0.0, 0.0)[1][frame, 0]
    delays = [np.interp(distance, table["range"], table["delay"].sel(path=k)) for k in (1, 3, 5)]
    loudest = travel_time(table)(distance)
    for pair, (first, second) in enumerate(((0, 1), (1, 2))):
        moved = branches.north_m[pair, frame] - given.heard.north_m[frame, 0]
        assert moved == pytest.approx(speed * (loudest - (delays[first] + delays[second]) / 2), abs=1e-6)


def test_one_course_leaves_the_mirror_image_open(table):
    given = simulated(table, (2000.0, 0.0), courses=((0.0, 0.0),))
    found = locate(Branches(given, table, PAIRS), Amplitudes.table_ii(), 2500.0, 250.0)
    assert sorted(np.sign(place.east_m) for place in found) == [-1.0, 1.0]
    for place in found:
        assert abs(place.east_m) == pytest.approx(2000.0, abs=4 * place.east_std_m)
