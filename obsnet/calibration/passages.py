"""Spectra and AIS tracks in, the frames in which a known ship was near out, with where the ships then
were.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from obsnet.ais import ReferenceTrack
from obsnet.errors import AISError, LayoutError
from obsnet.layout import iso, to_posix
from obsnet.signals.cepstrogram import CepstrogramConfig, ClutterFilter, cepstrogram

LEVELS_DB = np.arange(-200.0, 120.0, 1.0)
QUIET_SHARE = 0.2
SHIPS = 3
HEARD = ("time", "east_m", "north_m", "passage", "alone", "east_mps", "north_mps")


@dataclass(frozen=True, eq=False)
class Heard:
    """Where the known ships were when they emitted what is heard at each frame.

    Attributes
    ----------
    time : s since 1970, (frame).
    east_m, north_m : m from the station's stated position, (frame, ship), the nearest ship first; infinitely
        far
        where fewer ships are known.
    passage : number of the nearest ship's track, (frame).
    alone : whether the second ship is too far away to matter, (frame).
    east_mps, north_mps : velocity of the nearest ship, m/s, (frame).
    """

    time: np.ndarray
    east_m: np.ndarray
    north_m: np.ndarray
    passage: np.ndarray
    alone: np.ndarray
    east_mps: np.ndarray
    north_mps: np.ndarray

    def relative_to(self, east_m: float, north_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Azimuth [deg] and range [m] of the ships from a station at this offset from its stated position."""
        east, north = self.east_m - east_m, self.north_m - north_m
        return np.rad2deg(np.arctan2(east, north)) % 360.0, np.hypot(east, north)

    def blocks(self, length_s: float) -> np.ndarray:
        """Number of the stretch of `length_s` within its passage that each frame belongs to, from 0."""
        key = np.stack([self.passage.astype(float), np.floor(self.time / length_s)])
        return np.unique(key, axis=1, return_inverse=True)[1].ravel()

    def __getitem__(self, which: np.ndarray) -> Heard:
        return Heard(*(getattr(self, name)[which] for name in HEARD))


@dataclass(frozen=True, eq=False)
class Passages:
    """What the station recorded while a known ship was near.

    Attributes
    ----------
    heard : Heard, one entry per frame.
    frequency : Hz. power : |P|² (frequency, frame). intensity : complex (frequency, frame), −P*V horizontal,
        its
        argument the azimuth to the source as the metadata have it. vertical : Re(P*V_down) and |V_down|², or
        none.
    background : |P|² of the quietest fifth, scaled to the mean of Gaussian noise, and its mean intensity;
        (frequency).
    quefrency : s. cepstra : (frame, quefrency), clutter removed, NaN where unknown.
    nfft : length of the transform behind the cepstra.
    """

    heard: Heard
    frequency: np.ndarray
    power: np.ndarray
    intensity: np.ndarray | None
    vertical: tuple[np.ndarray, np.ndarray] | None
    background: np.ndarray
    background_intensity: np.ndarray | None
    quefrency: np.ndarray
    cepstra: np.ndarray
    nfft: int


