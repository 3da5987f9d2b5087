"""Outcome of the click experiment: sums and counts of its runs in, numbers, table and figure out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

CUTOFF_DEG = 10.0
"""Cut-off of the OSPA distance between animals and tracks."""


@dataclass(frozen=True)
class Result:
    """Outcomes of the three scenarios, one dictionary a run."""

    runs: int
    seed: int
    clutter: list[dict[str, float]]
    two_animals: list[dict[str, Any]]
    recordings: list[dict[str, float]]

    def total(self, outcomes: list[dict[str, float]], key: str) -> float:
        """Sum of one entry over runs."""
        return float(sum(outcome.get(key, 0.0) for outcome in outcomes))

    def rmse(self, outcomes: list[dict[str, float]], name: str, angle: str) -> float | None:
        """Root mean square error [deg], pooled over runs; None where there is no estimate."""
        count = self.total(outcomes, f"{name}_count")
        return float(np.sqrt(self.total(outcomes, f"{name}_{angle}") / count)) if count else None

    def over_stated(self, outcomes: list[dict[str, float]], name: str) -> float:
        """Root mean square of errors over the standard deviations that the smoother states."""
        count = self.total(outcomes, f"{name}_count")
        return float(np.sqrt(self.total(outcomes, f"{name}_normalised") / max(count, 1.0)))

    def share(self, outcomes: list[dict[str, float]], part: str, whole: str) -> float:
        """Share of one count in another, over all runs."""
        return self.total(outcomes, part) / max(self.total(outcomes, whole), 1.0)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers; all of simulated data."""
        one = self.clutter
        return {
            "experiment": "clicks",
            "simulated": True,
            "runs": self.runs,
            "seed": self.seed,
            "azimuth_rmse_deg": self.rmse(one, "smoother", "azimuth"),
            "elevation_rmse_deg": self.rmse(one, "smoother", "elevation"),
            "regression_azimuth_rmse_deg": self.rmse(one, "regression", "azimuth"),
            "regression_elevation_rmse_deg": self.rmse(one, "regression", "elevation"),
            "clutter_rejected": 1.0 - self.share(one, "clutter_taken", "clutter"),
            "clicks_lost": self.share(one, "own_lost", "own"),
            "filter_azimuth_rmse_deg": self.rmse(one, "filter", "azimuth"),
            "filter_elevation_rmse_deg": self.rmse(one, "filter", "elevation"),
            "regression_in_clutter_azimuth_rmse_deg": self.rmse(one, "naive", "azimuth"),
            "regression_in_clutter_elevation_rmse_deg": self.rmse(one, "naive", "elevation"),
            "tracks_per_run": self.total(one, "tracks") / self.runs,
            "error_over_stated": self.over_stated(one, "smoother"),
            "two_animals": self._two_animals(),
            "recordings": self._recordings(),
        }

    def _two_animals(self) -> dict[str, Any]:
        return {
            "ospa_deg": float(np.mean([outcome["ospa"].mean() for outcome in self.two_animals])),
            "ospa_cutoff_deg": CUTOFF_DEG,
            "right_number": float(np.mean([outcome["right_number"] for outcome in self.two_animals])),
            "tracks_per_run": float(np.mean([outcome["tracks"] for outcome in self.two_animals])),
        }

    def _recordings(self) -> dict[str, Any]:
        these = self.recordings
        right = self.total(these, "ranged_right")
        return {
            "runs": len(these),
            "clicks_found": self.share(these, "found", "clicks"),
            "false_clicks": self.total(these, "false") / len(these),
            "click_azimuth_rmse_deg": self.rmse(these, "clicks", "azimuth"),
            "click_elevation_rmse_deg": self.rmse(these, "clicks", "elevation"),
            "azimuth_rmse_deg": self.rmse(these, "tracks", "azimuth"),
            "elevation_rmse_deg": self.rmse(these, "tracks", "elevation"),
            "error_over_stated": self.over_stated(these, "tracks"),
            "tracks_per_animal": self.share(these, "tracks", "animals"),
            "echo_ranges": self.total(these, "ranged"),
            "echo_ranges_within_10_percent": self.share(these, "ranged_right", "ranged"),
            "range_rmse_percent": 100.0
            * float(np.sqrt(self.total(these, "range_squares") / max(right, 1.0))),
        }

    def table(self) -> list[str]:
        """Lines of text: obsnet's numbers beside the paper's."""
        from obsnet.experiments.clicks_report import lines

        return lines(self)

    def plot(self, path: str | Path) -> None:
        """Write a figure like the paper's figures 5, 7 and 8, with the two animals and the echo's ranges."""
        from obsnet.experiments.clicks_report import draw

        draw(self, path)
