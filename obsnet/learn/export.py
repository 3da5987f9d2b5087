"""Trained weights in, one ONNX file with its card out; and the check that it says what PyTorch says."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import logging
import os
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from obsnet.detectors.azimuth_features import BIN_S, CHANNELS
from obsnet.detectors.model_card import CARD_KEY, MODELS, MOST_BYTES, ModelCard, ModelFile, run
from obsnet.errors import ModelError
from obsnet.learn.azimuth import ROW_CELLS, ROW_MINUTES, AzimuthRows, AzimuthTaskConfig
from obsnet.learn.azimuth_training import restored
from obsnet.learn.calibration import Calibration, bounded
from obsnet.learn.dataset import JoinedSets
from obsnet.learn.networks import AzimuthNetwork, parameters
from obsnet.output import write_text
from obsnet.signals.spectra import SpectraConfig

TOLERANCE = 1e-4
INPUTS = ("invariants", "phasor", "doubled")
RAW = Calibration(lowest=-100.0, highest=100.0)
"""No calibration."""


class CalibratedAzimuth(nn.Module):
    """The network and its calibration, as they are exported."""

    def __init__(self, network: AzimuthNetwork, calibration: Calibration) -> None:
        super().__init__()
        self.network, self.calibration = network, calibration

    def forward(self, invariants: Tensor, phasor: Tensor, doubled: Tensor) -> Tensor:
        """Natural-log likelihood ratios (batch, minute, azimuth)."""
        (slope, slope2), (offset, offset2) = self.calibration.slope, self.calibration.offset
        which = doubled[:, None, None]
        ratio = self.network(invariants, phasor, doubled)
        ratio = (slope + (slope2 - slope) * which) * ratio + (offset + (offset2 - offset) * which)
        return bounded(ratio, self.calibration.lowest, self.calibration.highest)


def export(weights: str | Path, out: str | Path, calibrate: bool = True) -> Path:
    """Write a model with its card, and its SHA-256 beside it.

    Parameters
    ----------
    weights : a run's ``weights.pt``. out : the ONNX file. calibrate : False leaves the network's output as it is.

    Raises
    ------
    ModelError : the weights cannot be read, or the model is too large.
    """
    network, calibration, about = restored(weights)
    calibration = calibration if calibrate else RAW
    calibrated = CalibratedAzimuth(network, calibration).eval()
    card = azimuth_card(network, calibration, about)
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_onnx(calibrated, _example(network), INPUTS, card, out)
    return out


def azimuth_card(network: AzimuthNetwork, calibration: Calibration, about: dict[str, Any]) -> ModelCard:
    """The card of an azimuth network."""
    spectra = SpectraConfig()
    return ModelCard(
        task="azimuth",
        representation={
            "features": about["features"],
            "channels": list(CHANNELS),
            "bin_s": BIN_S,
            "spectra": {"window_s": spectra.window_s, "hop_s": spectra.hop_s},
        },
        grids={
            "minutes": ROW_MINUTES,
            "frequencies": network.config.frequencies,
            "azimuths": network.config.azimuths,
        },
        calibration=calibration.to_dict(),
        **origin(network, about),
    )


def origin(network: Any, about: dict[str, Any]) -> dict[str, Any]:
    """What a card says of how a network of either kind came to be.

    Of adapted weights, and of weights calibrated anew, metrics, digest and commit are those of that; what the network was
    before, or was trained with, stands in ``about``.
    """
    first = {
        "metrics": about["metrics"],
        "data_digest": about["data_digest"],
        "commit": about["made"]["commit"],
    }
    told: dict[str, Any] = {
        "network": asdict(network.config),
        "parameters": parameters(network),
        "versions": about["made"]["versions"],
        "trained_on": "simulated records of obsnet's twin",
    }
    if trained := about.get("trained"):
        told["trained"] = {"data_digest": trained.get("data_digest"), "commit": trained["made"]["commit"]}
    tuned = about.get("finetune", {})
    if not tuned.get("adapted"):
        return first | {"about": told}
    losses = {f"held_out_{key}": tuned[key] for key in ("loss_before", "loss_after")}
    told |= {"trained_on": "simulated records, then a station's own passages", "before": first}
    now = {"metrics": losses, "data_digest": tuned["data_digest"], "commit": tuned["set"]["commit"]}
    return now | {"about": told}


def write_onnx(
    model: nn.Module, example: tuple[Tensor, ...], names: tuple[str, ...], card: ModelCard, out: Path
) -> None:
    """Export a model of float32 tensors whose first axis is free, one file; its card goes into the metadata.

    Its SHA-256 goes on record, see `record_digest`.
    """
    import onnx

    batch = {name: {0: torch.export.Dim("batch", min=1, max=4096)} for name in names}
    for name in ("torch.onnx", "onnx_ir"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            model, example, dynamo=True, dynamic_shapes=tuple(batch.values()), input_names=list(names),
            output_names=["llr"], external_data=False, verbose=False,
        )  # fmt: skip
    assert program is not None
    proto = program.model_proto
    del proto.metadata_props[:]
    for node in proto.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del value.metadata_props[:]
    del proto.graph.metadata_props[:]
    proto.graph.doc_string = proto.doc_string = ""
    onnx.helper.set_model_props(proto, {CARD_KEY: card.to_json()})
    onnx.checker.check_model(proto)
    content = proto.SerializeToString(deterministic=True)
    if len(content) > MOST_BYTES:
        raise ModelError(f"the model has {len(content)} bytes, more than {MOST_BYTES}; make it smaller")
    partial = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    partial.write_bytes(content)
    record_digest(out, hashlib.sha256(content).hexdigest())
    os.replace(partial, out)


def record_digest(path: Path, digest: str) -> None:
    """Put a model's SHA-256 on record: in the list of the shipped ones, or beside the file."""
    if path.resolve().parent != MODELS:
        write_text(path.with_name(path.name + ".sha256"), f"{digest}  {path.name}\n")
        return
    listed = MODELS / "digests.json"
    known = json.loads(listed.read_text()) if listed.is_file() else {}
    write_text(listed, json.dumps(known | {path.name: digest}, indent=1, sort_keys=True) + "\n")


