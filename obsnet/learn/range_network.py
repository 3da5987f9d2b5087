"""The range scorer: features of one hypothesis in, natural-log likelihood ratio of a ship there against no ship out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from obsnet.detectors.range_features import CONTEXT, GLOBALS, RangeFeaturesConfig
from obsnet.errors import ConfigError


@dataclass(frozen=True)
class RangeNetworkConfig:
    """Widths of the encoder, of what a pair says, and of the head; dropout; the ratio lies within ±bound, smoothly.

    `blind` names members of `CONTEXT` that the network does not see, to learn what they are worth.
    """

    hidden: int = 48
    code: int = 16
    head: int = 48
    dropout: float = 0.1
    bound: float = 12.0
    blind: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not set(self.blind) <= set(CONTEXT[1:]):
            raise ConfigError(f"blind may hold {', '.join(CONTEXT[1:])}, found {', '.join(self.blind)}")


class RangeNetwork(nn.Module):
    """One scorer shared by all hypotheses, ranges, rates and stations.

    Each pair's patch and context pass one encoder, told which pair it is; what the pairs say together, and what is said
    once, passes a small head. Pairs that cannot exist there say nothing.
    """

    def __init__(
        self,
        config: RangeNetworkConfig = RangeNetworkConfig(),
        features: RangeFeaturesConfig = RangeFeaturesConfig(),
    ) -> None:
        super().__init__()
        self.config = config
        self.patch_shape = features.patch_shape
        self.size = features.size
        n_pairs, n_sub, n_lags, _ = features.patch_shape
        inputs = n_sub * n_lags * 2 + 2 * n_lags + len(CONTEXT) + n_pairs + 1
        self.encode = nn.Sequential(
            nn.Linear(inputs, config.hidden), nn.SiLU(), nn.Linear(config.hidden, config.code), nn.SiLU()
        )
        self.judge = nn.Sequential(
            nn.Linear(n_pairs * config.code + len(GLOBALS), config.head), nn.SiLU(), nn.Dropout(config.dropout),
            nn.Linear(config.head, 24), nn.SiLU(), nn.Linear(24, 1),
        )  # fmt: skip
        self.names: Tensor
        self.register_buffer("names", torch.eye(n_pairs))
        self.seen: Tensor
        seen = torch.tensor([float(name not in config.blind) for name in CONTEXT])
        self.register_buffer("seen", seen, persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Log likelihood ratios (n) of feature vectors (n, size) of `obsnet.detectors.range_features`."""
        n_pairs, n_sub, n_lags, _ = self.patch_shape
        patch_size = n_pairs * n_sub * n_lags * 2
        patch = features[:, :patch_size].reshape(-1, n_pairs, n_sub, n_lags, 2)
        context = features[:, patch_size : patch_size + n_pairs * len(CONTEXT)].reshape(
            -1, n_pairs, len(CONTEXT)
        )
        if self.config.blind:
            context = context * self.seen
        once = features[:, patch_size + n_pairs * len(CONTEXT) :]
        stacked = patch.sum(dim=2)
        coherent = torch.log1p((stacked**2).sum(dim=-1) / n_sub)
        incoherent = torch.log1p((patch**2).sum(dim=(2, 4)) / n_sub)
        place = once[:, None, :1].expand(-1, n_pairs, 1)
        named = self.names.unsqueeze(0).expand(features.shape[0], -1, -1)
        said = torch.cat([patch.flatten(2), coherent, incoherent, context, named, place], dim=2)
        code = self.encode(said) * context[:, :, :1]
        score = self.judge(torch.cat([code.flatten(1), once], dim=1)).squeeze(-1)
        return self.config.bound * torch.tanh(score / self.config.bound)


def range_loss(ratio: Tensor, log_measure: Tensor, ship: Tensor, ship_share: float) -> Tensor:
    """Negative log posterior of the true cell, or of no ship, over all hypotheses: the ratios become likelihood ratios.

    Parameters
    ----------
    ratio : (n, 1 + hypotheses) log likelihood ratios, the truth first.
    log_measure : (n, hypotheses) log of prior over expected draws of each sampled cell; −inf where masked.
    ship : (n) bool, whether the first hypothesis is a ship. ship_share : of the examples that have one.

    Notes
    -----
    −log(π e^{l(true)} / (1 − π + π Σ_h prior_h e^{l(h)})) with a ship, −log((1 − π) / (…)) without; the sum over all
    hypotheses is estimated from the sampled ones with their importance weights. At its minimum e^l is the ratio of the
    features' density with a ship there to that without one.
    """
    odds = torch.logit(torch.as_tensor(ship_share, dtype=ratio.dtype))
    total = torch.logsumexp(ratio[:, 1:] + log_measure, dim=1) + odds
    evidence = functional.softplus(total)
    return evidence - torch.where(ship, ratio[:, 0] + odds, torch.zeros_like(evidence))


def place_loss(ratio: Tensor, log_measure: Tensor, before: Tensor) -> Tensor:
    """Loss of windows that all hold a ship: where it is, not whether.

    Parameters
    ----------
    ratio, before : (n, 1 + hypotheses) log likelihood ratios now and before the adaptation, the truth first.
    log_measure : of `range_loss`.

    Notes
    -----
    −log(e^{l(true)} / Σ_h prior_h e^{l(h)}), which no constant in l changes, and the square of the change of the log marginal
    ratio of presence, log Σ_h prior_h e^{l(h)}: windows with ships alone would teach that there always is one.
    """
    total, first = (torch.logsumexp(said[:, 1:] + log_measure, dim=1) for said in (ratio, before))
    return total - ratio[:, 0] + (total - first) ** 2
