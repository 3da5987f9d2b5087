"""Spectra in, what the learned azimuth detector sees out: invariants and a phasor for each cell of 20 s and one bin.

The invariants do not change when the station is turned, and the phasor turns with it. They depend on the frames before
a cell and 40 s after it alone, never on where a block begins, so that any split of a record gives the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.detectors.background import BackgroundDirection
from obsnet.errors import LayoutError, ModelError
from obsnet.layout import from_posix, to_posix

BIN_S = 20.0
"""Length of a cell; cells begin at 10 s past UTC multiples of it, so that nine fill a window of 180 s about a minute."""

AHEAD, PAST = 2, 8
"""Cells after and before one that its invariants look at."""

LOOK_AHEAD_S = AHEAD * BIN_S

CHANNELS = (
    "level", "line", "transience", "coherence", "focus_near", "agreement_near", "focus_past", "agreement_past",
    "focus_band", "agreement_band", "background", "agreement_background",
)  # fmt: skip
"""Names of the invariants, in the order of the last axis but one of `Cells.invariants`."""


@dataclass(frozen=True)
class FeatureConfig:
    """Band [Hz] of the cells, memory [s] of the slow level and the background's direction, and how long [s] a direction must
    have been heard to count half as background.
    """

    fmin_hz: float = 11.0
    fmax_hz: float = 24.0
    memory_s: float = 21600.0
    memory_step_s: float = 600.0
    background_prior_s: float = 3600.0


@dataclass(frozen=True)
class Cells:
    """Consecutive cells of time.

    Attributes
    ----------
    index : int64 (time), number of the cell: it begins at (index + ½) · 20 s since 1970.
    invariants : float32 (time, channel, frequency), 0 where there are no data.
    phasor : complex64 (time, frequency), modulus 1, the azimuth to the source (or twice it); 0 where there are no data.
    ambiguity_deg : 360, or 180 where the phasor's argument is twice the azimuth.
    """

    index: np.ndarray
    invariants: np.ndarray
    phasor: np.ndarray
    ambiguity_deg: int = 360

    @property
    def valid(self) -> np.ndarray:
        """Which cells of time have data."""
        return np.abs(self.phasor).max(axis=1, initial=0.0) > 0

    def between(self, first: int, stop: int) -> Cells:
        """Cells first … stop − 1, those that are not held without data."""
        low, high = np.searchsorted(self.index, (first, stop))
        pad = (int(self.index[low]) - first if high > low else stop - first, 0)
        pad = (pad[0], stop - first - pad[0] - int(high - low))

        def padded(values: np.ndarray) -> np.ndarray:
            return np.pad(values[low:high], (pad, *[(0, 0)] * (values.ndim - 1)))

        index = np.arange(first, stop)
        return Cells(index, padded(self.invariants), padded(self.phasor), self.ambiguity_deg)

    def joined(self, new: Cells) -> Cells:
        """These cells and the ones that follow."""
        return Cells(
            np.concatenate([self.index, new.index]),
            np.concatenate([self.invariants, new.invariants]),
            np.concatenate([self.phasor, new.phasor]),
            new.ambiguity_deg,
        )

    def since(self, first: int) -> Cells:
        """The cells from a number on."""
        low = int(np.searchsorted(self.index, first))
        return Cells(self.index[low:], self.invariants[low:], self.phasor[low:], self.ambiguity_deg)

    def state(self) -> dict[str, np.ndarray]:
        """As arrays by name."""
        return vars(self) | {"ambiguity_deg": np.array(self.ambiguity_deg)}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Cells:
        """From `state`."""
        return cls(state["index"], state["invariants"], state["phasor"], int(state["ambiguity_deg"]))


def cell_index(time_s: np.ndarray | float) -> np.ndarray:
    """Number of the cell that holds a time [s since 1970]."""
    return np.floor((np.asarray(time_s, float) - BIN_S / 2) / BIN_S + 1e-9).astype(np.int64)


class AzimuthFeatures:
    """Makes cells of consecutive blocks of spectra; blocks must come in time order.

    The memory of a slow level per frequency (the median over 6 h of medians over 10 min, before the cell's own 10 min) and
    of the background's direction is 0 until 10 min have been heard.
    """

    def __init__(self, config: FeatureConfig = FeatureConfig()) -> None:
        self.config = config
        self._background = BackgroundDirection(
            config.memory_s, config.memory_step_s, config.background_prior_s
        )
        self._levels: dict[int, np.ndarray] = {}
        self._open: _Frames | None = None
        self._base: _Base | None = None
        self._emitted: int | None = None
        self._ambiguity_deg = 360

    def push(self, spectra: xr.Dataset) -> Cells:
        """Cells that the block finishes.

        Parameters
        ----------
        spectra : Dataset of east and north, and p where there is one; dims (frequency, time).

        Raises
        ------
        LayoutError : the horizontals are missing.
        ModelError : the spectra do not cover the band.
        """
        frames = self._frames(spectra)
        self._open = frames if self._open is None else self._open.joined(frames)
        if not len(self._open.time):
            return self._cells(0)
        last = int(cell_index(self._open.time[-1]))
        self._bin(before=last)
        return self._cells(last - AHEAD)

    def flush(self) -> Cells:
        """Cells of the record's end, whose surroundings are missing."""
        if self._open is None or not len(self._open.time):
            return self._cells(0)
        last = int(cell_index(self._open.time[-1])) + 1
        self._bin(before=last)
        return self._cells(last)

    def restart(self) -> None:
        """Begin anew after a long silence; the slow memory stays."""
        self._open = self._base = self._emitted = None

    def state(self) -> dict[str, np.ndarray]:
        """All that the next cell depends on, as arrays that are never changed in place."""
        arrays = {"ambiguity_deg": np.array(self._ambiguity_deg)}
        if self._emitted is not None:
            arrays["emitted"] = np.array(self._emitted)
        arrays |= {f"level/{step}": held for step, held in self._levels.items()}
        arrays |= {f"background/{key}": value for key, value in self._background.state().items()}
        for name, part in (("open", self._open), ("base", self._base)):
            if part is not None:
                arrays |= {f"{name}/{key}": value for key, value in vars(part).items()}
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        parts: dict[str, dict[str, np.ndarray]] = {"level": {}, "background": {}, "open": {}, "base": {}}
        for key, value in state.items():
            part, _, name = key.partition("/")
            if name:
                parts[part][name] = value
        self._ambiguity_deg = int(state["ambiguity_deg"])
        self._emitted = int(state["emitted"]) if "emitted" in state else None
        self._levels = {int(step): held for step, held in parts["level"].items()}
        self._background.restore(parts["background"])
        self._open = _Frames(**parts["open"]) if parts["open"] else None
        self._base = _Base(**parts["base"]) if parts["base"] else None

    def _frames(self, spectra: xr.Dataset) -> _Frames:
        missing = [name for name in ("east", "north") if name not in spectra]
        if missing:
            raise LayoutError(f"a learned azimuth needs both horizontals; {' and '.join(missing)} missing")
        band = self._band(spectra["frequency"].values)
        time = to_posix(spectra["time"].values)
        east, north = (spectra[name].values[band].T for name in ("east", "north"))
        motion = east.real**2 + east.imag**2 + north.real**2 + north.imag**2
        if "p" in spectra:
            p = spectra["p"].values[band].T
            power = p.real**2 + p.imag**2
            flow = -(p.real * north.real + p.imag * north.imag) - 1j * (
                p.real * east.real + p.imag * east.imag
            )
            size = np.sqrt(power * motion)
        else:
            self._ambiguity_deg = 180
            power, size = motion, motion
            difference = north.real**2 + north.imag**2 - east.real**2 - east.imag**2
            flow = difference + 2j * (north.real * east.real + north.imag * east.imag)
        valid = np.isfinite(size).all(axis=1) & (size > 0).any(axis=1)
        size = np.where(size > 0, size, np.inf)
        flow = np.where(valid[:, None], flow / size, 0).astype(np.complex64)
        with np.errstate(divide="ignore", invalid="ignore"):
            level = np.log10(np.maximum(power, np.finfo(np.float32).tiny)).astype(np.float32)
        background = self._direction(flow, valid, spectra["frequency"].values[band], time)
        slow = self._slow(level, valid, time)
        level = np.where(valid[:, None], level, 0.0)
        return _Frames(time, valid, flow, level, level - np.where(np.isnan(slow), level, slow), background)

    def _band(self, frequency: np.ndarray) -> slice:
        config = self.config
        if frequency[-1] < config.fmax_hz:
            raise ModelError(
                f"the azimuth model listens from {config.fmin_hz:g} to {config.fmax_hz:g} Hz, the spectra end at "
                f"{frequency[-1]:g} Hz; use --detector analytic or a model trained for this rate"
            )
        lo, hi = np.searchsorted(frequency, (config.fmin_hz, config.fmax_hz + 1e-9))
        return slice(int(lo), int(hi))

    def _direction(
        self, flow: np.ndarray, valid: np.ndarray, frequency: np.ndarray, time: np.ndarray
    ) -> np.ndarray:
        modulus = np.abs(flow)
        unit = np.where(valid[:, None], flow / np.where(modulus > 0, modulus, 1), np.nan + 0j)
        azigram = xr.DataArray(
            unit.T.astype(np.complex64),
            dims=("frequency", "time"),
            coords={"frequency": frequency, "time": from_posix(time)},
        )
        return self._background(azigram).T

    def _slow(self, level: np.ndarray, valid: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Median level of the steps before each frame's own; NaN before the first whole step."""
        config = self.config
        steps = np.floor(time / config.memory_step_s).astype(np.int64)
        slow = np.full(level.shape, np.nan, np.float32)
        for step in np.unique(steps):
            inside = steps == step
            oldest = step - round(config.memory_s / config.memory_step_s)
            for key in [key for key in self._levels if key < oldest]:
                del self._levels[key]
            before = [
                self._median(key) for key in sorted(self._levels) if key < step and len(self._levels[key])
            ]
            if before:
                slow[inside] = np.median(before, axis=0)
            heard = level[inside & valid]
            held = self._levels.get(int(step))
            self._levels[int(step)] = heard if held is None else np.concatenate([held, heard])
        return slow

    def _median(self, step: int) -> np.ndarray:
        """Median level of a step that is over; it is kept in the place of its frames."""
        if len(self._levels[step]) > 1:
            self._levels[step] = np.median(self._levels[step], axis=0)[None]
        return self._levels[step][0]

    def _bin(self, before: int) -> None:
        """Turn the open frames that lie before a cell into cells."""
        frames = self._open
        assert frames is not None
        cells = cell_index(frames.time)
        done = int(np.searchsorted(cells, before))
        base = _Base.of(frames.part(slice(0, done)), cells[:done], before)
        self._open = frames.part(slice(done, None))
        if base is not None:
            self._base = base if self._base is None else self._base.joined(base)

    def _cells(self, before: int) -> Cells:
        """Invariants of the cells held that lie before one and have not been given yet."""
        base = self._base
        if base is None:
            width = 0 if self._open is None else self._open.flow.shape[1]
            empty = np.empty((0, len(CHANNELS), width), np.float32)
            return Cells(
                np.empty(0, np.int64), empty, np.empty((0, width), np.complex64), self._ambiguity_deg
            )
        first = int(base.index[0]) if self._emitted is None else self._emitted
        low, high = np.searchsorted(base.index, (first, max(before, first)))
        cells = _invariants(base, int(low), int(high), self._ambiguity_deg)
        self._emitted = max(before, first)
        self._base = base.part(slice(max(int(high) - PAST, 0), None))
        return cells


@dataclass(frozen=True)
class _Frames:
    """Frames not yet in a cell; arrays (time, frequency)."""

    time: np.ndarray
    valid: np.ndarray
    flow: np.ndarray
    level: np.ndarray
    excess: np.ndarray
    background: np.ndarray

    def part(self, chosen: slice) -> _Frames:
        return _Frames(*(value[chosen] for value in vars(self).values()))

    def joined(self, new: _Frames) -> _Frames:
        pairs = zip(vars(self).values(), vars(new).values(), strict=True)
        return _Frames(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class _Base:
    """Means over the frames of each cell; arrays (time, frequency), 0 where there are no data."""

    index: np.ndarray
    valid: np.ndarray
    flow: np.ndarray
    level: np.ndarray
    excess: np.ndarray
    background: np.ndarray

    @classmethod
    def of(cls, frames: _Frames, cells: np.ndarray, before: int) -> _Base | None:
        if not len(cells):
            return None
        index = np.arange(int(cells[0]), before)
        edges = np.searchsorted(cells, np.arange(int(cells[0]), before + 1))
        weight = frames.valid.astype(np.float32)
        count = np.add.reduceat(np.append(weight, 0), edges[:-1]) * (edges[1:] > edges[:-1])

        def mean(values: np.ndarray) -> np.ndarray:
            padded = np.concatenate([values * weight[:, None], np.zeros((1, values.shape[1]), values.dtype)])
            total = np.add.reduceat(padded, edges[:-1], axis=0)
            total[edges[1:] <= edges[:-1]] = 0
            return total / np.maximum(count, 1)[:, None].astype(np.float32)

        made = (mean(getattr(frames, name)) for name in ("flow", "level", "excess", "background"))
        return cls(index, count > 0, *made)

    def part(self, chosen: slice) -> _Base:
        return _Base(*(value[chosen] for value in vars(self).values()))

    def joined(self, new: _Base) -> _Base:
        pairs = zip(vars(self).values(), vars(new).values(), strict=True)
        return _Base(*(np.concatenate(pair) for pair in pairs))


def _invariants(base: _Base, low: int, high: int, ambiguity_deg: int) -> Cells:
    """Cells low … high − 1 of the base."""
    start, stop = max(low - PAST, 0), min(high + AHEAD, len(base.index))
    flow, level, valid = (values[start:stop] for values in (base.flow, base.level, base.valid))
    inner = slice(low - start, high - start)
    modulus = np.abs(flow)
    unit = flow / np.where(modulus > 0, modulus, 1)
    near = _window_mean(unit, valid, AHEAD, AHEAD)[inner]
    past = _window_mean(unit, valid, PAST, 0)[inner]
    usual = _window_mean(level, valid, PAST, 0)[inner]
    band = _smooth(near, 5)
    unit, level, valid, modulus = unit[inner], level[inner], valid[inner], modulus[inner]
    background = base.background[low:high]
    channels = [
        np.clip(base.excess[low:high], -2.0, 3.0),
        np.clip(level - _smooth(level, 43), -1.5, 2.5),
        np.clip(level - usual, -2.0, 2.0),
        modulus,
        *_focus(unit, near),
        *_focus(unit, past),
        *_focus(unit, band),
        np.abs(background),
        unit.real * background.real + unit.imag * background.imag,
    ]
    invariants = np.stack(channels, axis=1).astype(np.float32) * valid[:, None, None]
    return Cells(base.index[low:high], invariants, unit.astype(np.complex64), ambiguity_deg)


def _smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Running mean over an odd number of bins along axis 1, reflected about the ends."""
    padded = np.pad(values, ((0, 0), (count // 2, count // 2)), mode="symmetric")
    total = np.zeros_like(values)
    for shift in range(count):
        total += padded[:, shift : shift + values.shape[1]]
    return total / np.float32(count)


def _focus(unit: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Modulus of a mean phasor, and the cosine between it and the cell's own."""
    modulus = np.abs(mean)
    agreement = (unit.real * mean.real + unit.imag * mean.imag) / np.where(modulus > 0, modulus, 1)
    return modulus, agreement


def _window_mean(values: np.ndarray, valid: np.ndarray, before: int, after: int) -> np.ndarray:
    """Mean of the cells with data among `before` cells before each, itself, and `after` after it; sums term by term, since
    a running sum would depend on where the block begins.
    """
    padded = np.pad(values * valid[:, None], ((before, after), (0, 0)))
    there = np.pad(valid.astype(np.float32), (before, after))
    total = np.zeros_like(values)
    count = np.zeros(len(values), np.float32)
    for shift in range(before + after + 1):
        total += padded[shift : shift + len(values)]
        count += there[shift : shift + len(values)]
    return total / np.maximum(count, 1)[:, None]
