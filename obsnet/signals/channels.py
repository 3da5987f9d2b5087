"""Frames of single channels in physical units, and the weights that make east, north and down of them."""

from __future__ import annotations

import numpy as np

from obsnet.errors import StationError
from obsnet.signals.frames import FrameTransform, clipped, constant, touched
from obsnet.signals.response import described, frequency_response
from obsnet.signals.station import Channel, Station
from obsnet.signals.timeline import Run
from obsnet.signals.waveforms import WaveformReport, Waveforms

_BATCH_SAMPLES = 1 << 16
_READ_SAMPLES = 1 << 22
_DELAY_TOLERANCE_S = 1e-7
_SECOND = 1_000_000_000


class ChannelSpectra:
    """Spectra of single channels, frame by frame; keeps what depends on the channel or its rate alone.

    Parameters
    ----------
    source : Waveforms
    frequency : ndarray (n,)
        Multiples of 1 / `window_s` from 0 Hz up.
    window_s, water_level_db, dead_s, clip_share : float
        As in `SpectraConfig`.
    """

    def __init__(
        self,
        source: Waveforms,
        frequency: np.ndarray,
        window_s: float,
        water_level_db: float,
        dead_s: float,
        clip_share: float,
    ) -> None:
        self._source, self._frequency = source, frequency
        self._window_s, self._water_level_db = window_s, water_level_db
        self._dead_s, self._clip_share = dead_s, clip_share
        self._inverses: dict[Channel, np.ndarray] = {}
        self._transforms: dict[float, FrameTransform] = {}

    def frames(self, channel: Channel, starts_ns: np.ndarray) -> np.ndarray:
        """Spectra (frame, frequency) of the frames that start at given times; NaN where one is not whole."""
        out = np.full((starts_ns.size, self._frequency.size), np.complex64(complex(np.nan, np.nan)))
        begin, end = int(starts_ns[0]) - _SECOND, int(starts_ns[-1]) + round((self._window_s + 1) * _SECOND)
        for run in self._source.timelines[channel.seed_id].between(begin, end):
            transform = self._transform(run.rate)
            position = run.nearest(starts_ns)
            whole = np.flatnonzero((position >= 0) & (position + transform.count <= run.length))
            # a block of hydrophone samples at 100 kHz would not fit: read a few frames at a time
            share = max(_READ_SAMPLES // transform.count, 1)
            for rows in np.split(whole, range(share, whole.size, share)) if whole.size else ():
                late = run.delay(position[rows] + transform.count // 2, starts_ns[rows]) - transform.middle_s
                out[rows] = self._transformed(run, position[rows], late, channel, transform)
        return out

    def _transformed(
        self, run: Run, position: np.ndarray, late: np.ndarray, channel: Channel, transform: FrameTransform
    ) -> np.ndarray:
        """Spectra of the frames that start at samples `position` of a run, `late` s after they should."""
        count, still = transform.count, max(round(self._dead_s * run.rate), 2)
        low = max(int(position[0]) - 2 * still, 0)
        samples = run.read(low, min(int(position[-1]) + count + 2 * still, run.length))
        position = position - low
        dead = touched(constant(samples, still), position, count)
        views = np.lib.stride_tricks.sliding_window_view(samples, count)
        factor = (self._inverse(channel) * transform.scale).astype(np.complex64)
        stuck = np.zeros(position.size, bool)
        out = np.empty((position.size, self._frequency.size), np.complex64)
        step = max(_BATCH_SAMPLES // count, 1)
        for batch in range(0, position.size, step):
            chosen = slice(batch, batch + step)
            cut = views[position[chosen]].astype(np.float64)
            stuck[chosen] = clipped(cut, self._clip_share)
            with np.errstate(invalid="ignore"):  # a frame with infinite samples becomes NaN
                np.multiply(transform(cut), factor, out=out[chosen])
            self._turn(out[chosen], late[chosen])
        dead |= ~np.isfinite(out[:, 0])  # one sample that is no number spoils every bin
        out[dead | stuck] = complex(np.nan, np.nan)
        report = self._source.report.channels[channel.seed_id]
        report.usable_frames += int((~(dead | stuck)).sum())
        report.dead_frames += int(dead.sum())
        report.clipped_frames += int((stuck & ~dead).sum())
        report.transform = transform.name
        return out

    def _turn(self, spectra: np.ndarray, late: np.ndarray) -> None:
        """Undo the lateness [s] of each row's samples."""
        if np.max(np.abs(late)) < _DELAY_TOLERANCE_S:
            return
        distinct = late[:1] if np.ptp(late) < _DELAY_TOLERANCE_S else late
        spectra *= np.exp(-2j * np.pi * distinct[:, None] * self._frequency).astype(np.complex64)

    def _transform(self, rate: float) -> FrameTransform:
        key = round(rate, 4)
        if key not in self._transforms:
            self._transforms[key] = FrameTransform(rate, self._window_s, self._frequency.size)
        return self._transforms[key]

    def _inverse(self, channel: Channel) -> np.ndarray:
        """Physical units per count at each frequency, polarity included, no further than the water level."""
        if channel not in self._inverses:
            response = channel.polarity * frequency_response(
                channel.response, self._frequency, channel.kind, channel.seed_id
            )
            size = np.abs(response)
            level = size[1:].max(initial=0.0) * 10 ** (-self._water_level_db / 20)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = np.conj(response) / (size * np.maximum(size, level))
            self._inverses[channel] = np.where(size > 0, inverse, 0)
        return self._inverses[channel]


def rotation(station: Station, report: WaveformReport) -> dict[str, np.ndarray]:
    """Weights of the motion channels in east, north and down, as far as the channels determine them.

    Parameters
    ----------
    station : Station
    report : WaveformReport
        Is told of a horizontal that is alone.

    Raises
    ------
    StationError
        A horizontal of a pair has no azimuth, the channels are not independent, or counts and m/s would
        make one direction.
    """
    motion = station.motion
    flat = [i for i, channel in enumerate(motion) if channel.horizontal]
    steep = [i for i, channel in enumerate(motion) if not channel.horizontal]
    if len(flat) < 2:
        if flat:
            report.note(f"{motion[flat[0]].seed_id} is the only horizontal: no azimuth")
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
    for together in (("east", "north"), ("down",)):
        _require_one_unit([
            channel
            for i, channel in enumerate(motion)
            if any(weights[name][i] for name in together if name in weights)
        ])  # fmt: skip
    return weights


def _require_one_unit(channels: list[Channel]) -> None:
    """Raise `StationError` where only some of the channels have a response."""
    bare, known = (
        [channel.seed_id for channel in channels if described(channel.response) == has]
        for has in (False, True)
    )
    if bare and known:
        lack, have = ("have" if len(ids) > 1 else "has" for ids in (bare, known))
        raise StationError(
            f"{' and '.join(bare)} {lack} no response, but {' and '.join(known)} {have} one: counts and m/s make no "
            "direction together; complete the StationXML, or leave out the response of all"
        )
