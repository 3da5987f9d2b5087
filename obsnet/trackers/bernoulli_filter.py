"""Bernoulli filter by particles: the probability that a target exists, and its state if it does, batch by
batch.

With q the probability of existence and s the density of the state, the time update is (eqs 3a, 3b)

    q' = p_b (1 − q) + p_s q,     s' = [p_b (1 − q) b + p_s q ∫ π s] / q'

and the measurement update, L the likelihood ratio of target against no target (eqs 4a, 4b),

    q = q' I / (1 − q' + q' I),   s ∝ L s',   I = ∫ L s'.

The births b are the caller's, as a rule drawn or weighted by the previous measurement's likelihood. Source:
Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data; Ristic et al. 2013, IEEE
Trans. Signal Process. 61(13), for the particles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsnet.errors import ConfigError
from obsnet.trackers.particles import normalise, systematic_resampling


@dataclass(frozen=True)
class BernoulliConfig:
    """Numbers of the filter, per batch.

    Parameters
    ----------
    survival, birth : float
        p_s and p_b, probabilities that a target goes on existing and that one appears.
    confirmation : float
        A target is confirmed while q exceeds this.
    replacement : float
        Share of the surviving targets whose state is drawn afresh from the births, 0 in the paper: a second target
        takes the place of the first, and a filter that follows a wrong branch finds the right one.
    particles, births : int
        Particles kept after a batch, and new ones that the caller adds before the next.
    """

    survival: float = 0.9999
    birth: float = 1e-5
    confirmation: float = 0.9
    replacement: float = 0.0
    particles: int = 1000
    births: int = 250

    def __post_init__(self) -> None:
        for name in ("survival", "birth", "confirmation"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ConfigError(f"{name} must lie between 0 and 1, found {getattr(self, name)!r}")
        if not 0.0 <= self.replacement < 1.0:
            raise ConfigError(f"replacement must lie in [0, 1), found {self.replacement!r}")
        if self.particles < 1 or self.births < 1:
            raise ConfigError(
                f"particles and births must be at least 1, found {self.particles} and {self.births}"
            )


class BernoulliFilter:
    """The recursion, whatever the state and the measurement.

    Attributes
    ----------
    existence : float
        q after the last batch.
    states : array, dims (state, particle)
        Equally weighted particles of the state, if a target exists.
    """

    def __init__(self, config: BernoulliConfig, states: np.ndarray, existence: float = 0.0) -> None:
        states = np.array(states, float)
        if states.ndim != 2 or states.shape[1] < 1 or not np.isfinite(states).all():
            raise ConfigError(
                f"a filter starts from finite states, dims (state, particle), found {states.shape}"
            )
        if not 0.0 <= existence < 1.0:
            raise ConfigError(f"the first existence probability must lie in [0, 1), found {existence!r}")
        self.config = config
        self.states = states
        self.existence = float(existence)

    @property
    def confirmed(self) -> bool:
        """Whether a target is confirmed."""
        return self.existence > self.config.confirmation

    def step(
        self,
        propagate: Callable[[np.ndarray], np.ndarray],
        births: np.ndarray,
        log_likelihood: Callable[[np.ndarray], np.ndarray] | None,
        rng: np.random.Generator,
        birth_log_weights: np.ndarray | None = None,
    ) -> float:
        """Time update, then measurement update, then resampling; the existence probability after it.

        Parameters
        ----------
        propagate : callable
            Draws the states one batch later, dims (state, particle) in and out.
        births : array, dims (state, birth)
            Draws from the birth density b.
        log_likelihood : callable or None
            ln L of states, minus infinity where a target is impossible; None where there is no measurement.
        rng : Generator
        birth_log_weights : array, dims (birth,), optional
            Where the births are not equally weighted; need not be normalised.

        Raises
        ------
        FilterError
            ln L is NaN or plus infinity for a particle, or minus infinity for all of them.
        """
        config, q = self.config, self.existence
        appeared, survived = config.birth * (1.0 - q), config.survival * q
        predicted = appeared + survived
        old = self.states.shape[1]
        states = np.concatenate([propagate(self.states), births], axis=1)
        weights = np.empty(states.shape[1])
        replaced = config.replacement * survived
        weights[:old] = _log((survived - replaced) / predicted / old)
        weights[old:] = _log((appeared + replaced) / predicted)
        if birth_log_weights is None:
            weights[old:] -= np.log(births.shape[1])
        else:
            weights[old:] += normalise(birth_log_weights, "birth")[0]
        if log_likelihood is not None:
            weights += log_likelihood(states)
            weights, evidence = normalise(weights)
            odds = math.log(predicted) - math.log1p(-predicted) + evidence
            predicted = 1.0 / (1.0 + math.exp(min(-odds, 700.0)))
        self.existence = predicted
        self.states = states[:, systematic_resampling(weights, rng, config.particles)]
        return self.existence


def move(states: np.ndarray, interval_s: float, acceleration: float, rng: np.random.Generator) -> np.ndarray:
    """Nearly constant velocity: rows 0 and 1 are a coordinate and its rate, driven by white acceleration
    (eq. 34).

    Parameters
    ----------
    states : array, dims (state, particle)
        Further rows are left as they are.
    interval_s : float
        T.
    acceleration : float
        Standard deviation, coordinate per s², constant within the interval.
    rng : Generator

    Returns
    -------
    array, dims (state, particle)
    """
    kick = acceleration * interval_s * rng.standard_normal(states.shape[1])
    moved = states.copy()
    moved[0] += interval_s * (states[1] + 0.5 * kick)
    moved[1] += kick
    return moved


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf
