import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from obsnet.arrays.compact import CompactArray
from obsnet.errors import ConfigError, FilterError, LayoutError
from obsnet.kinematics import wrap180
from obsnet.trackers.association import AssociationConfig, associate
from obsnet.trackers.kalman import constant_velocity, predict, update
from obsnet.trackers.observation_models import AzimuthModel, TdoaModel
from obsnet.trackers.scans import ScanConfig, azimuth_scans, regular_scans
from obsnet.trackers.track_tree import fold

ARRAY = CompactArray.tetrahedron()
PAIRS = ARRAY.pairs(every=False)
STD_S = 3e-6
MODEL = TdoaModel(ARRAY, PAIRS, np.eye(3) * STD_S**2)
FOREVER = AssociationConfig(particles=50, lifetime_s=1e12, min_clicks=1)


@dataclass(frozen=True)
class Line:
    """A position on a line, measured directly: the linear case, whose filter is Kalman's."""

    std: float = 0.5
    channels: int = 1
    dimensions: int = 1
    width: float = 40.0

    @property
    def noise(self):
        return np.eye(self.channels) * self.std**2

    def dynamics(self, interval_s, mean):
        return constant_velocity(interval_s, 1, np.full((*mean.shape[:-1], 1), 0.1))

    def observe(self, mean):
        slopes = np.tile([[1.0, 0.0]], (self.channels, 1))
        return mean @ slopes.T, np.broadcast_to(slopes, (*mean.shape[:-1], self.channels, 2))

    def innovation(self, value, predicted):
        return value - predicted

    def feasible(self, channel, value):
        return np.isfinite(value)

    def born(self, value, noise):
        mean = np.concatenate([value, np.zeros_like(value)], axis=1)
        spread = np.broadcast_to(np.diag([noise[0, 0], 1.0]), (len(value), 2, 2)).copy()
        return mean, spread, np.full(len(value), -np.log(self.width))


def line_scans(times, values, clutter=0.5, clicking=0.9, birth=0.0):
    config = ScanConfig(clicking, 0.98, clutter, (-20.0, 20.0), birth)
    return regular_scans(times, [np.zeros(len(v), int) for v in values], values, 1, config)


def kalman(model, times, values, mean, covariance):
    """Plain (extended) Kalman filter, one complete measurement a time."""
    means = []
    for k, value in enumerate(values):
        transition, drift = model.dynamics(times[k] - times[max(k - 1, 0)], mean)
        mean, covariance = predict(mean, covariance, transition, drift)
        predicted, jacobian = model.observe(mean)
        mean, covariance, _ = update(
            mean, covariance, model.innovation(value, predicted), jacobian, model.noise
        )
        means.append(mean)
    return np.array(means), covariance


def test_one_hypothesis_is_kalmans_filter_in_the_linear_case():
    rng = np.random.default_rng(1)
    times, values = np.arange(30.0), np.cumsum(rng.normal(0.0, 0.3, 30))
    start = (np.zeros(2), np.eye(2) * 4.0)
    found = associate(line_scans(times, values[:, None], clutter=0.0), Line(), FOREVER, initial=[start])
    means, covariance = kalman(Line(), times, values[:, None], *start)
    np.testing.assert_allclose(found.tracks[0].filtered, means, atol=1e-9)
    np.testing.assert_allclose(found.tracks[0].filtered_covariance[-1], covariance, atol=1e-9)


def test_one_hypothesis_is_the_extended_kalman_filter():
    rng = np.random.default_rng(2)
    times = np.cumsum(rng.uniform(0.5, 1.5, 40))
    azimuth, elevation = 350.0 + 0.5 * times, 20.0 + 0.2 * times
    values = ARRAY.tdoa(azimuth, elevation, PAIRS) + rng.normal(0.0, STD_S, (40, 3))
    start = (np.array([349.0, 21.0, 0.0, 0.0]), np.diag([4.0, 4.0, 1.0, 1.0]))
    scans = regular_scans(times, [np.arange(3)] * 40, values, 3, ScanConfig(clutter=0.0))
    found = associate(scans, MODEL, FOREVER, initial=[start])
    means, _ = kalman(MODEL, times, values, *start)
    np.testing.assert_allclose(found.tracks[0].filtered, means, atol=1e-8)
    assert len(found.tracks) == 1 and all((owner == 0).all() for owner in found.owner)


