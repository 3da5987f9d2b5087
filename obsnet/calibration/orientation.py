"""Orientation of the horizontals and polarity of the hydrophone, from where known ships were heard.

Cells in which the background is strong point partly to the background: it is subtracted, what is left weighs
by its ratio to the background, and the mode is sought rather than the mean, so that what points elsewhere
does not pull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.calibration.passages import Heard, Passages, vertex

COARSE_DEG, FINE_DEG, REACH_DEG = 2.0, 0.2, 20.0
MIN_STD_DEG = 0.2
OUTLIERS = 0.3
BLOCK_S, BAND_HZ = 900.0, 1.0
FLUX_BLOCK_S = 180.0
MIN_CELLS = 50


@dataclass(frozen=True, eq=False)
class Rotation:
    """How far the metadata's azimuths must be turned clockwise, [−180, 180) deg, and its standard deviation.

    `log_likelihood` is a cell's mean at the mode; `by_frequency` holds frequency [Hz], mode [deg] and number
    of cells of each band.
    """

    angle_deg: float
    std_deg: float
    cells: int
    log_likelihood: float
    by_frequency: tuple[tuple[float, float, int], ...]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Time–frequency cells that stand out: AIS azimuth minus heard azimuth [deg] for each ship and how likely
    it is that ship's, (cell, ship); concentration, error of the azimuth from the place [rad], frequency bin and
    stretch, (cell).
    """

    difference: np.ndarray
    share: np.ndarray
    concentration: np.ndarray
    tilt: np.ndarray
    frequency: np.ndarray
    block: np.ndarray


def rotation(
    passages: Passages,
    offset_m: tuple[float, float],
    offset_std_m: float,
    *,
    average_s: float,
    min_snr_db: float,
    min_range_m: float,
    max_range_m: float,
) -> Rotation | None:
    """Mode of AIS azimuth minus heard azimuth over cells that stand out of the background.

    The azimuths of a cell are wrapped Cauchy with 1 − R of 1/√SNR (paper's appendix B) and of their scatter
    within the cell. A share ε of cells points anywhere, the others to one of the known ships with its share s
    of the power that spherical spreading brings: the likelihood of a rotation φ is Π (ε + (1 − ε) Σ s 2π WC(d
    − φ; R)). Its standard deviation is the jackknife's, over stretches of 15 min (AIS, background) and over
    bands of 1 Hz (coupling), and what `offset_std_m` of the station's place turns at the ships' ranges, in
    quadrature.

    Returns
    -------
    Rotation, or none where no cell stands out or the station has no two horizontals.
    """
    cells = _cells(passages, offset_m, offset_std_m, average_s, min_snr_db, min_range_m, max_range_m)
    if cells is None or cells.frequency.size < MIN_CELLS:
        return None
    coarse = np.arange(-180.0, 180.0, COARSE_DEG)
    every = np.zeros(cells.frequency.size, int)
    centre = coarse[_log_likelihood(cells, coarse, every)[0].argmax()]
    fine = centre + np.arange(-REACH_DEG, REACH_DEG + FINE_DEG / 2, FINE_DEG)
    band = np.floor(passages.frequency[cells.frequency] / BAND_HZ).astype(int)
    blocks, bands = (_log_likelihood(cells, fine, group) for group in (cells.block, band))
    best = _mode(blocks.sum(axis=0), fine)
    tilt = np.rad2deg(np.median(cells.tilt)) / np.sqrt(np.unique(passages.heard.passage).size)
    std = np.sqrt(_jackknife(blocks, fine) ** 2 + _jackknife(bands, fine) ** 2 + tilt**2)
    counts = np.bincount(band)
    listed = tuple(
        (float((k + 0.5) * BAND_HZ), _wrap(_mode(bands[k], fine)), int(counts[k]))
        for k in np.flatnonzero(counts)
    )
    return Rotation(
        _wrap(best),
        float(max(std, MIN_STD_DEG)),
        int(every.size),
        float(blocks.sum(axis=0).max() / every.size),
        listed,
    )


def downward_flux(passages: Passages) -> float | None:
    """How significant it is that vertical energy flux points down (positive) or up, in standard deviations.

    Sound comes from above and part of it stays in the bottom (|R| ≤ 1), for ships and for the sea's noise
    alike: the vertical active intensity points down unless the hydrophone is reversed. Its coherence differs
    with range but never in sign, so its mean over stretches of 3 min is held against their root mean square.
    None without a vertical channel or with fewer than three stretches.
    """
    if passages.vertical is None:
        return None
    flux, motion = passages.vertical
    with np.errstate(invalid="ignore", divide="ignore"):
        coherence = np.mean(flux / np.sqrt(passages.power * motion), axis=0)
    valid = np.isfinite(coherence)
    blocks = passages.heard.blocks(FLUX_BLOCK_S)[valid]
    count = np.bincount(blocks)
    means = np.bincount(blocks, coherence[valid])[count > 0] / count[count > 0]
    if means.size < 3:
        return None
    return float(means.mean() * np.sqrt(means.size) / max(np.sqrt(np.mean(means**2)), 1e-12))


