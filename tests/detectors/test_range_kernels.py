"""The kernels against what their docstrings say, written down loop by loop in double precision."""

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import RegularGridInterpolator

from obsnet.detectors import range_kernels as kernels
from obsnet.detectors.range_features import CONTEXT, RangeFeatures, RangeFeaturesConfig
from obsnet.layout import from_posix
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation
from obsnet.ocean.sound_speed import SoundSpeed

START = 1_369_130_400.0
CONFIG = RangeFeaturesConfig(max_range_m=21_000.0, range_rate_step_mps=3.0)
RATES, RANGES = CONFIG.range_rate, CONFIG.range_m


@pytest.fixture(scope="module")
def front():
    table = propagation(SoundSpeed.constant(1500.0), 2500.0, Bottom(), np.arange(0.0, 30e3, 70.0))
    return RangeFeatures(table, CONFIG)


@pytest.fixture(scope="module")
def look(front):
    """Five minutes with a gap that takes part of one window and all of another, and one beyond the record."""
    values = np.random.default_rng(1).standard_normal((513, 70)).astype("f4")
    values[:, 20:42] = np.nan
    times = START + 10.24 * np.arange(70)
    coords = {"quefrency": np.arange(513) * 0.02, "time": from_posix(times)}
    cepstra = xr.DataArray(values, dims=("quefrency", "time"), coords=coords, attrs={"nfft": 1024})
    return front.look(cepstra, START + np.array([60.0, 120.0, 315.0, 600.0, 3600.0]))


def frames_of(look, minute):
    """Valid frames of a window and how much later than its minute they are."""
    rows = [t for t in range(look.start[minute], look.stop[minute]) if look.valid[t]]
    return [(t, look.frame_time[t] - look.minutes[minute]) for t in rows]


def columns(table, range_m):
    """Quefrency index of every pair at a range."""
    return table.index[table.pad + int(np.rint(range_m / 10.0))]


def test_energy_is_that_of_the_coherent_stack(front, look):
    assert look.energy.shape == (5, 5, len(RATES), len(RANGES))
    for w, k, i in np.random.default_rng(0).integers(0, (5, len(RATES), len(RANGES)), (300, 3)):
        total, frames = np.zeros(5, complex), frames_of(look, w)
        for t, later in frames:
            shift = 10.0 * np.rint(RATES[k] * later / 10.0)
            total += look.analytic[t, columns(front.table, RANGES[i] + shift)]
        expected = np.abs(total) ** 2 / max(len(frames), 1)
        np.testing.assert_allclose(look.energy[w, :, k, i], expected, rtol=1e-4, atol=1e-5)
    assert not look.energy[2].any()
    assert not look.energy[4].any()


def test_cheap_score_is_a_sum_of_hinges(look):
    hinges = 0.8 * (np.minimum(look.energy.astype(float), 60.0) - 1.8)
    np.testing.assert_allclose(look.score, np.maximum(hinges, 0.0).sum(axis=1), rtol=1e-5, atol=1e-5)
    loud = np.full((1, 2, 3, 4), 1e6, np.float32)
    np.testing.assert_allclose(kernels.cheap_score(loud), 2 * 0.8 * 58.2, rtol=1e-6)


def test_features_are_those_described(front, look):
    """Any hypotheses, on the grid and off it, of minutes in any order."""
    generator = np.random.default_rng(2)
    index = generator.integers(0, 5, 200)
    range_m = np.where(index % 2, generator.uniform(0, 21e3, 200), generator.choice(RANGES, 200))
    rate = np.where(index % 2, generator.uniform(-12, 12, 200), generator.choice(RATES, 200))
    found = front.features(look, index, range_m, rate)
    assert found.dtype == np.float32
    for row in range(200):
        expected = described(front, look, index[row], range_m[row], rate[row])
        np.testing.assert_allclose(found[row], expected, rtol=2e-5, atol=2e-5)
    ghosts = found[:, 270:305].reshape(-1, 5, len(CONTEXT))[..., CONTEXT.index("ghost")]
    assert 0.2 < (ghosts > 0).mean() < 0.95


def described(front, look, w, range_m, rate):
    table, frames = front.table, frames_of(look, w)
    centre = table.pad + int(np.rint(range_m / 10.0))
    none = look.analytic.shape[1] - 1
    sub = [min(max(int(np.floor(later / 60.0 + 1.5)), 0), 2) for _, later in frames]
    count = np.bincount(np.array(sub, int), minlength=3)
    patches, contexts = [], []
    for p in range(5):
        sums = np.zeros((3, 9), complex)
        for (t, later), s in zip(frames, sub, strict=True):
            j = columns(table, range_m + rate * later)[p]
            if j != none:
                sums[s] += look.analytic[t, j + 8 * np.arange(-4, 5)]
        energy = np.abs(sums[:, 4].sum()) ** 2 / max(count.sum(), 1)
        slope, there = table.slope[centre, p], table.index[centre, p] != none
        said = (1.0, np.log1p(energy), np.log1p(ghost(front, look, w, p, centre, rate)), 1e4 * slope,
                np.log(table.seconds[centre, p]), abs(1e3 * slope * rate), table.strength[centre, p])  # fmt: skip
        turned = sums * table.phase[centre, p] / np.sqrt(np.maximum(count, 1))[:, None]
        patches.append(there * np.stack([turned.real, turned.imag], axis=-1).ravel())
        contexts.append(there * np.array(said))
    return np.concatenate([*patches, *contexts, [range_m / table.depth_m], look.once[w]])


