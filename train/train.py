"""Train a detector: ``python train/train.py experiment=azimuth|range|finetune prepared=FOLDER``."""

import hydra
from omegaconf import DictConfig

from obsnet.learn.commands import speaking, train_detector


@hydra.main(version_base=None, config_path="../configs", config_name="train")
@speaking
def main(config: DictConfig) -> float:
    """Train, calibrate and measure; a sweeper takes the validation loss."""
    return train_detector(config)


if __name__ == "__main__":
    main()
