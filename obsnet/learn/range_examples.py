"""Training examples of the range detector: one record's cepstrogram and truth in, sampled hypotheses out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from obsnet.detectors.range_features import RangeFeatures, RangeFeaturesConfig
from obsnet.errors import ConfigError
from obsnet.layout import to_posix
from obsnet.ocean.rays import interpolate


@dataclass(frozen=True)
class RangeExamplesConfig:
    """How hypotheses are sampled.

    Parameters
    ----------
    hypotheses : drawn for each example, with replacement.
    every : one window in so many is taken where a ship is on the grid.
    empty_share : examples without a ship for each one with a ship, where the record has them.
    least_empty : examples without a ship that every record gives, where it has them.
    shares : of the draws by cheap score, around the truth, at the truth's ghosts, and by the prior alone.
    score_power : the cheap score's weight in its share of the draws.
    mask_m, mask_share : another ship's neighbourhood, in which hypotheses are neither true nor false.
    beliefs : tables to see each record through: the one that is given and mistaken ones, see `mistaken`.
    scale_error, speed_error : of those, standard deviations, relative.
    """

    hypotheses: int = 24
    every: int = 4
    empty_share: float = 0.35
    least_empty: int = 12
    shares: tuple[float, ...] = (0.45, 0.2, 0.1, 0.25)
    score_power: float = 3.0
    mask_m: float = 800.0
    mask_share: float = 0.05
    beliefs: int = 2
    scale_error: float = 0.002
    speed_error: float = 0.0015

    def __post_init__(self) -> None:
        if len(self.shares) != 4 or abs(sum(self.shares) - 1.0) > 1e-6 or self.shares[3] <= 0:
            raise ConfigError(f"shares must be four that sum to one, the last above 0, found {self.shares}")


FIELDS = {
    "features": "float16 (example, 1 + hypothesis, feature); the first hypothesis is the truth, zeros where no ship",
    "range_m": "float32 (example, 1 + hypothesis)",
    "log_proposal": "float32 (example, hypothesis), log of the expected number of draws of that cell; inf where masked",
    "ship": "bool (example), whether a ship is on the grid and the first hypothesis is it",
    "time": "float64 (example), minute, s since 1970",
}
"""Arrays of `range_examples`."""


def range_examples(
    cepstrogram: xr.DataArray,
    believed: xr.Dataset,
    truth: pd.DataFrame,
    generator: np.random.Generator,
    config: RangeExamplesConfig = RangeExamplesConfig(),
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
    known: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Draw training examples from one record.

    Parameters
    ----------
    cepstrogram : DataArray float32 (quefrency, time), clutter removed.
    believed : propagation table that the station's owner would use, errors included.
    truth : DataFrame time (datetime64, whole minutes), mmsi, range_m, range_rate_mps: every ship that may be heard, on
        the grid or beyond; with `uncertainty_m`, ships whose position is not known better are masked and never true.
    known : s since 1970, minutes of which `truth` is complete; all by default.

    Returns
    -------
    dict of arrays, see `FIELDS`.
    """
    tables = [believed] + [mistaken(believed, generator, config) for _ in range(config.beliefs - 1)]
    parts = [_seen_through(table, cepstrogram, truth, generator, config, features, known) for table in tables]
    return {name: np.concatenate([part[name] for part in parts]) for name in FIELDS}


def mistaken(table: xr.Dataset, generator: np.random.Generator, config: RangeExamplesConfig) -> xr.Dataset:
    """Propagation table of a slightly other depth and sound speed: τ(r) becomes (s/q) τ(r/s) for errors s and q."""
    scale = 1.0 + config.scale_error * generator.standard_normal()
    speed = 1.0 + config.speed_error * generator.standard_normal()
    ranges = table["range"].values
    moved = table.assign_coords(range=ranges * scale)
    moved = moved.assign(
        delay=table["delay"].variable * (scale / speed), slowness=table["slowness"].variable / speed
    )
    moved = moved.assign_attrs(depth_m=scale * table.attrs["depth_m"])
    return interpolate(moved, ranges[ranges <= scale * ranges[-1]])


