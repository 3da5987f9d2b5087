"""Errors of measured bearings: their covariance in time, draws of them, and their size and correlation from
known passages.

Autocovariance models C(τ) of Urazghildiiev & Hannay, eqs 12-14, with τ_α the correlation interval:

    linear       σ² (1 - |τ|/τ_α)₊                    (13; two windows of length τ_α overlap like that)
    sinc         σ² sin(τ/τ_α) / (τ/τ_α)              (12)
    exponential  σ² exp(-(τ / 0.5 τ_α)²)              (14; the paper's name for a bell)
    butterworth  noise through a sixth-order lowpass, cut at 1/(2 τ_α), an ideal one's first zero at τ_α

The last three are so smooth that their matrices are singular to working precision as soon as τ_α spans a few
samples: a process without power above some frequency could be predicted exactly. No measured bearing can, so
a white share of the variance (the nugget) is added to them; the eigenvalues are then at least nugget · σ²,
the condition number at most K / nugget for K bearings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar, nnls

from obsnet.errors import ConfigError, LayoutError
from obsnet.kinematics import wrap180

MODELS = ("linear", "sinc", "exponential", "butterworth")
SMOOTH_NUGGET = 1e-3


@dataclass(frozen=True)
class BearingErrors:
    """Stationary Gaussian bearing errors.

    Parameters
    ----------
    std_deg : float
        Standard deviation σ of one bearing [deg].
    correlation_s : float
        Correlation interval τ_α [s]; zero means independent errors.
    model : {"linear", "sinc", "exponential", "butterworth"}
        Autocovariance, see the module.
    nugget : float, optional
        White share of the variance, in [0, 1]. By default 0 for the linear model, 1e-3 for the smooth ones.
    """

    std_deg: float = 2.0
    correlation_s: float = 0.0
    model: str = "linear"
    nugget: float | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.std_deg) and self.std_deg > 0):
            raise ConfigError(f"std_deg must be positive, found {self.std_deg}")
        if not (np.isfinite(self.correlation_s) and self.correlation_s >= 0):
            raise ConfigError(f"correlation_s must be zero or positive, found {self.correlation_s}")
        if self.model not in MODELS:
            raise ConfigError(f"model must be one of {', '.join(MODELS)}, found {self.model!r}")
        if self.nugget is not None and not 0 <= self.nugget <= 1:
            raise ConfigError(f"nugget must lie in [0, 1], found {self.nugget}")

    @property
    def white_share(self) -> float:
        """Share of the variance that is white."""
        if self.nugget is not None:
            return self.nugget
        return 0.0 if self.model == "linear" else SMOOTH_NUGGET

    def covariance(self, time: np.ndarray, std_deg: np.ndarray | None = None) -> np.ndarray:
        """Covariance matrix of the errors at `time`.

        Parameters
        ----------
        time : array (K,), s; all different.
        std_deg : array (K,), optional
            Standard deviation of each bearing [deg], in place of the common one; the correlation is kept.

        Returns
        -------
        array (K, K), deg²
        """
        time = np.asarray(time, float)
        lag = np.abs(time[:, None] - time[None, :])
        rho = (1 - self.white_share) * correlation(lag, self.correlation_s, self.model)
        rho[np.diag_indices_from(rho)] = 1.0
        std = np.broadcast_to(self.std_deg if std_deg is None else np.asarray(std_deg, float), time.shape)
        return std[:, None] * rho * std[None, :]

    def sample(self, time: np.ndarray, runs: int, rng: np.random.Generator) -> np.ndarray:
        """Simulated errors at `time`: array (runs, K) [deg], rows independent."""
        root = np.linalg.cholesky(self.covariance(time))
        return rng.standard_normal((runs, len(root))) @ root.T


def correlation(lag_s: np.ndarray, correlation_s: float, model: str = "linear") -> np.ndarray:
    """Normalised autocorrelation ρ(τ) at `lag_s` [s] for the interval `correlation_s` [s] (eqs 12-14).

    >>> correlation(np.array([0.0, 50.0, 200.0]), 100.0)
    array([1. , 0.5, 0. ])
    """
    lag = np.abs(np.asarray(lag_s, float))
    if correlation_s <= 0:
        return (lag == 0).astype(float)
    ratio = lag / correlation_s
    if model == "linear":
        return np.clip(1.0 - ratio, 0.0, None)
    if model == "sinc":
        return np.sinc(ratio / np.pi)
    if model == "exponential":
        return np.exp(-((2.0 * ratio) ** 2))
    if model == "butterworth":
        return _butterworth(ratio)
    raise ConfigError(f"model must be one of {', '.join(MODELS)}, found {model!r}")


def _butterworth(ratio: np.ndarray) -> np.ndarray:
    frequency = (np.arange(2000) + 0.5) * 2e-3
    power = 1.0 / (1.0 + frequency**12)
    lags, place = np.unique(np.round(ratio, 9), return_inverse=True)
    rho = np.cos(np.pi * lags[:, None] * frequency) @ power / power.sum()
    return rho[place].reshape(ratio.shape)


@dataclass(frozen=True)
class CorrelationEstimate:
    """What known passages say of the errors: the fitted model and the autocovariance behind it.

    `std_deg` and `correlation_s` are the model's; their uncertainties come from a jackknife over passages and
    are NaN for fewer than three. `lag_s`, `autocovariance_deg2` and `pairs` describe the empirical
    autocovariance.
    """

    errors: BearingErrors
    std_uncertainty_deg: float
    correlation_uncertainty_s: float
    lag_s: np.ndarray
    autocovariance_deg2: np.ndarray
    pairs: np.ndarray

    @property
    def std_deg(self) -> float:
        """Standard deviation σ [deg]."""
        return self.errors.std_deg

    @property
    def correlation_s(self) -> float:
        """Correlation interval τ_α [s]."""
        return self.errors.correlation_s


def estimate_correlation(
    residuals: np.ndarray | Sequence[np.ndarray],
    times: np.ndarray | Sequence[np.ndarray],
    *,
    model: str = "linear",
    gate_deg: float = 45.0,
    max_lag_s: float | None = None,
) -> CorrelationEstimate:
    """Size and correlation of bearing errors from passages of known ships.

    The products of residuals r_i r_j, averaged per lag over all passages, estimate C(τ); the white part, σ²
    and τ_α follow by least squares weighted with the number of pairs. No mean is removed: with the truth
    known, a bias is an error too.

    Parameters
    ----------
    residuals : array (K,) or list of such, one per passage
        Measured minus known azimuth [deg], wrapped here; NaN where there is none.
    times : array (K,) or list of such, s
    model : str
        Autocovariance model, see `BearingErrors`.
    gate_deg : float
        Residuals beyond are false bearings, not errors, and are left out [deg].
    max_lag_s : float, optional
        Longest lag used [s]; half of the longest passage by default.

    Raises
    ------
    LayoutError
        Residuals and times do not match, or fewer than 8 bearings are left.

    Notes
    -----
    Urazghildiiev & Hannay measure C(τ) the same way (Sec. II); the white part is ours: it is what a sampled
    C(τ) shows as a step between lag zero and the first lag.
    """
    passages = _passages(residuals, times, gate_deg)
    step = float(np.median(np.concatenate([np.diff(t) for _, t in passages])))
    longest = max(t[-1] - t[0] for _, t in passages)
    count = max(round((max_lag_s or longest / 2) / step), 2) + 1
    sums = np.stack([_lag_sums(r, t, step, count) for r, t in passages])
    products, pairs = sums.sum(axis=0)
    fitted = _fit_correlation(products, pairs, step, model)
    spread = (np.nan, np.nan)
    if len(passages) >= 3:
        left = [_fit_correlation(one[0], one[1], step, model) for one in sums.sum(axis=0) - sums]
        values = np.array([(e.std_deg, e.correlation_s) for e in left])
        spread = tuple(np.sqrt((len(left) - 1) * values.var(axis=0)))
    lag = np.arange(count) * step
    return CorrelationEstimate(
        fitted, float(spread[0]), float(spread[1]), lag, products / np.maximum(pairs, 1), pairs
    )


def _passages(
    residuals: np.ndarray | Sequence[np.ndarray], times: np.ndarray | Sequence[np.ndarray], gate_deg: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    if np.ndim(residuals[0]) == 0:
        residuals, times = [np.asarray(residuals)], [np.asarray(times)]
    if len(residuals) != len(times):
        raise LayoutError(
            f"one array of times per passage is needed, found {len(times)} for {len(residuals)}"
        )
    passages = []
    for number, (residual, time) in enumerate(zip(residuals, times, strict=True)):
        residual, time = wrap180(np.asarray(residual, float)), np.asarray(time, float)
        if residual.shape != time.shape or residual.ndim != 1:
            raise LayoutError(
                f"passage {number}: residuals {residual.shape} and times {time.shape} must be equal 1-D"
            )
        with np.errstate(invalid="ignore"):
            keep = np.isfinite(time) & (np.abs(residual) <= gate_deg)
        order = np.argsort(time[keep], kind="stable")
        if keep.sum() >= 2:
            passages.append((residual[keep][order], time[keep][order]))
    found = sum(len(residual) for residual, _ in passages)
    if found < 8:
        raise LayoutError(
            f"the correlation of errors needs 8 bearings within {gate_deg:g}° of the truth, found {found}"
        )
    return passages


def _lag_sums(residual: np.ndarray, time: np.ndarray, step: float, count: int) -> np.ndarray:
    first, second = np.triu_indices(len(time))
    bins = np.rint((time[second] - time[first]) / step).astype(int)
    use = bins < count
    products = np.bincount(bins[use], (residual[first] * residual[second])[use], minlength=count)
    return np.stack([products, np.bincount(bins[use], minlength=count)])


def _fit_correlation(products: np.ndarray, pairs: np.ndarray, step: float, model: str) -> BearingErrors:
    weight = np.sqrt(pairs)
    target = np.where(pairs > 0, products / np.maximum(pairs, 1), 0.0) * weight
    lag = np.arange(len(pairs)) * step

    def solve(log_interval: float) -> tuple[float, np.ndarray]:
        rho = correlation(lag, float(np.exp(log_interval)), model)
        parts, misfit = nnls(np.stack([lag == 0, rho], axis=1) * weight[:, None], target)
        return misfit, parts

    grid = np.log(np.geomspace(step / 2, 4 * lag[-1], 80))
    best = int(np.argmin([solve(value)[0] for value in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    log_interval = float(minimize_scalar(lambda value: solve(value)[0], bounds=bounds, method="bounded").x)
    white, coloured = solve(log_interval)[1]
    total = max(white + coloured, 1e-12)
    interval = float(np.exp(log_interval)) if coloured > 0 else 0.0
    if correlation(np.array([step]), interval, model)[0] <= 0:
        interval = 0.0
    least = 0.0 if model == "linear" else SMOOTH_NUGGET
    share = max(white / total, least) if interval > 0 else least
    return BearingErrors(float(np.sqrt(total)), interval, model, float(min(share, 1.0)))
