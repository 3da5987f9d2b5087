"""Compare detectors on simulated records of the twin and of a second generator: python train/ablate.py --folder DIR --out docs/ablation."""

from __future__ import annotations

from pathlib import Path

from elsewhere import kinds

from obsnet.experiments.ablation_records import write_twin
from obsnet.experiments.ablation_report import main


def write_elsewhere(kind: str, seed: int, hours: float, folder: Path) -> None:
    """Write a record of the second generator."""
    kinds.write(kinds.compose(kind, seed, hours), folder)


if __name__ == "__main__":
    main({"elsewhere": write_elsewhere, "twin": write_twin}, __doc__)