def gather(
    blocks: Iterable[xr.Dataset],
    tracks: list[ReferenceTrack],
    delay: Callable[[np.ndarray], np.ndarray],
    *,
    fmin_hz: float,
    fmax_hz: float,
    max_range_m: float,
    isolation: float,
    clutter: CepstrogramConfig,
) -> Passages:
    """Stream through spectra and keep the frames in which a ship of known position is near.

    Parameters
    ----------
    blocks : Datasets of consecutive spectra, with p.
    tracks : reference tracks.
    delay : travel time [s] of range [m].
    fmin_hz, fmax_hz : band of the intensities.
    max_range_m : frames with a ship no farther than this are kept.
    isolation : a ship is alone where the second nearest is this many times as far.

    Raises
    ------
    AISError
        No ship of `tracks` was near while the station recorded.
    LayoutError
        The spectra lack the hydrophone.
    """
    background: _Background | None = None
    clean = ClutterFilter(clutter)
    kept: list[dict[str, np.ndarray]] = []
    names: tuple[np.ndarray, np.ndarray, int] | None = None
    span: list[float] = []
    for block in blocks:
        if not block.sizes["time"]:
            continue
        if "p" not in block:
            raise LayoutError("a calibration needs the hydrophone (p), which is missing from the spectra")
        cells = _cells(block, fmin_hz, fmax_hz)
        times = to_posix(block["time"].values)
        span = [span[0] if span else float(times[0]), float(times[-1])]
        background = background or _Background(cells["power"].shape[0], "intensity" in cells)
        background.add(cells["power"], cells.get("intensity"))
        cepstra = clean(cepstrogram(block))
        names = (block["frequency"].values, cepstra["quefrency"].values, int(cepstra.attrs["nfft"]))
        heard, near = heard_ships(times, tracks, delay, max_range_m, isolation)
        cells = {name: values[:, near].T for name, values in cells.items()}
        cells["cepstra"] = cepstra.values.T[near]
        cells |= {name: getattr(heard, name) for name in HEARD}
        kept.append(cells)
    if names is None or background is None or not sum(len(part["time"]) for part in kept):
        raise AISError(_nobody(tracks, span, max_range_m))
    whole = {name: np.concatenate([part[name] for part in kept]) for name in kept[0]}
    frequency, quefrency, nfft = names
    level, direction = background.quietest()
    return Passages(
        Heard(*(whole[name] for name in HEARD)),
        frequency[_band(frequency, fmin_hz, fmax_hz)],
        whole["power"].T,
        whole["intensity"].T if "intensity" in whole else None,
        (whole["flux"].T, whole["motion"].T) if "flux" in whole else None,
        level,
        direction,
        quefrency,
        whole["cepstra"],
        nfft,
    )


def heard_ships(
    times: np.ndarray,
    tracks: list[ReferenceTrack],
    delay: Callable[[np.ndarray], np.ndarray],
    max_range_m: float,
    isolation: float,
) -> tuple[Heard, np.ndarray]:
    """The nearest ships at each time as they are heard, and which times have a nearest one that is near and
    known.

    A position that is interpolated far from any AIS report is not known. The nearest ship is alone if no
    other is less than `isolation` times as far.
    """
    shape = (times.size, max(len(tracks), SHIPS))
    azimuth, distance, known = np.zeros(shape), np.full(shape, np.inf), np.zeros(shape, bool)
    velocity = np.zeros((2, *shape))
    for i, track in enumerate(tracks):
        found, range_m, _ = track.heard(times, delay)
        there = np.isfinite(range_m)
        azimuth[there, i], distance[there, i] = found[there], range_m[there]
        emitted = times - np.where(there, delay(np.where(there, range_m, 0.0)), 0.0)
        known[:, i] = there & ~track.at(emitted)[2]
        velocity[:, :, i] = track.velocity(emitted)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :SHIPS]
    azimuth, distance, known = (np.take_along_axis(x, nearest, axis=1) for x in (azimuth, distance, known))
    near = known[:, 0] & (distance[:, 0] <= max_range_m)
    first = nearest[near, 0]
    azimuth, distance = np.deg2rad(azimuth[near]), distance[near]
    far = np.where(np.isfinite(distance), distance, 1e9)
    alone = far[:, 1] > isolation * far[:, 0]
    east, north = far * np.sin(azimuth), far * np.cos(azimuth)
    return Heard(times[near], east, north, first, alone, *velocity[:, near, first]), near


