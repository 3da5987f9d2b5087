"""The panels that pictures are made of: representations and likelihood maps against time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.image import AxesImage

from obsnet.ocean.rays import tdoa
from obsnet.plots import style
from obsnet.plots.columns import Columns, azimuth_columns, range_columns
from obsnet.run import Run
from obsnet.strips import DENSITIES, HANN_NOISE_BINS

NO_AZIMUTH = "no two horizontals: no azimuth"
NO_RANGE = "no hydrophone: no range"


def spectrogram(ax: Axes, run: Run, columns: Columns, bar: bool = True) -> None:
    """Power spectral density of the pressure, or of the ground's motion without a hydrophone."""
    power = run.features.get("power")
    if power is None:
        without(ax, "frequency [Hz]", "no spectrogram")
        return
    bandwidth = HANN_NOISE_BINS / run.config.spectra.window_s
    # The spectra give a tone its amplitude; its mean square is half the amplitude's.
    density = columns.mean(power) / (2.0 * bandwidth)
    offset, unit = DENSITIES.get(power.attrs.get("units", ""), (0.0, "dB"))
    level = 10.0 * np.log10(np.maximum(density, np.finfo(np.float32).tiny)) + offset
    frequency = power["spectrogram_frequency"].values
    low, high = np.percentile(_finite(level[:, frequency >= 4.0]), [2, 99.7])
    picture = image(ax, level, columns, frequency, style.SEQUENTIAL, low, high)
    style.y_axis(ax, "frequency [Hz]", frequency[0], frequency[-1])
    if bar:
        style.bar(ax, picture, unit)


def azigram(ax: Axes, run: Run, columns: Columns, bar: bool = True) -> None:
    """Azimuth of the sound in each cell of time and frequency, in cyclic colours."""
    phasor = run.features.get("azigram")
    if phasor is None:
        without(ax, "frequency [Hz]", NO_AZIMUTH)
        return
    azimuth = np.rad2deg(np.angle(columns.mean(phasor))) % 360.0
    frequency = phasor["frequency"].values
    picture = image(ax, azimuth, columns, frequency, style.CYCLIC, 0.0, 360.0)
    style.y_axis(ax, "frequency [Hz]", frequency[0], frequency[-1])
    if bar:
        style.bar(ax, picture, "azimuth")


def cepstrogram(ax: Axes, run: Run, columns: Columns, bar: bool = True) -> None:
    """Envelope of the cepstrum, up to the longest delay between the first two paths."""
    cepstra = run.features.get("cepstrogram")
    if cepstra is None:
        without(ax, "quefrency [s]", NO_RANGE)
        return
    part = cepstra.sel(quefrency=slice(0.0, longest_quefrency(run) + 0.5))
    quefrency = part["quefrency"].values
    level = np.sqrt(columns.mean(part, squared_envelope))
    low, high = np.percentile(_finite(level[:, quefrency > 0.5]), [20, 99.8])
    picture = image(ax, level, columns, quefrency, style.SEQUENTIAL, low, high)
    style.y_axis(ax, "quefrency [s]", 0.0, longest_quefrency(run))
    if bar:
        style.bar(ax, picture, "cepstrum")


def azimuth_map(ax: Axes, run: Run, columns: Columns, bar: bool = True) -> None:
    """Log-likelihood ratio of a ship at each azimuth."""
    style.azimuth_axis(ax)
    if "azimuth_llr" not in run.maps:
        style.say(ax, NO_AZIMUTH)
        return
    values = azimuth_columns(run.maps, columns, run.detections["azimuth_llr"].to_numpy(float))
    picture = image(ax, values, columns, run.maps["azimuth"].values, style.SEQUENTIAL, *_llr_limits(values))
    style.azimuth_axis(ax)
    if bar:
        style.bar(ax, picture, "log-likelihood ratio")


def range_map(ax: Axes, run: Run, columns: Columns, bar: bool = True) -> None:
    """Log-likelihood ratio of a ship at each range, range rate marginalised."""
    if "range_llr" not in run.maps:
        without(ax, "range [km]", NO_RANGE)
        return
    values = range_columns(run.maps, run.features, columns, run.detections["range_llr"].to_numpy(float))
    range_km = run.maps["range"].values / 1e3
    picture = image(ax, values, columns, range_km, style.SEQUENTIAL, *_llr_limits(values))
    style.y_axis(ax, "range [km]", 0.0, farthest_km(run))
    if bar:
        style.bar(ax, picture, "log-likelihood ratio")


def image(
    ax: Axes, values: np.ndarray, columns: Columns, axis: np.ndarray, cmap: str, low: float, high: float
) -> AxesImage:
    """Values (column, cell) against time and a regular axis; NaN stays white."""
    half = (axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5
    extent = (style.days(columns.start), style.days(columns.end), axis[0] - half, axis[-1] + half)
    norm = Normalize(low, high if high > low else low + 1.0)
    return ax.imshow(
        values.T, origin="lower", aspect="auto", extent=extent, cmap=cmap, norm=norm, interpolation="nearest"
    )  # fmt: skip


def squared_envelope(cepstra: np.ndarray) -> np.ndarray:
    """Squared modulus of the analytic signal along quefrency, of cepstra (minute, quefrency)."""
    analytic = analytic_signal(cepstra)
    return (analytic.real**2 + analytic.imag**2).astype(np.float32)


def analytic_signal(values: np.ndarray) -> np.ndarray:
    """Analytic signal along the last axis: positive frequencies doubled, negative ones left out.

    As scipy.signal.hilbert, which takes a quarter of a second to import.
    """
    count = values.shape[-1]
    spectrum = np.fft.fft(values, axis=-1)
    spectrum[..., 1 : (count + 1) // 2] *= 2.0
    spectrum[..., count // 2 + 1 :] = 0.0
    return np.fft.ifft(spectrum, axis=-1)


def farthest_km(run: Run) -> float:
    """Top of the range axes [km]."""
    farthest = run.maps["range"].values[-1] if "range" in run.maps else run.config.range.max_range_m
    return float(np.ceil(farthest / 100.0) / 10.0)


def longest_quefrency(run: Run) -> float:
    """Quefrency [s] up to which there is something to see: the delay between paths 1 and 3, and a little."""
    if not {1, 3} <= set(run.table["path"].values.tolist()):
        return 7.0
    delay = tdoa(run.table, "1-3").values
    return float(np.clip(1.08 * np.nanmax(delay, initial=0.0), 1.0, 10.0))


def _llr_limits(values: np.ndarray) -> tuple[float, float]:
    """Symmetric about 0, where the map says nothing."""
    high = float(np.clip(np.percentile(_finite(values), 99.8), 10.0, 60.0))
    return -high, high


def without(ax: Axes, label: str, text: str) -> None:
    """A panel that has nothing to show, and why."""
    ax.set_yticks([])
    ax.set_ylabel(label, fontsize=9)
    style.say(ax, text)


def _finite(values: np.ndarray) -> np.ndarray:
    found = values[np.isfinite(values)]
    return found if found.size else np.array([0.0, 1.0])