def _seen_through(
    believed: xr.Dataset,
    cepstrogram: xr.DataArray,
    truth: pd.DataFrame,
    generator: np.random.Generator,
    config: RangeExamplesConfig,
    features: RangeFeaturesConfig,
    known: np.ndarray | None,
) -> dict[str, np.ndarray]:
    front = RangeFeatures(believed, features)
    minutes = _minutes(cepstrogram, features.window_s)
    if known is not None:
        minutes = minutes[np.isin(np.round(minutes), np.round(known))]
    ships = _ships(truth, minutes, features.range_m[-1])
    chosen = _choose(minutes, ships, generator, config)
    if not chosen:
        return _empty(config, features)
    rows = np.unique([row for row, _ in chosen])
    look = front.look(cepstrogram, minutes[rows])
    covered = np.array([look.valid[a:b].sum() for a, b in zip(look.start, look.stop, strict=True)]) > 0
    place = {row: i for i, row in enumerate(rows)}
    parts = [
        _example(front, look.score[place[row]], place[row], ships[row], ship, generator, config)
        for row, ship in chosen
        if covered[place[row]]
    ]
    if not parts:
        return _empty(config, features)
    index, range_m, rate, log_proposal, real = (np.stack(values) for values in zip(*parts, strict=True))
    shape = range_m.shape
    found = front.features(look, index.ravel(), range_m.ravel(), rate.ravel())
    found = found.reshape(*shape, -1)
    found[~real, 0] = 0.0
    return {
        "features": found.astype(np.float16),
        "range_m": range_m.astype(np.float32),
        "log_proposal": log_proposal.astype(np.float32),
        "ship": real,
        "time": look.minutes[index[:, 0]],
    }


def log_prior(
    range_m: np.ndarray, edges_m: np.ndarray, density: np.ndarray, step_m: float, rates: int
) -> np.ndarray:
    """Log prior of one cell of the grid at `range_m`, of a density [1/m] in bins between `edges_m`."""
    bins = np.clip(np.searchsorted(edges_m, range_m, side="right") - 1, 0, len(density) - 1)
    return np.log(density[bins] * step_m / rates)


def range_density(range_m: np.ndarray, edges_m: np.ndarray) -> np.ndarray:
    """Density [1/m] of true ranges in bins, smoothed over neighbours and never zero."""
    count = np.histogram(range_m, edges_m)[0] + 1.0
    padded = np.concatenate([count[:1], count, count[-1:]])
    smooth = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    return smooth / (smooth * np.diff(edges_m)).sum()