def enumerate_associations(
    model, times, channels, values, start, clutter, clicking, detection=0.98, width=40.0
):
    """Every history of one animal among clutter: log evidence over all-clutter, and the best history."""
    lists = [[(-1, *np.flatnonzero(channel == c)) for c in range(model.channels)] for channel in channels]
    histories = []
    for choice in itertools.product(*(itertools.product(*options) for options in lists)):
        mean, covariance = start
        total = 0.0
        for k, picks in enumerate(choice):
            transition, drift = model.dynamics(times[k] - times[max(k - 1, 0)], mean)
            mean, covariance = predict(mean, covariance, transition, drift)
            taken = [m for m in picks if m >= 0]
            if not taken:
                total += np.log(1.0 - clicking + clicking * (1.0 - detection) ** model.channels)
                continue
            innovation = np.array([values[k][m] - mean[0] if m >= 0 else np.nan for m in picks])
            mean, covariance, gain = update(mean, covariance, innovation, model.observe(mean)[1], model.noise)
            total += float(gain) + np.log(clicking) + len(taken) * np.log(detection / (clutter / width))
            total += (model.channels - len(taken)) * np.log(1.0 - detection)
        histories.append((total, choice))
    totals = np.array([total for total, _ in histories])
    best = max(histories, key=lambda history: history[0])[1]
    return totals.max() + np.log(np.exp(totals - totals.max()).sum()), [
        sorted(m for m in p if m >= 0) for p in best
    ]


@pytest.mark.parametrize(("count", "clutter"), [(1, (2, 1, 2, 3, 1)), (2, (1, 0, 2, 1))])
def test_the_evidence_is_that_of_all_histories_enumerated(count, clutter):
    rng = np.random.default_rng(3)
    model, times = Line(channels=count), np.arange(float(len(clutter)))
    values = [np.append(rng.uniform(-4.0, 4.0, n), rng.normal(0.0, 0.7)) for n in clutter]
    channels = [rng.integers(0, count, len(value)) for value in values]
    start = (np.zeros(2), np.eye(2))
    priors = ScanConfig(0.9, 0.7, 0.5, (-20.0, 20.0), 0.0)
    config = replace(FOREVER, particles=6000, gate_std=20.0, resample_below=0.0)
    scans = regular_scans(times, channels, values, count, priors)
    found = associate(scans, model, config, seed=4, initial=[start])
    exact, best = enumerate_associations(model, times, channels, values, start, 0.5, 0.9, 0.7)
    assert found.log_evidence == pytest.approx(exact, abs=0.05)
    taken = [np.flatnonzero(owner == 0).tolist() for owner in found.owner]
    last = max(k for k, picks in enumerate(best) if picks)
    assert taken[: last + 1] == best[: last + 1]


def test_evidence_does_not_depend_on_the_order_of_two_animals_that_compete():
    times = np.arange(4.0)
    rng = np.random.default_rng(5)
    values = [rng.normal(0.0, 0.6, 2) for _ in times]
    first, second = (np.array([-0.3, 0.0]), np.eye(2) * 0.3), (np.array([0.4, 0.0]), np.eye(2) * 0.3)
    config = replace(FOREVER, particles=4000, resample_below=0.0)
    one, other = (
        associate(line_scans(times, values), Line(), config, seed=6, initial=order).log_evidence
        for order in ([first, second], [second, first])
    )
    assert one == pytest.approx(other, abs=0.05)


def test_evidence_of_a_new_animal_is_the_integral_over_the_sphere():
    value = ARRAY.tdoa(200.0, 35.0, PAIRS) + np.array([2e-6, -1e-6, 3e-6])
    mean, spread, evidence = MODEL.born(value[None], MODEL.noise)
    azimuth, elevation = np.meshgrid(
        np.linspace(196.0, 204.0, 801), np.linspace(31.0, 39.0, 801), indexing="ij"
    )
    misfit = ((value - ARRAY.tdoa(azimuth, elevation, PAIRS)) ** 2).sum(axis=-1) / STD_S**2
    density = np.exp(-0.5 * misfit) / (2 * np.pi * STD_S**2) ** 1.5
    cell = np.deg2rad(0.01) ** 2 * np.cos(np.deg2rad(elevation)) / (4 * np.pi)
    assert evidence[0] == pytest.approx(np.log((density * cell).sum()), abs=0.01)
    weight = density * cell / (density * cell).sum()
    assert mean[0, 0] == pytest.approx((weight * azimuth).sum(), abs=0.02)
    assert spread[0, 0, 0] == pytest.approx((weight * (azimuth - mean[0, 0]) ** 2).sum(), rel=0.02)


def test_tdoas_that_no_direction_explains_bring_no_animal():
    _, _, evidence = MODEL.born(np.array([[6e-4, -6e-4, 6e-4]]), MODEL.noise)
    assert evidence[0] == -np.inf


