"""The range network's training: prepared records in, ``weights.pt`` with calibration and provenance out."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import xarray as xr
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from obsnet.config import build
from obsnet.detectors.learned_range import RangeCalibration
from obsnet.detectors.range_features import CONTEXT, RangeFeaturesConfig
from obsnet.errors import ConfigError
from obsnet.layout import from_posix
from obsnet.learn.dataset import JoinedSets, PreparedSet, Record
from obsnet.learn.networks import parameters
from obsnet.learn.prepare import provenance
from obsnet.learn.range_calibration import Heard, calibrate, hear, looked_at, measure, scorer_of
from obsnet.learn.range_examples import FIELDS, RangeExamplesConfig, log_prior, range_density, range_examples
from obsnet.learn.range_network import RangeNetwork, RangeNetworkConfig, place_loss, range_loss
from obsnet.learn.task import Batch, TrainerConfig, calibrated_anew, fit, load_weights, save_weights, seeded
from obsnet.output import prepare_folder
from obsnet.signals.cepstrogram import noise_std

WEIGHTS = "weights.pt"
SHIP_SHARE = 0.82
"""Of the examples of the shipped model, those with a ship."""
NEEDED = (
    "frame_time", "cepstra", "quefrency", "minute", "range_m", "range_rate_mps", "known", "path", "range",
    "delay", "slowness", "pressure_real", "pressure_imag",
)  # fmt: skip


@dataclass(frozen=True)
class RangeTaskConfig:
    """What the range network trains on.

    Parameters
    ----------
    examples : how hypotheses are drawn. features : what is seen of them.
    density_step_m : bins of the density of true ranges, which is the prior of the loss.
    look : where the network looks, and the cheap score's bound; calibration fits the rest.
    patch_noise, context_noise : standard deviations of noise added to patches and to the rest of the features in training,
        so that no record is known again by its exact geometry.
    """

    examples: RangeExamplesConfig = field(default_factory=RangeExamplesConfig)
    features: RangeFeaturesConfig = field(default_factory=RangeFeaturesConfig)
    density_step_m: float = 2500.0
    look: RangeCalibration = field(default_factory=lambda: RangeCalibration(least=7.0))
    patch_noise: float = 0.3
    context_noise: float = 0.12


class RangeExamples(Dataset):
    """Examples of a split of prepared sets, held in memory.

    Parameters
    ----------
    prior : of another set's `prior`, for validation; by default that of the examples themselves.
    empty : whether examples without a ship must be among them; a real archive seldom knows of any.

    Raises
    ------
    ConfigError : the sets hold no example with a ship, or none without where there must be.
    """

    def __init__(
        self,
        sets: Sequence[PreparedSet],
        split: str,
        config: RangeTaskConfig = RangeTaskConfig(),
        prior: tuple[np.ndarray, np.ndarray] | None = None,
        empty: bool = True,
    ) -> None:
        arrays = _examples(sets, split, config)
        ships = int(arrays["ship"].sum())
        if not ships or (empty and ships == len(arrays["ship"])):
            others = " and windows without" if empty else ""
            raise ConfigError(f"the {split} records need windows with a ship in range{others}; prepare more")
        self.arrays = arrays
        edges = np.append(np.arange(0.0, config.features.max_range_m, config.density_step_m), np.inf)
        edges[-1] = config.features.max_range_m
        self.prior = prior or (edges, range_density(arrays["range_m"][arrays["ship"], 0], edges))
        rates = len(config.features.range_rate)
        prior_here = log_prior(arrays["range_m"][:, 1:], *self.prior, config.features.range_step_m, rates)
        self._log_measure = (prior_here - arrays["log_proposal"]).astype(np.float32)
        self.ship_share = float(arrays["ship"].mean())

    def __len__(self) -> int:
        return len(self.arrays["ship"])

    def __getitem__(self, item: int) -> Batch:
        """Features (1 + hypothesis, feature), the truth first; log measure (hypothesis); whether a ship is there."""
        return {
            "features": torch.from_numpy(self.arrays["features"][item].astype(np.float32)),
            "log_measure": torch.from_numpy(self._log_measure[item]),
            "ship": torch.tensor(bool(self.arrays["ship"][item])),
        }


def _examples(sets: Sequence[PreparedSet], split: str, config: RangeTaskConfig) -> dict[str, np.ndarray]:
    """Examples of a split; they take longer than an epoch to make, and are kept in the first set's folder."""
    names = [
        f"{name} {prepared.attributes(name)['digest']}" for prepared in sets for name in prepared.names(split)
    ]
    told = repr((names, config.examples, config.features))
    path = sets[0].folder / f"range-{split}-{hashlib.sha256(told.encode()).hexdigest()[:12]}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as held:
            return {name: held[name] for name in FIELDS}
    parts = [
        range_examples(
            cepstrogram_of(record), record.table(), truth_of(record), np.random.default_rng(number),
            config.examples, config.features, known=known_minutes(record, config.features.range_m[-1]),
        )
        for number, record in enumerate(range_records(sets, split))
    ]  # fmt: skip
    if not parts:
        raise ConfigError(
            f"none of the {split} records holds a cepstrogram; prepare records with a hydrophone"
        )
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in FIELDS}
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    os.replace(partial, path)
    return arrays


