import json

import numpy as np
import pytest
from scipy.stats import skewnorm

from obsnet.errors import ConfigError
from obsnet.ocean.amplitudes import Amplitudes, SkewNormal

RANGES = np.arange(0.0, 80e3, 70.0)


def test_table_ii_is_a_skew_normal_density_per_metre():
    amplitudes = Amplitudes.table_ii()
    np.testing.assert_allclose(
        amplitudes.evaluate("3-5", RANGES),
        1.6e3 * skewnorm.pdf(RANGES, 6.0, 14e3, 20e3),
        rtol=1e-9,
        atol=1e-15,
    )


def test_table_ii_peaks_one_pair_after_the_other():
    amplitudes = Amplitudes.table_ii()
    peaks = {pair: amplitudes.evaluate(pair, RANGES) for pair in amplitudes.pairs}
    assert amplitudes.pairs == ("1-3", "3-5", "5-7")
    assert 0.05 < peaks["1-3"].max() < 0.13
    assert peaks["1-3"].max() > peaks["3-5"].max() > peaks["5-7"].max() > 0.03
    assert np.all(np.diff([RANGES[peaks[pair].argmax()] for pair in amplitudes.pairs]) > 5e3)


def test_broad_curves_expect_less_over_more_ranges():
    table, broad = Amplitudes.table_ii(), Amplitudes.broad()
    for pair in table.pairs:
        fitted, wide = table.evaluate(pair, RANGES), broad.evaluate(pair, RANGES)
        assert wide.max() < 0.8 * fitted.max()
        assert np.sum(wide > 0.01) > np.sum(fitted > 0.01)
    near = broad.evaluate("1-3", np.array([4340.0]))
    assert near > 0.005 > table.evaluate("1-3", np.array([4340.0]))


def test_scaling_keeps_the_amplitude_at_the_same_range_over_depth():
    amplitudes = Amplitudes.table_ii()
    shallow = amplitudes.scaled_to(2170.0)
    assert shallow.depth_m == 2170.0
    for pair in amplitudes.pairs:
        np.testing.assert_allclose(
            shallow.evaluate(pair, RANGES / 2), amplitudes.evaluate(pair, RANGES), rtol=1e-9
        )


def test_dictionary_round_trip_through_json():
    amplitudes = Amplitudes.table_ii().scaled_to(3000.0)
    assert Amplitudes.from_dict(json.loads(json.dumps(amplitudes.to_dict()))) == amplitudes


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"depth_m": 1.0, "pairs": {"1-3": {"k": 1.0}}},
        {"depth_m": "x", "pairs": {}},
        {"depth_m": 1.0, "pairs": 3},
    ],
)
def test_bad_dictionaries_are_refused(values):
    with pytest.raises(ConfigError, match="amplitudes need"):
        Amplitudes.from_dict(values)


def test_bad_curves_are_refused():
    with pytest.raises(ConfigError, match="omega_m > 0"):
        SkewNormal(1.0, 0.0, 0.0, 0.0)
    with pytest.raises(ConfigError, match="path pair"):
        Amplitudes({"13": SkewNormal(1.0, 0.0, 0.0, 1.0)})
    with pytest.raises(ConfigError, match=r"no amplitude for path pair '7-9'; there are 1-3, 3-5, 5-7"):
        Amplitudes.table_ii().evaluate("7-9", RANGES)
    with pytest.raises(ConfigError, match="depth must be > 0"):
        Amplitudes.table_ii().scaled_to(0.0)
