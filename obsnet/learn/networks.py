"""The azimuth network: cells of the azigram in, a log-likelihood ratio of a ship against azimuth out, minute by minute.

Turning the station turns the map by construction: the network sees invariants, and the azimuth enters only as the phase of
circular harmonics, after which every layer goes round the circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from obsnet.detectors.azimuth_features import CHANNELS

BLOCK_CELLS = 3
"""Cells of 20 s in a minute; a window of 180 s is three blocks of a minute."""


@dataclass(frozen=True)
class AzimuthNetworkConfig:
    """Sizes: frequencies in, hidden channels of the gates, gates, harmonics, azimuths, channels and reach around the circle.

    With `kernel` 1 every azimuth is judged by itself: no circular refinement.
    """

    frequencies: int = 266
    hidden: int = 12
    gates: int = 6
    harmonics: int = 24
    azimuths: int = 120
    width: int = 24
    kernel: int = 7


class AzimuthNetwork(nn.Module):
    """Gates × circular harmonics × circular refinement.

    1. Each cell's invariants give gates w_c ≥ 0, by a small network over the cell and its neighbours in frequency.
    2. Σ w_c u^k over the cells of a minute, k = 1 … K, weighted by a learned profile over k (a wrapped Cauchy is the
       profile R^k / k, so that the analytic detector is a special case), becomes a map over azimuth.
    3. The maps of three minutes, refined by a circular CNN that also knows the window's mean invariants, become the ratio.

    Shape: invariants (batch, 3 (minutes + 2), channel, frequency), phasor (batch, 2, 3 (minutes + 2), frequency) real and
    imaginary part, doubled (batch) 1 where the phasor's argument is twice the azimuth → (batch, minutes, azimuths).
    """

    def __init__(self, config: AzimuthNetworkConfig = AzimuthNetworkConfig()) -> None:
        super().__init__()
        self.config = config
        channels = len(CHANNELS) + 3
        self.gate = nn.Sequential(
            nn.Conv2d(channels, config.hidden, 1),
            nn.ReLU(),
            nn.Conv2d(config.hidden, config.hidden, (1, 3), padding=(0, 1)),
            nn.ReLU(),
        )
        self.open = nn.Conv2d(config.hidden, config.gates, 1)
        order = torch.arange(1, config.harmonics + 1, dtype=torch.float32)
        concentration = torch.linspace(0.75, 0.97, config.gates)[:, None]
        self.profile = nn.Parameter(concentration**order)
        self.scale = nn.Parameter(torch.full((config.gates, 1), 0.3))
        angle = 2 * np.pi / config.azimuths * torch.arange(config.azimuths) * order[:, None]
        self.waves: Tensor
        self.frequency: Tensor
        self.register_buffer("waves", torch.cat([torch.cos(angle), torch.sin(angle)]), persistent=False)
        hertz = torch.linspace(-1.0, 1.0, config.frequencies)
        self.register_buffer("frequency", hertz[None, None, None, :], persistent=False)
        self.pool = nn.Linear(channels + 2 * config.gates, config.width)
        reach = config.kernel // 2
        self.enter = _Circular(4 * config.gates, config.width, config.kernel, 1)
        self.refine = _Circular(config.width, config.width, config.kernel, reach)
        self.last = _Circular(config.width, 1, config.kernel, 1)
        if self.open.bias is not None:
            nn.init.constant_(self.open.bias, -2.0)

    def forward(self, invariants: Tensor, phasor: Tensor, doubled: Tensor) -> Tensor:
        """Uncalibrated log-likelihood ratios (batch, minutes, azimuths)."""
        cfg = self.config
        batch, cells = invariants.shape[0], invariants.shape[1]
        blocks = cells // BLOCK_CELLS
        there = (phasor[:, :1].square() + phasor[:, 1:].square() > 0.25).to(invariants.dtype)
        features = torch.cat(
            [
                invariants.transpose(1, 2),
                there,
                there * self.frequency,
                there * doubled[:, None, None, None],
            ],
            1,
        )
        gates = nn.functional.softplus(self.open(self.gate(features))) * there
        powers = _powers(phasor[:, 0], phasor[:, 1], cfg.harmonics)
        sums = torch.matmul(gates.transpose(1, 2), powers.transpose(2, 3))
        sums = sums.reshape(batch, blocks, BLOCK_CELLS, cfg.gates, 2 * cfg.harmonics).sum(2)
        maps = torch.matmul(sums * torch.cat([self.profile, self.profile], 1), self.waves)
        window = maps[:, :-2] + maps[:, 1:-1] + maps[:, 2:]
        stacked = torch.cat([window, maps[:, :-2], maps[:, 1:-1], maps[:, 2:]], 2)
        stacked = _compressed(stacked * torch.cat([self.scale] * 4))
        mean = self._pooled(features, gates, blocks)
        minutes = blocks - 2
        around = stacked.reshape(batch * minutes, 4 * cfg.gates, cfg.azimuths)
        hidden = torch.relu(self.enter(around) + self.pool(mean).reshape(batch * minutes, cfg.width, 1))
        hidden = hidden + torch.relu(self.refine(hidden))
        return self.last(hidden).reshape(batch, minutes, cfg.azimuths)

    def _pooled(self, features: Tensor, gates: Tensor, blocks: int) -> Tensor:
        """Mean invariants, gates and logarithms of gates over each window (batch, minutes, ·)."""
        means = torch.cat([features, gates], 1).mean(3)
        per_block = means.reshape(means.shape[0], means.shape[1], blocks, BLOCK_CELLS).mean(3)
        window = (per_block[:, :, :-2] + per_block[:, :, 1:-1] + per_block[:, :, 2:]) / 3.0
        window = window.transpose(1, 2)
        return torch.cat([window, torch.log(window[:, :, -self.config.gates :] + 1e-3)], 2)


class _Circular(nn.Module):
    """A convolution around the circle."""

    def __init__(self, inputs: int, outputs: int, kernel: int, dilation: int) -> None:
        super().__init__()
        self.reach = dilation * (kernel // 2)
        self.conv = nn.Conv1d(inputs, outputs, kernel, dilation=max(dilation, 1))

    def forward(self, values: Tensor) -> Tensor:
        if self.reach:
            values = torch.cat([values[..., -self.reach :], values, values[..., : self.reach]], -1)
        return self.conv(values)


def _powers(real: Tensor, imag: Tensor, count: int) -> Tensor:
    """Real parts, then imaginary parts of u, u² … u^count: (batch, cells, 2 count, frequency), by doubling."""
    reals, imags = real[:, :, None], imag[:, :, None]
    while reals.shape[2] < count:
        more = min(reals.shape[2], count - reals.shape[2])
        top_r, top_i = reals[:, :, -1:], imags[:, :, -1:]
        low_r, low_i = reals[:, :, :more], imags[:, :, :more]
        reals, imags = (
            torch.cat([reals, low_r * top_r - low_i * top_i], 2),
            torch.cat([imags, low_r * top_i + low_i * top_r], 2),
        )
    return torch.cat([reals, imags], 2)


def _compressed(values: Tensor) -> Tensor:
    """Sign times log(1 + modulus): sums over hundreds of cells in a range that a network likes."""
    return torch.sign(values) * torch.log1p(values.abs())


def parameters(network: nn.Module) -> int:
    """Number of trained parameters."""
    return sum(values.numel() for values in network.parameters())
