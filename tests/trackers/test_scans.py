import numpy as np
import pytest

from obsnet.arrays.arrival import directions
from obsnet.arrays.clicks import ClickRecord
from obsnet.arrays.compact import CompactArray
from obsnet.arrays.echo import EchoRanges
from obsnet.kinematics import wrap180
from obsnet.trackers.association import associate
from obsnet.trackers.observation_models import TdoaModel
from obsnet.trackers.scans import ScanConfig, click_scans, regular_scans

ARRAY = CompactArray.tetrahedron()
PAIRS = ARRAY.pairs()
SPREAD = ARRAY.tdoa_covariance(PAIRS, 3e-6, 1e-6)


def record(rng, time, azimuth, elevation, false=0):
    """Clicks of a recording as `process` gives them, with `false` ones whose TDOAs are anything."""
    tdoa = ARRAY.tdoa(azimuth, elevation, PAIRS) + rng.multivariate_normal(np.zeros(6), SPREAD, len(time))
    reach = ARRAY.travel(PAIRS)
    wild = rng.uniform(-1.0, 1.0, (false, 6)) * reach
    times = np.concatenate([time, rng.uniform(time[0], time[-1], false)])
    order = np.argsort(times)
    tdoa, times = np.vstack([tdoa, wild])[order], times[order]
    nothing = np.full(len(times), np.nan)
    covariance = np.broadcast_to(SPREAD, (len(times), 6, 6))
    return ClickRecord(
        ARRAY,
        PAIRS,
        0.0,
        float(times[-1]),
        np.zeros((0, 2)),
        times,
        tdoa,
        np.ones_like(tdoa),
        covariance,
        nothing,
        directions(tdoa, ARRAY, PAIRS, covariance),
        EchoRanges(nothing, nothing, nothing, nothing, np.full(len(times), -1)),
    )


def test_whole_clicks_of_two_animals_and_false_ones_are_told_apart():
    rng = np.random.default_rng(1)
    time = np.sort(rng.uniform(0.0, 60.0, 110))
    animal = rng.integers(0, 2, len(time))
    azimuth = np.where(animal == 0, 358.0 + 0.1 * time, 6.0 - 0.1 * time) % 360.0
    elevation = np.where(animal == 0, 25.0, 31.0)
    clicks = record(rng, time, azimuth, elevation, false=20)
    found = associate(click_scans(clicks), TdoaModel(ARRAY, PAIRS, SPREAD))
    assert len(found.tracks) == 2
    truth = np.full(len(clicks.time), -1)
    truth[np.searchsorted(clicks.time, time)] = animal
    owner = np.array([o[0] for o in found.owner])
    assert all(len(set(o)) == 1 for o in found.owner)
    first = int(owner[truth == 0][5])
    assert (owner[truth == 0] == first).mean() > 0.97 and (owner[truth == 1] == 1 - first).mean() > 0.97
    assert (owner[truth < 0] == -1).mean() > 0.95
    track = found.tracks[first]
    error = wrap180(track.azimuth_deg - (358.0 + 0.1 * track.time))
    assert np.sqrt(np.mean(error**2)) < 0.2


def test_a_click_without_some_pairs_still_counts():
    rng = np.random.default_rng(2)
    time = np.arange(1.0, 31.0)
    clicks = record(rng, time, np.full(30, 80.0), np.full(30, 40.0))
    clicks.tdoa[10:20, [0, 3, 4]] = np.nan
    found = associate(click_scans(clicks), TdoaModel(ARRAY, PAIRS, SPREAD))
    assert len(found.tracks) == 1 and found.tracks[0].clicked.all() and len(found.tracks[0].time) == 30
    assert len(found.tracks[0].measurements) == 6 * 20 + 3 * 10


def test_surface_echoes_are_not_tracked():
    rng = np.random.default_rng(3)
    clicks = record(rng, np.arange(1.0, 21.0), np.tile([80.0, 80.0], 10), np.tile([40.0, 60.0], 10))
    clicks.echoes.echo_of[1::2] = np.arange(0, 20, 2)
    scans = click_scans(clicks)
    assert [scan.time for scan in scans] == pytest.approx(np.arange(1.0, 21.0, 2.0))
    assert len(associate(scans, TdoaModel(ARRAY, PAIRS, SPREAD)).tracks) == 1


def test_priors_of_a_regular_scan_are_those_of_the_configuration():
    config = ScanConfig(
        clicking=0.8, detection=0.9, clutter=2.0, clutter_range=(-1.0, 3.0), birth_rate_hz=0.01
    )
    first, second = regular_scans([0.0, 5.0], [[0, 1, 1], []], [[0.1, 0.2, 0.3], []], 3, config)
    np.testing.assert_allclose(np.exp(first.log_clutter), 0.5)
    assert np.exp(first.log_click) == pytest.approx(0.8)
    assert np.exp(first.log_miss) == pytest.approx(0.2 + 0.8 * 0.1**3)
    assert np.exp(second.log_birth) == pytest.approx(0.05) and len(second.value) == 0


def test_a_click_that_comes_late_speaks_for_the_silence_before_it():
    rng = np.random.default_rng(4)
    clicks = record(rng, np.array([1.0, 2.0, 12.0]), np.full(3, 80.0), np.full(3, 40.0))
    scans = click_scans(clicks, click_rate_hz=0.5)
    assert [scan.log_miss for scan in scans] == pytest.approx([-0.5, -0.5, -5.0])
    assert scans[2].log_click == pytest.approx(np.log(0.5) - 5.0)
