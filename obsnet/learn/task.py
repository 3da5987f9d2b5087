"""Training of a detector: a network, its examples and its loss in, weights with their provenance out."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import lightning
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from obsnet.config import first_change
from obsnet.errors import ConfigError, ModelError
from obsnet.learn.dataset import digest
from obsnet.output import locked, prepare_folder

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class TrainerConfig:
    """How to train.

    Parameters
    ----------
    epochs, batch, learning_rate, weight_decay : of AdamW, whose rate rises and falls once.
    patience : epochs without a better validation loss after which training stops.
    seed : of weights, order and augmentation. threads : of torch; 1 gives the same numbers anywhere.
    max_minutes : training ends after so long.
    """

    epochs: int = 14
    batch: int = 16
    learning_rate: float = 4e-3
    weight_decay: float = 1e-4
    patience: int = 5
    seed: int = 0
    threads: int = 1
    max_minutes: float = 40.0


class Problem(Protocol):
    """What differs between the detectors."""

    @property
    def network(self) -> nn.Module:
        """What is trained."""
        ...

    def loss(self, batch: Batch, training: bool, generator: torch.Generator) -> Tensor:
        """Mean loss of a batch."""
        ...


class DetectorTask(lightning.LightningModule):
    """Lightning's view of a `Problem`."""

    def __init__(
        self, problem: Problem, config: TrainerConfig, steps: int, order: torch.Generator, settings: str
    ) -> None:
        super().__init__()
        self.problem, self.config, self._steps = problem, config, steps
        self.network = problem.network
        self._order, self._settings = order, settings
        self._generator = torch.Generator().manual_seed(config.seed)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """What the training is of, and where its random numbers stand: order, augmentation, and torch's own for dropout."""
        checkpoint["settings"] = self._settings
        checkpoint["random"] = [
            self._order.get_state(), self._generator.get_state(), torch.get_rng_state()
        ]  # fmt: skip

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Random numbers go on where they stood."""
        order, augmentation, other = checkpoint["random"]
        self._order.set_state(order)
        self._generator.set_state(augmentation)
        torch.set_rng_state(other)

    def training_step(self, batch: Batch, index: int) -> Tensor:
        """One batch."""
        value = self.problem.loss(batch, True, self._generator)
        self.log(
            "loss",
            value,
            prog_bar=True,
            on_step=False,
            on_epoch=True,
            batch_size=len(next(iter(batch.values()))),
        )
        return value

    def validation_step(self, batch: Batch, index: int) -> None:
        """One batch."""
        value = self.problem.loss(batch, False, self._generator)
        self.log("validation_loss", value, prog_bar=True, batch_size=len(next(iter(batch.values()))))

    def configure_optimizers(self) -> Any:
        """AdamW; the rate rises and falls once."""
        config = self.config
        optimiser = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, self._rate)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _rate(self, step: int) -> float:
        """Share of the learning rate: a rise over a tenth of all steps, then half a cosine down to nothing."""
        rise = max(self._steps // 10, 1)
        if step < rise:
            return (step + 1) / rise
        return 0.5 + 0.5 * math.cos(math.pi * min((step - rise) / max(self._steps - rise, 1), 1.0))


def fit(
    problem: Problem,
    train: Dataset,
    validation: Dataset,
    folder: str | Path,
    config: TrainerConfig,
    settings: dict[str, Any],
    progress: bool = True,
) -> float:
    """Train a problem's network; the best weights by validation stay in it.

    Parameters
    ----------
    folder : of checkpoints and losses (``log/version_N/metrics.csv``, a version each time that it goes on). Training goes on
        from ``last.ckpt`` where there is one, as if nothing had stopped it.
    settings : what else the training is of, above all the data's digest, as plain values.

    Returns
    -------
    The best validation loss.

    Raises
    ------
    ConfigError : the folder holds another training, with other data, settings, first weights or trainer (it may be given more
        minutes); or one is under way in it; or there are no epochs, or the time was too short for one.
    """
    if config.epochs < 1:
        raise ConfigError(f"{config.epochs} epochs (trainer.epochs) train nothing; give it 1 at least")
    folder = prepare_folder(folder)
    with _alone(folder):
        return _fit(problem, train, validation, folder, config, settings, progress)


def _fit(
    problem: Problem,
    train: Dataset,
    validation: Dataset,
    folder: Path,
    config: TrainerConfig,
    settings: dict[str, Any],
    progress: bool,
) -> float:
    last = folder / "last.ckpt"
    told = _told(problem.network, config, settings)
    if last.is_file():
        _check_same(last, told)
    torch.set_num_threads(config.threads)
    order = torch.Generator().manual_seed(config.seed + 1)
    loader = DataLoader(train, config.batch, shuffle=True, generator=order)
    check = DataLoader(validation, config.batch)
    task = DetectorTask(problem, config, max(len(loader), 1) * config.epochs, order, told)
    best = ModelCheckpoint(
        folder, "best", monitor="validation_loss", save_last=True, enable_version_counter=False
    )
    trainer = lightning.Trainer(
        accelerator="cpu", devices=1, max_epochs=config.epochs, deterministic=True,
        max_time={"seconds": round(60 * config.max_minutes)}, gradient_clip_val=1.0, log_every_n_steps=10,
        logger=CSVLogger(folder, name="log"), enable_progress_bar=progress, enable_model_summary=False,
        callbacks=[best, EarlyStopping("validation_loss", patience=config.patience)],
        num_sanity_val_steps=0,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(task, loader, check, ckpt_path=last if last.is_file() else None, weights_only=True)
    if not best.best_model_path:
        raise ConfigError("training ended before the first epoch; give it more minutes")
    state = torch.load(best.best_model_path, map_location="cpu", weights_only=True)["state_dict"]
    task.load_state_dict(state)
    assert best.best_model_score is not None
    return float(best.best_model_score)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Raise `ConfigError` where a training is under way in a folder."""
    with ExitStack() as held:
        try:
            if os.name == "posix":
                held.enter_context(locked(folder, alone=True))
        except OSError:
            raise ConfigError(
                f"another training is under way in {folder}; name another folder, or one with ${{trainer.seed}} in it for several seeds"
            ) from None
        yield