class RangeProblem:
    """The range network with its loss; `ship_share` of the examples have a ship.

    Where it was another `before`, it is adapted to windows that all have one.
    """

    def __init__(
        self,
        network: RangeNetwork,
        ship_share: float,
        task: RangeTaskConfig,
        before: RangeNetwork | None = None,
    ) -> None:
        self.network, self.ship_share, self.task, self._before = network, ship_share, task, before
        shape = task.features.patch_shape
        self._noise = torch.full((task.features.size,), task.context_noise)
        self._noise[: int(np.prod(shape))] = task.patch_noise
        self._noise[int(np.prod(shape)) :: len(CONTEXT)][: shape[0]] = 0.0

    def loss(self, batch: Batch, training: bool, generator: torch.Generator) -> Tensor:
        """Mean loss of a batch."""
        features = batch["features"]
        if training:
            noise = self._noise * torch.randn(features.shape, generator=generator)
            features = features + noise * (features != 0)
        ratio = self.network(features.flatten(0, 1)).reshape(features.shape[:2])
        if self._before is None:
            return range_loss(ratio, batch["log_measure"], batch["ship"], self.ship_share).mean()
        with torch.no_grad():
            before = self._before(features.flatten(0, 1)).reshape(features.shape[:2])
        return place_loss(ratio, batch["log_measure"], before).mean()


def train(
    sets: Sequence[PreparedSet],
    folder: str | Path,
    network: RangeNetworkConfig = RangeNetworkConfig(),
    task: RangeTaskConfig = RangeTaskConfig(),
    trainer: TrainerConfig = TrainerConfig(),
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
    begin_with: str | Path | None = None,
) -> dict[str, float]:
    """Train, calibrate and measure on validation records; ``weights.pt`` is written, the metrics come back.

    Parameters
    ----------
    sets : prepared sets, used together. folder : of the run. about : anything to keep with the weights.
    begin_with : weights of an earlier run to begin with, whose network and features are then taken; with no epochs they are
        calibrated anew and stay as they are.
    """
    made: Any = seeded(trainer.seed, lambda: RangeNetwork(network, task.features))
    if begin_with:
        made, _, features, earlier = restored(begin_with)
        task = replace(task, features=features)
        if not trainer.epochs:
            about = calibrated_anew(earlier, about)
            found = {"validation_loss": float(earlier["metrics"]["validation_loss"])}
            share = float(earlier.get("ship_share", SHIP_SHARE))
            return finish(made, sets, folder, task, trainer, found, about, say, share)
    examples = RangeExamples(sets, "train", task)
    check = RangeExamples(sets, "validation", task, examples.prior)
    say(f"{len(examples)} examples to train on, {len(check)} to validate, {parameters(made)} parameters")
    problem = RangeProblem(made, examples.ship_share, task)
    best = fit(problem, examples, check, folder, trainer, _settings(sets, problem))
    return finish(
        made, sets, folder, task, trainer, {"validation_loss": best}, about, say, examples.ship_share
    )


def finetune(
    sets: Sequence[PreparedSet],
    folder: str | Path,
    weights: str | Path,
    task: RangeTaskConfig = RangeTaskConfig(),
    trainer: TrainerConfig = TrainerConfig(epochs=4, batch=64, learning_rate=3e-4, weight_decay=1e-2),
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, float]:
    """Adapt trained weights to a station; the old ones are kept where the new are not better on held-out passages.

    The held-out passages are the validation split's. Calibration and share of windows with a ship stay as they were, and
    presence is held where it was: a handful of passages says nothing of the sea without ships.
    """
    network, _, features, before = restored(weights)
    first = restored(weights)[0].eval()
    task = replace(task, features=features)
    examples = RangeExamples(sets, "train", task, empty=False)
    check = RangeExamples(sets, "validation", task, examples.prior, empty=False)
    problem = RangeProblem(network, float(before.get("ship_share", SHIP_SHARE)), task, first)
    loss_before = _held_out_loss(problem, check)
    fit(problem, examples, check, folder, trainer, _settings(sets, problem))
    loss_after = _held_out_loss(problem, check)
    better = loss_after < loss_before
    if not better:
        network.load_state_dict(first.state_dict())
    verdict = "kept the new weights" if better else "kept the old weights"
    say(f"held-out passages: {loss_before:.4f} nats a window before, {loss_after:.4f} after; {verdict}")
    found = {"loss_before": loss_before, "loss_after": loss_after, "adapted": float(better)}
    told = {"set": provenance(task), "data_digest": _digest(sets), **found, **(about or {})}
    save_weights(Path(folder) / WEIGHTS, network, before | {"finetune": told})
    return found


