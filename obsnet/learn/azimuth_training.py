"""The azimuth network's training and fine-tuning: a prepared set in, ``weights.pt`` with calibration and provenance out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from obsnet.config import build
from obsnet.detectors.azimuth_features import FeatureConfig
from obsnet.errors import ConfigError
from obsnet.learn.azimuth import AzimuthRows, AzimuthTaskConfig, Batch, augmented, loss, presence
from obsnet.learn.calibration import Calibration, apply, calibrate, metrics, outputs
from obsnet.learn.dataset import JoinedSets, PreparedSet
from obsnet.learn.networks import AzimuthNetwork, AzimuthNetworkConfig, parameters
from obsnet.learn.prepare import provenance
from obsnet.learn.task import TrainerConfig, calibrated_anew, fit, load_weights, save_weights, seeded
from obsnet.output import prepare_folder

WEIGHTS = "weights.pt"


class AzimuthProblem:
    """The azimuth network with its loss; `before` is what it was before an adaptation."""

    def __init__(
        self, network: AzimuthNetwork, config: AzimuthTaskConfig, before: AzimuthNetwork | None = None
    ) -> None:
        self.network: torch.nn.Module = network
        self.config, self._before = config, before

    def loss(self, batch: Batch, training: bool, generator: torch.Generator) -> Tensor:
        """Mean loss of a batch, augmented in training."""
        batch = augmented(batch, generator, self.config) if training else batch
        inputs = batch["invariants"], batch["phasor"], batch["doubled"]
        ratio = self.network(*inputs)
        if self._before is None:
            return loss(ratio, batch, self.config)
        with torch.no_grad():
            before = presence(self._before(*inputs))
        return loss(ratio, batch, self.config, before)


def train(
    prepared: PreparedSet | JoinedSets,
    folder: str | Path,
    network: AzimuthNetworkConfig = AzimuthNetworkConfig(),
    labels: AzimuthTaskConfig = AzimuthTaskConfig(),
    trainer: TrainerConfig = TrainerConfig(),
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
    begin_with: str | Path | None = None,
) -> dict[str, float]:
    """Train, calibrate on validation, measure on test; ``weights.pt`` is written, its metrics come back.

    Parameters
    ----------
    folder : of the run. about : anything to keep with the weights, for instance the composed configuration.
    begin_with : weights of an earlier run to begin with, whose network is then taken; with no epochs they are calibrated and
        measured anew, at the odds of a ship that they were trained at, and training records are not needed.
    """
    if begin_with and not trainer.epochs:
        old, before, earlier = restored(begin_with)
        labels = replace(labels, prior_odds=before.prior_odds)
        return finish(old, prepared, folder, labels, trainer, calibrated_anew(earlier, about), say)
    rows = AzimuthRows(prepared, "train", labels)
    check = AzimuthRows(prepared, "validation", labels)
    labels = replace(labels, prior_odds=prior_odds(rows))
    network = replace(network, frequencies=rows[0]["phasor"].shape[-1])
    made = restored(begin_with)[0] if begin_with else seeded(trainer.seed, lambda: AzimuthNetwork(network))
    assert isinstance(made, AzimuthNetwork)
    say(f"{len(rows)} rows to train on, {len(check)} to validate, {parameters(made)} parameters")
    _fit(made, prepared, rows, check, folder, labels, trainer)
    return finish(made, prepared, folder, labels, trainer, about, say)


def _fit(
    network: AzimuthNetwork,
    prepared: PreparedSet | JoinedSets,
    rows: AzimuthRows,
    check: AzimuthRows,
    folder: str | Path,
    labels: AzimuthTaskConfig,
    trainer: TrainerConfig,
    before: AzimuthNetwork | None = None,
) -> None:
    settings = {"data": prepared.digest(), "labels": asdict(labels)}
    fit(AzimuthProblem(network, labels, before), rows, check, folder, trainer, settings)


def finetune(
    prepared: PreparedSet | JoinedSets,
    folder: str | Path,
    weights: str | Path,
    labels: AzimuthTaskConfig = AzimuthTaskConfig(),
    trainer: TrainerConfig = TrainerConfig(epochs=8, learning_rate=5e-4),
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, float]:
    """Adapt trained weights to a station; the old ones are kept where the new are not better on held-out passages.

    The held-out passages are the validation split's. The old calibration stays: what AIS does not show is unknown at a real
    station, and a handful of passages says nothing of the sea without ships. So presence is held where it was, too, in every
    minute of a set of which absence is not known: passages alone would teach that there always is a ship.
    """
    made, calibration, before = restored(weights)
    labels = replace(labels, prior_odds=calibration.prior_odds)
    rows = AzimuthRows(prepared, "train", labels)
    check = AzimuthRows(prepared, "validation", labels)
    for split, held in (("train", rows), ("validation", check)):
        if not any(held.seen(item)[1].any() for item in range(len(held))):
            raise ConfigError(f"no ship's place is known in any {split} record; prepare more days")
    old = restored(weights)[0].eval()
    loss_before = held_out_loss(made, check, calibration, labels, old)
    _fit(made, prepared, rows, check, folder, labels, trainer, old)
    loss_after = held_out_loss(made, check, calibration, labels, old)
    better = loss_after < loss_before
    if not better:
        made.load_state_dict(old.state_dict())
    verdict = "kept the new weights" if better else "kept the old weights"
    say(f"held-out passages: {loss_before:.4f} nats a minute before, {loss_after:.4f} after; {verdict}")
    found = {"loss_before": loss_before, "loss_after": loss_after, "adapted": float(better)}
    told = before | {
        "finetune": {"set": provenance(labels), "data_digest": prepared.digest(), **found, **(about or {})}
    }
    save_weights(Path(folder) / WEIGHTS, made, told)
    return found


def held_out_loss(
    network: AzimuthNetwork,
    rows: AzimuthRows,
    calibration: Calibration,
    labels: AzimuthTaskConfig,
    before: AzimuthNetwork,
) -> float:
    """Loss per minute of calibrated ratios, the change of presence since `before` included."""
    said, first = outputs(network, rows), outputs(before, rows)
    return float(loss(apply(said, calibration), said.batch, labels, presence(apply(first, calibration))))


def restored(path: str | Path) -> tuple[AzimuthNetwork, Calibration, dict[str, Any]]:
    """Network, calibration and description of a run's ``weights.pt``."""
    state, about = load_weights(path)
    network = AzimuthNetwork(build(AzimuthNetworkConfig, about["network"]))
    network.load_state_dict(state)
    return network, build(Calibration, about["calibration"]), about


