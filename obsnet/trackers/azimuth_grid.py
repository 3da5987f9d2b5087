"""A row of values over azimuth, read at any azimuth: around the whole circle or over a sector."""

from __future__ import annotations

import numpy as np

from obsnet.errors import LayoutError


class AzimuthGrid:
    """Equally spaced azimuths [deg], increasing; circular where one more step would reach the first again.

    >>> grid = AzimuthGrid(np.arange(0.0, 360.0, 90.0))
    >>> grid.circular, grid(np.array([0.0, 1.0, 2.0, 3.0]), np.array([45.0, 315.0])).tolist()
    (True, [0.5, 1.5])
    """

    def __init__(self, azimuth_deg: np.ndarray) -> None:
        azimuth = np.asarray(azimuth_deg, float)
        steps = np.diff(azimuth)
        if (
            azimuth.ndim != 1
            or len(azimuth) < 2
            or not np.allclose(steps, steps[0], atol=1e-6)
            or steps[0] <= 0
        ):
            raise LayoutError("azimuths of a map must increase in equal steps, at least two of them")
        self.azimuth_deg = azimuth
        self.first_deg = float(azimuth[0])
        self.step_deg = float((azimuth[-1] - azimuth[0]) / (len(azimuth) - 1))
        span = self.step_deg * len(azimuth)
        if span > 360.0 + 1e-6:
            raise LayoutError(f"azimuths of a map must cover the circle once at most, found {span:g} deg")
        self.circular = abs(span - 360.0) < 1e-6

    def __call__(self, row: np.ndarray, azimuth_deg: np.ndarray) -> np.ndarray:
        """Linear interpolation of `row` (azimuth,); minus infinity outside a sector."""
        count = len(row)
        position = (np.asarray(azimuth_deg, float) - self.first_deg) / self.step_deg
        if self.circular:
            position %= count
        inside = (position >= 0.0) & (position <= (count if self.circular else count - 1))
        position = np.where(inside, position, 0.0)
        cell = np.minimum(position.astype(np.int64), count - 1 if self.circular else count - 2)
        right = position - cell
        between = (1.0 - right) * row[cell] + right * row[(cell + 1) % count]
        return np.where(inside, between, -np.inf)
