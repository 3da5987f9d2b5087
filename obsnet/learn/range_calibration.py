"""Calibration of the range detector on validation records, and what its maps are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
import xarray as xr
from torch import Tensor

from obsnet.detectors.learned_range import (
    LearnedRangeDetector,
    RangeCalibration,
    Scorer,
    calibrated,
    presence_ratio,
    range_prior,
)
from obsnet.detectors.range_features import RangeFeaturesConfig
from obsnet.layout import to_posix
from obsnet.learn.calibration import INDEPENDENT_MIN, calibration_error
from obsnet.learn.range_network import RangeNetwork

STRETCH_S = 1200.0
PRESENCE_BINS, LEAST_SLOPE = 12, 0.05
CHEAP_STEP, CHEAP_BINS = 0.5, 80
SCALES = np.geomspace(0.6, 1.6, 25)
"""Ranges, over the true one, of the wrong tracks that the exponent is fitted against."""


@dataclass(frozen=True)
class Heard:
    """What the detector said of a record, uncalibrated, and the truth.

    Attributes
    ----------
    minutes : s since 1970. network : (minute, rate, range), NaN where it did not look. cheap : like it.
    ships : of each minute, range [m] and range rate [m/s] of the ships on the grid, (ship, 2).
    """

    minutes: np.ndarray
    network: np.ndarray
    cheap: np.ndarray
    ships: list[np.ndarray]


def scorer_of(network: RangeNetwork) -> Scorer:
    """A network as the detector takes it."""
    network.eval()

    def score(features: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(network(torch.from_numpy(features)).numpy())

    return score


def hear(
    scorer: Scorer,
    cepstrogram: xr.DataArray,
    table: xr.Dataset,
    truth: pd.DataFrame,
    known: np.ndarray,
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
    every: int = 2,
    look: RangeCalibration = RangeCalibration(),
) -> Heard:
    """Run the detector over one minute in `every` of a record, of those of which the truth is known.

    Parameters
    ----------
    table : believed propagation table. truth : of `obsnet.learn.range_examples.range_examples`. known : s since 1970.
    look : says where the network looks; it does in every minute, whatever the `least` (see `looked_at`).
    """
    times = to_posix(cepstrogram["time"].values)
    half = features.window_s / 2
    minutes = known[(known >= times[0] + half) & (known <= times[-1] - half)][::every]
    detector = LearnedRangeDetector(table, scorer, replace(look, least=0.0), features)
    said, cheap = detector.scores(cepstrogram, minutes)
    ships = _by_minute(truth, minutes, features.range_m[-1])
    valid = ~np.isnan(cepstrogram.values[0])
    covered = np.array([valid[np.abs(times - minute) < half].any() for minute in minutes], bool)
    there = np.flatnonzero(covered)
    return Heard(minutes[there], said[there], cheap[there], [ships[k] for k in there])


def looked_at(heard: Sequence[Heard], least: float) -> list[Heard]:
    """Records as if the network had looked only at minutes whose greatest cheap score reaches `least`."""
    found = []
    for record in heard:
        looks = record.cheap.max(axis=(1, 2), keepdims=True) >= least
        found.append(replace(record, network=np.where(looks, record.network, np.float32(np.nan))))
    return found


def calibrate(
    heard: Sequence[Heard],
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
    start: RangeCalibration = RangeCalibration(),
) -> RangeCalibration:
    """Slopes and offsets by maximum likelihood, bounds by the number of independent windows, exponent by wrong tracks.

    All is of looks at every minute, whatever `start.least`: refitted to fewer looks, presence found more false tracks.
    """
    parts = _parts(heard, features)
    odds = _odds(parts.ship)
    free = torch.tensor([0.0, 0.0, float(np.log(start.cheap_slope)), start.cheap_offset], requires_grad=True)
    optimiser = torch.optim.LBFGS([free], max_iter=25, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = _loss(parts, free, start.cheap_bound, odds).mean()
        value.backward()
        return value

    optimiser.step(closure)
    slope, offset, cheap_slope, cheap_offset = (float(x) for x in free.detach())
    fitted = replace(
        start, slope=float(np.exp(slope)), offset=offset, cheap_slope=float(np.exp(cheap_slope)), cheap_offset=cheap_offset,
        lowest=-100.0, highest=100.0,
    )  # fmt: skip
    said, seen = _presence(heard, features, fitted)
    spans = sum(np.ptp(record.minutes) for record in heard if len(record.minutes))
    evidence = float(np.log(max(spans / 60.0 / INDEPENDENT_MIN, 10.0)))
    fitted = replace(
        fitted, presence_said=said, presence_seen=seen,
        lowest=-evidence, highest=evidence + float(np.log(len(features.range_m))),
    )  # fmt: skip
    return replace(fitted, exponent=_exponent(heard, features, fitted))


def _presence(
    heard: Sequence[Heard], features: RangeFeaturesConfig, calibration: RangeCalibration
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Knots of the marginal ratio of presence: what was said in bins of equal number, and what was seen, made to increase."""
    said = np.concatenate(
        [
            presence_ratio(calibrated(record.network, record.cheap, calibration, features), features)
            for record in heard
        ]
    )
    seen = np.array([len(ships) > 0 for record in heard for ships in record.ships])
    odds = _odds_of(float(seen.mean()))
    bins = np.array_split(np.argsort(said), PRESENCE_BINS)
    count = np.array([len(b) for b in bins])
    share = (np.array([seen[b].sum() for b in bins]) + seen.mean()) / (count + 1.0)
    steps = isotonic(np.log(share / (1.0 - share)) - odds, count)
    knots = np.array([said[b].mean() for b in bins])
    tilt = LEAST_SLOPE * (knots - np.average(knots, weights=count))
    apart = np.concatenate([[True], np.diff(knots) > 1e-6])
    return tuple(map(float, knots[apart])), tuple(map(float, (steps + tilt)[apart]))


