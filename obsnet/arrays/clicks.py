"""Clicks on a compact array: a multichannel recording in, clicks with their angle of arrival, range and
azimuth map out.

Energy detector and coincidence (`click_detector`), TDOAs by cross-correlation (`tdoa`), angle of arrival
(`arrival`), range from the surface echo (`echo`), azimuth map (`click_map`): `process` runs them one after
the other. A tracker for several animals and clutter is `obsnet.trackers.association`.

Source: Bénard-Caudal, Giraudet & Glotin 2010, Appl. Acoust. 71.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from scipy.signal.windows import tukey

from obsnet.arrays.arrival import Directions, directions
from obsnet.arrays.click_detector import Arrival, DetectorConfig, arrivals, coincidences
from obsnet.arrays.click_map import ClickMapConfig, azimuth_map
from obsnet.arrays.compact import CompactArray
from obsnet.arrays.echo import EchoRanges, echo_range, surface_echoes
from obsnet.arrays.joint_tdoa import joint_tdoa
from obsnet.arrays.recording import Recording, read_wav
from obsnet.arrays.tdoa import Interpolation, cross_correlations, highest_tdoa, tdoa_variance
from obsnet.errors import ConfigError, WaveformError

__all__ = [
    "ClickConfig",
    "ClickMapConfig",
    "ClickRecord",
    "CompactArray",
    "DetectorConfig",
    "azimuth_map",
    "echo_range",
    "process",
    "read_wav",
]

SECOND_GATE = 0.2
"""Right clicks that the χ² gate may refuse among those tried again: many tries call for a narrower gate."""


@dataclass(frozen=True)
class ClickConfig:
    """From a recording to clicks with their angles of arrival.

    Attributes
    ----------
    detector : DetectorConfig
    channels : channels of the recording, counted from 1, in the order of the array's hydrophones; all by
        default.
    click_s : length of the stretch around a click that is correlated, s.
    interpolation : of the correlation's peak: none, parabolic or upsampled.
    every_pair : correlate all pairs, not only those with the first hydrophone (the paper's).
    timing_std_s : error of arrival times besides noise (synchronisation of the channels), s.
    false_rejection : share of right clicks that the χ² gate may refuse.
    echoes : look for surface echoes.
    max_range_m : beyond this no echo is believed, m.
    """

    detector: DetectorConfig = field(default_factory=DetectorConfig)
    channels: tuple[int, ...] | None = None
    click_s: float = 0.010
    interpolation: Interpolation = "upsampled"
    every_pair: bool = True
    timing_std_s: float = 1e-6
    false_rejection: float = 0.01
    echoes: bool = True
    max_range_m: float = 20_000.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.click_s) and self.click_s > 0):
            raise ConfigError(f"click_s must be positive, found {self.click_s!r}")
        if not self.timing_std_s >= 0:
            raise ConfigError(f"timing_std_s must be at least 0, found {self.timing_std_s!r}")
        if not 0.0 < self.false_rejection < 1.0:
            raise ConfigError(f"false_rejection must lie between 0 and 1, found {self.false_rejection!r}")
        if not self.max_range_m > 0:
            raise ConfigError(f"max_range_m must be positive, found {self.max_range_m!r}")


@dataclass(frozen=True)
class ClickRecord:
    """Clicks of one recording, in the order of time.

    Attributes
    ----------
    array : CompactArray; pairs : int array (pair, 2), hydrophones counted from 0.
    start, end : of the recording, s since 1970. gaps : array (gap, (start, end)) without samples, s since
        1970.
    time : array (click,), arrival at the array's centre, s since 1970.
    tdoa, coefficient : arrays (click, pair), t_i − t_j in s and correlation coefficient.
    tdoa_covariance : array (click, pair, pair), s².
    snr_db : array (click,), best hydrophone's.
    directions : Directions, with the χ² gate's verdict.
    echoes : EchoRanges, of the accepted clicks.
    """

    array: CompactArray
    pairs: np.ndarray
    start: float
    end: float
    gaps: np.ndarray
    time: np.ndarray
    tdoa: np.ndarray
    coefficient: np.ndarray
    tdoa_covariance: np.ndarray
    snr_db: np.ndarray
    directions: Directions
    echoes: EchoRanges

    @property
    def direct(self) -> np.ndarray:
        """Clicks that passed the gate and are no surface echo, bool array (click,)."""
        return self.directions.accepted & (self.echoes.echo_of < 0)

    def frame(self) -> pd.DataFrame:
        """One row a click: time [s since 1970], angles and their standard deviations, gate, echo, range."""
        spread = np.sqrt(np.diagonal(self.directions.covariance, axis1=1, axis2=2))
        columns = {
            "time": self.time,
            "azimuth_deg": self.directions.azimuth_deg,
            "elevation_deg": self.directions.elevation_deg,
            "azimuth_std_deg": spread[:, 0],
            "elevation_std_deg": spread[:, 1],
            "chi_squared": self.directions.chi_squared,
            "accepted": self.directions.accepted,
            "correlation": np.median(self.coefficient, axis=1) if len(self.time) else self.time,
            "snr_db": self.snr_db,
            "echo_of": self.echoes.echo_of,
            "echo_delay_s": self.echoes.delay_s,
            "range_m": self.echoes.range_m,
            "range_std_m": self.echoes.range_std_m,
            "depth_m": self.echoes.depth_m,
        }
        return pd.DataFrame(columns)

    def azimuth_map(
        self, times: np.ndarray, azimuth: np.ndarray | None = None, config: ClickMapConfig | None = None
    ) -> xr.Dataset:
        """Azimuth map of the direct clicks, see `click_map.azimuth_map`."""
        span = (self.start, self.end)
        return azimuth_map(self.frame()[self.direct], times, azimuth, config, span, self.gaps)


def process(
    wav: str | Path | tuple[float, np.ndarray],
    geometry: CompactArray | str | Path | np.ndarray,
    config: ClickConfig | None = None,
    starttime: float = 0.0,
) -> ClickRecord:
    """Detect the clicks of a recording and find where each came from.

    Parameters
    ----------
    wav : path of a multichannel WAV file, or (sampling rate [Hz], samples (hydrophone, time)).
    geometry : CompactArray, its YAML file, or positions (hydrophone, (east, north, depth)) in m; one
        hydrophone a channel. An array at or above the surface has no echoes.
    starttime : time of the first sample, s since 1970.

    Raises
    ------
    WaveformError
        The file cannot be read, or has another number of channels than the array has hydrophones.
    ConfigError
        A parameter does not fit the recording's sampling rate.
    """
    config = config or ClickConfig()
    geometry = CompactArray.of(geometry)
    recording = Recording.of(wav)
    if config.channels is not None:
        recording = recording.select(config.channels)
    if recording.count != geometry.count:
        raise WaveformError(
            f"{recording.name} has {recording.count} channels and the array {geometry.count} hydrophones; "
            "name the array's channels in the configuration or give the right geometry"
        )
    detector = config.detector
    within = max(detector.coincidence_s, 1.2 * geometry.aperture_s + 0.002)
    least = (
        geometry.count if detector.min_hydrophones is None else min(detector.min_hydrophones, geometry.count)
    )
    groups = coincidences(arrivals(recording, detector), within, least)
    pairs = geometry.pairs(config.every_pair)
    timed = [_timed(recording, geometry, pairs, group, config) for group in groups]
    clicks = sorted((click for click in timed if click is not None), key=lambda click: click.time)
    size = len(pairs)
    time = np.array([click.time for click in clicks])
    tdoa = np.array([click.tdoa for click in clicks]).reshape(-1, size)
    covariance = np.array([click.covariance for click in clicks]).reshape(-1, size, size)
    found = directions(tdoa, geometry, pairs, covariance, config.false_rejection)
    return ClickRecord(
        array=geometry,
        pairs=pairs,
        start=starttime,
        end=starttime + recording.duration_s,
        gaps=starttime + recording.gaps(),
        time=time + starttime,
        tdoa=tdoa,
        coefficient=np.array([click.coefficient for click in clicks]).reshape(-1, size),
        tdoa_covariance=covariance,
        snr_db=np.array([click.snr_db for click in clicks]),
        directions=found,
        echoes=_echoes(time, found, geometry, config),
    )


@dataclass(frozen=True)
class _TimedClick:
    time: float
    tdoa: np.ndarray
    coefficient: np.ndarray
    covariance: np.ndarray
    snr_db: float


def _timed(
    recording: Recording, array: CompactArray, pairs: np.ndarray, group: list[Arrival], config: ClickConfig
) -> _TimedClick | None:
    """TDOAs of one click and their covariance; None where it cannot be correlated.

    Where the pairs' highest peaks do not fit one direction, those that do are sought (`joint_tdoa`).
    """
    rate = recording.sampling_rate
    time = float(np.mean([arrival.time for arrival in group]))
    reach = array.travel(pairs) * 1.02 + 1.0 / rate
    half = int(np.ceil((config.click_s / 2.0 + reach.max()) * rate))
    centre = round(time * rate)
    segments = recording.segment(centre - half, centre + half + 1)
    segments = segments * tukey(segments.shape[1], 0.2)
    bands = _bands(group, config.detector.octaves(rate))
    duration = segments.shape[1] / rate
    correlation, lag_rate = cross_correlations(segments, rate, pairs, reach, bands, config.interpolation)
    tdoa, coefficient = highest_tdoa(correlation, lag_rate, config.interpolation)
    if not np.isfinite(tdoa).any():
        return None
    covariance = _covariance(array, pairs, coefficient, duration, bands, rate, config)
    if not directions(tdoa, array, pairs, covariance, config.false_rejection).accepted[0]:
        again = joint_tdoa(correlation, lag_rate, array, pairs, covariance, config.interpolation)
        spread = _covariance(array, pairs, again[1], duration, bands, rate, config)
        if directions(again[0], array, pairs, spread, SECOND_GATE).accepted[0]:
            (tdoa, coefficient), covariance = again, spread
    return _TimedClick(time, tdoa, coefficient, covariance, max(arrival.snr_db for arrival in group))


def _covariance(
    array: CompactArray,
    pairs: np.ndarray,
    coefficient: np.ndarray,
    duration_s: float,
    bands: list[tuple[float, float]],
    sampling_rate: float,
    config: ClickConfig,
) -> np.ndarray:
    """Covariance of a click's TDOAs: its noise, the channels' timing, and what is left of the sampling."""
    shared, own = tdoa_variance(coefficient, duration_s, bands)
    own += ((1.0 / np.sqrt(12.0) if config.interpolation == "none" else 0.05) / sampling_rate) ** 2
    return array.tdoa_covariance(pairs, float(np.sqrt(shared + config.timing_std_s**2)), float(np.sqrt(own)))


def _bands(group: list[Arrival], octaves: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Octaves that exceeded on most of the hydrophones, or on any where none did on most."""
    votes = np.array([sum(k in arrival.octaves for arrival in group) for k in range(len(octaves))])
    chosen = votes > len(group) / 2.0
    if not chosen.any():
        chosen = votes > 0
    return [octave for octave, keep in zip(octaves, chosen, strict=True) if keep]


def _echoes(time: np.ndarray, found: Directions, array: CompactArray, config: ClickConfig) -> EchoRanges:
    """Surface echoes among the accepted clicks, over all clicks."""
    delay, distance, spread, depth = (np.full(len(time), np.nan) for _ in range(4))
    nothing = EchoRanges(delay, distance, spread, depth, np.full(len(time), -1))
    chosen = np.flatnonzero(found.accepted)
    if not config.echoes or array.mean_depth_m <= 0 or not len(chosen):
        return nothing
    ranged = surface_echoes(
        time[chosen],
        found.azimuth_deg[chosen],
        found.elevation_deg[chosen],
        found.covariance[chosen],
        array.mean_depth_m,
        array.sound_speed_mps,
        max_range_m=config.max_range_m,
    )
    for name in ("delay_s", "range_m", "range_std_m", "depth_m"):
        getattr(nothing, name)[chosen] = getattr(ranged, name)
    nothing.echo_of[chosen] = np.where(ranged.echo_of >= 0, chosen[ranged.echo_of], -1)
    return nothing
