"""What is left of likelihood maps when a known ship, and then its ghosts, are taken out: what the next ship is looked for in."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import xarray as xr

from obsnet.kinematics import emission, wrap180
from obsnet.ocean.rays import parse_pair
from obsnet.trackers.course_grid import Delay
from obsnet.trackers.score_maps import above_floor, lobe
from obsnet.trackers.track import Track

TURN_DEG = 30.0
"""How far from a known ship's azimuth sound may still be that ship's."""

RANGED = 4.0
"""Range log-likelihood ratio from which a tile has heard a known ship's range."""

NEAR = (3000.0, 3.0)
"""Range [m] and range rate [m/s] to either side of a known ship's that are its own."""

NEAR_GHOST = (1000.0, 2.0)
"""The same of a ghost's."""


class Ghosts:
    """Where a ship's echoes put it besides where it is: ranges at which path pairs have delays that the ship's have elsewhere.

    Parameters
    ----------
    table : Dataset of `obsnet.ocean.rays.propagation`.
    pairs : path pairs that the range detector listens to.
    """

    def __init__(self, table: xr.Dataset, pairs: tuple[str, ...]) -> None:
        self._range = table["range"].values
        delay = dict(zip(table["path"].values.tolist(), table["delay"].values, strict=True))
        self._delays = {pair: delay[pair[1]] - delay[pair[0]] for pair in combinations(sorted(delay), 2)}
        self._heard = [
            pair
            for pair in map(parse_pair, pairs)
            if pair in self._delays and np.isfinite(self._delays[pair]).any()
        ]
        self._slopes = {pair: np.gradient(lag, self._range) for pair, lag in self._delays.items()}

    def of(self, range_m: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ghosts of a ship at each of some ranges.

        Parameters
        ----------
        range_m, rate : (n) m, m/s; NaN where there is no ship.

        Returns
        -------
        ranges [m] and range rates [m/s], (n, n_ghosts) both, NaN where there is none.
        """
        made = []
        for said, delays in self._delays.items():
            lag, slope = (
                np.interp(range_m, self._range, values, left=np.nan, right=np.nan)
                for values in (delays, self._slopes[said])
            )
            for pair in self._heard:
                if pair == said:
                    continue
                known = np.flatnonzero(np.isfinite(self._delays[pair]))[::-1]  # delays fall with range
                place = np.interp(
                    lag, self._delays[pair][known], self._range[known], left=np.nan, right=np.nan
                )
                there = np.interp(place, self._range, self._slopes[pair])
                with np.errstate(divide="ignore", invalid="ignore"):
                    made.append((place, rate * slope / there))
        ranges, rates = np.array(made).reshape(-1, 2, len(range_m)).transpose(1, 2, 0)
        return ranges, rates


class Remainder:
    """Maps of one segment's tiles without what is known, which it remembers.

    Parameters
    ----------
    tiles : (n_tiles) s since 1970. delay : travel time of the sound.
    azimuth, range_m, rate : axes of the maps [deg, m, m/s].
    two_sided : (n_tiles) where azimuths are known up to 180° alone; by default nowhere.
    """

    def __init__(
        self,
        tiles: np.ndarray,
        delay: Delay,
        azimuth: np.ndarray,
        range_m: np.ndarray,
        rate: np.ndarray,
        two_sided: np.ndarray | None = None,
    ) -> None:
        self._tiles, self._delay = tiles, delay
        self._turns = [(0.0, np.ones(len(tiles), bool))]
        if two_sided is not None and two_sided.any():
            self._turns.append((180.0, two_sided))
        self._azimuth, self._range_m, self._rate = azimuth, range_m, rate
        self._taken: list[tuple[Track, float]] = []

    def without(
        self,
        track: Track,
        azimuth_llr: np.ndarray | None,
        range_llr: np.ndarray | None,
        reach_m: float = np.inf,
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The maps with what a track explains made silent, for the search of the next ship; beyond `reach_m` it explains nothing."""
        self._taken.append((track, reach_m))
        azimuth, distance, rate = track.motion.observables(emission(track.motion, self._tiles, self._delay))
        distance = np.where(distance <= reach_m, distance, np.nan)
        ranged = np.zeros(len(self._tiles), bool)
        if range_llr is not None:
            near = abs(self._range_m[None, :] - distance[:, None]) <= NEAR[0]
            rates = abs(self._rate[None, :] - rate[:, None]) <= NEAR[1]
            here = near[:, :, None] & rates[:, None, :]
            ranged = np.where(here, range_llr, -np.inf).max(axis=(1, 2)) > RANGED
            range_llr = np.where(here, np.minimum(range_llr, 0.0), range_llr)
        if azimuth_llr is not None:
            # A ship that keeps its range but not its azimuth has turned: what is heard nearby is still that ship.
            explained = np.zeros(azimuth_llr.shape, bool)
            for turn, there in self._turns:
                beside = abs(wrap180(self._azimuth[None, :] - azimuth[:, None] - turn)) <= TURN_DEG
                beside &= ranged[:, None]
                beside |= lobe(azimuth_llr, self._azimuth, azimuth + turn, TURN_DEG)
                explained |= beside & there[:, None]
            explained &= np.isfinite(distance)[:, None]
            # Where one ship is loud, a ship anywhere may explain more than none: the next is held against the first.
            azimuth_llr = above_floor(
                np.where(explained, np.minimum(azimuth_llr, 0.0), azimuth_llr), explained
            )
        return azimuth_llr, range_llr

    def without_ghosts(self, ghosts: Ghosts, range_llr: np.ndarray) -> np.ndarray:
        """Range maps in which the ghosts of all that was taken out are silent too."""
        range_llr = range_llr.copy()
        for track, reach_m in self._taken:
            _, distance, rate = track.motion.observables(emission(track.motion, self._tiles, self._delay))
            ranges, rates = ghosts.of(np.where(distance <= reach_m, distance, np.nan), rate)
            first, last, slowest, fastest = (
                np.searchsorted(axis, at + side * reach)
                for axis, at, reach in zip(
                    (self._range_m, self._rate), (ranges, rates), NEAR_GHOST, strict=True
                )
                for side in (-1, 1)
            )
            there = np.isfinite(ranges) & np.isfinite(rates) & (first < last) & (slowest < fastest)
            for tile, ghost in np.argwhere(there):
                here = tile, ghost
                cells = range_llr[tile, first[here] : last[here], slowest[here] : fastest[here]]
                np.minimum(cells, 0.0, out=cells)
        return range_llr
