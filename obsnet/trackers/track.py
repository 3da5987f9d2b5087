"""What a tracker says to the world: a ship's course past the station, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from obsnet.kinematics import StraightCourse
from obsnet.layout import from_posix, iso

PARAMETERS = ("cpa_time_s", "cpa_range_m", "course_deg", "speed_mps")
"""Order of a track's covariance; the CPA range is signed (see `obsnet.kinematics`)."""

USUAL_MPS = (7.5, 2.0)
"""Mean and standard deviation [m/s] of the speeds of merchant ships, where bearings alone cannot tell speed from distance."""


def usual(speed_mps: np.ndarray, spread_mps: float, known: tuple[float, float] = USUAL_MPS) -> np.ndarray:
    """Log density of speeds of which mean and standard deviation are `known`, over that of speeds spread evenly over so much."""
    mean, std = known
    return np.log(spread_mps / (std * np.sqrt(2.0 * np.pi))) - 0.5 * ((speed_mps - mean) / std) ** 2


@dataclass(frozen=True)
class Segment:
    """A stretch of time in which one ship is heard: start, CPA where approach turns into departure, end (s since 1970); and whether
    a ship is heard right before it and right after it, in another segment.
    """

    start: float
    end: float
    cpa: float | None = None
    cut: tuple[bool, bool] = (False, False)


@dataclass(frozen=True)
class Track:
    """Where a ship was: its course (the tangent at CPA and, where it bends or turns, how), the covariance of that at CPA, and the evidence for it.

    Attributes
    ----------
    start, end : s since 1970; stretch over which the ship was heard.
    motion : StraightCourse of the ship itself, the sound's travel time undone.
    covariance : array (4, 4) over `PARAMETERS` (s, m, deg, m/s); infinite where a parameter is not observed.
    log_bayes_factor : natural log of the evidence for this ship against no ship.
    method : how the track was found, and what it could not see.
    """

    start: float
    end: float
    motion: StraightCourse
    covariance: np.ndarray
    log_bayes_factor: float
    method: str = "grid search"
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def ambiguity_deg(self) -> float:
        """180 where the course may as well be its image through the station, 360 where it is known."""
        return float(self.extra.get("ambiguity_deg", 360.0))

    @property
    def std(self) -> np.ndarray:
        """Standard deviations over `PARAMETERS`."""
        return np.sqrt(np.diag(self.covariance))

    def row(self, number: int) -> dict[str, Any]:
        """One row of tracks.csv; what was not observed is empty."""
        std = self.std
        values = {
            "track": number,
            "start": iso(self.start),
            "end": iso(self.end),
            "cpa_time": iso(self.motion.cpa_time, milliseconds=True),
            "cpa_distance_m": abs(self.motion.cpa_range_m),
            "cpa_azimuth_deg": self.motion.cpa_azimuth_deg,
            "course_deg": self.motion.course_deg % 360.0,
            "speed_mps": self.motion.speed_mps,
            "cpa_time_std_s": std[0],
            "cpa_distance_std_m": std[1],
            "course_std_deg": std[2],
            "speed_std_mps": std[3],
            "log_bayes_factor": self.log_bayes_factor,
        }
        if not np.isfinite(std[2]):
            values["cpa_azimuth_deg"] = values["course_deg"] = np.nan
        return {
            key: np.nan if isinstance(value, float) and np.isinf(value) else value
            for key, value in values.items()
        }

    def positions(self, step_s: float = 60.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (`datetime64`), east and north [m] along the track, every `step_s` from start to end."""
        count = max(int((self.end - self.start) // step_s), 1)
        time = np.linspace(self.start, self.end, count + 1)
        east, north = self.motion.position(time)
        return from_posix(time), east, north