def test_no_history_left_is_an_error():
    start = (np.zeros(2), np.eye(2))
    values = [np.array([0.0]), np.array([0.1]), np.array([15.0])]
    with pytest.raises(FilterError, match="association history weights are zero"):
        associate(line_scans(np.arange(3.0), values, clutter=0.0), Line(), FOREVER, initial=[start])
    found = associate(line_scans(np.arange(3.0), values, clutter=0.01), Line(), FOREVER, initial=[start])
    assert [owner.tolist() for owner in found.owner] == [[0], [0], [-1]]


def scene(rng, paths, times, clutter=1.0, present=None):
    """TDOAs of animals and clutter in random order: scans, and the animal of each measurement."""
    channels, values, animals = [], [], []
    for k in range(len(times)):
        who = [i for i in range(len(paths)) if present is None or present[i][k]]
        own = [ARRAY.tdoa(paths[i][0][k], paths[i][1][k], PAIRS) + rng.normal(0.0, STD_S, 3) for i in who]
        noise = np.repeat(np.arange(3), rng.poisson(clutter, 3))
        channel = np.concatenate([*(np.arange(3) for _ in who), noise]).astype(int)
        value = np.concatenate([*own, rng.uniform(-1.5e-3, 1.5e-3, len(noise))])
        animal = np.concatenate([*(np.full(3, i) for i in who), np.full(len(noise), -1)]).astype(int)
        order = rng.permutation(len(value))
        channels.append(channel[order])
        values.append(value[order])
        animals.append(animal[order])
    return regular_scans(times, channels, values, 3), animals


def test_an_animal_is_told_from_clutter_across_north():
    rng = np.random.default_rng(7)
    times = np.arange(1.0, 81.0)
    azimuth, elevation = (352.0 + 0.2 * times) % 360.0, 30.0 + 0.05 * times
    scans, animals = scene(rng, [(azimuth, elevation)], times)
    found = associate(scans, MODEL)
    assert len(found.tracks) == 1
    track = found.tracks[0]
    here = np.searchsorted(times, track.time)
    turn = wrap180(track.azimuth_deg - azimuth[here])
    assert (
        np.sqrt(np.mean(turn**2)) < 0.15
        and np.sqrt(np.mean((track.elevation_deg - elevation[here]) ** 2)) < 0.15
    )
    assert ((track.azimuth_deg >= 0.0) & (track.azimuth_deg < 360.0)).all()
    owner, animal = np.concatenate(found.owner), np.concatenate(animals)
    assert (owner[animal == 0] == 0).mean() > 0.97 and (owner[animal < 0] < 0).mean() > 0.98
    later = track.filtered_covariance[:, 0, 0] - track.smoothed_covariance[:, 0, 0]
    assert (later[:-1] > 0).all() and later[-1] == pytest.approx(0.0, abs=1e-12)
    inside = np.abs(turn) < 2.0 * np.sqrt(track.smoothed_covariance[:, 0, 0])
    assert inside.mean() > 0.8


def test_animals_come_and_go_and_keep_their_tracks_where_they_cross():
    rng = np.random.default_rng(8)
    times = np.arange(1.0, 101.0)
    paths = [(100.0 + 0.3 * times, np.full(100, 30.0)), (130.0 - 0.3 * times, np.full(100, 33.0))]
    present = [times <= 70.0, times >= 30.0]
    scans, _ = scene(rng, paths, times, present=present)
    found = associate(scans, MODEL)
    assert len(found.tracks) == 2
    first, second = found.tracks
    assert first.time[0] <= 3.0 and 68.0 <= first.time[-1] <= 73.0
    assert 30.0 <= second.time[0] <= 33.0 and second.time[-1] >= 98.0
    for track, (azimuth, _) in zip(found.tracks, paths, strict=True):
        inside = (track.time <= 70.0) if track is first else (track.time >= 30.0)
        error = wrap180(track.azimuth_deg - azimuth[np.searchsorted(times, track.time)])[inside]
        assert np.sqrt(np.mean(error**2)) < 0.2
    number = np.interp([15.0, 50.0, 95.0], times, found.animals)
    np.testing.assert_allclose(number, [1.0, 2.0, 1.0], atol=0.1)


def test_clutter_alone_is_no_animal():
    scans, _ = scene(np.random.default_rng(9), [], np.arange(1.0, 121.0))
    found = associate(scans, MODEL)
    assert found.tracks == [] and found.animals.max() < 0.9 and found.animals.mean() < 0.1
    assert all((owner == -1).all() for owner in found.owner)