def parity(
    weights: str | Path,
    model: str | Path,
    prepared: Sequence[str | Path],
    calibrate: bool = True,
    rows: int = 24,
) -> float:
    """Largest difference of the ONNX file from PyTorch on rows of validation records.

    Raises
    ------
    ModelError : it exceeds `TOLERANCE`.
    """
    network, calibration, _ = restored(weights)
    calibrated = CalibratedAzimuth(network, calibration if calibrate else RAW).eval()
    held = AzimuthRows(JoinedSets(prepared), "validation", AzimuthTaskConfig())
    session = ModelFile.read(model, "azimuth").session()
    worst = 0.0
    for item in np.linspace(0, len(held) - 1, min(rows, len(held))).astype(int):
        inputs = [held[int(item)][name][None] for name in INPUTS]
        with torch.no_grad():
            wanted = calibrated(*inputs).numpy()
        found = run(session, {name: value.numpy() for name, value in zip(INPUTS, inputs, strict=True)})
        worst = max(worst, float(np.abs(found - wanted).max()))
    if not worst <= TOLERANCE:
        raise ModelError(
            f"{model} differs from {weights} by {worst:.2g}, more than {TOLERANCE:g}; export it again"
        )
    return worst


def _example(network: AzimuthNetwork) -> tuple[Tensor, Tensor, Tensor]:
    width = network.config.frequencies
    generator = torch.Generator().manual_seed(0)
    angle = 2 * np.pi * torch.rand(3, ROW_CELLS, width, generator=generator)
    invariants = torch.randn(3, ROW_CELLS, len(CHANNELS), width, generator=generator)
    return invariants, torch.stack([torch.cos(angle), torch.sin(angle)], 1), torch.zeros(3)
