"""What an evaluation found, as a plain table, as a DataFrame and as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from obsnet.console import counted


@dataclass(frozen=True)
class ShipScore:
    """One row of the core paper's Table I; errors of the tracker are found minus true, NaN where it has no
    track.
    """

    number: int | None
    mmsi: int | None
    name: str
    cpa_time: str
    cpa_distance_m: float
    azimuth_n: int
    azimuth_smad_deg: float
    range_n: int
    range_smad_m: float
    range_rate_smad_mps: float
    track: int | None = None
    cpa_time_error_s: float = math.nan
    course_error_deg: float = math.nan
    cpa_distance_error_m: float = math.nan
    speed_error_mps: float = math.nan
    cpa_azimuth_error_deg: float = math.nan
    interpolated: float = math.nan
    expected: bool = True


@dataclass(frozen=True)
class Evaluation:
    """A run against AIS.

    Attributes
    ----------
    ships : rows of Table I, in order of the ships' CPA. total : its last row, SMAD over all ships.
    missed : numbers of the ships that passed within the record and have no track.
    false_tracks : numbers of the tracks that are no ship's.
    minutes : shares of right minutes and wrong ones per hour, for azimuth and range.
    coverage : shares of matched tracks whose stated 50 % and 90 % regions hold the truth.
    against_lines : SMAD of the tracker's errors against the straight lines through all AIS positions, the paper's truth.
    notes : what a reader must know.
    """

    ships: tuple[ShipScore, ...]
    total: ShipScore
    missed: tuple[int, ...]
    false_tracks: tuple[int, ...]
    tracks: int
    minutes: dict[str, dict[str, float]]
    coverage: dict[str, dict[str, float]]
    against_lines: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain containers; NaN becomes None."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain

    def table(self) -> str:
        """Table I in plain text, then what it lacks."""
        head = ("#", "ship", "N", "deg", "N", "m", "m/s", "CPA s", "course deg", "CPA m", "m/s")
        rows = [head, *(self._cells(row) for row in (*self.ships, self.total))]
        widths = [max(len(cells[i]) for cells in rows) for i in range(len(head))]
        lines = [_line(cells, widths) for cells in rows]
        titles = ""
        for column, title in ((2, "azimuth"), (4, "range"), (7, "tracker, absolute errors")):
            titles = titles.ljust(sum(widths[:column]) + 2 * column) + title
        rule = "-" * max(map(len, lines))
        return "\n".join([titles, lines[0], rule, *lines[1:-1], rule, lines[-1], "", *self._rest()])

    def _cells(self, row: ShipScore) -> tuple[str, ...]:
        return (
            "" if row.number is None else str(row.number),
            row.name[:20],
            str(row.azimuth_n),
            _number(row.azimuth_smad_deg, 1),
            str(row.range_n),
            _number(row.range_smad_m, 0),
            _number(row.range_rate_smad_mps, 2),
            _number(abs(row.cpa_time_error_s), 0),
            _number(abs(row.course_error_deg), 1),
            _number(abs(row.cpa_distance_error_m), 0),
            _number(abs(row.speed_error_mps), 2),
        )

    def _rest(self) -> list[str]:
        matched = sum(row.track is not None for row in self.ships)
        lines = [
            f"{counted(self.tracks, 'track')}: {matched} of {counted(len(self.ships), 'ship')} matched, {len(self.missed)} missed"
            f"{_listed(self.missed)}, {len(self.false_tracks)} false{_listed(self.false_tracks)}"
        ]
        if matched and self.against_lines:
            off = self.against_lines
            lines.append(
                "tracker against straight lines through all of each ship's AIS: "
                f"CPA {_number(off['cpa_time_error_s'], 0)} s, course {_number(off['course_error_deg'], 1)}°, "
                f"CPA {_number(off['cpa_distance_error_m'], 0)} m, {_number(off['speed_error_mps'], 2)} m/s"
            )
        for name, score in self.minutes.items():
            lines.append(
                f"{name}: right in {_percent(score['right'])} of {score['minutes']} minutes with a ship; "
                f"{_percent(score['right_estimates'])} of {score['estimates']} estimates right, "
                f"{_number(score['wrong_or_false_per_hour'], 1)} wrong or false an hour"
            )
        for name, held in self.coverage.items():
            if held["tracks"]:
                lines.append(
                    f"{name}: truth in the 50 % region of {_percent(held['50_percent'])} "
                    f"and in the 90 % region of {_percent(held['90_percent'])} of {counted(int(held['tracks']), 'track')}"
                )
        return [*lines, *(f"note: {note}" for note in self.notes)]


def _line(cells: tuple[str, ...], widths: list[int]) -> str:
    first, name, *rest = zip(cells, widths, strict=True)
    padded = [first[0].rjust(first[1]), name[0].ljust(name[1]), *(cell.rjust(width) for cell, width in rest)]
    return "  ".join(padded).rstrip()


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.0f} %"


def _listed(numbers: tuple[int, ...]) -> str:
    return f" ({', '.join(map(str, numbers))})" if numbers else ""


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
