"""The hand-built detectors of Trabattoni et al. 2023: wrapped Cauchy in azimuth, Gaussian cepstrum in range.

Azigram or cepstrogram in, natural-log likelihood ratios against no ship out. Two things are added to the paper's, both
optional: a null density that knows the direction of the background noise, and cepstral scores that never read beyond
their grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from obsnet.detectors import kernels
from obsnet.detectors.maps import coverage, hop, range_axis, range_rate_axis, window_bounds
from obsnet.detectors.matched_filters import MatchedFilters
from obsnet.errors import ConfigError
from obsnet.layout import AZIGRAM, CEPSTROGRAM, from_posix, require, to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import parse_pair, phase_difference, tdoa

EXPONENT_LIMIT = 690.0
"""Largest log that a float64 product can hold."""

MOST_CELLS = 2e6
"""Cells of range and closing range rate that a minute may have; the default has 2e4."""

_WINDOWS = 2
"""Windows stacked at once: what fits a core's cache."""

UNHEARD = 1e-3
"""Cepstral amplitude, a tenth of the noise of a 1024-sample frame, below which a pair counts as silent."""


def _check_windows(window_s: float, step_s: float) -> None:
    if step_s <= 0 or window_s < step_s or abs(window_s / step_s - round(window_s / step_s)) > 1e-9:
        raise ConfigError(f"window_s must be a whole number of step_s, found {window_s} and {step_s} s")


@dataclass(frozen=True)
class AzimuthDetectorConfig:
    """Wrapped-Cauchy azimuth detector.

    `mean_resultant_length` is the focus expected of a ship (0.99: +40 dB, appendix B); `impulsive` suits whales and other
    short broadband sources. `null` is the density of cells without a ship: `uniform` as in the paper, or `directional`,
    a wrapped Cauchy around the mean direction of each frequency over `background_window_s` before, of which what has been heard
    for `background_prior_s` counts half.
    """

    window_s: float = 180.0
    step_s: float = 60.0
    azimuth_step_deg: float = 1.0
    mean_resultant_length: float = 0.99
    mode: Literal["tonal", "impulsive"] = "tonal"
    detection_probability: float = 0.9
    frequency_overlap_exponent: float = 0.5
    null: Literal["uniform", "directional"] = "directional"
    background_window_s: float = 21600.0
    background_step_s: float = 600.0
    background_prior_s: float = 3600.0

    def __post_init__(self) -> None:
        _check_windows(self.window_s, self.step_s)
        if not 0.0 < self.mean_resultant_length < 1.0:
            raise ConfigError(f"mean_resultant_length must lie in (0, 1), found {self.mean_resultant_length}")
        step = self.azimuth_step_deg
        # azimuths known up to 180° alone are told by opposite cells that say the same
        if not 0.01 <= step <= 90.0 or abs(180.0 / step - round(180.0 / step)) > 1e-9:
            raise ConfigError(f"azimuth_step_deg must divide 180 and lie between 0.01 and 90, found {step}")
        if not 0.0 < self.detection_probability < 1.0:
            raise ConfigError(f"detection_probability must lie in (0, 1), found {self.detection_probability}")
        if not 0.0 < self.background_step_s <= self.background_window_s:
            raise ConfigError(
                "background_step_s must be positive and at most background_window_s, found "
                f"{self.background_step_s} and {self.background_window_s} s"
            )
        if not self.background_prior_s >= 0.0:
            raise ConfigError(f"background_prior_s must not be negative, found {self.background_prior_s}")

    @property
    def azimuth(self) -> np.ndarray:
        """Azimuth grid [deg], from 0 up to but without 360."""
        return np.arange(round(360.0 / self.azimuth_step_deg)) * self.azimuth_step_deg


