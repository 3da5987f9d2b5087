"""What a scan offers each track and a new animal: combinations of its measurements, with the log factor of
each.

All factors are relative to clutter: a combination that clutter explains as well has factor 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsnet.trackers.kalman import update
from obsnet.trackers.observation_models import ObservationModel
from obsnet.trackers.scans import Scan
from obsnet.trackers.track_tree import Forecast

FLOOR = -690.0
"""Log density that stands for clutter that cannot be, so that ratios stay finite; weights take the true
one."""

MOST_COMPLETE = 20_000
BEST_COMPLETE = 32


@dataclass(frozen=True)
class Options:
    """Combinations of a scan's measurements, at most one a channel.

    Attributes
    ----------
    combinations : measurements of each; member : bool array (combination, measurement).
    hit : array (track, combination), log factor of the track's animal having clicked so.
    miss : array (track,), that of its animal not having clicked, or having ended.
    updated, narrowed : states (track, combination, ...) after the click.
    born : array (combination,), log factor of a new animal; newborn, newborn_covariance : its state.
    """

    combinations: list[tuple[int, ...]]
    member: np.ndarray
    hit: np.ndarray
    miss: np.ndarray
    updated: np.ndarray
    narrowed: np.ndarray
    born: np.ndarray
    newborn: np.ndarray
    newborn_covariance: np.ndarray


def offer(scan: Scan, model: ObservationModel, forecast: Forecast, gate_std: float, branches: int) -> Options:
    """Combinations worth considering and their log factors.

    For each track the `branches` best combinations of measurements within `gate_std` standard deviations; for
    a new animal those that have a measurement of every channel, since fewer do not determine a direction.
    """
    noise = model.noise if scan.covariance is None else scan.covariance
    complete, states = _complete(scan, model, noise)
    gated = [] if scan.whole else _gated(scan, model, forecast, noise, gate_std, branches)
    found = list(dict.fromkeys([*complete, *gated]))
    values = np.full((len(found), model.channels), np.nan)
    member = np.zeros((len(found), len(scan.value)), bool)
    for row, taken in enumerate(found):
        member[row, list(taken)] = True
        values[row, scan.channel[list(taken)]] = scan.value[list(taken)]
    prior = _prior(scan, model, member)
    updated, narrowed, likelihood = _updates(model, forecast, values, noise, gate_std)
    size = 2 * model.dimensions
    rest = len(found) - len(complete)
    unborn = np.full(rest, -np.inf)
    alive = forecast.existence
    return Options(
        combinations=found,
        member=member,
        hit=likelihood + prior + _log(alive)[:, None],
        miss=_log(1.0 - alive + alive * np.exp(scan.log_miss)),
        updated=updated,
        narrowed=narrowed,
        born=np.append(states[2], unborn) + prior + scan.log_birth,
        newborn=np.vstack([states[0], np.zeros((rest, size))]),
        newborn_covariance=np.concatenate([states[1], np.zeros((rest, size, size))]),
    )


def _log(probability: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(probability, 1e-300))


def _prior(scan: Scan, model: ObservationModel, member: np.ndarray) -> np.ndarray:
    """Log prior of a click being measured as each combination, over clutter's density there."""
    detected = member.sum(axis=1)
    prior = scan.log_click - member @ np.maximum(scan.log_clutter, FLOOR)
    if not scan.whole:
        missed = model.channels - detected
        prior = prior + detected * np.log(scan.detection) + missed * np.log1p(-scan.detection)
    return prior


