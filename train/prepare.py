"""Waveforms, StationXML and AIS to prepared records: ``python train/prepare.py data=twin|archive out=FOLDER``."""

import hydra
from omegaconf import DictConfig

from obsnet.learn.commands import prepare_records, speaking


@hydra.main(version_base=None, config_path="../configs", config_name="prepare")
@speaking
def main(config: DictConfig) -> None:
    """Make the records that are not there yet."""
    prepare_records(config)


if __name__ == "__main__":
    main()