def test_the_same_seed_gives_the_same_tracks():
    scans, _ = scene(np.random.default_rng(10), [(np.full(20, 40.0), np.full(20, 10.0))], np.arange(20.0))
    one, other = (associate(scans, MODEL, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.tracks[0].smoothed, other.tracks[0].smoothed)
    assert one.log_evidence == other.log_evidence


def test_a_silent_animal_is_given_up():
    times = np.arange(40.0)
    values = [np.array([0.0]) if k < 10 else np.empty(0) for k in range(40)]
    scans = line_scans(times, values, clutter=0.0, clicking=0.6)
    config = replace(FOREVER, lifetime_s=100.0)
    found = associate(scans, Line(), config, initial=[(np.zeros(2), np.eye(2))])
    assert found.animals[9] > 0.99 and found.animals[-1] < 0.01
    assert found.tracks[0].time[-1] == 9.0
    mortal = np.exp(-1.0 / 100.0)
    chance = mortal * (1 - 0.6 * 0.98) / (1 - mortal + mortal * (1 - 0.6 * 0.98))
    assert found.animals[10] == pytest.approx(chance, rel=1e-6)


def test_azimuths_of_any_detector_can_be_tracked():
    rng = np.random.default_rng(11)
    times = np.arange(0.0, 90 * 60.0, 60.0)
    azimuth = (340.0 + times / 150.0) % 360.0
    seen = (azimuth + rng.normal(0.0, 3.0, len(times))) % 360.0
    seen[rng.random(len(times)) < 0.15] = np.nan
    wrong = rng.random(len(times)) < 0.08
    seen[wrong] = rng.uniform(0.0, 360.0, wrong.sum())
    found = associate(azimuth_scans(times, seen), AzimuthModel(azimuth_std_deg=3.0))
    assert len(found.tracks) == 1
    track = found.tracks[0]
    error = wrap180(track.azimuth_deg - azimuth[np.searchsorted(times, track.time)])
    assert len(track.time) > 80 and np.sqrt(np.mean(error**2)) < 1.8
    assert np.isnan(track.elevation_deg).all()


def test_a_track_across_the_zenith_has_one_direction_everywhere():
    azimuth, elevation = fold(np.array([[10.0, 80.0, 0, 0], [10.0, 100.0, 0, 0], [-350.0, -100.0, 0, 0]]))
    np.testing.assert_allclose(azimuth, [10.0, 190.0, 190.0])
    np.testing.assert_allclose(elevation, [80.0, 80.0, -80.0])
    states = np.array([[10.0, 100.0, 0, 0], [190.0, 80.0, 0, 0]])
    np.testing.assert_allclose(*MODEL.observe(states)[0], atol=1e-15)


def test_wrong_input_is_named():
    scans = line_scans(np.arange(2.0), [np.array([0.0])] * 2)
    with pytest.raises(LayoutError, match="order of time"):
        associate(scans[::-1], Line(), FOREVER)
    with pytest.raises(LayoutError, match="channels 0 to 1, the model 0 to 0"):
        associate(
            [replace(scans[0], channel=np.array([0, 1]), value=np.zeros(2), log_clutter=np.zeros(2))], Line()
        )
    with pytest.raises(LayoutError, match=r"initial animal needs a mean \(2,\)"):
        associate(scans, Line(), FOREVER, initial=[(np.zeros(4), np.eye(4))])
    with pytest.raises(LayoutError, match="each at its own"):
        regular_scans([0.0, 0.0], [[0], [0]], [[1.0], [2.0]], 1)
    with pytest.raises(LayoutError, match="one finite value a channel"):
        regular_scans([0.0], [[0]], [[np.nan]], 1)
    with pytest.raises(LayoutError, match="one entry a scan"):
        regular_scans([0.0], [[0], [0]], [[1.0]], 1)
    with pytest.raises(ConfigError, match="clutter_range must be"):
        ScanConfig(clutter_range=(1.0, -1.0))
    with pytest.raises(ConfigError, match="must lie in"):
        ScanConfig(clicking=1.0)
    with pytest.raises(ConfigError, match="particles must be a whole number"):
        AssociationConfig(particles=0)
    with pytest.raises(ConfigError, match="turn_std and rate_std_dps must be positive"):
        TdoaModel(ARRAY, PAIRS, np.eye(3), turn_std=0.0)
    with pytest.raises(LayoutError, match="matrix over 3 pairs"):
        TdoaModel(ARRAY, PAIRS, np.eye(2))
    assert associate([], MODEL).tracks == []
