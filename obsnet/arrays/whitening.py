"""Ambient noise as a vector autoregression: fit, order, stability, simulation, and the filter to white.

e_n = A_1 e_{n−1} + … + A_o e_{n−o} + Σ^½ w_n, w white with unit covariance.
Source: Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data, eqs 29–32.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit

from obsnet.errors import ConfigError, WaveformError

SINGULAR = 1e-11
"""Share of a channel's own that the others leave of it, up to which it is theirs: a thousand times what float64 rounds off."""
BLOCK = 2048


@dataclass(frozen=True)
class NoiseModel:
    """VAR(o) of M channels.

    Parameters
    ----------
    coefficients : array, dims (lag, channel, channel)
        A_1 … A_o; the first dim is empty where o = 0 (spatial correlation alone).
    covariance : array, dims (channel, channel)
        Σ of the innovations, positive definite; units of the samples, squared.

    Raises
    ------
    ConfigError
        Shapes do not agree, or Σ is not symmetric positive definite.
    """

    coefficients: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        covariance = np.asarray(self.covariance, float)
        coefficients = np.asarray(self.coefficients, float)
        channels = len(covariance)
        if covariance.shape != (channels, channels) or coefficients.shape[1:] != covariance.shape:
            raise ConfigError(
                "a noise model needs coefficients (lag, channel, channel), covariance (channel, channel); "
                f"found {coefficients.shape} and {covariance.shape}"
            )
        if not (np.isfinite(covariance).all() and np.isfinite(coefficients).all()):
            raise ConfigError("the noise model holds values that are not finite")
        if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance)[0] <= 0:
            raise ConfigError(
                "the innovations' covariance is not positive definite; a channel is dead or a copy of another"
            )
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def order(self) -> int:
        """Number of lags o."""
        return len(self.coefficients)

    @property
    def channels(self) -> int:
        """Number of channels M."""
        return len(self.covariance)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus among the eigenvalues of the companion matrix; below 1 the model is stable."""
        if self.order == 0:
            return 0.0
        return float(np.abs(np.linalg.eigvals(_companion(self.coefficients))).max())

    @property
    def is_stable(self) -> bool:
        """Whether the process that it describes has a finite power."""
        return self.spectral_radius < 1.0

    def square_root(self) -> np.ndarray:
        """Symmetric Σ^½."""
        return _symmetric_power(self.covariance, 0.5)

    def inverse_square_root(self) -> np.ndarray:
        """Symmetric Σ^−½, of all whitening matrices the one that changes the steering least."""
        return _symmetric_power(self.covariance, -0.5)

    def transfer(self, cycles_per_sample: np.ndarray) -> np.ndarray:
        """Response Σ^−½ (I − Σ_k A_k e^{−2πi f k}) of the whitening, dims (frequency, channel, channel)."""
        lags = np.arange(1, self.order + 1)
        turns = np.exp(-2j * np.pi * np.asarray(cycles_per_sample, float)[:, None] * lags)
        response = np.eye(self.channels) - np.einsum("fk,kij->fij", turns, self.coefficients)
        return self.inverse_square_root() @ response

    def spectral_density(self, cycles_per_sample: np.ndarray) -> np.ndarray:
        """Two-sided cross-spectral density per cycle per sample, dims (frequency, channel, channel)."""
        inverse = np.linalg.inv(self.transfer(cycles_per_sample))
        return inverse @ np.conj(np.swapaxes(inverse, -1, -2))

    def autocovariance(self) -> np.ndarray:
        """Covariance E[e_n e_nᵀ] of the samples, dims (channel, channel), from the spectral density."""
        bins = 4096
        density = self.spectral_density((np.arange(bins // 2) + 0.5) / bins)
        return 2.0 * density.real.sum(axis=0) / bins

    def simulate(self, count: int, rng: np.random.Generator, settle: int = 1000) -> np.ndarray:
        """Simulated Gaussian record, dims (time, channel), after `settle` samples thrown away.

        Raises
        ------
        ConfigError
            The model is not stable: its power would grow without bound.
        """
        if not self.is_stable:
            raise ConfigError(
                f"cannot simulate an unstable noise model (spectral radius {self.spectral_radius:.4f}); "
                "fit a longer record or a lower order"
            )
        innovations = rng.standard_normal((count + settle, self.channels)) @ self.square_root()
        return _recursion(self.coefficients, innovations)[settle:]


class Whitener:
    """The inverse of a noise model, carried from batch to batch.

    w_n = Σ^−½ (y_n − A_1 y_{n−1} − … − A_o y_{n−o}). Before the first sample the past is taken as zero, so
    that the first o samples of a record are not yet white.

    What it does to a target. A plane wave with phases h(ψ, f) over the hydrophones leaves the filter as
    g(ψ, f) = Σ^−½ (I − Σ_k A_k e^{−2πifk}) h(ψ, f), so that g g* / ‖g‖² is no longer h h* / M and a white
    target becomes coloured with ‖g(ψ, f)‖². The paper's likelihood (its eq. 23) keeps h and a white
    spectrum, and calls SNR the power η that then fits best. That costs a factor |h* g|² / (M ‖g‖²) in beam
    power, a few tenths of a decibel in a directional sea, and pulls the beam's peak a degree or so away
    from the noise. `Beamformer(whitening=…)` matches the beams to g instead.
    """

    def __init__(self, model: NoiseModel) -> None:
        self.model = model
        self._root = model.inverse_square_root()
        self._past = np.zeros((model.order, model.channels))

    def __call__(self, samples: np.ndarray) -> np.ndarray:
        """Whitened samples, dims (time, channel), of those that follow the ones given before.

        Raises
        ------
        WaveformError
            The number of channels is not the model's, or a sample is missing.
        """
        samples = np.asarray(samples, float)
        check_samples(samples, self.model.channels)
        order = self.model.order
        known = np.concatenate([self._past, samples])
        white = samples.copy()
        for lag, matrix in enumerate(self.model.coefficients, start=1):
            white -= known[order - lag : len(known) - lag] @ matrix.T
        self._past = known[len(known) - order :].copy()
        return white @ self._root


def fit(samples: np.ndarray, order: int) -> NoiseModel:
    """Noise model of a target-free record by least squares (eqs 31–32).

    Parameters
    ----------
    samples : array, dims (time, channel)
    order : int
        o ≥ 0.

    Raises
    ------
    WaveformError
        The record is too short for the order, has missing samples, or channels that are dead or copies.
    """
    triangle, used = _triangle(samples, order)
    if (np.abs(np.diag(triangle)) <= SINGULAR * np.linalg.norm(triangle, axis=0)).any():
        raise WaveformError(
            "the record does not determine a noise model: channels are dead or copy each other"
        )
    channels = triangle.shape[1] // (order + 1)
    covariance = _innovation_covariance(triangle, used, order, channels)
    past = order * channels
    try:
        stacked = np.linalg.solve(triangle[:past, :past], triangle[:past, past:])
        return NoiseModel(stacked.reshape(order, channels, channels).transpose(0, 2, 1), covariance)
    except (np.linalg.LinAlgError, ConfigError) as error:
        raise WaveformError(f"the record does not determine a noise model: {error}") from None


def from_autocovariance(autocovariance: np.ndarray) -> NoiseModel:
    """Noise model with the given autocovariances R_k = E[e_n e_{n−k}ᵀ], dims (lag 0…o, channel, channel).

    The multivariate Yule–Walker equations R_k = Σ_j A_j R_{k−j}, k = 1…o. Stable wherever R is a covariance.
    """
    lags = np.asarray(autocovariance, float)
    order, channels = len(lags) - 1, lags.shape[1]
    blocks = [[lags[k - j] if k >= j else lags[j - k].T for k in range(order)] for j in range(order)]
    if order == 0:
        return NoiseModel(np.zeros((0, channels, channels)), lags[0])
    right = np.concatenate(lags[1:], axis=1)
    stacked = np.linalg.solve(np.block(blocks).T, right.T).T
    coefficients = stacked.reshape(channels, order, channels).transpose(1, 0, 2)
    covariance = lags[0] - stacked @ right.T
    return NoiseModel(coefficients, (covariance + covariance.T) / 2.0)


def akaike(samples: np.ndarray, orders: Iterable[int]) -> dict[int, float]:
    """Akaike's criterion T ln|Σ_o| + 2 o M² of each order, all fitted on the same samples; the least is best.

    Raises
    ------
    WaveformError
        As `fit`, for the highest order.
    """
    candidates = sorted(set(orders))
    if not candidates:
        raise ConfigError("no order to choose from; give at least one")
    triangle, used = _triangle(samples, candidates[-1])
    channels = triangle.shape[1] // (candidates[-1] + 1)
    criterion = {}
    for order in candidates:
        covariance = _innovation_covariance(triangle, used, order, channels)
        criterion[order] = used * float(np.linalg.slogdet(covariance)[1]) + 2.0 * order * channels**2
    return criterion


def select_order(samples: np.ndarray, orders: Iterable[int] = range(21)) -> int:
    """Order with the least Akaike criterion."""
    criterion = akaike(samples, orders)
    return min(criterion, key=criterion.__getitem__)


def check_samples(samples: np.ndarray, channels: int | None = None) -> None:
    """Raise `WaveformError` unless samples have dims (time, channel) and none is missing."""
    if samples.ndim != 2 or (channels is not None and samples.shape[1] != channels):
        wanted = "channel" if channels is None else str(channels)
        raise WaveformError(f"samples must have dims (time, {wanted}), found {samples.shape}")
    missing = int((~np.isfinite(samples)).any(axis=1).sum())
    if missing:
        raise WaveformError(
            f"{missing} of {len(samples)} samples are missing; whiten each stretch between gaps by itself"
        )


def _triangle(samples: np.ndarray, order: int) -> tuple[np.ndarray, int]:
    """R of the QR of [e_{n−1}, …, e_{n−o}, e_n]; it holds the least squares of every order up to o."""
    samples = np.asarray(samples, float)
    check_samples(samples)
    if order < 0:
        raise ConfigError(f"the order of a noise model cannot be negative, found {order}")
    count, channels = samples.shape
    used = count - order
    if used <= (order + 1) * channels:
        raise WaveformError(
            f"a VAR({order}) of {channels} channels needs over {(order + 1) * channels + order} samples, "
            f"found {count}"
        )
    triangle = np.zeros((0, (order + 1) * channels))
    for first in range(order, count, BLOCK):
        last = min(first + BLOCK, count)
        columns = [samples[first - lag : last - lag] for lag in [*range(1, order + 1), 0]]
        stacked = np.concatenate([triangle, np.concatenate(columns, axis=1)])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    return triangle, used


def _innovation_covariance(triangle: np.ndarray, used: int, order: int, channels: int) -> np.ndarray:
    rest = triangle[order * channels :, -channels:]
    return rest.T @ rest / used


def _companion(coefficients: np.ndarray) -> np.ndarray:
    order, channels = coefficients.shape[:2]
    below = np.eye((order - 1) * channels, order * channels)
    return np.concatenate([np.concatenate(list(coefficients), axis=1), below])


def _symmetric_power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values**exponent) @ vectors.T


@njit(cache=True, nogil=True)
def _recursion(coefficients, innovations):
    order = coefficients.shape[0]
    count, channels = innovations.shape
    record = innovations.copy()
    for n in range(count):
        for lag in range(1, min(order, n) + 1):
            for i in range(channels):
                total = 0.0
                for j in range(channels):
                    total += coefficients[lag - 1, i, j] * record[n - lag, j]
                record[n, i] += total
    return record
