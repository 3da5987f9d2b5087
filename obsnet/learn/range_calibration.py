"""Calibration of the range detector on validation records, and what its maps are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import torch
import xarray as xr
from torch import Tensor

from obsnet.detectors.learned_range import LearnedRangeDetector, RangeCalibration, Scorer
from obsnet.detectors.maps import detections, presence
from obsnet.detectors.range_features import RangeFeaturesConfig
from obsnet.layout import to_posix
from obsnet.learn.range_network import RangeNetwork

Passage = tuple[xr.DataArray, xr.Dataset, pd.DataFrame, np.ndarray]
"""A record to calibrate on: cepstrogram, believed propagation table, truth, and the minutes of which the truth is known."""

INDEPENDENT_MIN = 3.0
"""Windows of 180 s are independent every so many minutes, at best."""
STRETCH_MIN = 20
SCALES = np.geomspace(0.6, 1.6, 25)
"""Ranges, over the true one, of the wrong tracks that the exponent is fitted against."""


def scorer_of(network: RangeNetwork) -> Scorer:
    """A network as the detector takes it."""
    network.eval()

    def score(features: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(network(torch.from_numpy(features)).numpy())

    return score


@dataclass(frozen=True)
class _Said:
    """Of every examined minute and ship: scores of all cells, masks, and where the truth is."""

    network: Tensor
    cheap: Tensor
    log_prior: Tensor
    corner: Tensor
    weight: Tensor
    ship: Tensor


def calibrate(
    network: RangeNetwork,
    passages: Sequence[Passage],
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
    start: RangeCalibration = RangeCalibration(),
    every: int = 3,
) -> RangeCalibration:
    """Slopes and offsets by maximum likelihood, bounds by the number of independent windows, exponent by wrong tracks.

    Parameters
    ----------
    every : one minute in so many is looked at for slopes and offsets.
    """
    said = _collect(network, passages, features, start, every)
    share = float(said.ship.float().mean())
    odds = float(np.log(share / (1.0 - share)))
    free = torch.tensor([0.0, 0.0, float(np.log(start.cheap_slope)), start.cheap_offset], requires_grad=True)
    optimiser = torch.optim.LBFGS([free], max_iter=40, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = _loss(said, free, start.cheap_bound, odds).mean()
        value.backward()
        return value

    optimiser.step(closure)
    slope, offset, cheap_slope, cheap_offset = (float(x) for x in free.detach())
    minutes = sum(len(known) for *_, known in passages)
    evidence = float(np.log(max(minutes / INDEPENDENT_MIN, 10.0)))
    fitted = replace(
        start, slope=float(np.exp(slope)), offset=offset, cheap_slope=float(np.exp(cheap_slope)), cheap_offset=cheap_offset,
        lowest=-evidence, highest=evidence + float(np.log(len(features.range_m))),
    )  # fmt: skip
    return replace(fitted, exponent=_exponent(network, passages, features, fitted))


def _loss(said: _Said, free: Tensor, cheap_bound: float, odds: float) -> Tensor:
    """Negative log posterior of each examined minute, see `obsnet.learn.range_network.range_loss`."""
    cheap = torch.clamp(free[2].exp() * said.cheap + free[3], max=cheap_bound)
    looked = torch.isfinite(said.network)
    ratio = torch.where(looked, free[0].exp() * torch.nan_to_num(said.network) + free[1], cheap)
    total = torch.logsumexp((ratio + said.log_prior).flatten(1), dim=1) + odds
    true = (torch.gather(ratio.flatten(1), 1, said.corner) * said.weight).sum(dim=1) + odds
    return torch.nn.functional.softplus(total) - torch.where(said.ship, true, torch.zeros_like(true))


def _collect(
    network: RangeNetwork,
    passages: Sequence[Passage],
    features: RangeFeaturesConfig,
    start: RangeCalibration,
    every: int,
) -> _Said:
    parts: list[tuple[np.ndarray, ...]] = []
    grid, rates = features.range_m, features.range_rate
    prior = np.log(np.maximum(grid, grid[1]) / (np.maximum(grid, grid[1]).sum() * len(rates)))
    for cepstrogram, table, truth, known in passages:
        minutes = _inside(cepstrogram, known, features.window_s)[::every]
        detector = LearnedRangeDetector(table, scorer_of(network), start, features)
        if not len(minutes):
            continue
        scored, cheap = detector.scores(cepstrogram, minutes)
        ships = _by_minute(truth, minutes, grid[-1])
        for row, here in enumerate(ships):
            if not np.isfinite(scored[row]).any():
                continue
            for ship in range(max(len(here), 1)):
                masked = np.broadcast_to(prior, cheap[row].shape).copy()
                for other, (r, _) in enumerate(here):
                    if other != ship:
                        masked[:, np.abs(grid - r) < max(800.0, 0.05 * r)] = -np.inf
                place = (float(here[ship, 0]), float(here[ship, 1])) if len(here) else (0.0, 0.0)
                corner, weight = _corners(*place, grid, rates)
                parts.append((scored[row], cheap[row], masked, corner, weight, np.array(len(here) > 0)))
    tensors = [torch.from_numpy(np.stack(column)) for column in zip(*parts, strict=True)]
    return _Said(tensors[0], tensors[1], tensors[2].float(), tensors[3], tensors[4].float(), tensors[5])


def _exponent(
    network: RangeNetwork,
    passages: Sequence[Passage],
    features: RangeFeaturesConfig,
    calibration: RangeCalibration,
) -> float:
    """Power of ratios summed along tracks at which the posterior over wrong tracks of the same shape means what it says."""
    sums = []
    grid, rates = features.range_m, features.range_rate
    for cepstrogram, table, truth, known in passages:
        minutes = _inside(cepstrogram, known, features.window_s)
        if len(minutes) < STRETCH_MIN:
            continue
        detector = LearnedRangeDetector(table, scorer_of(network), calibration, features)
        ratio = detector.ratios(cepstrogram, minutes)
        ships = _by_minute(truth, minutes, grid[-1] / SCALES[-1])
        for begin in range(0, len(minutes) - STRETCH_MIN + 1, STRETCH_MIN):
            rows = np.arange(begin, begin + STRETCH_MIN)
            if minutes[rows[-1]] - minutes[rows[0]] > 60.0 * STRETCH_MIN or any(
                len(ships[k]) != 1 for k in rows
            ):
                continue
            track = np.array([ships[k][0] for k in rows])
            place = np.clip(
                np.rint(track[:, :1] * SCALES / (grid[1] - grid[0])).astype(int), 0, len(grid) - 1
            )
            rate = np.rint((track[:, 1:] * SCALES - rates[0]) / (rates[1] - rates[0])).astype(int)
            sums.append(ratio[rows[:, None], np.clip(rate, 0, len(rates) - 1), place].sum(axis=0))
    if len(sums) < 5:
        return 1.0 / INDEPENDENT_MIN
    total = torch.from_numpy(np.stack(sums))
    truth_at = int(np.abs(SCALES - 1.0).argmin())
    powers = torch.logspace(-2, 0, 41)
    losses = torch.stack([-torch.log_softmax(power * total, 1)[:, truth_at].mean() for power in powers])
    return float(powers[int(losses.argmin())])


def measure(
    network: RangeNetwork,
    passages: Sequence[Passage],
    calibration: RangeCalibration,
    features: RangeFeaturesConfig = RangeFeaturesConfig(),
) -> dict[str, float]:
    """How well the maps serve, minute by minute.

    Returns
    -------
    nll : per examined minute and ship, nats (every third minute). right, wrong : shares of the minutes with ships in range that
    are detected within max(500 m, 3 %) of one, or elsewhere. false_per_hour : of minutes without. smad_m : of the right ones.
    ece : expected calibration error of presence. minutes_with, minutes_without.
    """
    rows = []
    for cepstrogram, table, truth, known in passages:
        minutes = _inside(cepstrogram, known, features.window_s)
        if not len(minutes):
            continue
        maps = LearnedRangeDetector(table, scorer_of(network), calibration, features).maps(
            cepstrogram, minutes
        )
        ratios = presence(maps)
        said = detections(maps, ratios)
        for row, here in enumerate(_by_minute(truth, minutes, maps["range"].values[-1])):
            if np.isnan(ratios["range"].iloc[row]):
                continue
            error = said["range_m"].iloc[row] - here[:, 0] if len(here) else np.array([np.nan])
            best = int(np.nanargmin(np.abs(error))) if np.isfinite(error).any() else 0
            near = bool(len(here)) and abs(error[best]) < max(500.0, 0.03 * here[best, 0])
            rows.append(
                (
                    ratios["range"].iloc[row],
                    len(here),
                    np.isfinite(said["range_m"].iloc[row]),
                    near,
                    error[best],
                )
            )
    ratio, ships, found, right, error = np.array(rows, float).T
    within, alarm = ships > 0, found > 0
    share = within.mean()
    sure = 1.0 / (1.0 + np.exp(-(ratio + np.log(share / (1.0 - share)))))
    good = error[(right > 0) & alarm]
    loss = _loss(
        _collect(network, passages, features, calibration, 3),
        torch.tensor([np.log(calibration.slope), calibration.offset, np.log(calibration.cheap_slope), calibration.cheap_offset]),
        calibration.cheap_bound, float(np.log(share / (1.0 - share))),
    )  # fmt: skip
    return {
        "nll": float(loss.mean()),
        "right": float((right > 0)[within & alarm].sum() / max(within.sum(), 1)),
        "wrong": float((right == 0)[within & alarm].sum() / max(within.sum(), 1)),
        "false_per_hour": float(60.0 * (alarm & ~within).sum() / max((~within).sum(), 1)),
        "smad_m": float(1.4826 * np.median(np.abs(good - np.median(good)))) if len(good) else float("nan"),
        "ece": _calibration_error(sure, within),
        "minutes_with": float(within.sum()),
        "minutes_without": float((~within).sum()),
    }


def _calibration_error(said: np.ndarray, seen: np.ndarray, bins: int = 10) -> float:
    place = np.minimum((said * bins).astype(int), bins - 1)
    gaps = [
        (place == k).mean() * abs(said[place == k].mean() - seen[place == k].mean()) for k in np.unique(place)
    ]
    return float(sum(gaps))


def _inside(cepstrogram: xr.DataArray, known: np.ndarray, window_s: float) -> np.ndarray:
    times = to_posix(cepstrogram["time"].values)
    return known[(known >= times[0] + window_s / 2) & (known <= times[-1] - window_s / 2)]


def _by_minute(truth: pd.DataFrame, minutes: np.ndarray, farthest_m: float) -> list[np.ndarray]:
    """Range [m] and range rate [m/s] of the ships of each minute on the grid, (ships, 2)."""
    seconds = to_posix(truth["time"].to_numpy("datetime64[ns]"))
    values = truth[["range_m", "range_rate_mps"]].to_numpy(float)
    near = values[:, 0] <= farthest_m
    return [values[near & (np.abs(seconds - minute) < 0.5)] for minute in minutes]


def _corners(
    range_m: float, rate: float, grid: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cells around a hypothesis (flat index) and their bilinear weights."""
    x = np.clip(range_m / (grid[1] - grid[0]), 0.0, len(grid) - 1.001)
    y = np.clip((rate - rates[0]) / (rates[1] - rates[0]), 0.0, len(rates) - 1.001)
    i, k = int(x), int(y)
    a, b = x - i, y - k
    index = np.array(
        [k * len(grid) + i, k * len(grid) + i + 1, (k + 1) * len(grid) + i, (k + 1) * len(grid) + i + 1]
    )
    return index, np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
