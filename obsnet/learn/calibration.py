"""Calibration on validation records: slope and offset, bounds, and the exponent for windows that overlap."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from obsnet.learn.azimuth import HERE, AzimuthRows, AzimuthTaskConfig, Batch, at_turn, minute_losses, presence
from obsnet.learn.networks import AzimuthNetwork

ENOUGH = 100
"""Minutes with ships, and minutes without, that it takes to fit one kind of azimuth; else the other kind's fit serves."""

INDEPENDENT_MIN = 3.0
"""Windows of 180 s are independent every so many minutes, at best."""


@dataclass(frozen=True)
class Calibration:
    """Of full azimuths and of doubled ones: ratio = bounded(slope · output + offset, lowest, highest); `exponent` for sums over
    minutes, `prior_odds` of the training draws (removed already).
    """

    slope: tuple[float, ...] = (1.0, 1.0)
    offset: tuple[float, ...] = (0.0, 0.0)
    lowest: float = -8.0
    highest: float = 12.0
    exponent: float = 1.0
    prior_odds: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """Plain containers."""
        return {
            key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()
        }


@dataclass(frozen=True)
class Outputs:
    """What a network says of rows, and their labels; tensors (row, …), with the record that each row is from."""

    ratio: Tensor
    batch: Batch
    record: np.ndarray


def outputs(network: AzimuthNetwork, rows: AzimuthRows, batch: int = 16) -> Outputs:
    """Run a network over all rows."""
    ratios, labels = [], []
    network.eval()
    with torch.no_grad():
        for item in DataLoader(rows, batch):
            ratios.append(network(item["invariants"], item["phasor"], item["doubled"]))
            labels.append({name: item[name] for name in ("doubled", "turn", "state", "weight", "watched")})
    joined = {name: torch.cat([item[name] for item in labels]) for name in labels[0]}
    return Outputs(torch.cat(ratios), joined, np.array([number for number, _ in rows.rows]))


def odds(said: Outputs) -> float:
    """Minutes with a ship over minutes without one, of those that say something."""
    weight, here = said.batch["weight"], (said.batch["state"] == HERE).any(2)
    return float((weight * here).sum() / (weight * ~here).sum().clamp(min=1.0))


def calibrate(said: Outputs, config: AzimuthTaskConfig) -> Calibration:
    """Slope and offset by maximum likelihood for either kind of azimuth, bounds from the number of independent windows."""
    slopes: list[float] = []
    offsets: list[float] = []
    for doubled in (0.0, 1.0):
        rows = said.batch["doubled"] == doubled
        here = (said.batch["state"][rows] == HERE).any(2)
        weight = said.batch["weight"][rows] > 0
        if min((weight & here).sum(), (weight & ~here).sum()) < ENOUGH:
            slopes.append(slopes[0] if slopes else 1.0)
            offsets.append(offsets[0] if offsets else 0.0)
            continue
        part = {name: values[rows] for name, values in said.batch.items()}
        slope, offset = _slope_offset(said.ratio[rows], part, config)
        slopes.append(slope)
        offsets.append(offset)
    independent = float(said.batch["weight"].sum()) / INDEPENDENT_MIN
    count = said.ratio.shape[-1]
    first = Calibration(
        (slopes[0], slopes[1]), (offsets[0], offsets[1]), -float(np.log(independent)),
        float(np.log(independent * count)), prior_odds=config.prior_odds,
    )  # fmt: skip
    return replace(first, exponent=overlap_exponent(apply(said, first), said))


def apply(said: Outputs, calibration: Calibration) -> Tensor:
    """Calibrated ratios (row, minute, azimuth)."""
    doubled = said.batch["doubled"].long()
    slope = torch.tensor(calibration.slope)[doubled][:, None, None]
    offset = torch.tensor(calibration.offset)[doubled][:, None, None]
    return bounded(slope * said.ratio + offset, calibration.lowest, calibration.highest)


def bounded(ratio: Tensor, lowest: float, highest: float) -> Tensor:
    """Ratios over azimuth (last axis) that say more than `highest` are lowered together, so that they keep their shape."""
    excess = (ratio.amax(-1, keepdim=True) - highest).clamp(min=0.0)
    return (ratio - excess).clamp(min=lowest)


