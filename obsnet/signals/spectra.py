"""Waveforms in, short-time spectra out: pressure, and velocity east, north and down, on a UTC grid.

One definition serves every sampling rate. A frame is a span of `window_s` seconds; its value at f_k = k /
window_s is

    S(f_k) = 2 / Σw · Σ_n w(t_n) (x_n − x̄) exp(−2πi f_k t_n) / R(f_k),   w(t) = sin²(πt / window_s),

with t_n the samples' own times after the frame's start, x̄ their w-weighted mean and R the channel's
response, so that a tone of amplitude A gives |S| = A. Rates above the analysis rate are not decimated:
their longer FFT is cut at half the analysis rate. That is a filter without a transition band, and leaves
the bins below as a station at the analysis rate would have them. At 50, 62.5, 100, 125, 200, 250 Hz the sum
is an FFT; at a rate that gives no whole number of samples it is a chirp-z transform. A start off the
sampling grid, or a drifting clock, is a phase: frames take the nearest samples and turn it back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from obsnet.errors import ConfigError, StationError, WaveformError
from obsnet.layout import iso
from obsnet.signals.channels import ChannelSpectra, rotation
from obsnet.signals.response import described
from obsnet.signals.station import Channel, Station
from obsnet.signals.waveforms import Waveforms, WaveformSource, open_waveforms

_SECOND = 1_000_000_000
SILENCE_NS = 10 * 86400 * _SECOND


@dataclass(frozen=True)
class SpectraConfig:
    """How frames are cut and corrected.

    Attributes
    ----------
    window_s, hop_s : float
        Length and spacing of frames, s; frames start on UTC multiples of the hop.
    analysis_rate_hz : float
        Spectra reach half this rate. Channels sampled more slowly cannot serve.
    water_level_db : float
        The response is not undone where it lies further than this below its maximum.
    dead_s : float
        A channel that does not change for so long is missing.
    clip_share : float
        A frame with this share of its samples stuck at its extremes is missing.
    block_s : float
        Length of the blocks that are held in memory, s.
    """

    window_s: float = 20.48
    hop_s: float = 10.24
    analysis_rate_hz: float = 50.0
    water_level_db: float = 40.0
    dead_s: float = 1.0
    clip_share: float = 0.01
    block_s: float = 7200.0

    def __post_init__(self) -> None:
        for name in ("window_s", "hop_s", "analysis_rate_hz", "water_level_db", "dead_s", "block_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} must be positive, found {value}")
        if self.hop_s > self.window_s:
            raise ConfigError(f"hop_s must not exceed window_s, found {self.hop_s} and {self.window_s} s")
        if not 0 < self.clip_share <= 1:
            raise ConfigError(f"clip_share must lie in (0, 1], found {self.clip_share}")
        bins = self.window_s * self.analysis_rate_hz / 2
        if abs(bins - round(bins)) > 1e-6:
            raise ConfigError(
                f"window_s must hold an even number of samples at analysis_rate_hz, found {2 * bins:g}; "
                f"try {2 * round(bins) / self.analysis_rate_hz:g} s"
            )

    @property
    def frequency(self) -> np.ndarray:
        """Frequencies of the bins, Hz."""
        return np.arange(round(self.window_s * self.analysis_rate_hz / 2) + 1) / self.window_s

    @property
    def window_ns(self) -> int:
        """Length of a frame in ns."""
        return round(self.window_s * _SECOND)

    @property
    def hop_ns(self) -> int:
        """Spacing of frames in ns."""
        return round(self.hop_s * _SECOND)


def spectra(
    source: Any,
    station: Station,
    config: SpectraConfig = SpectraConfig(),
    starttime: Any = None,
    endtime: Any = None,
) -> xr.Dataset:
    """Spectra of a whole record; for long ones see `iter_spectra`.

    Parameters
    ----------
    source : obspy Stream, path, list of paths or WaveformSource
        As `open_waveforms` takes it.
    station : Station
        Directions, polarities and responses of the channels.
    config : SpectraConfig
    starttime, endtime : optional
        Frames whose centre lies in [starttime, endtime) are kept; consecutive spans give consecutive frames.

    Returns
    -------
    Dataset
        p [Pa], east, north, down [m/s], those that the channels allow; complex64, dims (frequency [Hz],
        time); NaN where a frame touches a gap, a dead or a clipped stretch. `time` is the centre of the
        frame. A tone of amplitude A has modulus A. A channel that is missing throughout is left out.

    Raises
    ------
    WaveformError
        No usable waveforms, or less than one frame of them.
    StationError
        The horizontals have no azimuth, or are not independent.
    """
    opened = open_waveforms(
        source, station, starttime=starttime, endtime=endtime, min_rate_hz=config.analysis_rate_hz
    )
    blocks = list(iter_spectra(opened, config))
    whole = blocks[0] if len(blocks) == 1 else xr.concat(blocks, "time", combine_attrs="override")
    empty = [name for name, array in whole.items() if np.isnan(array.values[-1]).all()]
    return whole.drop_vars(empty) if len(empty) < len(whole) else whole


def iter_spectra(source: WaveformSource, config: SpectraConfig = SpectraConfig()) -> Iterator[xr.Dataset]:
    """Spectra block by block: consecutive frames, each once, the same as in one piece; memory of one block.

    Parameters
    ----------
    source : WaveformSource
    config : SpectraConfig

    Yields
    ------
    Dataset
        As from `spectra`, of at most `block_s`; all blocks have the same variables. Frames in gaps are NaN,
        but a silence of over ten days, such as a clock that starts in 1980 makes, is passed over and noted.
    """
    spans = _spans(source, config)
    builder = SpectraBuilder(source, config, spans[0][0], spans[-1][1])
    source.report.left_aside.update(dict.fromkeys(builder.unused, "another sensor serves in its stead"))
    step = max(round(config.block_s / config.hop_s), 1)
    for first, last in spans:
        for begin in range(first, last, step):
            yield builder.block(np.arange(begin, min(begin + step, last)))


def _spans(source: WaveformSource, config: SpectraConfig) -> list[tuple[int, int]]:
    """Ranges of frames (hops since 1970) centred in the span asked for, inside the data to half a sample."""
    hop, window = config.hop_ns, config.window_ns
    half = round(0.5 / config.analysis_rate_hz * _SECOND)
    asked = -(-(source.begin_ns - window // 2) // hop), -(-(source.end_ns - window // 2) // hop)
    held, spans = source.covered(SILENCE_NS), []
    for begin, end in held:
        first = max(asked[0], -(-(begin - half) // hop))
        last = min(asked[1], (end + half - window) // hop + 1)
        if first < last:
            spans.append((first, last))
    if not spans:
        begin, end = max(source.begin_ns, source.data_begin_ns), min(source.end_ns, source.data_end_ns)
        raise WaveformError(
            f"the waveforms of {source.station.code} hold no whole frame: {(end - begin) / _SECOND:g} s from "
            f"{iso(np.datetime64(begin, 'ns'))}; give at least {config.window_s + config.hop_s:g} s"
        )
    for (_, end), (begin, _) in pairwise(held):
        days = (begin - end) / _SECOND / 86400
        source.report.note(f"nothing for {days:.0f} days from {iso(np.datetime64(end, 'ns'))}: passed over")
    return spans


class SpectraBuilder:
    """Makes the Dataset of a range of frames from the channels that serve at their times."""

    def __init__(self, source: Waveforms, config: SpectraConfig, first: int, last: int) -> None:
        self.source, self.config, self.frequency = source, config, config.frequency
        self._channels = ChannelSpectra(
            source, self.frequency, config.window_s, config.water_level_db, config.dead_s, config.clip_share
        )
        centres = np.array([first, last - 1]) * config.hop_ns + config.window_ns // 2
        edges = {t for c in source.station.epochs for t in (c.starttime, c.endtime) if math.isfinite(t)}
        turns = sorted(round(t * _SECOND) for t in edges)
        regimes = [int(centres[0]), *(t for t in turns if centres[0] < t <= centres[1])]
        self._regimes = np.array(regimes)
        self._stations = [source.station_at(t) for t in regimes]
        self._rotations = [rotation(station, source.report) for station in self._stations]
        self.units: dict[str, str] = {}
        for station, weights in zip(self._stations, self._rotations, strict=True):
            if station.pressure is not None:
                self.units["p"] = "Pa" if self._known(station.pressure) else "count"
            for name, row in weights.items():
                used = [channel for channel, weight in zip(station.motion, row, strict=True) if weight]
                known = [self._known(channel) for channel in used]
                self.units[name] = "m/s" if all(known) else "count"
        if not self.units:
            heard = sorted({channel.seed_id for station in self._stations for channel in station.channels})
            if heard:
                raise StationError(
                    f"{source.station.code} offers neither two horizontals nor a hydrophone: there are waveforms "
                    f"of {' and '.join(heard)} alone; give those of its other channels too"
                )
            raise StationError(
                f"no channel of {source.station.code} has an epoch at the time of its waveforms, "
                f"{iso(np.datetime64(int(centres[0]), 'ns'))}; give metadata of that time"
            )

    @property
    def unused(self) -> list[str]:
        """SEED ids of the channels with waveforms that serve at no time."""
        serving = {channel.seed_id for station in self._stations for channel in station.channels}
        return sorted(self.source.timelines.keys() - serving)

    def _known(self, channel: Channel) -> bool:
        if not described(channel.response):
            self.source.report.note(f"{channel.seed_id} has no response: its samples are taken as they are")
        return described(channel.response)

    def block(self, frames: np.ndarray) -> xr.Dataset:
        """Dataset of the given (consecutive) frames."""
        starts = frames * self.config.hop_ns
        centres = starts + self.config.window_ns // 2
        owner = np.maximum(np.searchsorted(self._regimes, centres, "right") - 1, 0)
        if owner[0] == owner[-1]:
            made = self._components(owner[0], starts)
        else:
            parts = [self._components(j, starts[owner == j]) for j in np.unique(owner)]
            made = {name: np.concatenate([part[name] for part in parts]) for name in self.units}
        return xr.Dataset(
            {
                name: (("frequency", "time"), made[name].T, {"units": unit})
                for name, unit in self.units.items()
            },
            {
                "frequency": ("frequency", self.frequency, {"units": "Hz"}),
                "time": ("time", centres.astype("datetime64[ns]")),
            },
            {
                "station": self.source.station.code,
                "sampling_rate": self.config.analysis_rate_hz,
                "window_s": self.config.window_s,
                "hop_s": self.config.hop_s,
                "window": "hann",
                "scaling": "amplitude of a tone",
            },
        )

    def _components(self, regime: int, starts: np.ndarray) -> dict[str, np.ndarray]:
        """Arrays (frame, frequency) of all variables at frames under one set of metadata."""
        station, made = self._stations[regime], {}
        if station.pressure is not None:
            made["p"] = self._channels.frames(station.pressure, starts)
        motion = [self._channels.frames(channel, starts) for channel in station.motion]
        for name, weights in self._rotations[regime].items():
            terms = [np.float32(w) * array for w, array in zip(weights, motion, strict=True) if w != 0]
            made[name] = sum(terms[1:], start=terms[0])
        for name in self.units.keys() - made.keys():
            made[name] = np.full((starts.size, self.frequency.size), np.complex64(complex(np.nan, np.nan)))
        return made
