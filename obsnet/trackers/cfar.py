"""Beam power against azimuth and batch in; constant-false-alarm-rate detections and their likelihood out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from obsnet.errors import ConfigError
from obsnet.trackers.clustering import dbscan


@dataclass(frozen=True)
class CfarConfig:
    """Cell-averaging CFAR over beams and past batches.

    The cell under test is compared with cells up to `guard_deg + training_deg` away on either side, except
    those within `guard_deg`, in its own batch and the `past` batches before. It is a detection where it
    exceeds their mean by Φ⁻¹(1 − `false_alarm_rate`) standard deviations.
    """

    false_alarm_rate: float = 0.25
    guard_deg: float = 8.0
    training_deg: float = 20.0
    past: int = 20

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarm_rate < 1.0:
            raise ConfigError(f"false_alarm_rate must lie between 0 and 1, found {self.false_alarm_rate}")
        if self.guard_deg < 0 or self.training_deg <= 0 or self.past < 0:
            raise ConfigError(
                "guard_deg and past must not be negative and training_deg must be positive, "
                f"found {self.guard_deg}, {self.past}, {self.training_deg}"
            )


def exceedance(power: np.ndarray, step_deg: float, config: CfarConfig | None = None) -> np.ndarray:
    """Whether each cell is a detection, bool, dims (batch, beam).

    Parameters
    ----------
    power : array, dims (batch, beam), the beams `step_deg` apart
    step_deg : float
    config : CfarConfig, optional

    Raises
    ------
    ConfigError
        No training cell fits on either side of some beam.
    """
    config = config or CfarConfig()
    guard, reach = (
        round(width / step_deg) for width in (config.guard_deg, config.guard_deg + config.training_deg)
    )
    beams = power.shape[1]
    if guard + 1 > beams // 2 or reach <= guard:
        raise ConfigError(
            f"{beams} beams of {step_deg} deg leave no training cells beyond {config.guard_deg} deg"
        )
    power = np.asarray(power, float)
    count = _ring_sum(np.ones_like(power), guard, reach, config.past)
    mean = _ring_sum(power, guard, reach, config.past) / count
    variance = np.maximum(_ring_sum(power**2, guard, reach, config.past) / count - mean**2, 0.0)
    return power > mean + ndtri(1.0 - config.false_alarm_rate) * np.sqrt(variance)


def merge(cells: np.ndarray, azimuth_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Detections after adjacent cells of a batch are merged at their mean azimuth.

    Parameters
    ----------
    cells : bool array, dims (batch, beam)
    azimuth_deg : array, dims (beam,), increasing in equal steps

    Returns
    -------
    batch : int array, dims (detection,), ascending
    azimuth_deg : array, dims (detection,)
    """
    batch, beam = np.nonzero(cells)
    labels = dbscan(np.stack([batch * 2.0, beam.astype(float)], axis=1), radius=1.0)
    if not len(labels):
        return np.empty(0, int), np.empty(0)
    size = np.bincount(labels)
    mean = np.bincount(labels, azimuth_deg[beam]) / size
    return (np.bincount(labels, batch) / size).astype(int), mean


def detection_llr(
    batch: np.ndarray,
    detected_deg: np.ndarray,
    azimuth_deg: np.ndarray,
    batches: int,
    detection_probability: float,
    std_deg: float,
    clutter: float,
    width_deg: float,
) -> np.ndarray:
    """Log-likelihood ratio ln(1 − p_d + p_d Σ N(ψ_d; ψ, R)/(λκ)), dims (batch, azimuth) (eqs 13–16).

    Parameters
    ----------
    batch, detected_deg : arrays, dims (detection,)
        As of `merge`.
    azimuth_deg : array, dims (azimuth,)
        Where the source may be.
    batches : int
    detection_probability : float
        p_d, below 1.
    std_deg : float
        √R, spread of a detection about the source.
    clutter : float
        λ, false detections expected per batch.
    width_deg : float
        The sector over which they fall uniformly, 1/κ.
    """
    if not (0 < detection_probability < 1 and std_deg > 0 and clutter > 0 and width_deg > 0):
        raise ConfigError(
            "detection needs 0 < p_d < 1 and positive spread, clutter and width, found "
            f"{detection_probability}, {std_deg}, {clutter}, {width_deg}"
        )
    nearness = np.exp(-0.5 * ((detected_deg[:, None] - azimuth_deg) / std_deg) ** 2)
    density = nearness * (width_deg / clutter / (np.sqrt(2.0 * np.pi) * std_deg))
    ratio = np.full((batches, len(azimuth_deg)), 1.0 - detection_probability)
    np.add.at(ratio, batch, detection_probability * density)
    return np.log(ratio)


def _ring_sum(values: np.ndarray, guard: int, reach: int, past: int) -> np.ndarray:
    """Sum over the training cells of each cell; windows are cut at the edges."""
    return _past_sum(_side_sum(values, reach) - _side_sum(values, guard), past)


def _side_sum(values: np.ndarray, reach: int) -> np.ndarray:
    total = np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, axis=1)], axis=1)
    beams = values.shape[1]
    index = np.arange(beams)
    return total[:, np.minimum(index + reach + 1, beams)] - total[:, np.maximum(index - reach, 0)]


def _past_sum(values: np.ndarray, past: int) -> np.ndarray:
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    return total[index + 1] - total[np.maximum(index - past, 0)]
