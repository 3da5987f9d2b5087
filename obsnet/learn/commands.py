"""What the scripts of `train/` and `export/` do with a composed configuration."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from obsnet.config import build
from obsnet.console import progress, say
from obsnet.errors import ConfigError, ObsnetError

PLACES = ("prepared", "out", "weights", "begin_with")
"""Keys of files and folders, of which a run's record keeps the names alone."""


def _names(paths: str | list[str] | None) -> Any:
    if isinstance(paths, list):
        return [_names(path) for path in paths]
    return paths and Path(paths).name


def plain(config: DictConfig) -> dict[str, Any]:
    """A composed configuration, interpolations resolved, as plain containers."""
    try:
        made = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        line = f"{error.full_key}: {str(error).splitlines()[0]}"
        hint = "; give station=NAME, of configs/station/NAME.yaml" if "station." in line else ""
        raise ConfigError(line + hint) from None
    return {str(key): value for key, value in made.items()} if isinstance(made, dict) else {}


def speaking(command: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Turn bad input into one line and exit status 2."""

    @functools.wraps(command)
    def run(config: DictConfig) -> Any:
        try:
            return command(config)
        except ObsnetError as error:
            print(f"obsnet: error: {' '.join(str(error).split())}", file=sys.stderr)
            sys.exit(2)

    return run


def prepare_records(config: DictConfig) -> None:
    """Prepare the records of ``config.data`` into ``config.out``."""
    from obsnet.learn.prepare import ArchiveData, TwinData, prepare
    from obsnet.learn.range_records import HydrophoneData, prepare_hydrophone

    values = plain(config)
    data = dict(values["data"])
    kinds = {"twin": TwinData, "archive": ArchiveData, "hydrophone": HydrophoneData}
    kind = data.pop("kind", None)
    if kind not in kinds:
        raise ConfigError(f"data.kind must be one of {', '.join(kinds)}, found {kind!r}")
    with progress("prepare", quiet=False) as draw:
        wanted: Any = build(kinds[kind], data, "data")
        made = (
            prepare_hydrophone(values["out"], wanted, draw)
            if isinstance(wanted, HydrophoneData)
            else prepare(values["out"], wanted, draw)
        )
    say(f"{len(made.names())} records in {made.folder}")


def train_detector(config: DictConfig) -> float:
    """Train (or, with ``config.weights``, adapt) the detector that ``config.task`` names; returns its validation loss."""
    from obsnet.learn.dataset import JoinedSets, PreparedSet
    from obsnet.learn.task import TrainerConfig

    values = plain(config)
    folders = _sets(values)
    folder = Path(values["out"])
    trainer = build(TrainerConfig, values["trainer"], "trainer")
    about = {"resolved": values | {key: _names(values.get(key)) for key in PLACES}}
    if values["task"] == "azimuth":
        from obsnet.learn import azimuth_training as training
        from obsnet.learn.azimuth import AzimuthTaskConfig
        from obsnet.learn.networks import AzimuthNetworkConfig

        prepared = JoinedSets(folders)
        labels = build(AzimuthTaskConfig, values["labels"], "labels")
        if values.get("weights"):
            found = training.finetune(prepared, folder, values["weights"], labels, trainer, about, say)
            return min(found["loss_before"], found["loss_after"])
        network = build(AzimuthNetworkConfig, values["network"], "network")
        found = training.train(
            prepared, folder, network, labels, trainer, about, say, values.get("begin_with")
        )
        return found["validation_nll"]
    if values["task"] == "range":
        from obsnet.learn import range_training
        from obsnet.learn.range_network import RangeNetworkConfig

        task = build(range_training.RangeTaskConfig, values["labels"], "labels")
        sets = [PreparedSet(name) for name in folders]
        if values.get("weights"):
            found = range_training.finetune(sets, folder, values["weights"], task, trainer, about, say)
            return min(found["loss_before"], found["loss_after"])
        widths = build(RangeNetworkConfig, values["network"], "network")
        found = range_training.train(
            sets, folder, widths, task, trainer, about, say, values.get("begin_with")
        )
        return found["validation_loss"]
    raise ConfigError(f"task must be azimuth or range, found {values['task']!r}")


def export_detector(config: DictConfig) -> None:
    """Write the ONNX file of ``config.weights`` to ``config.out`` and check it."""
    values = plain(config)
    export, parity = _exporting(values["weights"])
    path = export(values["weights"], values["out"], values["calibrate"])
    worst = parity(values["weights"], path, _sets(values), values["calibrate"])
    say(f"{path}: {path.stat().st_size} bytes, differs from PyTorch by {worst:.1e} at most")


def verify_export(config: DictConfig) -> None:
    """Check the ONNX file of ``config.out`` against ``config.weights`` on real maps."""
    values = plain(config)
    _, parity = _exporting(values["weights"])
    worst = parity(values["weights"], values["out"], _sets(values), values["calibrate"])
    say(f"{values['out']}: differs from PyTorch by {worst:.1e} at most")


def _sets(values: dict[str, Any]) -> list[str]:
    """The prepared folders, of one name or a list."""
    return values["prepared"] if isinstance(values["prepared"], list) else [values["prepared"]]


def _exporting(weights: str) -> tuple[Callable[..., Any], Callable[..., float]]:
    """Export and its check, of the detector that the weights are of."""
    from obsnet.learn.task import load_weights

    if load_weights(weights)[1].get("task") == "range":
        from obsnet.learn.range_export import export_range, range_parity

        return export_range, range_parity
    from obsnet.learn.export import export, parity

    return export, parity