def ghost(front, look, w, p, centre, rate):
    """Largest cheap score, q's own share left out, about the hypothesis at which a pair q has pair p's delay and drift."""
    table, best = front.table, 0.0
    for q in range(5):
        i = table.inverse[q, table.index[centre, p]]
        if q == p or i < 0:
            continue
        slope = table.slope[table.pad + i * 14, q]
        k = int(np.rint((rate * table.slope[centre, p] / slope - RATES[0]) / 3.0)) if slope else -1
        if not 0 <= k < len(RATES):
            continue
        near = np.s_[max(k - 1, 0) : k + 2, max(i - 1, 0) : i + 2]
        own = 0.8 * np.maximum(np.minimum(look.energy[w, q][near], 60.0) - 1.8, 0.0)
        best = max(best, float((look.score[w][near] - own).max()))
    return best


def test_choice_goes_from_peak_to_peak():
    score = np.random.default_rng(3).standard_normal((20, 9, 40)).astype(np.float32) - 1.0
    chosen = kernels.choose(score, 4, 2, 5)
    for window, found in zip(score, chosen, strict=True):
        left, expected = window.copy(), np.zeros(window.shape, bool)
        for _ in range(4):
            rate, place = np.unravel_index(left.argmax(), left.shape)
            if left[rate, place] > 0:
                first = min(max(rate - 2, 0), 4)
                expected[first : first + 5, max(place - 2, 0) : place + 3] = True
                left[:, max(place - 2, 0) : place + 3] = -1.0
        np.testing.assert_array_equal(found, expected)


def test_rates_beside_those_looked_at_fall_with_the_cheap_score():
    generator = np.random.default_rng(4)
    cheap = generator.uniform(0, 9, (3, 9, 6)).astype(np.float32)
    said = np.full_like(cheap, np.nan)
    said[:, 2:7, 1], said[1, 0:5, 4] = generator.standard_normal((3, 5)), generator.standard_normal(5)
    filled = said.copy()
    kernels.carry_on(filled, cheap, 0.3)
    for w, k, i in np.ndindex(said.shape):
        looked = np.flatnonzero(~np.isnan(said[w, :, i]))
        if not looked.size:
            assert np.isnan(filled[w, k, i])
            continue
        edge = min(max(k, looked[0]), looked[-1])
        fall = max(cheap[w, edge, i] - cheap[w, k, i], 0.0)
        assert filled[w, k, i] == pytest.approx(said[w, edge, i] - 0.3 * fall, abs=1e-5)


def test_resampling_is_bilinear():
    generator = np.random.default_rng(5)
    coarse = generator.standard_normal((2, 5, 8)).astype(np.float32)
    below = [generator.integers(0, n - 1, m) for n, m in ((8, 30), (5, 11))]
    weight = [generator.uniform(0, 1, m).astype(np.float32) for m in (30, 11)]
    fine = kernels.resample(coarse, below[0], weight[0], below[1], weight[1])
    assert fine.dtype == np.float32
    places = np.meshgrid(below[1] + weight[1], below[0] + weight[0])
    for window, found in zip(coarse, fine, strict=True):
        expected = RegularGridInterpolator((np.arange(5), np.arange(8)), window)(tuple(places))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("reach", [(4, 4), (2, 1), (0, 3)])
def test_shares_are_those_of_the_means_within_reach(reach):
    """Also beside a peak, and where what is summed differs by a factor of e⁷⁰; the ratio of presence stays."""
    generator = np.random.default_rng(6)
    llr = generator.uniform(-9, 15, (2, 25, 14)).astype(np.float32)
    shape = generator.uniform(-200, 300, (2, 25, 14)).astype(np.float32)
    expected = llr.astype(float)
    for w, i, k in np.ndindex(llr.shape):
        near = np.s_[w, max(i - reach[0], 0) : i + reach[0] + 1, max(k - reach[1], 0) : k + reach[1] + 1]
        mean, fine = (np.log(np.mean(np.exp(a[near].astype(float)))) for a in (llr, 0.15 * shape))
        expected[w, i, k] = mean + 0.15 * shape[w, i, k] - fine
    prior = np.arange(25.0)
    before, after = (np.log(np.einsum("i,wik->w", prior, np.exp(a))) for a in (llr.astype(float), expected))
    expected += (before - after)[:, None, None]
    kernels.share_out(llr, shape, 0.15, *reach, prior)
    np.testing.assert_allclose(llr, expected, rtol=1e-5, atol=3e-5)
