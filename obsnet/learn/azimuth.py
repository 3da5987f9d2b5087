"""The azimuth detector's examples, loss and calibration: prepared records in, a calibrated network out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from obsnet.detectors.azimuth_features import BIN_S, CHANNELS, cell_index
from obsnet.detectors.learned import WINDOW_S
from obsnet.errors import ConfigError
from obsnet.learn.dataset import NO_PHASOR, JoinedSets, PreparedSet, Record

ROW_MINUTES = 10
ROW_CELLS = 3 * (ROW_MINUTES + 2)
ABSENT, HERE, UNKNOWN = 0, 1, 2
Batch = dict[str, Tensor]


@dataclass(frozen=True)
class AzimuthTaskConfig:
    """Labels and augmentation.

    Parameters
    ----------
    reach_m : ships within this range are to be found; those beyond, and those whose place AIS does not tell, are unknown.
    beside_deg : half-width of the sector about an unknown or another ship that says nothing.
    prior_odds : odds of a ship against none in the training draws; only their removal from the output matters.
    forget_share : share of rows whose slow memory (level, background) is taken away, as after a station's start.
    fade_share : share of rows whose lines and transients are weakened or strengthened: how much a ship's spectrum stands out and
        flickers is the simulator's habit, which the network shall not lean on.
    unseen : share of minutes in which, where absence is not known, something else is heard than the ship that AIS shows.
    """

    reach_m: float = 60e3
    beside_deg: float = 20.0
    prior_odds: float = 1.0
    forget_share: float = 0.15
    fade_share: float = 0.5
    unseen: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 < self.unseen < 1.0:
            raise ConfigError(f"unseen, a share, lies between 0 and 1, not at {self.unseen:g}")


class AzimuthRows(Dataset):
    """Rows of ten minutes of prepared records, in memory.

    A row holds invariants (cell, channel, frequency), phasor (2, cell, frequency), doubled (), turn (minute, ship) in parts
    of the circle (of the doubled one where `doubled`), state (minute, ship) of `ABSENT`, `HERE`, `UNKNOWN`, weight
    (minute), 0 where a minute says nothing, and watched (), 1 where no vessel is about that AIS does not show.
    """

    def __init__(
        self,
        prepared: PreparedSet | JoinedSets,
        split: str,
        config: AzimuthTaskConfig = AzimuthTaskConfig(),
        ships: int = 4,
    ) -> None:
        self.config = config
        only = ("cell_index", "invariants", "phasor", "minute", "azimuth_deg", "range_m", "known")
        self._records: list[Record] = []
        self._labels: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.rows: list[tuple[int, int]] = []
        for record in prepared.records(split, only):
            if not len(record.cell_index):
                continue
            number = len(self._records)
            self._records.append(record)
            self._labels.append(_labels(record, config, ships))
            self.rows += [(number, row) for row in range(len(record.minute) // ROW_MINUTES)]
        if not self.rows:
            raise ConfigError(
                f"{prepared.folder} holds no {split} record with both horizontals; prepare more records"
            )

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, item: int) -> Batch:
        number, row = self.rows[item]
        record = self._records[number]
        minutes = slice(ROW_MINUTES * row, ROW_MINUTES * (row + 1))
        first = int(cell_index(record.minute[minutes.start] - WINDOW_S / 2))
        low = first - int(record.cell_index[0])
        inside = slice(max(low, 0), max(low + ROW_CELLS, 0))
        angle, invariants = record.phasor[inside], record.invariants[inside]
        pad = (max(-low, 0), ROW_CELLS - len(angle) - max(-low, 0))
        turned = np.pi / 32767.0 * angle.astype(np.float32)
        unit = np.stack([np.cos(turned), np.sin(turned)]) * (angle != NO_PHASOR)
        turn, state, weight = (labels[minutes] for labels in self._labels[number])
        return {
            "invariants": torch.from_numpy(np.pad(invariants, (pad, (0, 0), (0, 0))).astype(np.float32)),
            "phasor": torch.from_numpy(np.pad(unit, ((0, 0), pad, (0, 0))).astype(np.float32)),
            "doubled": torch.tensor(float(record.attributes["ambiguity_deg"] == 180)),
            "turn": torch.from_numpy(turn),
            "state": torch.from_numpy(state),
            "weight": torch.from_numpy(weight),
            "watched": torch.tensor(float(record.absence_known)),
        }

    def seen(self, item: int) -> tuple[np.ndarray, np.ndarray]:
        """Whether a ship is within reach, and weight, of each minute of a row."""
        number, row = self.rows[item]
        minutes = slice(ROW_MINUTES * row, ROW_MINUTES * (row + 1))
        _, state, weight = (labels[minutes] for labels in self._labels[number])
        return (state == HERE).any(axis=1), weight


def _labels(
    record: Record, config: AzimuthTaskConfig, ships: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn, state (minute, ship) and weight (minute) of a record; the nearest ships, padded."""
    order = np.argsort(np.nan_to_num(record.range_m, nan=np.inf), axis=1)[:, :ships]
    azimuth, distance, known = (
        np.take_along_axis(values, order, axis=1)
        for values in (record.azimuth_deg, record.range_m, record.known)
    )
    placed = np.isfinite(azimuth)
    state = np.where(placed & known & (distance <= config.reach_m), HERE, ABSENT)
    state = np.where(placed & (state != HERE), UNKNOWN, state)
    lost = (~known & ~placed).any(axis=1)
    here = (state == HERE).any(axis=1)
    weight = (_heard(record) & ~lost & (here | record.absence_known)).astype(np.float32)
    fold = 360.0 / float(record.attributes["ambiguity_deg"])
    turn = np.nan_to_num(azimuth * fold / 360.0).astype(np.float32) % 1.0
    missing = ((0, 0), (0, ships - turn.shape[1]))
    return np.pad(turn, missing), np.pad(state, missing).astype(np.int64), weight


