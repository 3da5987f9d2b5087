"""Write the ONNX file of trained weights and check it: ``python export/to_onnx.py weights=… out=… prepared=…``."""

import hydra
from omegaconf import DictConfig

from obsnet.learn.commands import export_detector, speaking


@hydra.main(version_base=None, config_path="../configs", config_name="export")
@speaking
def main(config: DictConfig) -> None:
    """Write the ONNX file of trained weights and check it."""
    export_detector(config)


if __name__ == "__main__":
    main()
