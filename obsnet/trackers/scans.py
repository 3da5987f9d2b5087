"""What association works on: scans of measurements, and how a state is moved, observed and born.

A scan is what was measured at one time: TDOAs by pair with clutter among them, one whole click, or one
azimuth. A model says how a state moves and what it would measure; states are in degrees and degrees per
second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsnet.arrays.clicks import ClickRecord
from obsnet.errors import ConfigError, LayoutError


@dataclass(frozen=True)
class Scan:
    """Measurements of one time, with the prior of what may have caused them.

    Attributes
    ----------
    time : s. channel : int array (m,), the model's channel of each measurement. value : array (m,).
    log_clutter : array (m,), log density of clutter at each measurement; minus infinity where there is none.
    log_click, log_miss : log probability (or rate) that an animal there clicks in this scan, and that it does
        not.
    log_birth : log probability (or rate) of a new animal.
    detection : probability that a channel measures a click; 1 where `whole`.
    whole : all measurements are one event, and belong together or not at all.
    covariance : array (channel, channel) of this scan's measurements; the model's own by default.
    """

    time: float
    channel: np.ndarray
    value: np.ndarray
    log_clutter: np.ndarray
    log_click: float
    log_miss: float
    log_birth: float
    detection: float = 0.98
    whole: bool = False
    covariance: np.ndarray | None = None


@dataclass(frozen=True)
class ScanConfig:
    """Priors of scans at regular times.

    Attributes
    ----------
    clicking : probability that an animal clicks in a scan. detection : that a channel then measures it.
    clutter : mean number of clutter measurements a channel and scan, Poisson.
    clutter_range : lowest and highest clutter value, uniform between; s for TDOAs, deg for azimuths.
    birth_rate_hz : rate of new animals, 1/s.
    """

    clicking: float = 0.95
    detection: float = 0.98
    clutter: float = 1.0
    clutter_range: tuple[float, float] = (-1.5e-3, 1.5e-3)
    birth_rate_hz: float = 1.0 / 300.0

    def __post_init__(self) -> None:
        if not (0.0 < self.clicking < 1.0 and 0.0 < self.detection < 1.0):
            raise ConfigError(
                f"clicking and detection must lie in (0, 1), found {self.clicking!r}, {self.detection!r}"
            )
        if not (np.isfinite(self.clutter) and self.clutter >= 0 and self.birth_rate_hz >= 0):
            raise ConfigError(
                f"clutter, birth_rate_hz must be at least 0, found {self.clutter!r}, {self.birth_rate_hz!r}"
            )
        if len(self.clutter_range) != 2 or not self.clutter_range[0] < self.clutter_range[1]:
            raise ConfigError(
                f"clutter_range must be a lower and a higher value, found {self.clutter_range!r}"
            )


def regular_scans(
    times: np.ndarray,
    channels: Sequence[np.ndarray],
    values: Sequence[np.ndarray],
    count: int,
    config: ScanConfig | None = None,
) -> list[Scan]:
    """Scans of measurements by channel, clutter among them: the paper's section 4.3.

    Parameters
    ----------
    times : array (scan,), s, ascending. channels, values : one array a scan. count : number of channels.

    Raises
    ------
    LayoutError
        Times do not ascend, or the lists are of unequal length.
    """
    config = config or ScanConfig()
    times = np.asarray(times, float)
    if not len(times) == len(channels) == len(values):
        raise LayoutError(
            "times, channels and values must have one entry a scan, "
            f"found {len(times)}, {len(channels)}, {len(values)}"
        )
    if not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
        raise LayoutError("scans must be in the order of time, each at its own; sort and merge them first")
    width = config.clutter_range[1] - config.clutter_range[0]
    density = np.log(config.clutter / width) if config.clutter > 0 else -np.inf
    silent = 1.0 - config.clicking + config.clicking * (1.0 - config.detection) ** count
    step = np.append(np.median(np.diff(times)) if len(times) > 1 else 1.0, np.diff(times))
    scans = []
    for time, interval, channel, value in zip(times, step, channels, values, strict=True):
        channel, value = np.asarray(channel, int), np.asarray(value, float)
        if channel.shape != value.shape or channel.ndim != 1 or not np.isfinite(value).all():
            raise LayoutError(f"the scan at {time:g} s needs one finite value a channel entry")
        expected = min(config.birth_rate_hz * interval, 0.5)
        scans.append(
            Scan(
                time=float(time),
                channel=channel,
                value=value,
                log_clutter=np.full(len(value), density),
                log_click=float(np.log(config.clicking)),
                log_miss=float(np.log(silent)),
                log_birth=float(np.log(expected)) if expected > 0 else -np.inf,
                detection=config.detection,
            )
        )
    return scans


def click_scans(
    record: ClickRecord,
    click_rate_hz: float = 0.3,
    clutter_rate_hz: float = 0.05,
    birth_rate_hz: float = 1.0 / 300.0,
) -> list[Scan]:
    """One scan a click of a recording: all its TDOAs come from one animal, or all are clutter.

    Clicks are Poisson processes: an animal's of rate r, clutter's uniform over the TDOAs that fit the array.
    Surface echoes are left out, lest an animal's image be tracked; clicks that failed the χ² gate are kept,
    as the clutter they most likely are.
    """
    keep = (record.echoes.echo_of < 0) & np.isfinite(record.tdoa).any(axis=1)
    reach = record.array.travel(record.pairs)
    scans: list[Scan] = []
    before = record.start
    for k in np.flatnonzero(keep):
        channel = np.flatnonzero(np.isfinite(record.tdoa[k]))
        interval = max(float(record.time[k]) - before, 1e-6)
        log_clutter = np.log(clutter_rate_hz) / len(channel) - np.log(2.0 * reach[channel])
        scans.append(
            Scan(
                time=before + interval,
                channel=channel,
                value=record.tdoa[k, channel],
                log_clutter=log_clutter,
                log_click=float(np.log(click_rate_hz) - click_rate_hz * interval),
                log_miss=-click_rate_hz * interval,
                log_birth=float(np.log(birth_rate_hz)),
                detection=1.0,
                whole=True,
                covariance=record.tdoa_covariance[k],
            )
        )
        before += interval
    return scans


def azimuth_scans(times: np.ndarray, azimuth_deg: np.ndarray, config: ScanConfig | None = None) -> list[Scan]:
    """Scans from a detector's azimuths, one a minute, NaN where it found nothing (as in `detections.csv`)."""
    config = config or ScanConfig(
        clicking=0.9, detection=0.98, clutter=0.1, clutter_range=(0.0, 360.0), birth_rate_hz=1.0 / 7200.0
    )
    azimuth_deg = np.asarray(azimuth_deg, float)
    found = [np.array([value]) if np.isfinite(value) else np.empty(0) for value in azimuth_deg]
    return regular_scans(times, [np.zeros(len(value), int) for value in found], found, 1, config)
