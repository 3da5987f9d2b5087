"""Fail unless an ONNX file says what PyTorch says: ``python export/verify.py weights=… out=… prepared=…``."""

import hydra
from omegaconf import DictConfig

from obsnet.learn.commands import speaking, verify_export


@hydra.main(version_base=None, config_path="../configs", config_name="export")
@speaking
def main(config: DictConfig) -> None:
    """Fail unless an ONNX file says what PyTorch says."""
    verify_export(config)


if __name__ == "__main__":
    main()