@dataclass(frozen=True)
class RangeDetectorConfig:
    """Gaussian cepstral range detector: grids, path pairs, and the shape of a cepstral pulse.

    `centre_frequency_hz` is 15 in the paper's text and 16.5 in its scripts; `pulse` is exp(−x²/2Δτ²) in the text and
    exp(−x²/Δτ²) in the scripts. Over half a window a step of range rate moves a ship by less than a step of range;
    every third rate is one that the learned detector looks at.
    """

    window_s: float = 180.0
    step_s: float = 60.0
    range_step_m: float = 70.0
    max_range_m: float = 50_000.0
    range_rate_step_mps: float = 2 / 3
    max_range_rate_mps: float = 13.0
    wander_bins: float = 2.0
    centre_frequency_hz: float = 15.0
    pulse_width_s: float = 0.05
    pulse: Literal["text", "scripts"] = "text"
    pairs: tuple[str, ...] = ("1-3", "3-5", "5-7", "7-9", "9-11")

    def __post_init__(self) -> None:
        _check_windows(self.window_s, self.step_s)
        for name in (
            "range_step_m",
            "max_range_m",
            "range_rate_step_mps",
            "max_range_rate_mps",
            "pulse_width_s",
        ):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        if self.wander_bins < 0:
            raise ConfigError(f"wander_bins must not be negative, found {self.wander_bins}")
        if not self.pairs:
            raise ConfigError("pairs must name one path pair at least, such as '1-3'")
        for pair in self.pairs:
            parse_pair(pair)
        cells = self.max_range_m / self.range_step_m * self.max_range_rate_mps / self.range_rate_step_mps
        if not cells <= MOST_CELLS:
            raise ConfigError(
                f"range_step_m and range_rate_step_mps make a grid of {2 * cells:.0e} cells; make them coarser"
            )

    @property
    def range_m(self) -> np.ndarray:
        """Range grid [m], from 0."""
        return range_axis(self.max_range_m, self.range_step_m)

    @property
    def range_rate(self) -> np.ndarray:
        """Range rate grid [m/s], symmetric about 0."""
        return range_rate_axis(self.max_range_rate_mps, self.range_rate_step_mps)


