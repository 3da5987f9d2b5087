"""Samples of an array in, an azimuth map out: the form in which any tracker takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.special import logsumexp

from obsnet.arrays.beamforming import Beamformer
from obsnet.arrays.likelihood import GAUSSIAN, beam_llr
from obsnet.arrays.whitening import NoiseModel, Whitener
from obsnet.errors import ConfigError, WaveformError
from obsnet.layout import from_posix


@dataclass(frozen=True)
class BeamMapConfig:
    """How batches become rows of a map.

    Attributes
    ----------
    window_s : length of a row, s; a source should stay within a beam for as long.
    snr_db : SNRs after whitening between which the source's is not known, dB.
    degrees_of_freedom : of the noise, ν > 2; infinite for Gaussian noise.
    """

    window_s: float = 10.0
    snr_db: tuple[float, ...] = (-24.0, -20.0, -16.0, -12.0, -8.0, -4.0, 0.0, 4.0)
    degrees_of_freedom: float = GAUSSIAN

    def __post_init__(self) -> None:
        if not self.window_s > 0 or not self.snr_db or not self.degrees_of_freedom > 2:
            raise ConfigError(
                "a beam map needs a positive window, an SNR and more than 2 degrees of freedom, found "
                f"{self.window_s!r}, {self.snr_db!r}, {self.degrees_of_freedom!r}"
            )


def azimuth_map(
    samples: np.ndarray,
    start_s: float,
    beamformer: Beamformer,
    noise: NoiseModel,
    config: BeamMapConfig | None = None,
) -> xr.Dataset:
    """Log-likelihood ratio of a broadband source at each azimuth against noise alone.

    Per row, ln L(ψ) is the log of the mean over SNRs of the product over batches of the track-before-detect
    ratio (`obsnet.arrays.likelihood`): the source keeps its azimuth and SNR through the window.

    Parameters
    ----------
    samples : array, dims (time, hydrophone); NaN where missing
    start_s : time of the first sample, s since 1970
    beamformer : its grid is the map's
    noise : fitted to target-free samples, whitens the rest
    config : BeamMapConfig, optional

    Returns ------- LikelihoodMaps: Dataset with ``azimuth_llr`` (time, azimuth) float32, natural log, NaN
    where every batch of a window is missing, and ``azimuth_coverage`` (time), the share of its batches that
    are there.

    Raises
    ------
    WaveformError
        Samples do not have the beamformer's hydrophones or do not fill one window.
    """
    config = config or BeamMapConfig()
    samples = np.asarray(samples, float)
    if samples.ndim != 2 or samples.shape[1] != beamformer.array.count:
        raise WaveformError(f"samples must have dims (time, {beamformer.array.count}), found {samples.shape}")
    interval = beamformer.nperseg / beamformer.sampling_rate
    per_row = max(round(config.window_s / interval), 1)
    rows = len(samples) // (beamformer.nperseg * per_row)
    if rows == 0:
        raise WaveformError(f"{len(samples)} samples do not fill one window of {config.window_s:g} s")
    white = _whitened(samples[: rows * per_row * beamformer.nperseg], noise)
    batches = white.reshape(rows * per_row, beamformer.nperseg, -1)
    there = np.isfinite(batches).all(axis=(1, 2))
    total = _window_sums(np.where(there[:, None, None], batches, 0.0), there, rows, beamformer, config)
    coverage = there.reshape(rows, per_row).mean(axis=1)
    total[coverage == 0] = np.nan
    centre = start_s + (np.arange(rows) + 0.5) * per_row * interval
    dataset = xr.Dataset(
        {
            "azimuth_llr": (("time", "azimuth"), total.astype(np.float32), {"units": "1"}),
            "azimuth_coverage": ("time", coverage.astype(np.float32), {"units": "1"}),
        },
        coords={"time": from_posix(centre), "azimuth": beamformer.azimuth_deg},
    )
    dataset["azimuth"].attrs["units"] = "degrees"
    return dataset


def _window_sums(
    batches: np.ndarray, there: np.ndarray, rows: int, beamformer: Beamformer, config: BeamMapConfig
) -> np.ndarray:
    power = beamformer.power(batches)
    energy = (batches**2).sum(axis=(1, 2))[:, None]
    size = (beamformer.nperseg, beamformer.array.count, config.degrees_of_freedom)
    sums = []
    for snr in config.snr_db:
        llr = np.where(there[:, None], beam_llr(power, energy, snr, *size), 0.0)
        sums.append(llr.reshape(rows, -1, llr.shape[1]).sum(axis=1))
    return np.asarray(logsumexp(sums, axis=0)) - np.log(len(config.snr_db))


def _whitened(samples: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """Each stretch between gaps by itself; its first samples, for want of a past, are missing too."""
    white = np.full(samples.shape, np.nan)
    missing = ~np.isfinite(samples).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], missing, [True]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        white[start:stop] = Whitener(noise)(samples[start:stop])
        white[start : min(start + noise.order, stop)] = np.nan
    return white