def _heard(record: Record) -> np.ndarray:
    """Whether anything was recorded in each minute's window."""
    before = np.concatenate([[0], np.cumsum((record.phasor != NO_PHASOR).any(axis=1))])
    first = cell_index(record.minute - WINDOW_S / 2) - int(record.cell_index[0])
    begin, end = (np.clip(cells, 0, len(before) - 1) for cells in (first, first + round(WINDOW_S / BIN_S)))
    return before[end] > before[begin]


def augmented(batch: Batch, generator: torch.Generator, config: AzimuthTaskConfig) -> Batch:
    """Rows turned, mirrored and, some of them, robbed of their memory or their lines: none changes what they should say."""
    rows = batch["turn"].shape[0]
    turn = torch.rand(rows, generator=generator)
    mirrored = torch.rand(rows, generator=generator) < 0.5
    forgets = torch.rand(rows, generator=generator) < config.forget_share
    sign = torch.where(mirrored, -1.0, 1.0)[:, None, None]
    real, imag = batch["phasor"][:, 0], batch["phasor"][:, 1] * sign
    angle = 2 * np.pi * turn[:, None, None]
    phasor = torch.stack(
        [
            real * torch.cos(angle) - imag * torch.sin(angle),
            real * torch.sin(angle) + imag * torch.cos(angle),
        ],
        1,
    )
    gain = torch.ones(rows, 1, batch["invariants"].shape[2], 1)
    gain[forgets, 0, :, 0] *= _without("level", "background", "agreement_background")
    fades = torch.rand(rows, generator=generator) < config.fade_share
    for name, most in (("line", 1.3), ("transience", 1.6)):
        drawn = most * torch.rand(rows, generator=generator)
        gain[:, 0, CHANNELS.index(name), 0] *= torch.where(fades, drawn, 1.0)
    invariants = batch["invariants"] * gain
    turned = (batch["turn"] * sign + turn[:, None, None]) % 1.0
    return batch | {"phasor": phasor, "invariants": invariants, "turn": turned}


def _without(*names: str) -> Tensor:
    """1 for every channel but those named."""
    return torch.tensor([float(name not in names) for name in CHANNELS])


