"""Parameters and levels of the grid search."""

from __future__ import annotations

from dataclasses import dataclass

from obsnet.config import require_seed
from obsnet.errors import ConfigError

MOST_CELLS = 5e4
"""Of CPA range and speed in the coarsest grid, 20 times as many as by default: a day's tiles of these take a gigabyte."""


COARSE = (1000.0, 10.0, 0.5)
"""Steps of the grid over the whole prior: CPA range [m], course [deg], speed [m/s]."""


@dataclass(frozen=True)
class GridSearchConfig:
    """Prior, likelihood and levels of the grid search.

    `tile_s` is the time from one minute that is read to the next, so that their windows share no frames. `tile_bound` is the most that one tile may say (log-likelihood ratio; maps that say more are lowered, keeping their shape), `exponent` the power to which the whole likelihood is raised, `min_log_bayes_factor` what a track must reach against no ship
    and against a source whose azimuth drifts by `still_deg_per_hour` at most; a further ship beside or soon after a first must
    reach `min_log_bayes_factor_next`, since what is left of the first is not noise, or `min_log_bayes_factor_apart` where it is heard
    when no other is; where its CPA is located sharply, to two minutes and 500 m as remainders are not, no more than a first one. A track must be heard for
    `shortest_s`, for half of it if it is located sharply and moves.
    `range_scale_std` is the relative standard deviation of all ranges together: what a sound speed known to 0.8 % leaves open in the
    propagation table, as a profile taken for a sea that one does not know; lower it where the profile was measured (0.2 % in sound speed are 0.5 % in range). With `lines`, the Doppler shift of a ship's
    lines has a say in the scale of its distance and speed (`obsnet.trackers.line_doppler`).
    """

    azimuth_detection_probability: float = 0.9
    range_detection_probability: float = 0.6
    tile_s: float = 180.0
    tile_bound: float = 12.0
    exponent: float = 1.0
    max_cpa_range_m: float = 50_000.0
    min_speed_mps: float = 3.0
    max_speed_mps: float = 15.0
    candidates: int = 6
    max_ships: int = 4
    min_log_bayes_factor: float = 10.0
    min_log_bayes_factor_next: float = 60.0
    min_log_bayes_factor_apart: float = 30.0
    still_deg_per_hour: float = 4.0
    shortest_s: float = 1800.0
    range_scale_std: float = 0.015
    lines: bool = True
    samples: int = 3000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("azimuth_detection_probability", "range_detection_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ConfigError(f"{name} must lie in (0, 1), found {getattr(self, name)}")
        if not 0.0 < self.min_speed_mps < self.max_speed_mps:
            raise ConfigError(
                f"min_speed_mps must lie below max_speed_mps, found {self.min_speed_mps}, {self.max_speed_mps}"
            )
        if not 0.0 <= self.range_scale_std < 1.0:
            raise ConfigError(f"range_scale_std must lie in [0, 1), found {self.range_scale_std}")
        require_seed(self.seed)
        for name in (
            "tile_s",
            "tile_bound",
            "exponent",
            "max_cpa_range_m",
            "candidates",
            "max_ships",
            "samples",
        ):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        range_step, _, speed_step = COARSE
        cells = (
            2.0 * self.max_cpa_range_m / range_step * (self.max_speed_mps - self.min_speed_mps) / speed_step
        )
        if not cells <= MOST_CELLS:
            raise ConfigError(
                f"max_cpa_range_m of {self.max_cpa_range_m:g} and max_speed_mps of {self.max_speed_mps:g} make a grid of "
                f"{cells:.0e} cells; lower them"
            )


@dataclass(frozen=True)
class Level:
    """Steps and half-widths of one level in CPA time [s], CPA range [m], course [deg], speed [m/s]."""

    step: tuple[float, float, float, float]
    half: tuple[float, float, float, float]


MEDIUM = Level((20.0, 200.0, 2.0, 0.1), (180.0, 1000.0, 10.0, 0.5))
FINE = Level((4.0, 40.0, 0.4, 0.02), (20.0, 200.0, 2.0, 0.1))

SMOOTHING = (280.0, 3.0, 0.5)
"""Standard deviations by which maps are smoothed for these levels: range [m], azimuth [deg], range rate [m/s]."""