class AnalyticAzimuthDetector:
    """Wrapped-Cauchy likelihood ratio of a ship's azimuth (paper's eqs 7–13).

    The directional null is learned from the past alone, so that any split of a record gives the same maps: instances
    hold that past and take blocks in time order, each block's frames once as `new_frames`.
    """

    name = "analytic"

    def __init__(self, config: AzimuthDetectorConfig = AzimuthDetectorConfig()) -> None:
        self.config = config
        self.window_s = config.window_s

    def maps(
        self, azigram: xr.DataArray, minutes: np.ndarray, background: np.ndarray | None = None
    ) -> xr.Dataset:
        """Log-likelihood ratio against azimuth and its coverage at `minutes`.

        Parameters
        ----------
        azigram : DataArray complex64 (frequency, time), from `obsnet.signals.azigram`.
        minutes : s since 1970, consecutive multiples of `step_s`.
        background : complex array like `azigram`, mean phasor of the noise at each cell (modulus its concentration);
            none for the paper's uniform null.

        Returns
        -------
        Dataset of azimuth_llr (time, azimuth) float32, azimuth_coverage (time) float32.
        """
        require(azigram, AZIGRAM)
        config = self.config
        times = to_posix(azigram["time"].values)
        hop_s = hop(times)
        if config.mode == "tonal":
            _check_product(config, hop_s)
        fold = 360 // int(azigram.attrs.get("ambiguity_deg", 360))
        angle = np.deg2rad(config.azimuth) * fold
        real, imag = np.ascontiguousarray(azigram.values.real), np.ascontiguousarray(azigram.values.imag)
        null = null_density(azigram.values, background)
        start, stop = window_bounds(times, minutes, config.window_s)
        if config.mode == "tonal":
            llr = self._tonal(real, imag, null, times, minutes, angle)
        else:
            said = kernels.impulsive(
                real, imag, null, angle, config.mean_resultant_length, config.frequency_overlap_exponent,
                config.detection_probability,
            )  # fmt: skip
            before = np.concatenate([np.zeros((1, len(angle))), np.cumsum(said, axis=0)])
            llr = before[stop] - before[start]
        covered = coverage(~np.isnan(real).all(axis=0), times, minutes, config.window_s)
        llr[covered == 0] = np.nan
        return azimuth_maps(llr, covered, minutes, config.azimuth, 360 // fold)

    def _tonal(
        self,
        real: np.ndarray,
        imag: np.ndarray,
        null: np.ndarray,
        times: np.ndarray,
        minutes: np.ndarray,
        angle: np.ndarray,
    ) -> np.ndarray:
        config = self.config
        per_window = round(config.window_s / config.step_s)
        block_edges = minutes[0] - config.window_s / 2 + config.step_s * np.arange(len(minutes) + per_window)
        edges = np.searchsorted(times, block_edges - 1e-6)
        total = kernels.tonal(real, imag, null, edges, per_window, angle, config.mean_resultant_length)
        return np.log(total / real.shape[0])


class AnalyticRangeDetector:
    """Gaussian cepstral likelihood ratio of a ship's range and range rate (paper's eqs 15–23)."""

    name = "analytic"

    def __init__(
        self,
        propagation: xr.Dataset,
        amplitudes: Amplitudes,
        config: RangeDetectorConfig = RangeDetectorConfig(),
    ) -> None:
        self.config = config
        self.window_s = config.window_s
        self._propagation = propagation
        self._amplitudes = amplitudes
        self._bank: MatchedFilters | None = None

    def maps(self, cepstrogram: xr.DataArray, minutes: np.ndarray) -> xr.Dataset:
        """Log-likelihood ratio against range and range rate, and its coverage, at `minutes`.

        Parameters
        ----------
        cepstrogram : DataArray float32 (quefrency, time), clutter removed.
        minutes : s since 1970.

        Returns
        -------
        Dataset of range_llr (time, range, range_rate) float32, range_coverage (time) float32.
        """
        require(cepstrogram, CEPSTROGRAM)
        config = self.config
        times = to_posix(cepstrogram["time"].values)
        frames = cepstrogram.values.T
        valid = ~np.isnan(frames[:, 0])
        bank = self._filters(cepstrogram)
        scores = bank.scores(np.where(valid[:, None], frames, 0.0), valid)
        start, stop = window_bounds(times, minutes, config.window_s)
        llr = np.empty((len(minutes), len(config.range_m), len(config.range_rate)), np.float32)
        for lo in range(0, len(minutes), _WINDOWS):
            part = slice(lo, lo + _WINDOWS)
            beam = kernels.slant_stack(
                scores, bank.margin, start[part], stop[part], times, minutes[part], config.range_step_m, config.range_rate
            )  # fmt: skip
            llr[part] = bank.wandering(beam).transpose(0, 2, 1)
        covered = coverage(valid, times, minutes, config.window_s)
        llr[covered == 0] = np.nan
        return range_maps(llr, covered, minutes, config.range_m, config.range_rate)

    def _filters(self, cepstrogram: xr.DataArray) -> MatchedFilters:
        quefrency = cepstrogram["quefrency"].values
        if self._bank is None or not np.array_equal(quefrency, self._bank.quefrency):
            nfft = int(cepstrogram.attrs.get("nfft", 2 * (len(quefrency) - 1)))
            pulses = _pulses(quefrency, self._propagation, self._amplitudes, self.config)
            self._bank = MatchedFilters(quefrency, nfft, pulses, self.config)
        return self._bank


def cepstral_model(
    quefrency_s: np.ndarray,
    propagation: xr.Dataset,
    amplitudes: Amplitudes,
    config: RangeDetectorConfig = RangeDetectorConfig(),
) -> np.ndarray:
    """Expected cepstrum of each path pair at each range (paper's eq. 17).

    Parameters
    ----------
    quefrency_s : array (n_quefrency), s.
    propagation : Dataset of `obsnet.ocean.rays.propagation`.
    amplitudes : strength of each pair against range.

    Returns
    -------
    array (n_pairs, n_range, n_quefrency); zero where a path does not exist, a pair has no amplitude, and
    beyond four pulse widths.

    Notes
    -----
    a cos(2π f0 (τ − τ_ij) + Δφ) exp(−(τ − τ_ij)²/2Δτ²) with Δφ = arg A_j − arg A_i for fields exp(+iωt): the path ratio
    (A_j/A_i) exp(−iωτ_ij) enters log|1 + …| as its real part, whose inverse transform has its pulse at +τ_ij, and
    ∫ S(f) cos(ωτ_ij − Δφ) cos(ωτ) df over a band around f0 is an envelope times cos(2π f0 (τ − τ_ij) + Δφ).
    """
    return np.stack(list(_pulses(np.asarray(quefrency_s, float), propagation, amplitudes, config)))


def _pulses(
    quefrency_s: np.ndarray, propagation: xr.Dataset, amplitudes: Amplitudes, config: RangeDetectorConfig
) -> Iterator[np.ndarray]:
    """Expected cepstrum of one pair after the other, as of `cepstral_model`: (n_range, n_quefrency)."""
    if not set(config.pairs) & set(amplitudes.pairs):
        known = ", ".join(amplitudes.pairs)
        raise ConfigError(f"no amplitude is known of the pairs {', '.join(config.pairs)}; known are {known}")
    range_m = config.range_m
    factor = 2.0 if config.pulse == "text" else 1.0
    for pair in config.pairs:
        model = np.zeros((len(range_m), len(quefrency_s)))
        if pair in amplitudes.pairs:
            delay = _interp(tdoa(propagation, pair), range_m)
            phase = _interp_phase(phase_difference(propagation, pair), range_m)
            amplitude = amplitudes.evaluate(pair, range_m)
            amplitude[~(amplitude >= UNHEARD)] = 0.0
            row, column = np.nonzero(np.abs(quefrency_s - delay[:, None]) <= 4 * config.pulse_width_s)
            lag = quefrency_s[column] - delay[row]
            pulse = np.cos(2 * np.pi * config.centre_frequency_hz * lag + phase[row])
            pulse *= amplitude[row] * np.exp(-(lag**2) / (factor * config.pulse_width_s**2))
            model[row, column] = np.nan_to_num(pulse)
        yield model


def null_density(phasor: np.ndarray, background: np.ndarray | None, cap: float = 0.95) -> np.ndarray:
    """Null density of each cell over the uniform one: wrapped Cauchy around the background's mean phasor.

    The concentration is capped so that a calm, focused background cannot veto a ship.
    """
    if background is None:
        return np.ones(phasor.shape, np.float32)
    modulus = np.minimum(np.abs(background), cap)
    with np.errstate(invalid="ignore"):
        aligned = np.cos(np.angle(phasor) - np.angle(background))
    return (1.0 - modulus**2) / (1.0 - 2.0 * modulus * aligned + modulus**2)


def azimuth_maps(
    llr: np.ndarray, covered: np.ndarray, minutes: np.ndarray, azimuth: np.ndarray, ambiguity_deg: int = 360
) -> xr.Dataset:
    """Label an azimuth log-likelihood ratio (time, azimuth), known up to `ambiguity_deg`, as likelihood maps."""
    attrs = {"units": "degree", "ambiguity_deg": ambiguity_deg}
    return xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), llr.astype(np.float32), _LLR),
            "azimuth_coverage": ("time", covered, {"units": "1"}),
        },
        coords={"time": from_posix(minutes), "azimuth": ("azimuth", azimuth, attrs)},
    )