def _told(network: nn.Module, config: TrainerConfig, settings: dict[str, Any]) -> str:
    """All that decides what a training ends in, as JSON."""
    trainer = asdict(config)
    del trainer["max_minutes"]
    first = digest({name: values.numpy() for name, values in network.state_dict().items()})
    return json.dumps({"trainer": trainer, "first weights": first[:12], **settings}, default=str)


def _check_same(last: Path, told: str) -> None:
    """Raise `ConfigError` unless a checkpoint is of the training that is told."""
    try:
        before = json.loads(torch.load(last, map_location="cpu", weights_only=True).get("settings", "{}"))
    except Exception as error:  # torch raises whatever its unpickler met
        line = str(error).splitlines()[0][:120]
        raise ConfigError(f"{last} cannot be read: {line}; remove it or name another folder") from None
    if changed := first_change(before, json.loads(told)):
        raise ConfigError(f"{last} is of a training with {changed}; name another folder")


def save_weights(path: str | Path, network: nn.Module, about: dict[str, Any]) -> None:
    """Weights and what is known about them, in a file that loads with ``weights_only=True``; whole or not at all."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    torch.save({"state": network.state_dict(), "about": json.dumps(about, default=str)}, partial)
    os.replace(partial, path)


def calibrated_anew(earlier: dict[str, Any], about: dict[str, Any] | None) -> dict[str, Any]:
    """What to keep with weights that are calibrated anew: `about`, and how they were trained, by their description `earlier`."""
    kept = ("trainer", "labels", "examples", "made", "data_digest")
    trained = {key: earlier[key] for key in kept if key in earlier}
    return {"trained": earlier.get("trained", trained), **(about or {})}


def load_weights(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """State and description from `save_weights`.

    Raises
    ------
    ModelError : the file is missing or not of ours.
    """
    try:
        held = torch.load(path, map_location="cpu", weights_only=True)
        return held["state"], json.loads(held["about"])
    except FileNotFoundError:
        raise ModelError(f"there are no weights at {path}; run train/train.py first") from None
    except Exception as error:  # torch raises whatever its unpickler met
        raise ModelError(f"{path} holds no weights of obsnet: {str(error).splitlines()[0][:120]}") from None


def seeded(seed: int, make: Callable[[], nn.Module]) -> nn.Module:
    """A network whose first weights depend on the seed alone."""
    torch.manual_seed(seed)
    return make()
