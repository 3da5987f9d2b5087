"""What a calibration found, its file, and the station with it applied."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import xarray as xr
from pyproj import Geod

from obsnet.config import build, read_yaml
from obsnet.errors import ConfigError, OutputError, StationError
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.ocean.sound_speed import OceanConfig
from obsnet.signals.station import Station


@dataclass(frozen=True)
class Orientation:
    """Azimuth of the first horizontal [deg] and its standard deviation; `cells` time–frequency cells made
    it.
    """

    azimuth_deg: float
    std_deg: float
    cells: int = 0


@dataclass(frozen=True)
class Polarity:
    """Sign of the hydrophone against its response; `significance` of the flux behind it in standard
    deviations.

    0 where there is no vertical channel: then the sign is the metadata's and the orientation was found with
    it, so that azimuths are right in either case.
    """

    sign: int
    significance: float = 0.0


@dataclass(frozen=True)
class Position:
    """Where the station is, deg WGS 84, and its offset from where it was said to be [m], with standard
    deviations.
    """

    latitude: float
    longitude: float
    east_m: float
    north_m: float
    east_std_m: float
    north_std_m: float
    correlation: float = 0.0


@dataclass(frozen=True)
class Echo:
    """How late the sea floor's echo comes at vertical incidence, beyond the water's depth, and its standard
    deviation [s].
    """

    delay_s: float
    std_s: float


@dataclass(frozen=True)
class Calibration:
    """Orientation, polarity, position and path amplitudes of a station, from AIS passages.

    A part that the passages did not determine is None, and `notes` says why; `apply` leaves it as the
    metadata have it. `echo` is None where echoes come when the water's depth says, or nothing tells.
    `fitted_pairs` are those of `amplitudes` that were heard; the others are the paper's,
    scaled to the depth. `stack` holds the stacked cepstral amplitudes, for plots; it is not written.
    """

    station: str
    passages: int
    orientation: Orientation | None
    polarity: Polarity | None
    position: Position | None
    amplitudes: Amplitudes
    fitted_pairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    orientation_by_frequency: tuple[tuple[float, float, int], ...] = ()
    echo: Echo | None = None
    stack: xr.Dataset | None = field(default=None, compare=False, repr=False)

    def apply(self, station: Station) -> Station:
        """The station as calibrated.

        Raises
        ------
        StationError
            The calibration is of another station.
        """
        if station.code != self.station:
            raise StationError(
                f"the calibration is of {self.station}, the station is {station.code}; calibrate this one"
            )
        position = self.position
        return station.calibrated(
            orientation_deg=self.orientation.azimuth_deg if self.orientation else None,
            hydrophone_polarity=self.polarity.sign if self.polarity else None,
            latitude=position.latitude if position else None,
            longitude=position.longitude if position else None,
        )

    def ocean(self, config: OceanConfig) -> OceanConfig:
        """The ocean as calibrated: with the sea floor's echo as late as it was found to be."""
        return replace(config, echo_delay_s=self.echo.delay_s) if self.echo else config

    def table(self) -> str:
        """Plain text for people."""
        plural = "" if self.passages == 1 else "s"
        lines = [f"{self.station}: calibrated with {self.passages} AIS passage{plural}"]
        if self.orientation:
            found = self.orientation
            lines.append(f"  first horizontal  {found.azimuth_deg:.1f}° ± {found.std_deg:.1f}°")
        if self.polarity:
            kind = "reversed" if self.polarity.sign < 0 else "normal"
            lines.append(
                f"  hydrophone        {kind} ({abs(self.polarity.significance):.0f} standard deviations)"
            )
        if self.position:
            at = self.position
            east, north = (
                f"{at.east_m:+.0f} ± {at.east_std_m:.0f} m",
                f"{at.north_m:+.0f} ± {at.north_std_m:.0f} m",
            )
            lines.append(f"  offset            {east} east, {north} north")
        if self.echo:
            lines.append(
                f"  echo of the floor {1e3 * self.echo.delay_s:+.0f} ± {1e3 * self.echo.std_s:.0f} ms"
            )
        for pair, curve in self.amplitudes.curves.items():
            source = "measured" if pair in self.fitted_pairs else "not heard, scaled from the paper"
            lines.append(
                f"  pair {pair}          k {curve.k:.3g}, α {curve.alpha:.2g}, ξ {curve.xi_m / 1e3:.1f} km, "
                f"ω {curve.omega_m / 1e3:.1f} km ({source})"
            )
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

    def to_dict(self) -> dict[str, Any]:
        """Plain mapping, ready for YAML or JSON."""
        parts = {name: getattr(self, name) for name in ("orientation", "polarity", "position", "echo")}
        return {
            "station": self.station,
            "passages": self.passages,
            **{name: asdict(part) if part else None for name, part in parts.items()},
            "amplitudes": self.amplitudes.to_dict(),
            "fitted_pairs": list(self.fitted_pairs),
            "notes": list(self.notes),
            "orientation_by_frequency": [list(row) for row in self.orientation_by_frequency],
        }

    def write(self, path: str | Path) -> None:
        """Write the calibration as JSON (a name ending in .json) or YAML, atomically."""
        import yaml

        path = Path(path)
        plain = self.to_dict()
        if path.suffix == ".json":
            text = json.dumps(plain, indent=1, ensure_ascii=False)
        else:
            text = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            partial.write_text(text, encoding="utf-8")
            os.replace(partial, path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise OutputError(f"cannot write the calibration {path}: {error.strerror}") from None

    @classmethod
    def read(cls, path: str | Path) -> Calibration:
        """Read what `write` wrote.

        Raises
        ------
        ConfigError
            The file cannot be read, a key is unknown or missing, or a value is of the wrong kind.
        """
        values = read_yaml(path)
        unknown = sorted(set(values) - {f.name for f in fields(cls) if f.name != "stack"})
        if unknown:
            raise ConfigError(f"{path} is not a calibration: unknown key '{unknown[0]}'")
        try:
            return cls(
                str(values["station"]),
                int(values["passages"]),
                build(Orientation, values["orientation"], "orientation") if values["orientation"] else None,
                build(Polarity, values["polarity"], "polarity") if values["polarity"] else None,
                build(Position, values["position"], "position") if values["position"] else None,
                Amplitudes.from_dict(values["amplitudes"]),
                tuple(map(str, values.get("fitted_pairs", ()))),
                tuple(map(str, values.get("notes", ()))),
                tuple((float(f), float(a), int(n)) for f, a, n in values.get("orientation_by_frequency", ())),
                build(Echo, values["echo"], "echo") if values.get("echo") else None,
            )
        except KeyError as error:
            raise ConfigError(f"{path} is not a calibration: it lacks {error.args[0]}") from None
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{path} is not a calibration: {error}") from None


def moved(station: Station, east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point at an offset [m] from the station."""
    azimuth = math.degrees(math.atan2(east_m, north_m))
    longitude, latitude, _ = Geod(ellps="WGS84").fwd(
        station.longitude, station.latitude, azimuth, math.hypot(east_m, north_m)
    )
    return float(latitude), float(longitude)