def _updates(
    model: ObservationModel, forecast: Forecast, values: np.ndarray, noise: np.ndarray, gate_std: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every track updated by every combination: states and log likelihood, dims (track, combination, ...).

    A combination with a measurement outside the track's gate is impossible.
    """
    predicted, jacobian = model.observe(forecast.mean)
    innovation = model.innovation(values[None], predicted[:, None])
    shape = (len(forecast.mean), len(values))
    updated, narrowed, likelihood = update(
        np.broadcast_to(forecast.mean[:, None], (*shape, forecast.mean.shape[-1])),
        forecast.covariance[:, None],
        innovation,
        np.broadcast_to(jacobian[:, None], (*shape, *jacobian.shape[1:])),
        noise,
    )
    outside = innovation**2 > gate_std**2 * _variances(jacobian, forecast, noise)[:, None]
    return updated, narrowed, np.where(outside.any(axis=-1), -np.inf, likelihood)


def _variances(jacobian: np.ndarray, forecast: Forecast, noise: np.ndarray) -> np.ndarray:
    """Variance of each channel's innovation, dims (track, channel)."""
    return np.einsum("upi,uij,upj->up", jacobian, forecast.covariance, jacobian) + np.diag(noise)


def _gated(
    scan: Scan, model: ObservationModel, forecast: Forecast, noise: np.ndarray, gate_std: float, branches: int
) -> list[tuple[int, ...]]:
    """For each track the best combinations of measurements in its gate, judged channel by channel."""
    if not (len(forecast.mean) and len(scan.value)):
        return []
    predicted, jacobian = model.observe(forecast.mean)
    which = np.arange(len(scan.value))
    vector = np.full((len(scan.value), model.channels), np.nan)
    vector[which, scan.channel] = scan.value
    apart = model.innovation(vector[None], predicted[:, None])[:, which, scan.channel]
    variance = _variances(jacobian, forecast, noise)[:, scan.channel]
    inside = apart**2 < gate_std**2 * variance
    score = -0.5 * (apart**2 / variance + np.log(2.0 * np.pi * variance)) - np.maximum(
        scan.log_clutter, FLOOR
    )
    score += np.log(scan.detection) - np.log1p(-scan.detection)
    found: list[tuple[int, ...]] = []
    for track in np.flatnonzero(inside.any(axis=1)):
        beam: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
        for channel in np.unique(scan.channel[inside[track]]):
            near = np.flatnonzero(inside[track] & (scan.channel == channel))
            grown = [(total + score[track, m], (*taken, int(m))) for total, taken in beam for m in near]
            beam = sorted([*beam, *grown], reverse=True)[:branches]
        found += [tuple(sorted(taken)) for _, taken in beam if taken]
    return found


def _complete(
    scan: Scan, model: ObservationModel, noise: np.ndarray
) -> tuple[list[tuple[int, ...]], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Combinations that a new animal could cause, and its mean, covariance and log evidence for each."""
    size = 2 * model.dimensions
    nothing = (np.zeros((0, size)), np.zeros((0, size, size)), np.zeros(0))
    if scan.whole:
        grid = np.arange(len(scan.value))[None] if len(scan.value) else np.zeros((0, 0), int)
    else:
        grid = _products(scan, model)
    if not grid.size:
        return [], nothing
    vector = np.full((len(grid), model.channels), np.nan)
    vector[np.arange(len(grid))[:, None], scan.channel[grid]] = scan.value[grid]
    mean, covariance, evidence = model.born(vector, noise)
    best = np.argsort(evidence)[::-1][:BEST_COMPLETE]
    if not scan.whole:
        best = best[np.isfinite(evidence[best])]
    return [tuple(sorted(map(int, grid[row]))) for row in best], (
        mean[best],
        covariance[best],
        evidence[best],
    )


def _products(scan: Scan, model: ObservationModel) -> np.ndarray:
    """One feasible measurement of every channel, all ways, dims (combination, channel)."""
    good = model.feasible(scan.channel, scan.value)
    lists = [np.flatnonzero(good & (scan.channel == channel)) for channel in range(model.channels)]
    ways = np.prod([float(len(choice)) for choice in lists])
    if ways == 0 or ways > MOST_COMPLETE:
        return np.zeros((0, model.channels), int)
    return np.stack(np.meshgrid(*lists, indexing="ij"), axis=-1).reshape(-1, len(lists))