def _cells(
    passages: Passages,
    offset_m: tuple[float, float],
    offset_std_m: float,
    average_s: float,
    min_snr_db: float,
    min_range_m: float,
    max_range_m: float,
) -> _Cells | None:
    """Cells of `average_s`: intensity less the background's, turned with the nearest ship while it is
    averaged.
    """
    if passages.intensity is None or passages.background_intensity is None:
        return None
    azimuth, distance = passages.heard.relative_to(*offset_m)
    valid = np.isfinite(passages.power).all(axis=0) & np.isfinite(passages.intensity).all(axis=0)
    valid &= (distance[:, 0] >= min_range_m) & (distance[:, 0] <= max_range_m)
    if not valid.any():
        return None
    heard: Heard = passages.heard[valid]
    group = heard.blocks(average_s)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    count = np.diff(np.append(starts, order.size))
    first = order[starts]
    azimuth, distance = azimuth[valid], distance[valid]
    since = azimuth[:, 0] - azimuth[first[np.unique(group, return_inverse=True)[1]], 0]
    excess = (passages.intensity[:, valid] - passages.background_intensity[:, None]) * _phasor(-since)
    mean = np.add.reduceat(excess[:, order], starts, axis=1)
    focus = np.abs(np.add.reduceat(_unit(excess)[:, order], starts, axis=1)) / count
    snr = np.add.reduceat(passages.power[:, valid][:, order], starts, axis=1) / count
    snr = snr / passages.background[:, None] - 1.0
    loud = snr >= 10.0 ** (min_snr_db / 10.0)
    frequency, column = np.nonzero(loud)
    tilt = np.minimum(offset_std_m / distance[first, 0][column], 1.0)
    spread = 1.0 / np.sqrt(snr[loud] * count[column]) + tilt
    level = distance[first][column] ** -2.0
    return _Cells(
        azimuth[first][column] - np.rad2deg(np.angle(mean[loud]))[:, None],
        level / level.sum(axis=1, keepdims=True),
        np.clip(focus[loud] * (1.0 - spread), 0.2, 0.97),
        tilt,
        frequency,
        heard.blocks(BLOCK_S)[first][column],
    )


def _log_likelihood(cells: _Cells, angle_deg: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Log-likelihood of each rotation [deg], summed over the cells of each group: (group, rotation)."""
    total = np.zeros((int(group.max()) + 1, angle_deg.size))
    peak = (1.0 - OUTLIERS) * (1.0 - cells.concentration**2)
    level, slope = 1.0 + cells.concentration**2, 2.0 * cells.concentration
    real, imag = (part(np.deg2rad(cells.difference)) for part in (np.cos, np.sin))
    ships = np.flatnonzero(cells.share.max(axis=0) > 0.05)
    for j, angle in enumerate(np.deg2rad(angle_deg)):
        ratio = np.full(group.size, OUTLIERS)
        for i in ships:
            aligned = real[:, i] * np.cos(angle) + imag[:, i] * np.sin(angle)
            ratio += cells.share[:, i] * peak / (level - slope * aligned)
        total[:, j] = np.bincount(group, np.log(ratio), total.shape[0])
    return total


def _jackknife(parts: np.ndarray, angle_deg: np.ndarray) -> float:
    """Standard deviation of the mode from leaving out each part's log-likelihood in turn."""
    used = parts[np.ptp(parts, axis=1) > 0]
    if len(used) < 2:
        return float("inf")
    total = used.sum(axis=0)
    modes = np.array([_mode(total - part, angle_deg) for part in used])
    return float(np.sqrt((len(used) - 1) / len(used) * np.sum((modes - modes.mean()) ** 2)))


def _mode(log_likelihood: np.ndarray, angle_deg: np.ndarray) -> float:
    at = int(log_likelihood.argmax())
    return float(angle_deg[at] + vertex(log_likelihood, at) * (angle_deg[1] - angle_deg[0]))


def _phasor(angle_deg: np.ndarray) -> np.ndarray:
    return np.exp(1j * np.deg2rad(angle_deg))


def _unit(values: np.ndarray) -> np.ndarray:
    return values / np.maximum(np.abs(values), np.finfo(float).tiny)


def _wrap(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
