"""A station calibrated by ships whose AIS is known: orientation, hydrophone polarity, position, path
amplitudes, and how late the sea floor's echo is.

Spectra and reference tracks in, a `Calibration` out, which writes the file that tracking takes. The station's
clock is taken as it is.

Source: Trabattoni et al. 2019 (orientation and position from ship noise); Trabattoni et al. 2023, JASA 153,
260, doi:10.1121/10.0016810, appendices C and D (amplitudes).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from obsnet.calibration.echo import echo_delay
from obsnet.calibration.envelope import Branches, fit, locate, stack
from obsnet.calibration.orientation import Rotation, downward_flux, rotation
from obsnet.calibration.passages import Passages, gather
from obsnet.calibration.result import Calibration, Echo, Orientation, Polarity, Position, moved
from obsnet.errors import ConfigError
from obsnet.layout import to_posix
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.rays import propagation_table, travel_time
from obsnet.signals.cepstrogram import CepstrogramConfig
from obsnet.signals.spectra import iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms

if TYPE_CHECKING:
    from obsnet.ais import ReferenceTrack
    from obsnet.run import RunConfig

__all__ = [
    "Calibration",
    "CalibrationConfig",
    "Echo",
    "Orientation",
    "Polarity",
    "Position",
    "calibrate",
    "calibrate_waveforms",
]

FLUX_SIGNIFICANCE = 3.0
MAX_STD_DEG = 15.0
UNKNOWN_PLACE_M = 300.0
"""How far a station may have drifted while it sank, standard deviation."""


@dataclass(frozen=True)
class CalibrationConfig:
    """Which frames and cells a calibration uses.

    Parameters
    ----------
    fmin_hz, fmax_hz : band of the azimuths.
    average_s, min_snr_db : cells are averages over this long, and stand out of the background by this much.
    min_range_m, max_range_m : ranges of the ships for the orientation; position and amplitudes use
        `amplitude_range_m`.
    isolation : frames in which the second nearest ship is not this many times as far are left out.
    search_m, search_step_m : half-width and step of the search for the station's position.
    echo_delay_s : least and greatest delay of the sea floor's echo at vertical incidence; equal for none.
    pairs : path pairs. bin_m : bin of range for the amplitudes.
    """

    fmin_hz: float = 11.0
    fmax_hz: float = 24.0
    average_s: float = 60.0
    min_snr_db: float = 6.0
    min_range_m: float = 2000.0
    max_range_m: float = 40_000.0
    amplitude_range_m: float = 60_000.0
    isolation: float = 2.0
    search_m: float = 1500.0
    search_step_m: float = 100.0
    echo_delay_s: tuple[float, float] = (-0.1, 0.4)
    pairs: tuple[str, ...] = ("1-3", "3-5", "5-7", "7-9", "9-11")
    bin_m: float = 1000.0
    clutter: CepstrogramConfig = field(default_factory=CepstrogramConfig)

    def __post_init__(self) -> None:
        for low, high in (
            ("fmin_hz", "fmax_hz"),
            ("min_range_m", "max_range_m"),
            ("search_step_m", "search_m"),
        ):
            below, above = getattr(self, low), getattr(self, high)
            if not 0 < below < above:
                raise ConfigError(f"{low} must be > 0 and below {high}, found {below:g} and {above:g}")
        for name in ("average_s", "bin_m", "amplitude_range_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be > 0, found {getattr(self, name):g}")
        if not -1.0 <= self.echo_delay_s[0] <= self.echo_delay_s[1] <= 1.0:
            raise ConfigError(f"echo_delay_s must increase within [-1, 1] s, found {self.echo_delay_s}")
        if not self.isolation >= 1:
            raise ConfigError(f"isolation must be >= 1, found {self.isolation:g}")
        if not self.pairs:
            raise ConfigError("pairs must name one path pair at least, such as '1-3'")


def calibrate(
    spectra: xr.Dataset | Iterable[xr.Dataset],
    station: Station,
    tracks: list[ReferenceTrack],
    table: xr.Dataset,
    config: CalibrationConfig = CalibrationConfig(),
) -> Calibration:
    """Calibrate a station by the ships that passed it.

    Parameters
    ----------
    spectra : Dataset of p, east, north, down, or consecutive blocks of it, made with `station`'s metadata.
    station : Station, as its metadata have it.
    tracks : list of ReferenceTrack around `station`.
    table : propagation table of the station.
    config : CalibrationConfig

    Returns
    -------
    Calibration. What the passages do not determine is None, with a note.

    Raises
    ------
    AISError
        No ship was near while the station recorded.
    LayoutError
        The spectra lack the hydrophone.
    """
    blocks = [spectra] if isinstance(spectra, xr.Dataset) else spectra
    passages = gather(
        blocks,
        tracks,
        travel_time(table),
        fmin_hz=config.fmin_hz,
        fmax_hz=config.fmax_hz,
        max_range_m=max(config.max_range_m, config.amplitude_range_m),
        isolation=config.isolation,
        clutter=config.clutter,
    )
    notes: list[str] = []
    expected = Amplitudes.default().scaled_to(station.depth_m)
    branches = Branches(passages, table, tuple(pair for pair in config.pairs if pair in expected.pairs))
    echo = echo_delay(branches, expected, config.echo_delay_s, config.search_m, config.search_step_m)
    place, turned = None, None
    if echo:
        late = branches.late(echo.delay_s)
        place, turned = _place_and_turn(station, passages, late, expected, config, [])
        echo = replace(echo, delay_s=table.attrs.get("echo_delay_s", 0.0) + echo.delay_s) if place else None
        branches = late if place else branches
    if not place:
        place, turned = _place_and_turn(station, passages, branches, expected, config, notes)
    shift = (place.east_m, place.north_m) if place else (0.0, 0.0)
    polarity = _polarity(station, downward_flux(passages), notes)
    edges = np.arange(0.0, config.amplitude_range_m + config.bin_m / 2, config.bin_m)
    stacked = stack(branches, shift, edges)
    amplitudes, heard = fit(stacked, expected)
    return Calibration(
        station.code,
        int(np.unique(passages.heard.passage).size),
        _orientation(station, turned, polarity, passages.intensity is not None, notes),
        polarity,
        place,
        amplitudes,
        heard,
        tuple(notes),
        turned.by_frequency if turned else (),
        echo,
        stacked,
    )


def calibrate_waveforms(
    waveforms: Any,
    station: Station,
    tracks: list[ReferenceTrack],
    settings: RunConfig | None = None,
    starttime: Any = None,
    endtime: Any = None,
    progress: Callable[[float, float], None] | None = None,
    config: CalibrationConfig | None = None,
) -> Calibration:
    """Calibrate a station from its waveforms, block by block.

    Parameters
    ----------
    waveforms : obspy Stream, or path(s) of files, folders or an SDS archive.
    station, tracks : as for `calibrate`; the metadata need not give an orientation.
    settings : RunConfig, optional
        Its sections spectra, azigram (band), cepstrogram (clutter filter), range (pairs) and ocean are used.
    starttime, endtime : part of the record to use.
    progress : called with seconds done and in all.
    config : CalibrationConfig, optional; by default what `settings` say, else its own defaults.
    """
    from obsnet.pipeline import RunConfig

    settings = settings or RunConfig()
    if config is None:
        config = CalibrationConfig(
            fmin_hz=settings.azigram.fmin_hz,
            fmax_hz=settings.azigram.fmax_hz,
            pairs=settings.range.pairs,
            clutter=settings.cepstrogram,
        )
    stated = {channel.azimuth_deg for channel in station.horizontals}
    if len(station.horizontals) == 2 and (None in stated or len(stated) == 1):
        station = station.calibrated(orientation_deg=0.0)  # any will do to begin with
    rate_hz = settings.spectra.analysis_rate_hz
    source = open_waveforms(waveforms, station, starttime=starttime, endtime=endtime, min_rate_hz=rate_hz)

    def blocks() -> Iterator[xr.Dataset]:
        for block in iter_spectra(source, settings.spectra):
            yield block
            if progress is not None and block.sizes["time"]:
                done = to_posix(block["time"].values[-1]) - source.begin_ns / 1e9
                progress(float(done), (source.end_ns - source.begin_ns) / 1e9)

    station = source.station
    return calibrate(blocks(), station, tracks, propagation_table(settings.ocean, station.depth_m), config)


def _place_and_turn(
    station: Station,
    passages: Passages,
    branches: Branches,
    amplitudes: Amplitudes,
    config: CalibrationConfig,
    notes: list[str],
) -> tuple[Position | None, Rotation | None]:
    """Place of the station and rotation of its azimuths there; the azimuths choose between mirror images."""

    def turn(shift_m: tuple[float, float], std_m: float) -> Rotation | None:
        return rotation(
            passages,
            shift_m,
            std_m,
            average_s=config.average_s,
            min_snr_db=config.min_snr_db,
            min_range_m=config.min_range_m,
            max_range_m=config.max_range_m,
        )

    places = locate(branches, amplitudes, config.search_m, config.search_step_m)
    turns = [
        turn((place.east_m, place.north_m), max(place.east_std_m, place.north_std_m)) for place in places
    ]
    fits = [found.log_likelihood if found else -np.inf for found in turns]
    if not places or (len(places) > 1 and not np.isfinite(fits).any()):
        notes.append("the cepstral branches do not determine the position; it is left as it was")
        return None, turn((0.0, 0.0), UNKNOWN_PLACE_M)
    best = int(np.argmax(fits))
    offset = places[best]
    latitude, longitude = moved(station, offset.east_m, offset.north_m)
    stds = (offset.east_std_m, offset.north_std_m, offset.correlation)
    return Position(latitude, longitude, offset.east_m, offset.north_m, *stds), turns[best]


def _polarity(station: Station, flux: float | None, notes: list[str]) -> Polarity | None:
    if station.pressure is None:
        return None
    stated = station.pressure.polarity
    if flux is None or abs(flux) < FLUX_SIGNIFICANCE:
        reason = (
            "there is no vertical channel" if flux is None else "the vertical energy flux is not significant"
        )
        notes.append(f"{reason}: the hydrophone's polarity is taken as stated, the orientation goes with it")
        return Polarity(stated, 0.0)
    return Polarity(stated if flux > 0 else -stated, flux)


def _orientation(
    station: Station, turned: Rotation | None, polarity: Polarity | None, directed: bool, notes: list[str]
) -> Orientation | None:
    if not directed:
        notes.append("without two horizontals there is no orientation to find")
        return None
    if turned is None or not turned.std_deg < MAX_STD_DEG:
        notes.append(
            "no ship stands out of the background for long enough; the orientation is left as it was"
        )
        return None
    flipped = (
        polarity is not None and station.pressure is not None and polarity.sign != station.pressure.polarity
    )
    azimuth = (station.orientation_deg or 0.0) + turned.angle_deg + (180.0 if flipped else 0.0)
    return Orientation(azimuth % 360.0, turned.std_deg, turned.cells)
