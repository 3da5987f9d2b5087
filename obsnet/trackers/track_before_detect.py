"""Beam power, batch by batch, in; existence, azimuth and SNR of one target out, without any detection before.

State of the target: azimuth [deg], its rate [deg/s], SNR after whitening [dB].
Source: Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data, eqs 33–36.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from obsnet.errors import ConfigError
from obsnet.trackers.bernoulli_filter import BernoulliConfig, BernoulliFilter, move

Likelihood = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class BearingTrackerConfig:
    """Motion and birth of a target seen by an array.

    Parameters
    ----------
    interval_s : float
        Time between batches.
    acceleration_deg_s2, snr_rate_db_s : float
        Process noises: standard deviations of the azimuth's acceleration and of the SNR's change per
        second, each constant within a batch.
    rate_std_deg_s : float
        Spread of a newborn target's azimuth rate.
    min_azimuth_deg, max_azimuth_deg : float
        Sector in which targets are born.
    min_snr_db, max_snr_db : float
        SNR of newborn targets, uniform in dB.
    bernoulli : BernoulliConfig
    """

    interval_s: float
    acceleration_deg_s2: float = 0.13
    snr_rate_db_s: float = 0.5
    rate_std_deg_s: float = 0.03
    min_azimuth_deg: float = -60.0
    max_azimuth_deg: float = 60.0
    min_snr_db: float = -20.0
    max_snr_db: float = -15.0
    bernoulli: BernoulliConfig = field(default_factory=BernoulliConfig)

    def __post_init__(self) -> None:
        if not self.interval_s > 0:
            raise ConfigError(f"interval_s must be positive, found {self.interval_s!r}")
        for name in ("acceleration_deg_s2", "snr_rate_db_s", "rate_std_deg_s"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, found {getattr(self, name)!r}")
        for name in ("azimuth_deg", "snr_db"):
            low, high = getattr(self, f"min_{name}"), getattr(self, f"max_{name}")
            if not low < high:
                raise ConfigError(f"min_{name} must be below max_{name}, found {low!r} and {high!r}")


@dataclass(frozen=True)
class BearingTrack:
    """Existence probability; posterior means and azimuth spread given existence; dims (batch,)."""

    existence: np.ndarray
    azimuth_deg: np.ndarray
    azimuth_std_deg: np.ndarray
    snr_db: np.ndarray


class BearingTracker:
    """Bernoulli filter over [azimuth, rate, SNR], births weighted by the previous batch's likelihood.

    Parameters
    ----------
    config : BearingTrackerConfig
    rng : Generator
    """

    def __init__(self, config: BearingTrackerConfig, rng: np.random.Generator) -> None:
        self.config = config
        self._rng = rng
        self._previous: Likelihood | None = None
        self.filter = BernoulliFilter(config.bernoulli, self._births())

    def step(self, likelihood: Likelihood | None) -> float:
        """Existence probability after one more batch.

        Parameters
        ----------
        likelihood : callable(azimuth_deg, snr_db) or None
            ln L of the batch at paired azimuths and SNRs; None where the batch is missing.
        """
        births = self._births()
        weights = None if self._previous is None else self._previous(births[0], births[2])
        measure = None if likelihood is None else lambda states: likelihood(states[0], states[2])
        self._previous = likelihood
        return self.filter.step(self._propagate, births, measure, self._rng, weights)

    def _propagate(self, states: np.ndarray) -> np.ndarray:
        config = self.config
        moved = move(states, config.interval_s, config.acceleration_deg_s2, self._rng)
        moved[2] += config.snr_rate_db_s * config.interval_s * self._rng.standard_normal(states.shape[1])
        return moved

    def _births(self) -> np.ndarray:
        config, count = self.config, self.config.bernoulli.births
        width = config.max_azimuth_deg - config.min_azimuth_deg
        births = np.empty((3, count))
        births[0] = config.min_azimuth_deg + width / count * (np.arange(count) + self._rng.random(count))
        births[1] = config.rate_std_deg_s * self._rng.standard_normal(count)
        births[2] = self._rng.uniform(config.min_snr_db, config.max_snr_db, count)
        return births


def track(
    likelihoods: Sequence[Likelihood | None], config: BearingTrackerConfig, rng: np.random.Generator
) -> BearingTrack:
    """Run a `BearingTracker` over batches.

    Parameters
    ----------
    likelihoods : sequence, one per batch
        As `BearingTracker.step` takes them.
    config : BearingTrackerConfig
    rng : Generator
    """
    tracker = BearingTracker(config, rng)
    output = np.empty((4, len(likelihoods)))
    for batch, likelihood in enumerate(likelihoods):
        output[0, batch] = tracker.step(likelihood)
        states = tracker.filter.states
        output[1, batch], _, output[3, batch] = mean = states.sum(axis=1) / states.shape[1]
        spread = states[0] - mean[0]
        output[2, batch] = math.sqrt(spread @ spread / len(spread))
    return BearingTrack(*output)
