"""Spectra in, azigram out: direction of arrival of every time–frequency cell, and how far it can be trusted.

With a hydrophone the active intensity gives the azimuth over the full circle; without one the polarisation of the
horizontals gives it up to 180°, as a phasor of the doubled angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from obsnet.errors import ConfigError, LayoutError
from obsnet.layout import SPECTRA, require


@dataclass(frozen=True)
class AzigramConfig:
    """Frequency band [Hz], averaging in frames, and the estimator (`auto`: intensity where there is a hydrophone).

    Averages are of whole records: a run, which takes them block by block, has none.
    """

    fmin_hz: float = 11.0
    fmax_hz: float = 24.0
    average_frames: int = 1
    method: Literal["auto", "intensity", "polarisation"] = "auto"

    def __post_init__(self) -> None:
        if not 0.0 <= self.fmin_hz < self.fmax_hz:
            raise ConfigError(f"fmin_hz must lie below fmax_hz, found {self.fmin_hz} and {self.fmax_hz} Hz")
        if self.average_frames < 1 or self.average_frames % 2 == 0:
            raise ConfigError(f"average_frames must be odd and positive, found {self.average_frames}")


def azigram(spectra: xr.Dataset, config: AzigramConfig = AzigramConfig()) -> xr.DataArray:
    """Direction of arrival and its reliability, per time–frequency cell.

    Parameters
    ----------
    spectra : Dataset of p [Pa], east and north [m/s], complex64; dims (frequency, time). Positive pressure is
        compression, so the active intensity ½ Re(conj(P) V) points away from the ship.
    config : AzigramConfig

    Returns
    -------
    DataArray complex64, dims (frequency, time). Argument: azimuth from the station to the source, clockwise from north.
    Modulus: mean resultant length over `average_frames` frames (1 for one frame); NaN in gaps. With polarisation
    (`attrs["ambiguity_deg"] == 180`) the argument is **twice** the azimuth, which is known up to 180°.

    Raises
    ------
    LayoutError : the horizontals, or the hydrophone that the intensity needs, are missing.

    Source: Trabattoni et al. 2023, eqs (5)–(6), with the sign of methods for a hydrophone of positive polarity.
    """
    require(spectra, SPECTRA)
    missing = [name for name in ("east", "north") if name not in spectra]
    if missing:
        raise LayoutError(
            f"an azigram needs both horizontals; {' and '.join(missing)} missing from the spectra"
        )
    method = config.method
    if method == "auto":
        method = "intensity" if "p" in spectra else "polarisation"
    if method == "intensity" and "p" not in spectra:
        raise LayoutError(
            "the active intensity needs the hydrophone (p); use method 'polarisation' without one"
        )
    band = _band(spectra["frequency"].values, config)
    east, north = spectra["east"].values[band], spectra["north"].values[band]
    if method == "intensity":
        phasor = _intensity(spectra["p"].values[band], east, north)
    else:
        phasor = _polarisation(east, north)
    phasor = _average(phasor, config.average_frames)
    return xr.DataArray(
        phasor,
        dims=("frequency", "time"),
        coords={"frequency": spectra["frequency"].values[band], "time": spectra["time"].values},
        name="azigram",
        attrs={
            "long_name": "azimuth to the source as a phasor, modulus the mean resultant length",
            "units": "1",
            "method": method,
            "ambiguity_deg": 360 if method == "intensity" else 180,
        },
    )


def _band(frequency: np.ndarray, config: AzigramConfig) -> slice:
    lo = int(np.searchsorted(frequency, config.fmin_hz))
    hi = int(np.searchsorted(frequency, config.fmax_hz, side="right"))
    if hi <= lo:
        raise ConfigError(
            f"no spectral bin between {config.fmin_hz} and {config.fmax_hz} Hz; "
            f"the spectra reach from {frequency[0]:g} to {frequency[-1]:g} Hz"
        )
    return slice(lo, hi)


def _intensity(p: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    toward_north = -(p.real * north.real + p.imag * north.imag)
    toward_east = -(p.real * east.real + p.imag * east.imag)
    return _unit(toward_north, toward_east)


def _polarisation(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Phasor of twice the azimuth of the major axis of the horizontal particle motion."""
    difference = north.real**2 + north.imag**2 - east.real**2 - east.imag**2
    cross = 2.0 * (north.real * east.real + north.imag * east.imag)
    return _unit(difference, cross)


def _unit(real: np.ndarray, imag: np.ndarray) -> np.ndarray:
    """Phasor of modulus 1; NaN where neither component carries a direction."""
    scale = np.maximum(np.abs(real), np.abs(imag))
    with np.errstate(invalid="ignore", divide="ignore"):
        real, imag = real / scale, imag / scale
        modulus = np.sqrt(real * real + imag * imag)
        return (real / modulus + 1j * (imag / modulus)).astype(np.complex64)


def _average(phasor: np.ndarray, frames: int) -> np.ndarray:
    """Centred mean over the frames that are there; NaN only where the centre frame itself is a gap."""
    if frames == 1:
        return phasor
    there = ~np.isnan(phasor)
    padded = np.pad(np.where(there, phasor, 0), ((0, 0), (frames // 2, frames // 2)))
    counts = np.pad(there, ((0, 0), (frames // 2, frames // 2)))
    window = np.lib.stride_tricks.sliding_window_view
    total = window(padded, frames, axis=1).sum(-1)
    count = window(counts, frames, axis=1).sum(-1)
    mean = total / np.maximum(count, 1)
    return np.where(there, mean, np.nan).astype(np.complex64)