def prior_odds(rows: AzimuthRows) -> float:
    """Minutes with a ship over minutes without one, of those that say something."""
    said = with_ship = 0.0
    for item in range(len(rows)):
        here, weight = rows.seen(item)
        said += float(weight.sum())
        with_ship += float((weight * here).sum())
    if not 0 < with_ship < said:
        raise ConfigError("training needs minutes with a ship and minutes without one; prepare more records")
    return with_ship / (said - with_ship)


def finish(
    network: AzimuthNetwork,
    prepared: PreparedSet | JoinedSets,
    folder: str | Path,
    labels: AzimuthTaskConfig,
    trainer: TrainerConfig,
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, float]:
    """Calibrate a trained network on validation, measure it on test, and keep all in ``weights.pt``."""
    said = outputs(network, AzimuthRows(prepared, "validation", labels))
    calibration = calibrate(said, labels)
    found = {f"validation_{k}": v for k, v in metrics(apply(said, calibration), said, labels).items()}
    try:
        tested = outputs(network, AzimuthRows(prepared, "test", labels))
        found |= {f"test_{k}": v for k, v in metrics(apply(tested, calibration), tested, labels).items()}
    except ConfigError:
        say("the prepared set holds no test records")
    description = {
        "task": "azimuth",
        "network": asdict(network.config),
        "labels": asdict(labels),
        "trainer": asdict(trainer),
        "features": asdict(FeatureConfig()),
        "calibration": calibration.to_dict(),
        "metrics": found,
        "data_digest": prepared.digest(),
        "made": provenance(trainer),
        **(about or {}),
    }
    save_weights(prepare_folder(folder) / WEIGHTS, network, description)
    for name, value in found.items():
        say(f"{name} {value:.4g}")
    return found
