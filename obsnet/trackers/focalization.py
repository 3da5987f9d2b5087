"""Unlabelled delays between paths in, the source's range, depth and range rate out: a particle filter
(focalization).

The filter of Watkins et al. with two additions, both off when `survival_s` and `birth_s` are infinite: an
existence probability (Bernoulli filter), and births, by which it finds a source that comes or that it lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import expit

from obsnet.errors import ConfigError, FilterError, LayoutError
from obsnet.trackers.false_alarms import FalseAlarms
from obsnet.trackers.particles import effective_sample_size, normalise, systematic_resampling, weighted_mean
from obsnet.trackers.tdoa_association import TdoaModel, association_log_likelihood

RANGE, DEPTH, RATE = 0, 1, 2
EXPLAINING = 200
"""Particles that decide which measurements the source explains."""


@dataclass(frozen=True)
class FocalizationConfig:
    """Measurement, motion and prior of the focalization filter; the defaults are those of a deep station.

    Parameters
    ----------
    detection_probability : per pair, where both its paths exist; one value serves every pair. What is not
        heard stays unheard for many scans, so that misses say less than their number: take less than the
        share of scans in which a clear pair is detected.
    tdoa_std_s : standard deviation of a measured delay, s, per pair or one for all.
    false_alarms : mean number per scan, uniform between `min_tdoa_s` and `max_tdoa_s`, outside of which no
        delay is looked at.
    false_alarm_memory_s, false_alarm_resolution_s : where finite, time constant of a running mean, begun with
        `false_alarms`, of the delays that the source does not explain; and how finely it knows where they
        are, 0 for uniform ones.
    max_range_m, range_prior : the area of interest; `uniform` in range as in the paper, or `area`,
        proportional to range.
    max_source_depth_m : the source's depth is uniform down to here, 0 for a ship.
    rate_prior, rate_scale_mps : range rate, normal with this standard deviation as in the paper, or uniform
        within ±.
    acceleration_std_mps2, depth_rate_std_mps : driving noise of eq. (4), constant over a scan.
    range_diffusion_m : m per √s, a regularisation that keeps resampled particles apart; 0 in the paper.
    particles : J. After each scan they are resampled where the effective sample size is below J/2, and always
        when there are births.
    survival_s, birth_s : mean time that a source stays and that passes until the next comes; infinite: it is
        there.
    jump_s : mean time until the source is looked for anew in the whole prior though it exists: what gets the
        filter off a ghost branch.
    birth_share : births per scan as a share of J, with as much weight as birth and jump give them.
    """

    detection_probability: tuple[float, ...] = (0.3,)
    tdoa_std_s: tuple[float, ...] = (0.02,)
    false_alarms: float = 2.0
    false_alarm_memory_s: float = 1200.0
    false_alarm_resolution_s: float = 0.05
    min_tdoa_s: float = 0.3
    max_tdoa_s: float = 6.5
    max_range_m: float = 80_000.0
    range_prior: Literal["uniform", "area"] = "area"
    max_source_depth_m: float = 0.0
    rate_prior: Literal["normal", "uniform"] = "uniform"
    rate_scale_mps: float = 13.0
    acceleration_std_mps2: float = 0.015
    depth_rate_std_mps: float = 0.0
    range_diffusion_m: float = 2.0
    particles: int = 10_000
    survival_s: float = 14_400.0
    birth_s: float = 14_400.0
    jump_s: float = 30_000.0
    birth_share: float = 0.2
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.detection_probability or not all(0.0 <= d <= 1.0 for d in self.detection_probability):
            raise ConfigError(
                f"detection_probability must lie in [0, 1] for each pair, found {self.detection_probability}"
            )
        if not self.tdoa_std_s or not all(np.isfinite(s) and s > 0 for s in self.tdoa_std_s):
            raise ConfigError(f"tdoa_std_s must be positive, found {self.tdoa_std_s}")
        if not 0.0 <= self.min_tdoa_s < self.max_tdoa_s:
            raise ConfigError(
                "min_tdoa_s must be at least 0 and below max_tdoa_s, found "
                f"{self.min_tdoa_s} and {self.max_tdoa_s}"
            )
        positive = ("false_alarms", "false_alarm_memory_s", "max_range_m", "rate_scale_mps", "survival_s")
        for name in (*positive, "birth_s", "jump_s"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        for name in (
            "max_source_depth_m",
            "acceleration_std_mps2",
            "depth_rate_std_mps",
            "range_diffusion_m",
        ):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, found {getattr(self, name)}")
        if self.particles < 2:
            raise ConfigError(f"particles must be at least 2, found {self.particles}")
        if not 0.0 <= self.birth_share <= 1.0:
            raise ConfigError(f"birth_share must lie in [0, 1], found {self.birth_share}")
        if self.has_births and self.birth_share * self.particles < 1:
            raise ConfigError(
                f"birth_share={self.birth_share} of {self.particles} particles leaves no birth; "
                "raise either, or make birth_s and jump_s infinite"
            )

    @property
    def has_births(self) -> bool:
        """Whether a source may come or be looked for anew."""
        return bool(np.isfinite(self.birth_s) or np.isfinite(self.jump_s))


@dataclass(frozen=True)
class Scan:
    """What the filter knows after one scan: posterior mean and standard deviation, evidence and existence.

    `log_evidence` is the log-likelihood ratio of this scan's measurements, a source somewhere in the
    prediction against none; 0 where the scan was missing. `existence` is the probability that there is a
    source.
    """

    range_m: float
    range_std_m: float
    depth_m: float
    range_rate_mps: float
    range_rate_std_mps: float
    log_evidence: float
    existence_llr: float
    expected_detections: float


class FocalizationFilter:
    """Particle filter over range, depth and range rate of one source, driven by unlabelled delays.

    Parameters
    ----------
    model : delays of each pair of paths from a hypothetical source.
    config : FocalizationConfig

    Notes
    -----
    Motion is eq. (4): r ← r + vT + ½T²u, v ← v + Tu. A delay is even in range, so a particle that crosses
    range 0 is reflected and its range rate changes sign; depths are reflected at the surface and at
    `max_source_depth_m`, range rates of a uniform prior at its ends. A particle beyond `max_range_m` has
    left.

    Existence follows the Bernoulli recursion. With p_S and p_B the probabilities to stay and to come within a
    scan, p_J to jump, and b(x) the prior, the predicted existence is q⁻ = p_S q + p_B (1 − q), the predicted
    density [p_S q ((1 − p_J) f(x) + p_J b(x)) + p_B (1 − q) b(x)] / q⁻, and after a scan with evidence ℓ = ∫
    L(x) f⁻(x) dx it is q⁻ℓ / (1 − q⁻ + q⁻ℓ).

    Random numbers of scan n depend on the seed and n alone: a filter restored from `state_dict` goes on as if
    never stopped.

    Source: Watkins et al., eqs (1), (3), (4).
    """

    def __init__(self, model: TdoaModel, config: FocalizationConfig = FocalizationConfig()) -> None:
        self.model, self.config = model, config
        self._detection = _per_pair(config.detection_probability, model.pairs, "detection_probability")
        self._std = _per_pair(config.tdoa_std_s, model.pairs, "tdoa_std_s")
        self._rng = np.random.default_rng([config.seed, 0])
        self._particles = self._prior(config.particles)
        self._log_weights = np.full(config.particles, -np.log(config.particles))
        self._steps = 0
        self._log_odds = 0.0
        window = (config.min_tdoa_s, config.max_tdoa_s)
        self._clutter = FalseAlarms(
            config.false_alarms, window, config.false_alarm_memory_s, config.false_alarm_resolution_s
        )
        self.existence = 1.0 if not np.isfinite(config.birth_s) else _stationary_existence(config)

    @property
    def particles(self) -> np.ndarray:
        """Range [m], depth [m] and range rate [m/s], dims (particle, state)."""
        return self._particles

    @property
    def false_alarms(self) -> float:
        """Mean number of false alarms per scan, as learned so far."""
        return self._clutter.count

    @property
    def log_weights(self) -> np.ndarray:
        """Normalised natural log weights, dims (particle,)."""
        return self._log_weights

    def step(
        self, measured_s: np.ndarray | None, elapsed_s: float, receiver_depth_m: float | None = None
    ) -> Scan:
        """Predict over `elapsed_s`, take a scan's delays [s], and estimate.

        Parameters
        ----------
        measured_s : array, dims (measurement,), s, without labels; empty where nothing was detected, None
            where there was no scan (a gap).
        elapsed_s : s since the scan before; 0 for the first.
        receiver_depth_m : m, where the model asks for it.

        Raises
        ------
        FilterError
            The measurements contradict every particle.
        """
        if not (np.isfinite(elapsed_s) and elapsed_s >= 0):
            raise LayoutError(f"scans must come in time order, found {elapsed_s} s since the scan before")
        self._steps += 1
        self._rng = np.random.default_rng([self.config.seed, self._steps])
        self._predict(float(elapsed_s))
        self._log_odds = _logit(self.existence)
        log_evidence, expected = 0.0, 0.0
        if measured_s is not None:
            log_evidence, expected = self._update(self._observable(measured_s), elapsed_s, receiver_depth_m)
        scan = self._estimate(log_evidence, expected)
        self._resample()
        return scan

    def log_likelihood(
        self, range_m: np.ndarray, measured_s: np.ndarray, receiver_depth_m: float | None = None
    ) -> np.ndarray:
        """Log-likelihood ratio of one scan's delays, dims (range,), for a source at the surface."""
        states = np.zeros((len(range_m), 3))
        states[:, RANGE] = range_m
        return self._likelihood(states, self._observable(measured_s), receiver_depth_m)[0]

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything that the next scan depends on, as plain arrays."""
        return {
            "particles": self._particles.copy(),
            "log_weights": self._log_weights.copy(),
            "existence": np.array(self.existence),
            "false_alarms": self._clutter.local.copy(),
            "steps": np.array(self._steps),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict` of a filter with the same model and configuration."""
        particles, log_weights = np.array(state["particles"], float), np.array(state["log_weights"], float)
        if particles.shape != (self.config.particles, 3) or log_weights.shape != particles.shape[:1]:
            raise ConfigError(
                f"this state holds {len(particles)} particles, "
                f"the configuration asks for {self.config.particles}"
            )
        self._particles, self._log_weights = particles, log_weights
        self.existence, self._clutter.local = (
            float(state["existence"]),
            np.array(state["false_alarms"], float),
        )
        self._steps = int(state["steps"])

    def _prior(self, count: int) -> np.ndarray:
        config, rng = self.config, self._rng
        states = np.empty((count, 3))
        stratum = (np.arange(count) + rng.random(count)) / count
        if config.range_prior == "area":
            stratum = np.sqrt(stratum)
        states[:, RANGE] = config.max_range_m * stratum
        states[:, DEPTH] = config.max_source_depth_m * rng.random(count)
        if config.rate_prior == "normal":
            states[:, RATE] = config.rate_scale_mps * rng.standard_normal(count)
        else:
            states[:, RATE] = config.rate_scale_mps * rng.uniform(-1.0, 1.0, count)
        return states

    def _predict(self, elapsed_s: float) -> None:
        config, states, rng = self.config, self._particles, self._rng
        acceleration = config.acceleration_std_mps2 * rng.standard_normal(len(states))
        states[:, RANGE] += states[:, RATE] * elapsed_s + 0.5 * elapsed_s**2 * acceleration
        states[:, RATE] += elapsed_s * acceleration
        if config.range_diffusion_m > 0:
            spread = config.range_diffusion_m * np.sqrt(elapsed_s)
            states[:, RANGE] += spread * rng.standard_normal(len(states))
        if config.depth_rate_std_mps > 0:
            states[:, DEPTH] += config.depth_rate_std_mps * elapsed_s * rng.standard_normal(len(states))
            states[:, DEPTH] = _fold(states[:, DEPTH], config.max_source_depth_m)
        across = states[:, RANGE] < 0
        states[across, RANGE] *= -1.0
        states[across, RATE] *= -1.0
        if config.rate_prior == "uniform":
            states[:, RATE] = _fold(states[:, RATE] + config.rate_scale_mps, 2 * config.rate_scale_mps)
            states[:, RATE] -= config.rate_scale_mps
        self._log_weights[states[:, RANGE] > config.max_range_m] = -np.inf
        self._predict_existence(elapsed_s)

    def _predict_existence(self, elapsed_s: float) -> None:
        config = self.config
        inside = float(np.exp(self._log_weights).sum())
        stays = self.existence * inside * float(np.exp(-elapsed_s / config.survival_s))
        if not config.has_births:
            if inside == 0:
                raise FilterError(
                    f"every particle has left the area of interest of {config.max_range_m} m; "
                    "widen max_range_m"
                )
            self._log_weights, _ = normalise(self._log_weights)
            self.existence = stays if np.isfinite(config.survival_s) else self.existence
            return
        comes = (1.0 - self.existence) * -np.expm1(-elapsed_s / config.birth_s)
        jumps = stays * -np.expm1(-elapsed_s / config.jump_s)
        births = self._prior(round(config.birth_share * config.particles))
        with np.errstate(divide="ignore"):
            old = self._log_weights + np.log((stays - jumps) / inside if inside > 0 else 0.0)
            new = np.full(len(births), np.log((comes + jumps) / len(births)))
        self._particles = np.concatenate([self._particles, births])
        self._log_weights, log_total = normalise(np.concatenate([old, new]))
        self.existence = float(np.exp(min(log_total, 0.0)))

    def _observable(self, measured_s: np.ndarray) -> np.ndarray:
        measured = np.atleast_1d(np.asarray(measured_s, float)).ravel()
        if not np.isfinite(measured).all():
            raise LayoutError(
                "a measured delay is not finite; drop missing delays, and give None where there was no scan"
            )
        return measured[(measured >= self.config.min_tdoa_s) & (measured < self.config.max_tdoa_s)]

    def _likelihood(
        self, states: np.ndarray, measured: np.ndarray, receiver_depth_m: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        predicted = self.model.tdoas(states[:, RANGE], states[:, DEPTH], receiver_depth_m)
        detection = self._detection * self.model.visibility(states[:, RANGE], receiver_depth_m)
        window = (self.config.min_tdoa_s, self.config.max_tdoa_s)
        return association_log_likelihood(
            predicted, measured, detection, self._std, self._clutter.density(measured), window
        )

    def _update(
        self, measured: np.ndarray, elapsed_s: float, receiver_depth_m: float | None
    ) -> tuple[float, float]:
        log_ratio, explained = self._likelihood(self._particles, measured, receiver_depth_m)
        self._log_weights, log_evidence = normalise(self._log_weights + log_ratio)
        self._log_odds = _logit(self.existence) + log_evidence
        self.existence = float(expit(self._log_odds))
        if np.isfinite(self.config.false_alarm_memory_s):
            unexplained = self._unexplained(measured, receiver_depth_m)
            self._clutter.learn(measured, unexplained, elapsed_s)
        return log_evidence, self.existence * float(np.exp(self._log_weights) @ explained)

    def _unexplained(self, measured: np.ndarray, receiver_depth_m: float | None) -> np.ndarray:
        """Probability that the source did not make each measurement, from the likelihood without it."""
        some = self._particles[systematic_resampling(self._log_weights, self._rng, EXPLAINING)]
        whole, _ = self._likelihood(some, measured, receiver_depth_m)
        without = [
            self._likelihood(some, np.delete(measured, m), receiver_depth_m)[0] for m in range(len(measured))
        ]
        odd = np.array([np.exp(part - whole).mean() for part in without])
        return 1.0 - self.existence * (1.0 - np.minimum(odd, 1.0))

    def _estimate(self, log_evidence: float, expected: float) -> Scan:
        mean, covariance = weighted_mean(self._particles, self._log_weights)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return Scan(
            range_m=float(mean[RANGE]),
            range_std_m=float(std[RANGE]),
            depth_m=float(mean[DEPTH]),
            range_rate_mps=float(mean[RATE]),
            range_rate_std_mps=float(std[RATE]),
            log_evidence=log_evidence,
            existence_llr=self._log_odds,
            expected_detections=expected,
        )

    def _resample(self) -> None:
        count = self.config.particles
        if len(self._particles) == count and effective_sample_size(self._log_weights) >= 0.5 * count:
            return
        kept = systematic_resampling(self._log_weights, self._rng, count)
        self._particles = self._particles[kept]
        self._log_weights = np.full(count, -np.log(count))


def _per_pair(values: tuple[float, ...], pairs: tuple[str, ...], name: str) -> np.ndarray:
    if len(values) not in (1, len(pairs)):
        raise ConfigError(f"{name} needs one value or one for each of {', '.join(pairs)}, found {values}")
    return np.broadcast_to(np.asarray(values, float), len(pairs)).copy()


def _stationary_existence(config: FocalizationConfig) -> float:
    if not np.isfinite(config.survival_s):
        return 0.5
    return config.survival_s / (config.survival_s + config.birth_s)


def _logit(probability: float) -> float:
    with np.errstate(divide="ignore"):
        return float(np.log(probability) - np.log1p(-probability))


def _fold(values: np.ndarray, width: float) -> np.ndarray:
    """Reflect at 0 and at `width` as often as needed."""
    if width <= 0:
        return np.zeros_like(values)
    return width - np.abs(np.mod(values, 2.0 * width) - width)