def range_maps(
    llr: np.ndarray, covered: np.ndarray, minutes: np.ndarray, range_m: np.ndarray, range_rate: np.ndarray
) -> xr.Dataset:
    """Label a range log-likelihood ratio (time, range, range_rate) as likelihood maps."""
    return xr.Dataset(
        {
            "range_llr": (("time", "range", "range_rate"), llr, _LLR),
            "range_coverage": ("time", covered, {"units": "1"}),
        },
        coords={
            "time": from_posix(minutes),
            "range": ("range", range_m, {"units": "m"}),
            "range_rate": ("range_rate", range_rate, {"units": "m s-1"}),
        },
    )


_LLR = {"long_name": "natural log of the likelihood ratio, a ship here against no ship", "units": "1"}


def _interp(values: xr.DataArray, range_m: np.ndarray) -> np.ndarray:
    """Linear in range; NaN off the table."""
    return np.interp(range_m, values["range"].values, values.values, left=np.nan, right=np.nan)


def _interp_phase(phase_deg: xr.DataArray, range_m: np.ndarray) -> np.ndarray:
    """Phase [rad] at `range_m`, interpolated on the circle."""
    phasor = phase_deg.copy(data=np.exp(1j * np.deg2rad(phase_deg.values)))
    return np.angle(_interp(phasor, range_m))


def _check_product(config: AzimuthDetectorConfig, hop_s: float) -> None:
    concentration = config.mean_resultant_length
    largest = config.window_s / hop_s * np.log((1 + concentration) / (1 - concentration))
    if largest > EXPONENT_LIMIT:
        raise ConfigError(
            f"a window of {config.window_s:g} s holds {config.window_s / hop_s:.0f} frames of {concentration:g} mean resultant "
            "length, more than a product can hold; shorten the window or lower mean_resultant_length"
        )
