"""Multichannel recordings: a WAV file or an array in, stretches of samples a hydrophone out."""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import wavfile

from obsnet.errors import WaveformError

BLOCK = 1_000_000


@dataclass(frozen=True)
class Recording:
    """Samples of several hydrophones, read from disk as they are asked for.

    Attributes
    ----------
    sampling_rate : Hz
    raw : array (time, hydrophone), as stored; full scale is ±`full_scale` around `midpoint`.
    """

    sampling_rate: float
    raw: np.ndarray
    full_scale: float = 1.0
    midpoint: float = 0.0
    name: str = "the recording"

    @classmethod
    def of(cls, source: str | Path | tuple[float, np.ndarray]) -> Recording:
        """A WAV file, or a pair (sampling rate [Hz], array (hydrophone, time))."""
        if isinstance(source, (str, Path)):
            return cls.open(source)
        try:
            rate, samples = source
            rate, samples = float(rate), np.asarray(samples)
        except (TypeError, ValueError):
            raise WaveformError(
                "a recording is a WAV file or a pair (sampling rate, array (hydrophone, time)), "
                f"found {type(source).__name__}"
            ) from None
        if samples.ndim != 2 or not np.issubdtype(samples.dtype, np.number) or np.iscomplexobj(samples):
            raise WaveformError(
                f"samples must be real, dims (hydrophone, time), found {samples.dtype} {samples.shape}"
            )
        if samples.shape[0] > samples.shape[1] > 0:
            raise WaveformError(
                f"samples must have dims (hydrophone, time), found shape {samples.shape}; transpose the array"
            )
        return cls(rate, samples.T)._checked()

    @classmethod
    def open(cls, path: str | Path) -> Recording:
        """Open a WAV file of any PCM or float format; mapped, not read, where its format allows.

        Raises
        ------
        WaveformError
            There is no such file, it is not WAV, it is cut short, or it holds no sample.
        """
        path = Path(path)
        try:
            rate, raw = _read(path)
        except FileNotFoundError:
            raise WaveformError(f"{path} does not exist; give the path of a WAV file") from None
        except OSError as error:
            raise WaveformError(f"cannot read {path}: {error.strerror or error}") from None
        except (ValueError, struct.error, EOFError, TypeError, ZeroDivisionError, UnboundLocalError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise WaveformError(f"{path} is not a complete PCM or float WAV file: {reason}") from None
        raw = raw[:, None] if raw.ndim == 1 else raw
        if np.issubdtype(raw.dtype, np.floating):
            return cls(float(rate), raw, name=str(path))._checked()
        half = 2.0 ** (8 * raw.dtype.itemsize - 1)
        midpoint = half if raw.dtype == np.uint8 else 0.0
        return cls(float(rate), raw, half, midpoint, str(path))._checked()

    def _checked(self) -> Recording:
        if not (np.isfinite(self.sampling_rate) and self.sampling_rate > 0):
            raise WaveformError(
                f"{self.name} has a sampling rate of {self.sampling_rate!r} Hz; it must be positive"
            )
        if self.raw.size == 0:
            raise WaveformError(f"{self.name} holds no sample")
        return self

    @property
    def count(self) -> int:
        """Number of hydrophones."""
        return self.raw.shape[1]

    @property
    def length(self) -> int:
        """Samples a hydrophone."""
        return self.raw.shape[0]

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return self.length / self.sampling_rate

    def select(self, channels: tuple[int, ...]) -> Recording:
        """The given channels, counted from 1, in the given order.

        Raises
        ------
        WaveformError
            The recording has no such channel.
        """
        if not channels or min(channels) < 1 or max(channels) > self.count:
            raise WaveformError(f"{self.name} has channels 1 to {self.count}, asked for {channels}")
        raw = self.raw[:, [channel - 1 for channel in channels]]
        return Recording(self.sampling_rate, raw, self.full_scale, self.midpoint, self.name)

    def segment(self, start: int, stop: int, dtype: type = np.float64) -> np.ndarray:
        """Samples [start, stop) as (hydrophone, time), full scale 1; zero beyond the ends, NaN where not a
        number.
        """
        inside: np.ndarray = np.asarray(self.raw[max(start, 0) : max(stop, 0)], dtype)
        scaled = (inside - dtype(self.midpoint)) / dtype(self.full_scale)
        scaled[~np.isfinite(scaled)] = np.nan
        before = min(max(-start, 0), stop - start)
        after = stop - start - before - len(scaled)
        return np.pad(scaled, ((before, after), (0, 0))).T if before or after else scaled.T

    def gaps(self) -> np.ndarray:
        """Stretches in which a hydrophone has no number, dims (gap, (start, end)), s; integer formats have
        none.
        """
        if not np.issubdtype(self.raw.dtype, np.floating):
            return np.zeros((0, 2))
        edges: list[int] = []
        missing = False
        for first in range(0, self.length, BLOCK):
            bad = ~np.isfinite(self.raw[first : first + BLOCK]).all(axis=1)
            steps = np.flatnonzero(np.diff(np.concatenate([[missing], bad]).astype(np.int8)))
            edges += (first + steps).tolist()
            missing = bool(bad[-1])
        edges += [self.length] if missing else []
        return np.array(edges, float).reshape(-1, 2) / self.sampling_rate


def read_wav(path: str | Path) -> tuple[float, np.ndarray]:
    """Sampling rate [Hz] and samples of a multichannel WAV file.

    Returns
    -------
    sampling_rate : Hz
    samples : float32 array (hydrophone, time), full scale ±1 for integer formats, as stored for float ones.

    Raises
    ------
    WaveformError
        As `Recording.open`.
    """
    recording = Recording.open(path)
    return recording.sampling_rate, np.ascontiguousarray(recording.segment(0, recording.length, np.float32))


def _read(path: Path) -> tuple[int, np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)
        try:
            return wavfile.read(path, mmap=True)
        except ValueError as error:
            if "container size" not in str(error):
                raise
        _refuse_short(path)
        return wavfile.read(path)


def _refuse_short(path: Path) -> None:
    """Refuse a file shorter than its header says; scipy sees that only where it maps the file."""
    with path.open("rb") as file:
        head = file.read(8)
    order = ">" if head[:4] == b"RIFX" else "<"
    declared = struct.unpack(order + "I", head[4:8])[0] + 8
    found = path.stat().st_size
    if head[:4] in (b"RIFF", b"RIFX") and declared > found:
        raise ValueError(f"its header says {declared} bytes, it holds {found}")
