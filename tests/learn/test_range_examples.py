import numpy as np
import pandas as pd
import pytest
import xarray as xr

from obsnet.errors import ConfigError
from obsnet.layout import from_posix
from obsnet.learn.oceans import draw_ocean
from obsnet.learn.range_examples import (
    FIELDS,
    RangeExamplesConfig,
    log_prior,
    mistaken,
    range_density,
    range_examples,
)
from obsnet.ocean.bottom import Bottom
from obsnet.ocean.rays import propagation
from obsnet.ocean.sound_speed import SoundSpeed
from obsnet.signals.cepstrogram import noise_std

START = 1_369_130_400.0
QUEFRENCY = np.arange(513) * 0.02
CONFIG = RangeExamplesConfig(hypotheses=200, every=2, least_empty=3)


@pytest.fixture(scope="module")
def ocean():
    return draw_ocean(np.random.default_rng(3), 4000.0)


@pytest.fixture(scope="module")
def noise():
    times = START + 10.24 * np.arange(180)
    values = np.random.default_rng(2).standard_normal((513, 180)) * noise_std(QUEFRENCY, 1024)[:, None]
    coords = {"quefrency": QUEFRENCY, "time": from_posix(times)}
    return xr.DataArray(values.astype("f4"), dims=("quefrency", "time"), coords=coords, attrs={"nfft": 1024})


def truth(*ships, minutes=range(30), uncertainty=None):
    rows = [(START + 60.0 * k, i, r + 60.0 * k * v, v) for i, (r, v) in enumerate(ships) for k in minutes]
    frame = pd.DataFrame(rows, columns=["time", "mmsi", "range_m", "range_rate_mps"])
    frame["time"] = from_posix(frame["time"].to_numpy())
    return frame if uncertainty is None else frame.assign(uncertainty_m=uncertainty)


def draw(noise, ocean, ships, **options):
    return range_examples(noise, ocean.believed, ships, np.random.default_rng(0), CONFIG, **options)


def test_examples_hold_every_field(noise, ocean):
    made = draw(noise, ocean, truth((10e3, 8.0)))
    assert set(made) == set(FIELDS)
    count = len(made["ship"])
    assert made["ship"].sum() >= 10
    assert made["features"].shape[:2] == (count, 201)
    assert made["features"].dtype == np.float16
    assert np.isfinite(made["features"]).all()
    ship = made["ship"]
    elapsed = made["time"][ship] - START
    np.testing.assert_allclose(made["range_m"][ship, 0], 10e3 + 8.0 * elapsed, rtol=1e-6)


def test_importance_weights_restore_the_prior(noise, ocean):
    made = draw(noise, ocean, truth((10e3, 8.0)))
    edges = np.array([0.0, 25e3, 50.2e3])
    density = np.array([0.2, 0.8]) / 25e3
    prior = np.exp(log_prior(made["range_m"][:, 1:], edges, density, 140.0, 13) - made["log_proposal"])
    assert prior.sum(axis=1).mean() == pytest.approx(1.0, abs=0.1)
    near = np.where(made["range_m"][:, 1:] < 25e3, prior, 0.0)
    assert near.sum(axis=1).mean() == pytest.approx(0.2, abs=0.04)


def test_records_without_a_ship_give_examples_without_one(noise, ocean):
    made = draw(noise, ocean, truth())
    assert len(made["ship"]) == 3 * CONFIG.beliefs
    assert not made["ship"].any()
    assert not made["features"][:, 0].any()


def test_another_ship_is_masked_and_both_are_true(noise, ocean):
    made = draw(noise, ocean, truth((10e3, 0.0), (30e3, 0.0)))
    first = made["range_m"][:, 0]
    assert {10e3, 30e3} == set(np.unique(first).tolist())
    other = np.where(first == 10e3, 30e3, 10e3)
    close = np.abs(made["range_m"][:, 1:] - other[:, None]) < 700.0
    assert np.isinf(made["log_proposal"][close]).all()
    assert np.isfinite(made["log_proposal"][np.abs(made["range_m"][:, 1:] - other[:, None]) > 2e3]).all()


def test_a_ship_of_unknown_place_is_masked_and_never_true(noise, ocean):
    made = draw(noise, ocean, truth((20e3, 0.0), uncertainty=5e3))
    assert not made["ship"].any()
    inside = np.abs(made["range_m"][:, 1:] - 20e3) < 5e3
    assert np.isinf(made["log_proposal"][inside]).all()


def test_unknown_minutes_are_left_out(noise, ocean):
    known = START + 60.0 * np.arange(10)
    made = draw(noise, ocean, truth((10e3, 8.0)), known=known)
    assert len(made["time"])
    assert made["time"].max() <= known[-1]


def test_a_ship_beyond_the_grid_is_no_ship(noise, ocean):
    assert not draw(noise, ocean, truth((70e3, 1.0)))["ship"].any()


def test_a_record_of_gaps_gives_no_examples(noise, ocean):
    gone = noise.copy()
    gone.values[:] = np.nan
    made = draw(gone, ocean, truth((10e3, 8.0)))
    assert set(made) == set(FIELDS)
    assert len(made["ship"]) == 0


def test_density_of_ranges_is_one_and_never_zero():
    edges = np.arange(0.0, 51e3, 2.5e3)
    density = range_density(np.array([1e3, 9e3, 9.1e3, 30e3]), edges)
    assert (density * np.diff(edges)).sum() == pytest.approx(1.0)
    assert (density > 0).all()


def test_bad_shares_are_refused():
    with pytest.raises(ConfigError, match="sum to one"):
        RangeExamplesConfig(shares=(0.5, 0.5, 0.5, 0.5))


def test_oceans_are_believed_with_errors_but_not_absurd_ones():
    for seed in range(5):
        ocean = draw_ocean(np.random.default_rng(seed))
        error = (ocean.believed["delay"] - ocean.truth["delay"]).diff("path")
        at = np.abs(error.sel(range=7000.0)).max("path")
        assert 1e-4 < float(at) < 0.12
        assert not 2700.0 < ocean.depth_m < 3100.0


def test_a_mistaken_table_is_that_of_another_depth_and_speed():
    ranges = np.arange(0.0, 40e3, 70.0)
    table = propagation(SoundSpeed.constant(1500.0), 4000.0, Bottom(), ranges)

    class Fixed:
        values = iter((2.0, -1.0))

        def standard_normal(self):
            return next(self.values)

    config = RangeExamplesConfig(scale_error=0.005, speed_error=0.002)
    wrong = mistaken(table, Fixed(), config)
    other = propagation(SoundSpeed.constant(1500.0 * 0.998), 4040.0, Bottom(), wrong["range"].values)
    np.testing.assert_allclose(wrong["delay"], other["delay"], atol=2e-5)
    np.testing.assert_allclose(wrong["slowness"], other["slowness"], atol=2e-8)