def minute_losses(ratio: Tensor, batch: Batch, config: AzimuthTaskConfig) -> Tensor:
    """Negative log posterior of what is there, per minute (row, minute).

    With a ship at θ: −log(π(θ) e^{l(θ)} / (1 + Σ π e^l)), with none: −log(1 / (1 + Σ π e^l)), π the prior of an azimuth over
    that of no ship. Where several ships are there each is asked for alone, without the sectors of the others. Beside ships, too,
    it is asked whether the rest of the circle is empty: else a loud ship, which no minute without one resembles, would lift the
    ratio everywhere. The sectors of ships beyond reach say nothing. At its minimum l is the log-likelihood ratio, the prior of
    the training draws removed.

    Where absence is not known, every minute that says something holds a ship, so that the ratio would rise without end, and
    vessels may be about that AIS does not show. There it is asked where the ship is, not whether: −log((1 − ε) e^{l(θ)} / Σ e^l +
    ε / number of azimuths), ε = `unseen`.
    """
    count = ratio.shape[-1]
    log_prior = float(np.log(config.prior_odds / count))
    centre = torch.arange(count, dtype=ratio.dtype) / count
    apart = (batch["turn"][..., None] - centre + 0.5) % 1.0 - 0.5
    beside = apart.abs() < config.beside_deg / 360.0 * (1.0 + batch["doubled"][:, None, None, None])
    here, unknown = batch["state"] == HERE, batch["state"] == UNKNOWN
    silent = (beside & unknown[..., None]).any(2)
    own = apart.abs() < 1.5 / count
    # The others' sectors, except the ship's own cells.
    others = torch.stack(
        [
            (beside & here[..., None])[:, :, [j for j in range(here.shape[2]) if j != i]].any(2)
            for i in range(here.shape[2])
        ],
        2,
    )
    closed = (others | silent[:, :, None]) & ~own
    scores = ratio + log_prior
    every = _logsumexp(scores[:, :, None].masked_fill(closed, -torch.inf))
    taken = silent | (beside & here[..., None]).any(2)
    nothing = torch.nn.functional.softplus(_logsumexp(scores.masked_fill(taken, -torch.inf)))
    there = at_turn(scores, batch["turn"])
    elsewhere = ratio.new_tensor(np.log(config.unseen / count))
    place = -torch.logaddexp(np.log1p(-config.unseen) + there - every, elsewhere)
    watched = batch["watched"][:, None] > 0
    asked = torch.where(watched[..., None], torch.nn.functional.softplus(every) - there, place)
    nothing = torch.where(watched, nothing, torch.zeros_like(nothing))
    number = here.sum(2)
    with_ship = (asked * here).sum(2) / number.clamp(min=1)
    return with_ship + nothing


def presence(ratio: Tensor) -> Tensor:
    """Log marginal ratio of presence of ratios (row, minute, azimuth), every azimuth as likely: (row, minute)."""
    return torch.logsumexp(ratio, -1) - float(np.log(ratio.shape[-1]))


def _logsumexp(values: Tensor) -> Tensor:
    return torch.logsumexp(torch.nan_to_num(values, neginf=-60.0), -1)


def at_turn(values: Tensor, turn: Tensor) -> Tensor:
    """Values (row, minute, azimuth) at turns (row, minute, ship), linear between the grid's azimuths."""
    count = values.shape[-1]
    place = (turn % 1.0) * count
    low = place.floor()
    share = place - low
    first = low.long() % count
    return values.gather(2, first) * (1 - share) + values.gather(2, (first + 1) % count) * share


def loss(
    ratio: Tensor, batch: Batch, config: AzimuthTaskConfig, presence_before: Tensor | None = None
) -> Tensor:
    """Mean over the minutes that say something; where absence is not known, presence is held where it was before.

    Parameters
    ----------
    presence_before : of `presence`, before an adaptation; its change costs its square, in minutes whatever is known of them.
    """
    weight = batch["weight"]
    value = (minute_losses(ratio, batch, config) * weight).sum() / weight.sum().clamp(min=1.0)
    if presence_before is None:
        return value
    change = (presence(ratio) - presence_before) ** 2 * (1.0 - batch["watched"][:, None])
    return value + change.mean()