def _minutes(cepstrogram: xr.DataArray, window_s: float) -> np.ndarray:
    times = to_posix(cepstrogram["time"].values)
    return np.arange(np.ceil((times[0] + window_s / 2) / 60), (times[-1] - window_s / 2) // 60 + 1) * 60.0


@dataclass(frozen=True)
class _Ships:
    """Ships of one minute: range, range rate, what must be masked around, and whether a ship may be the truth."""

    range_m: np.ndarray
    rate: np.ndarray
    uncertainty_m: np.ndarray
    usable: np.ndarray


def _ships(truth: pd.DataFrame, minutes: np.ndarray, farthest_m: float) -> list[_Ships]:
    seconds = to_posix(truth["time"].to_numpy("datetime64[ns]"))
    values = truth[["range_m", "range_rate_mps"]].to_numpy(float)
    unsure = truth["uncertainty_m"].to_numpy(float) if "uncertainty_m" in truth else np.zeros(len(truth))
    order = np.argsort(seconds, kind="stable")
    low, high = np.searchsorted(seconds[order], minutes - 0.5), np.searchsorted(seconds[order], minutes + 0.5)
    found = []
    for a, b in zip(low, high, strict=True):
        rows = order[a:b]
        near = values[rows, 0] <= farthest_m
        usable = near & (unsure[rows] <= 300.0)
        found.append(_Ships(values[rows, 0], values[rows, 1], unsure[rows], usable))
    return found


def _choose(
    minutes: np.ndarray, ships: list[_Ships], generator: np.random.Generator, config: RangeExamplesConfig
) -> list[tuple[int, int]]:
    """Pairs of minute and ship (−1 for none) to make examples of."""
    offset = int(generator.integers(config.every))
    taken = [
        (row, int(ship))
        for row in range(offset, len(minutes), config.every)
        for ship in np.flatnonzero(ships[row].usable)
    ]
    vacant = [row for row in range(len(minutes)) if not ships[row].usable.any()]
    wanted = min(max(round(config.empty_share * len(taken)), config.least_empty), len(vacant))
    picked = sorted(generator.choice(vacant, wanted, replace=False)) if wanted else []
    return taken + [(int(row), -1) for row in picked]


def _example(
    front: RangeFeatures,
    score: np.ndarray,
    place: int,
    ships: _Ships,
    ship: int,
    generator: np.random.Generator,
    config: RangeExamplesConfig,
) -> tuple[np.ndarray, ...]:
    """Minute index, ranges, rates, log proposals and truth flag of one example."""
    grid, rates = front.config.range_m, front.config.range_rate
    prior = np.broadcast_to(np.maximum(grid, grid[1]), score.shape)
    prior = prior / prior.sum()
    by_score = prior * (1.0 + score) ** config.score_power
    mixture = [by_score / by_score.sum(), None, None, prior]
    if ship >= 0:
        mixture[1] = _near(grid, rates, [ships.range_m[ship]], 5.0)
        mixture[2] = _near(grid, rates, _ghost_ranges(front, ships.range_m[ship]), 2.0)
    parts = [(share, part) for share, part in zip(config.shares, mixture, strict=True) if part is not None]
    total = sum(share for share, _ in parts)
    proposal = sum(share / total * part for share, part in parts)
    drawn = generator.choice(proposal.size, config.hypotheses, p=(proposal / proposal.sum()).ravel())
    log_proposal = np.log(config.hypotheses * proposal.ravel()[drawn])
    range_m, rate = grid[drawn % len(grid)], rates[drawn // len(grid)]
    for other in range(len(ships.range_m)):
        if other != ship:
            reach = max(config.mask_m, config.mask_share * ships.range_m[other]) + ships.uncertainty_m[other]
            log_proposal[np.abs(range_m - ships.range_m[other]) < reach] = np.inf
    true = (ships.range_m[ship], ships.rate[ship]) if ship >= 0 else (0.0, 0.0)
    true_rate = np.clip(true[1], rates[0], rates[-1])
    return (
        np.full(config.hypotheses + 1, place),
        np.concatenate([[true[0]], range_m]),
        np.concatenate([[true_rate], rate]),
        log_proposal,
        np.array(ship >= 0),
    )


def _near(
    grid: np.ndarray, rates: np.ndarray, centres: list[float] | np.ndarray, cells: float
) -> np.ndarray | None:
    """Uniform density over the cells within `cells` ranges of any of `centres`, (rate, range); none if there are none."""
    if not len(centres):
        return None
    step = grid[1] - grid[0]
    inside = (np.abs(grid[:, None] - np.asarray(centres)[None, :]) <= cells * step).any(axis=1)
    return np.broadcast_to(inside / max(inside.sum() * len(rates), 1), (len(rates), len(grid)))


def _ghost_ranges(front: RangeFeatures, range_m: float) -> np.ndarray:
    """Ranges at which a pair has the delay that another pair has at `range_m`."""
    table = front.table
    centre = table.pad + round(range_m / 10.0)
    found = np.unique(table.inverse[:, table.index[centre]])
    ranges = front.config.range_m[found[found >= 0]]
    return ranges[np.abs(ranges - range_m) > 3 * front.config.range_step_m]


def _empty(config: RangeExamplesConfig, features: RangeFeaturesConfig) -> dict[str, np.ndarray]:
    n = config.hypotheses
    return {
        "features": np.zeros((0, n + 1, features.size), np.float16),
        "range_m": np.zeros((0, n + 1), np.float32),
        "log_proposal": np.zeros((0, n), np.float32),
        "ship": np.zeros(0, bool),
        "time": np.zeros(0),
    }
