"""When is one ship heard? Presence of every minute in, segments out.

Minutes are averaged with the chance that a detector misses (paper's eqs 24–25), over two hours as in the paper and over less:
two hours drown a ship that is heard for forty minutes. Where a departure is followed by an approach a second ship has come,
and the segment is split; whatever is heard stays in a segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd

from obsnet.errors import ConfigError
from obsnet.trackers.track import Segment


@dataclass(frozen=True)
class SegmentationConfig:
    """Detection probabilities, averaging windows, shortest segment (minutes), and the most that one minute may say.

    A ship is heard where the average over any of the windows `average_min` speaks for it; whether it approaches or leaves is
    averaged over `range_average_min`.
    """

    azimuth_detection_probability: float = 0.9
    range_detection_probability: float = 0.6
    average_min: tuple[float, ...] = (30.0, 60.0, 120.0)
    range_average_min: float = 60.0
    shortest_min: float = 30.0
    minute_bound: float = 3.0

    def __post_init__(self) -> None:
        for name in ("azimuth_detection_probability", "range_detection_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ConfigError(f"{name} must lie in (0, 1), found {getattr(self, name)}")
        for name in ("range_average_min", "shortest_min", "minute_bound"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"{name} must be positive, found {getattr(self, name)}")
        if not self.average_min or min(self.average_min) <= 0:
            raise ConfigError(f"average_min must hold positive minutes, found {list(self.average_min)}")


def mixture(log_ratio: np.ndarray, probability: float) -> np.ndarray:
    """Log of (1 − Pd) + Pd·ratio: a detector may miss the ship. No data (NaN) says nothing (0)."""
    with np.errstate(invalid="ignore"):
        mixed = np.logaddexp(np.log1p(-probability), np.log(probability) + log_ratio)
    return np.where(np.isnan(log_ratio), 0.0, mixed)


def segments(
    presence: pd.DataFrame, config: SegmentationConfig = SegmentationConfig(), ended: bool = True
) -> list[Segment]:
    """Stretches of time in which one ship is heard.

    Parameters
    ----------
    presence : DataFrame indexed by s since 1970, in regular steps but for times that are left out, with log presence ratios `azimuth`, `range`, and those of the range
        detector for closing and opening range rates alone, `approaching` and `leaving`; NaN where there is no data. Columns
        of a detector that is not there are missing or all NaN.
    config : SegmentationConfig
    ended : whether the record ends here. If it goes on, only the segments that no later minute can change.

    Returns
    -------
    list of Segment in time order, each at least `shortest_min` long; none begins or ends where there is no data, none reaches
    over times that are left out.

    Source: Trabattoni et al. 2023, section III.D, eqs (24)–(25); the first factor of eq. (24) reads P_α.
    """
    *before, last = _stretches(presence)
    whole = [segment for stretch in before for segment in _segments(stretch, config, ended=True)]
    return whole + _segments(last, config, ended)


def _segments(presence: pd.DataFrame, config: SegmentationConfig, ended: bool) -> list[Segment]:
    """Segments of one stretch in regular steps."""
    time = presence.index.to_numpy(float)
    if len(time) < 2:
        return []
    step = float(time[1] - time[0])
    level = {
        name: _column(presence, name, config.range_detection_probability, config)
        for name in ("range", "approaching", "leaving")
    }
    narrow = _odd(config.range_average_min * 60.0 / step)
    heard, settled = _heard(presence, config)
    settled = len(time) if ended else settled
    smooth = {name: _average(values, narrow) for name, values in level.items()}
    radial = heard & (smooth["range"] > 0)
    phase = np.where(radial & (smooth["approaching"] > smooth["leaving"]), -1, 0)
    phase = np.where(radial & (smooth["approaching"] < smooth["leaving"]), 1, phase)
    known = np.flatnonzero(presence.notna().any(axis=1).to_numpy())
    found: list[Segment] = []
    for lo, hi in _runs(heard[:settled]):
        inside = known[np.searchsorted(known, lo) : np.searchsorted(known, hi)]
        pieces = _split(time, phase, int(inside[0]), int(inside[-1]) + 1, config) if inside.size else []
        found += pieces[:-1] if hi == settled and not ended else pieces
    return [segment for segment in found if segment.end - segment.start >= config.shortest_min * 60.0]


def quiet_until(presence: pd.DataFrame, config: SegmentationConfig = SegmentationConfig()) -> float | None:
    """Last minute [s since 1970] without a ship that no later minute can change; segments to come start after it."""
    *before, last = _stretches(presence)
    ended = float(before[-1].index[-1]) if before else None
    if len(last) < 2:
        return ended
    heard, settled = _heard(last, config)
    quiet = np.flatnonzero(~heard[:settled])
    return float(last.index[quiet[-1]]) if quiet.size else ended


def _stretches(presence: pd.DataFrame) -> list[pd.DataFrame]:
    """Parts in regular steps, cut where times are left out as in a long silence; one, even if there is nothing."""
    apart = np.diff(presence.index.to_numpy(float))
    cuts = np.flatnonzero(apart > 1.5 * np.median(apart)) + 1 if apart.size else np.empty(0, int)
    return [presence.iloc[first:last] for first, last in pairwise([0, *cuts.tolist(), len(presence)])]


def _heard(presence: pd.DataFrame, config: SegmentationConfig) -> tuple[np.ndarray, int]:
    """In which minutes a ship is heard (eq. 24), and up to which one later minutes change nothing."""
    step = float(presence.index[1] - presence.index[0])
    level = _column(presence, "range", config.range_detection_probability, config)
    azimuth = _column(presence, "azimuth", config.azimuth_detection_probability, config)
    widths = [_odd(minutes * 60.0 / step) for minutes in config.average_min]
    heard = np.any([_average(azimuth + level, width) > 0 for width in widths], axis=0)
    return heard, max(len(presence) - max(widths) // 2, 0)


def _column(presence: pd.DataFrame, name: str, probability: float, config: SegmentationConfig) -> np.ndarray:
    if name not in presence:
        return np.zeros(len(presence))
    mixed = mixture(presence[name].to_numpy(float), probability)
    return np.minimum(mixed, config.minute_bound)


def _split(
    time: np.ndarray, phase: np.ndarray, lo: int, hi: int, config: SegmentationConfig
) -> list[Segment]:
    """Split a heard stretch halfway between each departure and the approach after it; set each piece's CPA.

    Two ships at once make the phase flicker: legs shorter than half of what makes a segment are none, and no cut leaves
    less than a segment on either side. What is heard belongs to some piece.
    """
    shortest = 60.0 * config.shortest_min
    runs = [(a + lo, b + lo, sign) for sign in (-1, 1) for a, b in _runs(phase[lo:hi] == sign)]
    runs = sorted(run for run in runs if time[run[1] - 1] - time[run[0]] >= 0.5 * shortest)
    pieces: list[Segment] = []
    start, cpa = time[lo], None
    for (_, end, sign), (begin, _, following) in pairwise(runs):
        middle = 0.5 * (time[end - 1] + time[begin])
        if sign == -1 and following == 1:
            cpa = middle
        elif sign == 1 and following == -1 and min(middle - start, time[hi - 1] - middle) >= shortest:
            pieces.append(Segment(start, middle, cpa, (bool(pieces), True)))
            start, cpa = middle, None
    pieces.append(Segment(start, time[hi - 1], cpa, (bool(pieces), False)))
    return pieces


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and one-past-last index of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _average(values: np.ndarray, width: int) -> np.ndarray:
    """Centred running mean, over what there is near the ends."""
    width = min(width, 2 * len(values) - 1)
    half = width // 2
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    lo, hi = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (total[hi] - total[lo]) / (hi - lo)


def _odd(width: float) -> int:
    return 2 * int(width // 2) + 1