def _digest(sets: Sequence[PreparedSet]) -> str:
    """Digests of prepared sets."""
    return JoinedSets([prepared.folder for prepared in sets]).digest()


def _settings(sets: Sequence[PreparedSet], problem: RangeProblem) -> dict[str, Any]:
    """What a training is of, as `fit` wants to know."""
    return {"data": _digest(sets), "task": asdict(problem.task), "ship share": problem.ship_share}


def _held_out_loss(problem: RangeProblem, examples: RangeExamples) -> float:
    problem.network.eval()
    generator, total = torch.Generator(), 0.0
    with torch.no_grad():
        for batch in DataLoader(examples, 64):
            total += float(problem.loss(batch, False, generator)) * len(batch["ship"])
    return total / len(examples)


def finish(
    network: RangeNetwork,
    sets: Sequence[PreparedSet],
    folder: str | Path,
    task: RangeTaskConfig,
    trainer: TrainerConfig,
    found: dict[str, float],
    about: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
    ship_share: float = SHIP_SHARE,
) -> dict[str, float]:
    """Calibrate a trained network on the validation records, measure it there, and write its weights."""
    heard = hear_records(network, sets, "validation", task.features, task.look)
    calibration = calibrate(heard, task.features, task.look)
    heard = looked_at(heard, calibration.least)
    found = found | {f"validation_{k}": v for k, v in measure(heard, calibration, task.features).items()}
    description = {
        "task": "range",
        "network": asdict(network.config),
        "features": asdict(task.features),
        "examples": asdict(task.examples),
        "trainer": asdict(trainer),
        "calibration": asdict(calibration),
        "metrics": found,
        "ship_share": ship_share,
        "data_digest": _digest(sets),
        "made": provenance(trainer),
        **(about or {}),
    }
    save_weights(prepare_folder(folder) / WEIGHTS, network, description)
    for name, value in found.items():
        say(f"{name} {value:.4g}")
    return found


def hear_records(
    network: RangeNetwork,
    sets: Sequence[PreparedSet],
    split: str,
    features: RangeFeaturesConfig,
    look: RangeCalibration,
) -> list[Heard]:
    """What a network says of the records of a split, beside the truth (`obsnet.learn.range_calibration.hear`)."""
    scorer = scorer_of(network)
    return [
        hear(
            scorer,
            cepstrogram_of(record),
            record.table(),
            truth_of(record),
            known_minutes(record, features.range_m[-1]),
            features,
            look=look,
        )
        for record in range_records(sets, split)
    ]


def restored(path: str | Path) -> tuple[RangeNetwork, RangeCalibration, RangeFeaturesConfig, dict[str, Any]]:
    """Network, calibration, features and description of a run's ``weights.pt``."""
    state, about = load_weights(path)
    features = build(RangeFeaturesConfig, about["features"])
    network = RangeNetwork(build(RangeNetworkConfig, about["network"]), features)
    network.load_state_dict(state)
    network.eval()
    return network, build(RangeCalibration, about["calibration"]), features, about


def range_records(sets: Sequence[PreparedSet], split: str) -> Iterator[Record]:
    """Records of a split that hold a cepstrogram, one by one."""
    for prepared in sets:
        yield from (record for record in prepared.records(split, NEEDED) if record.cepstra.size)


def cepstrogram_of(record: Record) -> xr.DataArray:
    """The clutter-filtered cepstrogram of a prepared record."""
    quefrency = record.quefrency
    nfft = 2 * (quefrency.size - 1)
    values = record.cepstra.astype(np.float32).T * noise_std(quefrency, nfft).astype(np.float32)[:, None]
    coords = {"quefrency": quefrency, "time": from_posix(record.frame_time)}
    return xr.DataArray(values, dims=("quefrency", "time"), coords=coords, attrs={"nfft": nfft})


def truth_of(record: Record) -> pd.DataFrame:
    """Ships of a prepared record whose place is known, as `range_examples` takes them."""
    there = np.isfinite(record.range_m) & record.known
    minute, ship = np.nonzero(there)
    return pd.DataFrame(
        {
            "time": from_posix(record.minute[minute]),
            "mmsi": ship,
            "range_m": record.range_m[there].astype(float),
            "range_rate_mps": record.range_rate_mps[there].astype(float),
        }
    )


def known_minutes(record: Record, farthest_m: float = np.inf) -> np.ndarray:
    """Minutes in which the place of every ship is known, s since 1970; with absence unknown, those with a ship within `farthest_m`."""
    complete = record.known.all(axis=1)
    if not record.absence_known:
        complete &= (record.known & (record.range_m <= farthest_m)).any(axis=1)
    return record.minute[complete]
