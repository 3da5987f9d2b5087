import numpy as np
import pandas as pd
import pytest

from obsnet.arrays.click_map import ClickMapConfig, azimuth_map
from obsnet.detectors.maps import detections
from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import from_posix

ONE_RATE = ClickMapConfig(window_s=60.0, click_rates_hz=(0.5,), clutter_rate_hz=0.1, motion_deg=3.0)


def table(time, azimuth, spread=4.0):
    return pd.DataFrame({"time": time, "azimuth_deg": azimuth, "azimuth_std_deg": np.full(len(time), spread)})


def test_one_click_has_the_ratio_of_poisson_processes():
    maps = azimuth_map(table([100.0], [350.0]), np.array([100.0]), config=ONE_RATE)
    grid = maps["azimuth"].values
    apart = np.minimum(np.abs(grid - 350.0), 360.0 - np.abs(grid - 350.0))
    density = np.exp(-0.5 * (apart / 5.0) ** 2) / (5.0 * np.sqrt(2 * np.pi))
    expected = -0.5 * 60.0 + np.log(1.0 + 5.0 * 360.0 * density)
    np.testing.assert_allclose(maps["azimuth_llr"].values[0], expected, rtol=1e-4, atol=1e-4)
    assert maps["azimuth_llr"].dtype == np.float32


def test_silence_speaks_against_an_animal_and_the_rates_are_averaged():
    config = ClickMapConfig(window_s=10.0, click_rates_hz=(0.1, 1.0))
    maps = azimuth_map(table([], []), np.array([5.0]), config=config)
    np.testing.assert_allclose(
        maps["azimuth_llr"].values, np.log((np.exp(-1.0) + np.exp(-10.0)) / 2.0), rtol=1e-5
    )


def test_another_animals_clicks_do_not_speak_against_one():
    time = np.arange(0.0, 60.0)
    alone = azimuth_map(table(time, np.full(60, 100.0)), np.array([30.0]), config=ONE_RATE)
    both = table(np.repeat(time, 2), np.tile([100.0, 220.0], 60))
    together = azimuth_map(both, np.array([30.0]), config=ONE_RATE)
    at = {"azimuth": 100.0}
    assert float(together["azimuth_llr"].sel(at)[0]) == pytest.approx(
        float(alone["azimuth_llr"].sel(at)[0]), rel=1e-4
    )
    assert float(together["azimuth_llr"].sel(azimuth=220.0)[0]) > 100.0


def test_turning_the_clicks_turns_the_map():
    rng = np.random.default_rng(1)
    time, azimuth = np.sort(rng.uniform(0.0, 300.0, 80)), rng.normal(20.0, 5.0, 80) % 360.0
    windows = np.arange(30.0, 300.0, 60.0)
    before = azimuth_map(table(time, azimuth), windows)["azimuth_llr"].values
    after = azimuth_map(table(time, (azimuth + 77.0) % 360.0), windows)["azimuth_llr"].values
    np.testing.assert_allclose(after, np.roll(before, 77, axis=1), rtol=1e-4, atol=1e-3)


def test_any_tracker_reads_it_like_any_detectors_map():
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 600.0)
    azimuth = (355.0 + time / 60.0 + rng.normal(0.0, 0.5, 600)) % 360.0
    maps = azimuth_map(
        table(from_posix(time), azimuth, 0.5), from_posix(np.arange(30.0, 900.0, 60.0)), span=(0.0, 600.0)
    )
    read = detections(maps)
    assert maps["azimuth_llr"].dims == ("time", "azimuth") and maps["azimuth_coverage"].dims == ("time",)
    heard = read[:10]
    np.testing.assert_allclose(
        (heard.azimuth_deg - 355.5 - np.arange(10) + 180.0) % 360.0 - 180.0, 0.0, atol=0.3
    )
    assert (heard.azimuth_llr > 50.0).all()
    assert (
        np.isnan(maps["azimuth_llr"].values[10:]).all()
        and (maps["azimuth_coverage"].values[10:] == 0.0).all()
    )
    assert read.azimuth_llr[10:].isna().all()


def test_half_a_window_counts_half_the_silence():
    maps = azimuth_map(table([], []), np.array([0.0]), config=ONE_RATE, span=(0.0, 100.0))
    np.testing.assert_allclose(maps["azimuth_llr"].values, -15.0, rtol=1e-6)
    assert float(maps["azimuth_coverage"][0]) == 0.5


def test_clicks_without_a_direction_are_left_out():
    maps = azimuth_map(table([1.0, 2.0], [np.nan, 10.0]), np.array([0.0]), config=ONE_RATE)
    alone = azimuth_map(table([2.0], [10.0]), np.array([0.0]), config=ONE_RATE)
    np.testing.assert_array_equal(maps["azimuth_llr"].values, alone["azimuth_llr"].values)


def test_wrong_input_is_named():
    with pytest.raises(LayoutError, match="lack azimuth_std_deg"):
        azimuth_map(table([1.0], [2.0]).drop(columns="azimuth_std_deg"), np.array([0.0]))
    with pytest.raises(LayoutError, match="azimuth grid"):
        azimuth_map(table([1.0], [2.0]), np.array([0.0]), np.array([[1.0]]))
    with pytest.raises(ConfigError, match="window_s must be positive"):
        ClickMapConfig(window_s=0.0)
    with pytest.raises(ConfigError, match="positive rates"):
        ClickMapConfig(click_rates_hz=())
