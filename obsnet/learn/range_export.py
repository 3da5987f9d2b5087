"""A trained range network in, its ONNX file with the card out; and the check that it says what PyTorch says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from obsnet.detectors.learned_range import RangeCalibration
from obsnet.detectors.model_card import ModelCard, ModelFile, run
from obsnet.detectors.range_features import CONTEXT, GLOBALS
from obsnet.errors import ModelError
from obsnet.learn.dataset import PreparedSet
from obsnet.learn.export import TOLERANCE, origin, write_onnx
from obsnet.learn.range_training import RangeExamples, RangeTaskConfig, restored
from obsnet.signals.spectra import SpectraConfig

RAW = RangeCalibration(lowest=-100.0, highest=100.0)
"""No calibration; the cheap score's line is the one that fitting begins with."""


def export_range(weights: str | Path, out: str | Path, calibrate: bool = True) -> Path:
    """Write a range model with its card, and its SHA-256 beside it; the calibration, if wanted, stands in the card."""
    network, calibration, features, about = restored(weights)
    spectra = SpectraConfig()
    card = ModelCard(
        task="range",
        representation={
            "features": asdict(features),
            "context": list(CONTEXT),
            "globals": list(GLOBALS),
            "spectra": {name: getattr(spectra, name) for name in ("window_s", "hop_s", "analysis_rate_hz")},
        },
        grids={"features": features.size},
        calibration=asdict(calibration if calibrate else RAW),
        **origin(network, about),
    )
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_onnx(network.eval(), (torch.randn(3, features.size),), ("features",), card, out)
    return out


def range_parity(
    weights: str | Path,
    model: str | Path,
    prepared: Sequence[str | Path],
    calibrate: bool = True,
    examples: int = 100,
) -> float:
    """Largest difference of the ONNX file from PyTorch on hypotheses of validation records; no calibration is in it.

    Raises
    ------
    ModelError : it exceeds `TOLERANCE`.
    """
    network, _, features, _ = restored(weights)
    sets = [PreparedSet(folder) for folder in prepared]
    held = RangeExamples(sets, "validation", RangeTaskConfig(features=features)).arrays["features"]
    chosen = np.linspace(0, len(held) - 1, min(examples, len(held))).astype(int)
    inputs = held[chosen].astype(np.float32).reshape(-1, features.size)
    with torch.no_grad():
        wanted = network(torch.from_numpy(inputs)).numpy()
    session = ModelFile.read(model, "range").session()
    found = np.concatenate([run(session, {"features": part}) for part in np.array_split(inputs, 8)])
    worst = float(np.abs(found - wanted).max())
    if not worst <= TOLERANCE:
        raise ModelError(
            f"{model} differs from {weights} by {worst:.2g}, more than {TOLERANCE:g}; export it again"
        )
    return worst