def _slope_offset(ratio: Tensor, batch: Batch, config: AzimuthTaskConfig) -> tuple[float, float]:
    log_slope, offset = torch.zeros(1, requires_grad=True), torch.zeros(1, requires_grad=True)
    optimiser = torch.optim.LBFGS([log_slope, offset], max_iter=40, line_search_fn="strong_wolfe")
    weight = batch["weight"] / batch["weight"].sum()

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = (minute_losses(log_slope.exp() * ratio + offset, batch, config) * weight).sum()
        value.backward()
        return value

    optimiser.step(closure)
    return float(log_slope.detach().exp()), float(offset.detach())


def overlap_exponent(ratio: Tensor, said: Outputs, stretch: int = 30, turns: int = 24) -> float:
    """Power of the summed ratios over half-hours at which the posterior over a ship's track means what it says.

    The track of a ship known throughout a stretch competes with the same track turned by whole parts of the circle; the
    exponent is the temperature of least negative log posterior.
    """
    state, turn = said.batch["state"], said.batch["turn"]
    parts = stretch // state.shape[1]
    sums = []
    for begin in range(0, len(ratio) - parts + 1, parts):
        rows = slice(begin, begin + parts)
        if len(set(said.record[rows])) > 1:
            continue
        here = (state[rows] == HERE).all(0).all(0)
        alone = (state[rows] == HERE).any(1).any(0).sum() == 1
        if not (here[0] and alone):
            continue
        shifts = torch.arange(turns) / turns
        track = (turn[rows][:, :, :1] + shifts) % 1.0
        sums.append(at_turn(ratio[rows], track).sum((0, 1)))
    if len(sums) < 5:
        return 1.0 / 3.0
    total = torch.stack(sums)
    powers = torch.logspace(-2, 0, 41)
    losses = [-(torch.log_softmax(power * total, 1)[:, 0]).mean() for power in powers]
    return float(powers[int(torch.stack(losses).argmin())])


def metrics(
    ratio: Tensor, said: Outputs, config: AzimuthTaskConfig, threshold: float = 0.0
) -> dict[str, float]:
    """How well calibrated ratios serve.

    Returns
    -------
    nll : per minute, nats. ece : expected calibration error of presence at the records' own odds of a ship: a ratio has no prior
    of its own. right, wrong : shares of minutes with one ship within reach detected within 10°, or elsewhere. false_per_hour :
    minutes an hour without ships that alarm. minutes_with, minutes_without.
    """
    weight = said.batch["weight"] > 0
    losses = minute_losses(ratio, said.batch, config)
    here = (said.batch["state"] == HERE).sum(2)
    any_unknown = (said.batch["state"] == 2).any(2)
    one, none = weight & (here == 1) & ~any_unknown, weight & (here == 0) & ~any_unknown
    there = presence(ratio)
    alarm = there > threshold
    best = ratio.argmax(2).float() / ratio.shape[2]
    apart = ((best[..., None] - said.batch["turn"] + 0.5) % 1.0 - 0.5).abs() * 360.0
    apart = apart / (1.0 + said.batch["doubled"][:, None, None])
    near = (apart.masked_fill(said.batch["state"] != HERE, 360.0).min(2).values < 10.0) & alarm
    sure = torch.sigmoid(there + np.log(odds(said)))
    chosen = weight & ~any_unknown
    return {
        "nll": float((losses * weight).sum() / weight.sum()),
        "ece": calibration_error(sure[chosen].numpy(), (here > 0)[chosen].numpy()),
        "right": float((near & one).sum() / one.sum().clamp(min=1)),
        "wrong": float((alarm & ~near & one).sum() / one.sum().clamp(min=1)),
        "false_per_hour": 60.0 * float((alarm & none).sum() / none.sum().clamp(min=1)),
        "minutes_with": float(one.sum()),
        "minutes_without": float(none.sum()),
    }


def calibration_error(said: np.ndarray, seen: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error: mean over bins of probability of |mean said − share seen|, weighted by their members.

    >>> round(calibration_error(np.array([0.2] * 10), np.array([True] * 2 + [False] * 8)), 6)
    0.0
    """
    place = np.minimum((said * bins).astype(int), bins - 1)
    total = 0.0
    for number in range(bins):
        inside = place == number
        if inside.any():
            total += inside.mean() * abs(float(said[inside].mean()) - float(seen[inside].mean()))
    return float(total)