def vertex(values: np.ndarray, at: int) -> float:
    """Where the parabola through a value and its neighbours peaks, in steps from `at`, within half a step."""
    if not 0 < at < values.size - 1:
        return 0.0
    below, here, above = values[at - 1 : at + 2]
    bend = below - 2.0 * here + above
    return float(np.clip(0.5 * (below - above) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def _band(frequency: np.ndarray, fmin_hz: float, fmax_hz: float) -> slice:
    return slice(int(np.searchsorted(frequency, fmin_hz)), int(np.searchsorted(frequency, fmax_hz, "right")))


def _cells(block: xr.Dataset, fmin_hz: float, fmax_hz: float) -> dict[str, np.ndarray]:
    band = _band(block["frequency"].values, fmin_hz, fmax_hz)
    pressure = block["p"].values[band]
    cells = {"power": np.abs(pressure) ** 2}
    if "east" in block and "north" in block:
        towards = [-(pressure.conj() * block[name].values[band]).real for name in ("north", "east")]
        cells["intensity"] = (towards[0] + 1j * towards[1]).astype(np.complex64)
    if "down" in block:
        down = block["down"].values[band]
        cells["flux"], cells["motion"] = (pressure.conj() * down).real, np.abs(down) ** 2
    return cells


class _Background:
    """Power and mean intensity of the quietest cells of each frequency, from a histogram that grows with no
    record.
    """

    def __init__(self, size: int, directed: bool) -> None:
        shape = (size, LEVELS_DB.size)
        self._count, self._power = np.zeros(shape), np.zeros(shape)
        self._intensity = np.zeros(shape, complex) if directed else None

    def add(self, power: np.ndarray, intensity: np.ndarray | None) -> None:
        valid = np.isfinite(power) & (power > 0)
        if intensity is not None:
            valid &= np.isfinite(intensity)
        row = np.broadcast_to(np.arange(power.shape[0])[:, None], power.shape)[valid]
        level = np.clip(np.round(10.0 * np.log10(power[valid])) - LEVELS_DB[0], 0, LEVELS_DB.size - 1).astype(
            int
        )
        flat, size = row * LEVELS_DB.size + level, self._count.size
        shape = self._count.shape
        self._count += np.bincount(flat, minlength=size).reshape(shape)
        self._power += np.bincount(flat, power[valid], size).reshape(shape)
        if self._intensity is not None and intensity is not None:
            values = intensity[valid]
            self._intensity += np.bincount(flat, values.real, size).reshape(shape)
            self._intensity += 1j * np.bincount(flat, values.imag, size).reshape(shape)

    def quietest(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Mean power of the noise, from its `QUIET_SHARE` quantile, and its mean intensity at that power.

        |P|² of Gaussian noise is exponential: its q quantile is −ln(1 − q) times its mean.
        """
        total = np.maximum(self._count.sum(axis=1, keepdims=True), 1.0)
        cumulative = np.cumsum(self._count, axis=1) / total
        edge = (cumulative < QUIET_SHARE).sum(axis=1).clip(max=LEVELS_DB.size - 1)
        level = 10.0 ** (LEVELS_DB[edge] / 10.0) / -np.log1p(-QUIET_SHARE)
        if self._intensity is None:
            return level, None
        quiet = np.arange(LEVELS_DB.size) <= edge[:, None]
        power = np.sum(self._power * quiet, axis=1)
        ratio = np.sum(self._intensity * quiet, axis=1) / np.maximum(power, np.finfo(float).tiny)
        return level, _median(ratio) * level


def _median(values: np.ndarray, reach: int = 10) -> np.ndarray:
    """Running median over neighbouring frequencies: the background is broad, a ship's lines are narrow."""
    padded = np.pad(values, reach, mode="reflect" if values.size > reach else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.median(windows.real, axis=1) + 1j * np.median(windows.imag, axis=1)


def _nobody(tracks: list[ReferenceTrack], span: list[float], max_range_m: float) -> str:
    when = f"between {iso(span[0])} and {iso(span[1])}" if span else "in an empty record"
    return (
        f"none of {len(tracks)} AIS tracks passes within {max_range_m / 1e3:g} km of the station {when}; "
        "give AIS of the record's own time and place"
    )
