"""Spectra in, cepstrogram out: the delays between the paths by which the ship's noise arrives.

Echoes appear as ridges that drift with the ship; the ship's own harmonics and the instrument stay put. The clutter filter
removes what stays put. Its output at a time depends on the window before that time alone, never on where a chunk or a
file begins, so that a live station and a batch run agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import SPECTRA, require, to_posix


@dataclass(frozen=True)
class CepstrogramConfig:
    """Clutter filter: kind, length of the window it learns from, and how often it learns anew (seconds)."""

    clutter: Literal["svd", "mean", "none"] = "svd"
    clutter_window_s: float = 10800.0
    clutter_step_s: float = 600.0

    def __post_init__(self) -> None:
        if not 0.0 < self.clutter_step_s <= self.clutter_window_s:
            raise ConfigError(
                "clutter_step_s must be positive and at most clutter_window_s, found "
                f"{self.clutter_step_s} and {self.clutter_window_s} s"
            )


def cepstrogram(spectra: xr.Dataset) -> xr.DataArray:
    """Real cepstrum of every frame of the hydrophone, before any clutter filter.

    Parameters
    ----------
    spectra : Dataset with p [Pa], dims (frequency, time), frequencies from 0 to Nyquist.

    Returns
    -------
    DataArray float32, dims (quefrency [s], time), non-negative quefrencies up to half the frame; NaN in gaps.

    Source: Trabattoni et al. 2023, eq. (14): inverse real FFT of log|S|.
    """
    require(spectra, SPECTRA)
    if "p" not in spectra:
        raise LayoutError("a cepstrogram needs the hydrophone (p), which is missing from the spectra")
    frequency = spectra["frequency"].values
    modulus = np.abs(spectra["p"].values.T)
    # The windowed mean is removed from every frame: its empty bin would put a constant into every quefrency.
    modulus[:, 0] = modulus[:, 1]
    floor = np.finfo(np.float32).tiny
    log_modulus = np.log(np.maximum(modulus, floor))
    nfft = 2 * (frequency.size - 1)
    cepstrum = np.fft.irfft(log_modulus, n=nfft, axis=1)[:, : nfft // 2 + 1]
    step = 1.0 / (2.0 * frequency[-1])
    return xr.DataArray(
        np.ascontiguousarray(cepstrum.T, dtype=np.float32),
        dims=("quefrency", "time"),
        coords={"quefrency": step * np.arange(nfft // 2 + 1), "time": spectra["time"].values},
        name="cepstrogram",
        attrs={"long_name": "real cepstrum of the pressure", "units": "1", "nfft": nfft},
    )


def noise_std(quefrency_s: np.ndarray, nfft: int) -> np.ndarray:
    """Standard deviation of the cepstrum of noise under a Hann window (paper's eq. 15).

    >>> float(noise_std(np.array([0.0, 10.24]), 1024)[1])
    0.01328125
    """
    quefrency = np.asarray(quefrency_s, float)
    return (0.625 + 0.2 * np.cos(np.pi * quefrency / quefrency[-1])) / np.sqrt(nfft)


class ClutterFilter:
    """Removes from each cepstrum what was the same over the window before it.

    Every `clutter_step_s` (on UTC multiples) the filter learns a basis from the valid frames of the `clutter_window_s`
    before; the frames until the next such instant are projected off it. Until a station has heard `WARM_UP_FRAMES` frames
    in that window, the mean of those that it has heard is subtracted instead, and the difference scaled to the spread of
    a single frame's noise; only its first frame is NaN.

    Parameters
    ----------
    config : CepstrogramConfig

    Notes
    -----
    Source: Trabattoni et al. 2023, appendix A, singular values before the knee set to zero. Removing the leading left
    singular vectors of a window from a frame is the same projection; learning it from the past makes it causal.
    The eigenvectors of the Gram matrix over quefrency replace the full SVD.
    """

    WARM_UP_FRAMES = 30

    def __init__(self, config: CepstrogramConfig = CepstrogramConfig()) -> None:
        self.config = config
        self._frames: dict[int, np.ndarray] = {}
        self._held = _Moment(0, np.zeros(()))
        self._learned: np.ndarray | None = None
        self._learned_step: int | None = None
        self._early = _Moment(0, np.zeros(()))

    def __call__(self, cepstra: xr.DataArray) -> xr.DataArray:
        """Filter the next block of frames, dims (quefrency, time); blocks must come in time order."""
        if self.config.clutter == "none":
            return cepstra
        values = np.ascontiguousarray(cepstra.values.T)
        steps = np.floor(to_posix(cepstra["time"].values) / self.config.clutter_step_s).astype(np.int64)
        filtered = np.full_like(values, np.nan)
        done = 0
        while done < len(steps):
            step = int(steps[done])
            if self._is_due(step):
                self._learn(step)
            end = self._next_instant(steps, values, done)
            filtered[done:end] = self._project(values[done:end])
            self._remember(step, values[done:end])
            done = end
        return cepstra.copy(data=np.ascontiguousarray(filtered.T))

    def state(self) -> dict[str, np.ndarray]:
        """All that the next frame depends on, as arrays that are never changed in place."""
        arrays = {f"frames/{step}": frames for step, frames in self._frames.items()}
        arrays["held"], arrays["held_count"] = self._held.moment, np.array(self._held.count)
        arrays["early"], arrays["early_count"] = self._early.moment, np.array(self._early.count)
        if self._learned is not None:
            arrays["learned"] = self._learned
        if self._learned_step is not None:
            arrays["learned_step"] = np.array(self._learned_step)
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        kept = sorted(int(name.removeprefix("frames/")) for name in state if name.startswith("frames/"))
        self._frames = {step: state[f"frames/{step}"] for step in kept}
        self._held = _Moment(int(state["held_count"]), state["held"])
        self._early = _Moment(int(state["early_count"]), state["early"])
        self._learned = state.get("learned")
        self._learned_step = int(state["learned_step"]) if "learned_step" in state else None

    def _is_due(self, step: int) -> bool:
        if self._learned is None:
            return self._held.count >= self.WARM_UP_FRAMES
        return step != self._learned_step

    def _next_instant(self, steps: np.ndarray, values: np.ndarray, done: int) -> int:
        """First frame after `done` before which the filter must look whether to learn anew."""
        end = int(np.searchsorted(steps, steps[done], side="right"))
        if self._learned is None:
            valid = np.cumsum(~np.isnan(values[done:end, 0])) + self._held.count
            end = min(end, done + 1 + int(np.searchsorted(valid, self.WARM_UP_FRAMES)))
        return max(end, done + 1)

    def _learn(self, step: int) -> None:
        oldest = step - round(self.config.clutter_window_s / self.config.clutter_step_s)
        for key in [key for key in self._frames if key < oldest]:
            self._held = self._held - self._moment(self._frames.pop(key))
        count = self._held.count
        self._learned_step = step
        if count < self.WARM_UP_FRAMES:
            self._learned, self._early = None, _Moment(0, np.zeros(()))
        elif self.config.clutter == "svd":
            self._learned = leading_basis(self._held.moment, count)
        else:
            self._learned = self._held.moment / count

    def _project(self, frames: np.ndarray) -> np.ndarray:
        learned = self._learned
        if learned is None:
            return self._off_early_mean(frames)
        if self.config.clutter == "svd":
            return frames - (frames @ learned) @ learned.T
        return frames - learned.astype(frames.dtype)

    def _off_early_mean(self, frames: np.ndarray) -> np.ndarray:
        valid = ~np.isnan(frames[:, 0])
        heard = np.where(valid[:, None], frames, 0.0).astype(float)
        before = np.broadcast_to(self._early.moment, (1, frames.shape[1]))
        total = np.cumsum(np.concatenate([before, heard]), axis=0)
        count = self._early.count + np.concatenate([[0], np.cumsum(valid)])
        self._early = _Moment(int(count[-1]), total[-1])
        number = count[:-1, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            off = (frames - total[:-1] / number) * np.sqrt(number / (number + 1.0))
        return off.astype(frames.dtype)

    def _remember(self, step: int, frames: np.ndarray) -> None:
        valid = frames[~np.isnan(frames[:, 0])]
        if not len(valid):
            return
        held = self._frames.get(step)
        self._frames[step] = valid if held is None else np.concatenate([held, valid])
        self._held = self._held + self._moment(valid)

    def _moment(self, frames: np.ndarray) -> _Moment:
        exact = frames.astype(float)
        return _Moment(len(exact), exact.T @ exact if self.config.clutter == "svd" else exact.sum(axis=0))


@dataclass(frozen=True)
class _Moment:
    """How many frames, and their Gram matrix over quefrency (or their sum)."""

    count: int
    moment: np.ndarray

    def __add__(self, other: _Moment) -> _Moment:
        return _Moment(self.count + other.count, self.moment + other.moment)

    def __sub__(self, other: _Moment) -> _Moment:
        return _Moment(self.count - other.count, self.moment - other.moment)


def leading_basis(gram: np.ndarray, count: int, guess: int = 16) -> np.ndarray:
    """Orthonormal vectors over quefrency before the knee of the singular values.

    Parameters
    ----------
    gram : array (n_quefrency, n_quefrency), Gram matrix of `count` frames.
    guess : how many singular values to look for the knee among at first; doubled until the knee lies inside.

    Returns
    -------
    array float32 (n_quefrency, n_kept): the singular vectors whose singular values come before the knee.
    """
    total = min(len(gram), count)
    while True:
        size = min(guess, total)
        values, vectors = _leading_eigenpairs(gram, size)
        keep = knee(np.sqrt(np.maximum(values, 0.0)), total)
        if keep < size // 2 or size == total:
            return np.ascontiguousarray(vectors[:, :keep], dtype=np.float32)
        guess *= 2


def _leading_eigenpairs(matrix: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest eigenvalues, decreasing, and their vectors, by subspace iteration from a fixed start."""
    if 2 * size >= len(matrix):
        values, vectors = np.linalg.eigh(matrix)
        return values[::-1][:size], vectors[:, ::-1][:, :size]
    single = matrix.astype(np.float32)
    basis = np.random.default_rng(0).standard_normal((len(matrix), size + 8), np.float32)
    for _ in range(4):
        basis, _ = np.linalg.qr(single @ (single @ basis))
    basis = basis.astype(matrix.dtype)
    values, turn = np.linalg.eigh(basis.T @ matrix @ basis)
    return values[::-1][:size], (basis @ turn)[:, ::-1][:, :size]


def knee(decreasing: np.ndarray, total: int | None = None) -> int:
    """Index of the knee of a decreasing curve, normalised on both axes (kneedle, Satopaa et al. 2011).

    `total` is the length of the whole curve where only its beginning is given.

    >>> knee(np.array([10.0, 1.0, 0.9, 0.8, 0.7, 0.6]))
    1
    """
    y = decreasing / decreasing[0] if decreasing[0] > 0 else decreasing
    x = np.arange(len(decreasing)) / max((total or len(decreasing)) - 1, 1)
    return int(np.argmax(1.0 - y - x))
