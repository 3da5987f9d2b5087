"""What the grid search refuses before anything is read."""

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.trackers.search_config import GridSearchConfig


@pytest.mark.parametrize("seed", [-1, 1.5, True, None])
def test_seeds_that_are_none(seed):
    with pytest.raises(ConfigError, match="seed must be a whole number of at least 0"):
        GridSearchConfig(seed=seed)


def test_any_whole_number_from_zero_on_is_a_seed():
    assert GridSearchConfig(seed=2**70).seed == 2**70
    assert GridSearchConfig(seed=np.int64(3)).seed == 3


@pytest.mark.parametrize(
    "prior",
    [
        {"max_speed_mps": 1e9},
        {"max_cpa_range_m": 1e9},
        {"max_speed_mps": 1e200, "max_cpa_range_m": 1e200},
        {"max_speed_mps": 200.0, "max_cpa_range_m": 200e3},
    ],
)
def test_priors_whose_grid_would_not_fit_into_memory(prior):
    with pytest.raises(ConfigError, match=r"make a grid of \S+ cells; lower them"):
        GridSearchConfig(**prior)


def test_wide_priors_are_searched():
    """Whatever a ship can do: 200 km away, 40 m/s."""
    GridSearchConfig(max_speed_mps=40.0, max_cpa_range_m=200e3)
