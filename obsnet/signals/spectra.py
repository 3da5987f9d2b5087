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
from typing import Any

import numpy as np
import xarray as xr

from obsnet.errors import ConfigError, StationError, WaveformError
from obsnet.layout import iso
from obsnet.signals.frames import FrameTransform, clipped, constant, touched
from obsnet.signals.response import described, frequency_response
from obsnet.signals.station import Channel, Station
from obsnet.signals.timeline import Run
from obsnet.signals.waveforms import WaveformSource, open_waveforms

_SECOND = 1_000_000_000
_BATCH = 64
_DELAY_TOLERANCE_S = 1e-7


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
        As from `spectra`, of at most `block_s`; all blocks have the same variables.
    """
    first, last = _frame_range(source, config)
    front = _FrontEnd(source, config, first, last)
    step = max(round(config.block_s / config.hop_s), 1)
    for begin in range(first, last, step):
        yield front.block(np.arange(begin, min(begin + step, last)))


def _frame_range(source: WaveformSource, config: SpectraConfig) -> tuple[int, int]:
    """Frames (in hops since 1970) whose centre is asked for and which lie in the data, to half a sample."""
    hop, window = config.hop_ns, config.window_ns
    half = round(0.5 / config.analysis_rate_hz * _SECOND)
    first = max(-(-(source.begin_ns - window // 2) // hop), -(-(source.data_begin_ns - half) // hop))
    last = min(-(-(source.end_ns - window // 2) // hop), (source.data_end_ns + half - window) // hop + 1)
    if first >= last:
        span = (min(source.end_ns, source.data_end_ns) - max(source.begin_ns, source.data_begin_ns)) / _SECOND
        raise WaveformError(
            f"the waveforms of {source.station.code} hold no whole frame: {span:g} s from "
            f"{iso(np.datetime64(max(source.begin_ns, source.data_begin_ns), 'ns'))}; give at least "
            f"{config.window_s + config.hop_s:g} s"
        )
    return first, last


class _FrontEnd:
    """Turns frame numbers into spectra; keeps what depends on the channel or its rate alone."""

    def __init__(self, source: WaveformSource, config: SpectraConfig, first: int, last: int) -> None:
        self.source, self.config, self.frequency = source, config, config.frequency
        self._inverses: dict[Channel, np.ndarray] = {}
        self._transforms: dict[float, FrameTransform] = {}
        edges = {t for c in source.station.epochs for t in (c.starttime, c.endtime) if math.isfinite(t)}
        self._edges = np.sort(np.array([round(t * _SECOND) for t in edges], np.int64))
        centres = np.array([first, last - 1]) * config.hop_ns + config.window_ns // 2
        inside = self._edges[(self._edges > centres[0]) & (self._edges <= centres[1])]
        self._stations = {int(t): source.station_at(int(t)) for t in (centres[0], *inside)}
        self._rotations = {t: _rotation(station, source) for t, station in self._stations.items()}
        self.units: dict[str, str] = {}
        for t, station in self._stations.items():
            if station.pressure is not None:
                self.units["p"] = "Pa" if self._known(station.pressure) else "count"
            for name in self._rotations[t]:
                self.units[name] = "m/s" if all(map(self._known, station.motion)) else "count"
        if not self.units:
            raise StationError(
                f"no channel of {source.station.code} has an epoch at the time of its waveforms, "
                f"{iso(np.datetime64(int(centres[0]), 'ns'))}; give metadata of that time"
            )

    def _known(self, channel: Channel) -> bool:
        if not described(channel.response):
            self.source.report.note(f"{channel.seed_id} has no response: its samples are taken as they are")
        return described(channel.response)

    def block(self, frames: np.ndarray) -> xr.Dataset:
        """Dataset of the given (consecutive) frames."""
        starts = frames * self.config.hop_ns
        centres = starts + self.config.window_ns // 2
        variables = {name: np.empty((frames.size, self.frequency.size), np.complex64) for name in self.units}
        regimes = np.array(sorted(self._stations))
        owner = np.clip(np.searchsorted(regimes, centres, "right") - 1, 0, None)
        for j in np.unique(owner):
            mine = owner == j
            made = self._components(int(regimes[j]), starts[mine])
            for name, target in variables.items():
                target[mine] = made.get(name, np.complex64(complex(np.nan, np.nan)))
        data = {
            name: (("frequency", "time"), array.T, {"units": self.units[name]})
            for name, array in variables.items()
        }
        return xr.Dataset(
            data,
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
        station, made = self._stations[regime], {}
        if station.pressure is not None:
            made["p"] = self._channel(station.pressure, starts)
        motion = [self._channel(channel, starts) for channel in station.motion]
        for name, weights in self._rotations[regime].items():
            terms = [weight * array for weight, array in zip(weights, motion, strict=True) if weight != 0]
            made[name] = sum(terms[1:], start=terms[0])
        return made

    def _channel(self, channel: Channel, starts: np.ndarray) -> np.ndarray:
        """Spectra (frame, frequency) of one channel in its own direction, in Pa or m/s."""
        out = np.full((starts.size, self.frequency.size), np.complex64(complex(np.nan, np.nan)))
        timeline = self.source.timelines[channel.seed_id]
        for run in timeline.between(
            int(starts[0]) - _SECOND, int(starts[-1]) + self.config.window_ns + _SECOND
        ):
            transform = self._transform(run.rate)
            position = run.nearest(starts)
            whole = np.flatnonzero((position >= 0) & (position + transform.count <= run.length))
            if whole.size:
                position = position[whole]
                delay = run.delay(position + transform.count // 2, starts[whole]) - transform.middle_s
                self._fill(out, whole, run, position, delay, channel, transform)
        return out

    def _fill(
        self,
        out: np.ndarray,
        rows: np.ndarray,
        run: Run,
        position: np.ndarray,
        delay: np.ndarray,
        channel: Channel,
        transform: FrameTransform,
    ) -> None:
        """Transform the frames that start at `position` in `run` into `out[rows]`."""
        count, still = transform.count, max(round(self.config.dead_s * run.rate), 2)
        low, high = (
            max(int(position[0]) - 2 * still, 0),
            min(int(position[-1]) + count + 2 * still, run.length),
        )
        samples = run.read(low, high)
        position = position - low
        dead = touched(constant(samples, still), position, count)
        views = np.lib.stride_tricks.sliding_window_view(samples, count)
        factor = (self._inverse(channel) * transform.scale).astype(np.complex64)
        stuck = np.zeros(rows.size, bool)
        for batch in range(0, rows.size, _BATCH):
            chosen = slice(batch, batch + _BATCH)
            cut = views[position[chosen]].astype(np.float64)
            stuck[chosen] = clipped(cut, self.config.clip_share)
            out[rows[chosen]] = transform(cut) * factor * self._turn(delay[chosen])
        out[rows[dead | stuck]] = complex(np.nan, np.nan)
        report = self.source.report.channels.get(channel.seed_id)
        if report is not None:
            report.dead_frames += int(dead.sum())
            report.clipped_frames += int((stuck & ~dead).sum())

    def _turn(self, delay: np.ndarray) -> np.ndarray | np.complex64:
        """Phase that undoes the lateness [s] of the samples, one row a frame."""
        if np.max(np.abs(delay)) < _DELAY_TOLERANCE_S:
            return np.complex64(1)
        distinct = delay[:1] if np.ptp(delay) < _DELAY_TOLERANCE_S else delay
        return np.exp(-2j * np.pi * distinct[:, None] * self.frequency).astype(np.complex64)

    def _transform(self, rate: float) -> FrameTransform:
        key = round(rate, 4)
        if key not in self._transforms:
            self._transforms[key] = FrameTransform(rate, self.config.window_s, self.frequency.size)
        return self._transforms[key]

    def _inverse(self, channel: Channel) -> np.ndarray:
        """Physical units per count at each frequency, polarity included, no further than the water level."""
        if channel not in self._inverses:
            response = channel.polarity * frequency_response(
                channel.response, self.frequency, channel.kind, channel.seed_id
            )
            size = np.abs(response)
            level = size[1:].max(initial=0.0) * 10 ** (-self.config.water_level_db / 20)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = np.conj(response) / (size * np.maximum(size, level))
            self._inverses[channel] = np.where(size > 0, inverse, 0)
        return self._inverses[channel]


def _rotation(station: Station, source: WaveformSource) -> dict[str, np.ndarray]:
    """Weights of the motion channels in east, north and down, as far as they determine them."""
    motion = station.motion
    flat = [i for i, channel in enumerate(motion) if channel.horizontal]
    steep = [i for i, channel in enumerate(motion) if not channel.horizontal]
    if len(flat) < 2:
        if flat:
            source.report.note(f"{motion[flat[0]].seed_id} is the only horizontal: no azimuth")
        weights = {"down": np.zeros(len(motion))} if steep else {}
        for name in weights:
            weights[name][steep[0]] = 1.0 / motion[steep[0]].direction[2]
        return weights
    for i in flat:
        if motion[i].azimuth_deg is None:
            raise StationError(f"{motion[i].seed_id} has no azimuth in its StationXML; give --orientation")
    used = flat + steep if len(motion) == 3 else flat
    directions = np.array([motion[i].direction for i in used])[:, : len(used)]
    if abs(np.linalg.det(directions)) < 0.1:
        ids = " and ".join(motion[i].seed_id for i in flat)
        angles = " and ".join(f"{motion[i].azimuth_deg:g}°" for i in flat)
        raise StationError(f"{ids} point along {angles}: they are not independent; give --orientation")
    inverse = np.linalg.inv(directions)
    inverse[np.abs(inverse) < 1e-9] = 0.0
    names = ("east", "north", "down")[: len(used)]
    weights = {name: np.zeros(len(motion)) for name in names}
    for name, row in zip(names, inverse, strict=True):
        weights[name][used] = row
    return weights