def isotonic(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Least-squares non-decreasing fit: neighbours that decrease are pooled.

    >>> isotonic(np.array([1.0, 3.0, 2.0, 5.0]), np.ones(4)).tolist()
    [1.0, 2.5, 2.5, 5.0]
    """
    blocks: list[tuple[float, float, int]] = []
    for value, weight in zip(values, weights, strict=True):
        blocks.append((float(value), float(weight), 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (a, wa, na), (b, wb, nb) = blocks[-2:]
            blocks[-2:] = [((a * wa + b * wb) / (wa + wb), wa + wb, na + nb)]
    return np.concatenate([np.full(n, value) for value, _, n in blocks])


def measure(
    heard: Sequence[Heard],
    calibration: RangeCalibration,
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
    threshold: float = 0.0,
) -> dict[str, float]:
    """How well the maps serve, minute by minute.

    Returns
    -------
    nll : per minute and ship, nats. right, wrong : shares of the minutes with ships in range that are detected within
    max(500 m, 3 %) of one, or elsewhere. false_per_hour : of minutes without. smad_m, bias_m : of the right ones.
    ece : expected calibration error of presence. minutes_with, minutes_without.
    """
    grid = features.range_m
    prior = range_prior(features)
    rows = []
    for record in heard:
        ratio = calibrated(record.network, record.cheap, calibration, features)
        best = grid[(ratio + prior).reshape(len(ratio), -1).argmax(axis=1) % len(grid)]
        for said, where, ships in zip(presence_ratio(ratio, features), best, record.ships, strict=True):
            errors = where - ships[:, 0]
            nearest = int(np.abs(errors).argmin()) if len(ships) else -1
            near = nearest >= 0 and abs(errors[nearest]) < max(500.0, 0.03 * ships[nearest, 0])
            rows.append((said, len(ships) > 0, near, errors[nearest] if nearest >= 0 else np.nan))
    table = np.array(rows, float)
    presence, within, near, error = table[:, 0], table[:, 1] > 0, table[:, 2] > 0, table[:, 3]
    alarm, share = presence > threshold, np.clip(within.mean(), 0.01, 0.99)
    good = error[near & alarm]
    nll = np.concatenate([_minute_nll(record, calibration, features, _odds_of(share)) for record in heard])
    return {
        "nll": float(nll.mean()),
        "right": float((near & alarm & within).sum() / max(within.sum(), 1)),
        "wrong": float((~near & alarm & within).sum() / max(within.sum(), 1)),
        "false_per_hour": float(60.0 * (alarm & ~within).sum() / max((~within).sum(), 1)),
        "smad_m": float(1.4826 * np.median(np.abs(good - np.median(good)))) if len(good) else float("nan"),
        "bias_m": float(np.median(good)) if len(good) else float("nan"),
        "ece": calibration_error(1.0 / (1.0 + np.exp(-(presence + np.log(share / (1.0 - share))))), within),
        "minutes_with": float(within.sum()),
        "minutes_without": float((~within).sum()),
    }


@dataclass(frozen=True)
class _Parts:
    """Of every minute and ship: the scores of the cells that were looked at and their log prior (−∞ at other ships), the log
    prior of the others in bins of cheap score, and the scores of the four cells around the truth with their weights.
    """

    network: Tensor
    log_prior: Tensor
    log_mass: Tensor
    corner_network: Tensor
    corner_cheap: Tensor
    weight: Tensor
    ship: Tensor


def _parts(heard: Sequence[Heard], features: RangeFeaturesConfig) -> _Parts:
    grid, rates, prior = features.range_m, features.range_rate, range_prior(features)
    most = max(int(np.isfinite(record.network).sum(axis=(1, 2)).max(initial=1)) for record in heard)
    rows: list[tuple[np.ndarray, ...]] = []
    for record in heard:
        for network, cheap, ships in zip(record.network, record.cheap, record.ships, strict=True):
            looked = np.isfinite(network)
            count = int(looked.sum())
            said = np.zeros(most, np.float32)
            said[:count] = network[looked]
            bins = np.minimum((cheap / CHEAP_STEP).astype(int), CHEAP_BINS - 1)
            for ship in range(max(len(ships), 1)):
                masked = _masked(prior, grid, ships, ship)
                held = np.full(most, -np.inf, np.float32)
                held[:count] = masked[looked]
                mass = np.bincount(bins[~looked], np.exp(masked[~looked]), CHEAP_BINS)
                place = (float(ships[ship, 0]), float(ships[ship, 1])) if len(ships) else (0.0, 0.0)
                corner, weight = _corners(*place, grid, rates)
                around = network.ravel()[corner], cheap.ravel()[corner]
                rows.append((said, held, np.log(mass + 1e-30), *around, weight, np.array(len(ships) > 0)))
    t = [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]
    return _Parts(t[0], t[1], t[2].float(), t[3], t[4], t[5].float(), t[6])


def _loss(parts: _Parts, free: Tensor, cheap_bound: float, odds: float) -> Tensor:
    """Negative log posterior of each minute and ship, see `obsnet.learn.range_network.range_loss`."""
    slope, offset, cheap_slope, cheap_offset = free[0].exp(), free[1], free[2].exp(), free[3]

    def cheaply(score: Tensor) -> Tensor:
        return torch.clamp(cheap_slope * score + cheap_offset, max=cheap_bound)

    others = cheaply((torch.arange(CHEAP_BINS) + 0.5) * CHEAP_STEP) + parts.log_mass
    every = torch.cat([slope * parts.network + offset + parts.log_prior, others], dim=1)
    total = torch.logsumexp(every, dim=1) + odds
    known = torch.isfinite(parts.corner_network)
    around = torch.where(
        known, slope * parts.corner_network.nan_to_num() + offset, cheaply(parts.corner_cheap)
    )
    true = (around * parts.weight).sum(dim=1) + odds
    return torch.nn.functional.softplus(total) - torch.where(parts.ship, true, torch.zeros_like(true))


def _minute_nll(
    record: Heard, calibration: RangeCalibration, features: RangeFeaturesConfig, odds: float
) -> np.ndarray:
    """Negative log posterior of each minute and ship of a record, by its calibrated ratios."""
    ratios, found = calibrated(record.network, record.cheap, calibration, features), []
    grid, rates, prior = features.range_m, features.range_rate, range_prior(features)
    for ratio, ships in zip(ratios, record.ships, strict=True):
        for ship in range(max(len(ships), 1)):
            masked = _masked(prior, grid, ships, ship)
            total = np.logaddexp(0.0, np.logaddexp.reduce((ratio + masked).ravel()) + odds)
            if len(ships):
                corner, weight = _corners(float(ships[ship, 0]), float(ships[ship, 1]), grid, rates)
                total -= (ratio.ravel()[corner] * weight).sum() + odds
            found.append(total)
    return np.array(found)


def _masked(prior: np.ndarray, grid: np.ndarray, ships: np.ndarray, ship: int) -> np.ndarray:
    """Log prior, −∞ around the ships but one."""
    masked = prior.copy()
    for other in np.delete(ships[:, 0], ship) if len(ships) else ():
        masked[:, np.abs(grid - other) < max(800.0, 0.05 * other)] = -np.inf
    return masked


def _odds(ship: Tensor) -> float:
    return _odds_of(float(ship.float().mean()))


def _odds_of(share: float) -> float:
    share = float(np.clip(share, 0.01, 0.99))
    return float(np.log(share / (1.0 - share)))


def _exponent(heard: Sequence[Heard], features: RangeFeaturesConfig, calibration: RangeCalibration) -> float:
    """Power of ratios summed along tracks at which the posterior over wrong tracks of the same shape means what it says.

    It is of sums over consecutive minutes: where only some minutes are looked at, their number counts for the rest.
    """
    sums = []
    grid, rates = features.range_m, features.range_rate
    for record in heard:
        step = float(np.median(np.diff(record.minutes))) if len(record.minutes) > 1 else np.inf
        length = int(STRETCH_S / step)
        if length < 3:
            continue
        ratio = calibrated(record.network, record.cheap, calibration, features)
        for begin in range(0, len(ratio) - length + 1, length):
            rows = np.arange(begin, begin + length)
            ships = [record.ships[k] for k in rows]
            if record.minutes[rows[-1]] - record.minutes[rows[0]] > STRETCH_S or any(
                len(s) != 1 for s in ships
            ):
                continue
            track = np.concatenate(ships)
            if track[:, 0].max() * SCALES[-1] > grid[-1]:
                continue
            place = np.clip(
                np.rint(track[:, :1] * SCALES / (grid[1] - grid[0])).astype(int), 0, len(grid) - 1
            )
            rate = np.rint((track[:, 1:] * SCALES - rates[0]) / (rates[1] - rates[0])).astype(int)
            along = ratio[rows[:, None], np.clip(rate, 0, len(rates) - 1), place].sum(axis=0)
            sums.append(along * step / 60.0)
    if len(sums) < 5:
        return 1.0 / INDEPENDENT_MIN
    total = torch.from_numpy(np.stack(sums))
    true = int(np.abs(SCALES - 1.0).argmin())
    powers = torch.logspace(-2, 0, 41)
    losses = torch.stack([-torch.log_softmax(power * total, 1)[:, true].mean() for power in powers])
    return float(powers[int(losses.argmin())])


def _by_minute(truth: pd.DataFrame, minutes: np.ndarray, farthest_m: float) -> list[np.ndarray]:
    seconds = to_posix(truth["time"].to_numpy("datetime64[ns]"))
    values = truth[["range_m", "range_rate_mps"]].to_numpy(float)
    near = values[:, 0] <= farthest_m
    return [values[near & (np.abs(seconds - minute) < 0.5)] for minute in minutes]


def _corners(
    range_m: float, rate: float, grid: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cells around a hypothesis (flat index) and their bilinear weights."""
    x = float(np.clip(range_m / (grid[1] - grid[0]), 0.0, len(grid) - 1.001))
    y = float(np.clip((rate - rates[0]) / (rates[1] - rates[0]), 0.0, len(rates) - 1.001))
    i, k = int(x), int(y)
    a, b = x - i, y - k
    first = k * len(grid) + i
    index = np.array([first, first + 1, first + len(grid), first + len(grid) + 1])
    return index, np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
