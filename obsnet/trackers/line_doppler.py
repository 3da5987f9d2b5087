"""The Doppler shift of a ship's lines: how fast it goes, where bearings and ghost ranges leave that open.

Bearings tell a course but for one scale of its distance and speed, and echoes read as other path pairs repeat it at another
scale. Lines of machinery fall in pitch as the ship goes by, in proportion to its speed. Every scale says how each line moved;
along the right one the lines of all tiles fall on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.trackers.course_grid import Delay, at_scales, best_run, score_points
from obsnet.trackers.score_maps import ScoreMaps

FAINTEST, STRONGEST = 0.8, 2.0
"""Log power above the broad spectrum from which on a maximum is a line, and the most that one counts."""
FINER = 2
"""Cells of a picture of lines to a bin of the spectrum."""
WIDTH_BINS, BLUR_BINS = 0.55, 0.8
"""Spread of a line about its pitch, and of what is left of the sum over tiles when its mean is taken off."""
CHANCE = 2.0
"""Standard deviations that a pitch may stand out by chance."""
LEAST_OF_LINES = 300.0
"""Evidence of lines, nats, below which they tell no scale of simulated ships."""
LINES_SHARE = 0.07
"""Weight of it beside what range maps say: a shaft whose rate wanders by as much as the shift moves all lines at once, in all tiles."""
AGREED = 0.8
"""Share of the greatest evidence of lines from which on they agree to a scale: the lines of a shaft that turns unevenly fall on each
other best along a wrong one.
"""
BY_LINES = 0.15
"""Relative standard deviation of a speed that lines tell, where they agree to one alone."""
SAME_SCALE = 0.13
"""Difference of two scales, in natural logarithms, up to which the range maps choose between them."""
_BASE_HZ = 4.0
"""Lowest pitch looked at: below, a shift is less than a bin."""
STEEPEST = 1e-3
"""Slowness [s/m] of nothing in the sea: where travel time grows faster, the loudest path is another."""
_MARGIN = 0.02
"""Greatest relative shift of a line, at the ends of the band."""


@dataclass(frozen=True)
class Lines:
    """Lines heard in each tile.

    Attributes
    ----------
    picture : (n_tiles, n_cells) float32, every line a little mound at its pitch. first_hz, step_hz : pitch of the cells.
    """

    picture: np.ndarray
    first_hz: float
    step_hz: float

    @classmethod
    def of(cls, level: np.ndarray, frequency: np.ndarray) -> Lines:
        """Lines of log powers over the broad spectrum (n_tiles, n_frequency), NaN without data, as `line_level` has them."""
        step = float(frequency[1] - frequency[0]) / FINER
        cells = FINER * level.shape[1]
        picture = np.zeros((len(level), cells), np.float32)
        below, here, above = level[:, :-2], level[:, 1:-1], level[:, 2:]
        tile, number = np.nonzero((here > below) & (here >= above) & (here > FAINTEST))
        low, top, high = (part[tile, number] for part in (below, here, above))
        pitch = FINER * (number + 1 + np.clip(0.5 * (low - high) / (low - 2.0 * top + high), -0.5, 0.5))
        weight = np.minimum(top, STRONGEST)
        nearest = np.rint(pitch).astype(int)
        for cell in range(-3, 4):
            mound = weight * np.exp(-0.5 * ((nearest + cell - pitch) / (FINER * WIDTH_BINS)) ** 2)
            inside = (nearest + cell >= 0) & (nearest + cell < cells)
            np.add.at(picture, (tile[inside], (nearest + cell)[inside]), mound[inside])
        return cls(picture, float(frequency[0]), step)

    def evidence(
        self,
        point: np.ndarray,
        scales: np.ndarray,
        tiles: np.ndarray,
        first: int,
        last: int,
        delay: Delay,
    ) -> np.ndarray:
        """How far lines fall on each other if a course's CPA range and speed are so many times as great.

        The squared standard scores of all pitches beyond chance, halved. What stays at one pitch, a line of the station or
        a hum that no ship makes, is taken off.

        Parameters
        ----------
        point : CPA time [s on the clock of `tiles`], signed CPA range [m], course, speed [m/s].
        scales : (n). tiles : (n_tiles) s. first, last : tiles in which the ship is heard.

        Returns
        -------
        (n) float64, nats.
        """
        heard = slice(first, last + 1)
        picture = self.picture[heard]
        shift = doppler(point, scales, tiles[heard], delay)
        top_hz = self.first_hz + self.step_hz * (picture.shape[1] - 1)
        pitch = np.arange(
            max(self.first_hz * (1.0 + _MARGIN), _BASE_HZ), top_hz * (1.0 - _MARGIN), self.step_hz
        )
        moving = picture - picture.mean(axis=0)
        spread = float(picture.std()) * np.sqrt(len(picture))
        found = np.zeros(len(scales))
        if spread == 0.0 or not len(pitch):
            return found
        row = np.arange(len(picture))[:, None] * picture.shape[1]
        coarse = np.linspace(pitch[0], pitch[-1], 6)
        for number, factor in enumerate(shift):
            cell = np.rint((pitch * factor[:, None] - self.first_hz) / self.step_hz).astype(np.int64)
            total = moving.take(row + np.clip(cell, 0, picture.shape[1] - 1)).sum(axis=0)
            apart = (factor[:, None] - factor) * coarse[:, None, None] / (FINER * self.step_hz * BLUR_BINS)
            left = 1.0 - np.exp(-0.5 * apart**2).mean(axis=(1, 2))
            score = total / (spread * np.sqrt(np.interp(pitch, coarse, np.maximum(left, 0.1))))
            found[number] = 0.5 * np.sum(np.maximum(score - CHANCE, 0.0) ** 2) / FINER
        return found

    def _say(
        self, point: np.ndarray, scales: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps
    ) -> np.ndarray | None:
        """The evidence for each scale in the tiles in which the ship is heard; None where it is too little."""
        if not len(scales):
            return None
        _, per_tile = score_points(point[None], tiles, delay, scores)
        said = self.evidence(point, scales, tiles, *best_run(per_tile[:, 0]), delay)
        return said if said.max() >= LEAST_OF_LINES else None

    def speed(
        self, point: np.ndarray, scales: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps
    ) -> tuple[float, float] | None:
        """Mean and standard deviation [m/s] of the speed along a course whose scale nothing else tells, if lines do."""
        said = self._say(point, scales, tiles, delay, scores)
        return None if said is None else _told(point[3] * scales, said)

    def rescaled(
        self, point: np.ndarray, scales: np.ndarray, tiles: np.ndarray, delay: Delay, scores: ScoreMaps
    ) -> tuple[np.ndarray, tuple[float, float]] | None:
        """The course at another scale, if lines do not agree to its own and what they and range maps say together is for it.

        What range maps say counts as it is, the lines with a share: lines tell apart what path pairs confuse, and where no range
        is heard they alone do. With the course come mean and standard deviation of the speed that lines tell [m/s].
        """
        said = self._say(point, scales, tiles, delay, scores)
        if said is None:
            return None
        points, ranged = at_scales(point, scales, tiles, delay, scores)
        agreed, together = said >= AGREED * said.max(), ranged + LINES_SHARE * said
        best = int(np.argmax(np.where(agreed, together, -np.inf)))
        near = np.abs(np.log(scales)) < SAME_SCALE
        if near[best] or (near & agreed).any() or together[near].max(initial=-np.inf) >= together[best]:
            return None
        return points[best], _told(point[3] * scales, said)


def _told(speed_mps: np.ndarray, said: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of the speed, of those to which lines agree by what they say for each."""
    agreed = np.log(speed_mps[said >= AGREED * said.max()])
    mean = float(np.exp(agreed.mean()))
    return mean, mean * float(np.hypot(BY_LINES, agreed.std()))


def doppler(point: np.ndarray, scales: np.ndarray, tiles: np.ndarray, delay: Delay) -> np.ndarray:
    """Pitch heard over pitch emitted at each tile, for a course at each scale: (n_scales, n_tiles)."""
    cpa_range, speed = abs(point[1]) * scales[:, None], point[3] * scales[:, None]
    emitted = delay.emitted(tiles - point[0], cpa_range, speed)
    distance = np.sqrt(cpa_range**2 + (speed * emitted) ** 2)
    slowness = np.gradient(delay.seconds, delay.step_m)
    grid, one_path = delay.step_m * np.arange(len(slowness)), np.abs(slowness) < STEEPEST
    slowness = np.interp(distance, grid[one_path], slowness[one_path])
    return 1.0 / (1.0 + slowness * speed**2 * emitted / np.maximum(distance, 1.0))
