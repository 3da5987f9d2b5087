from dataclasses import replace
from pathlib import Path

import pytest

hydra = pytest.importorskip("hydra")
pytest.importorskip("torch")

from obsnet.config import build  # noqa: E402
from obsnet.errors import ConfigError  # noqa: E402
from obsnet.learn.azimuth import AzimuthTaskConfig  # noqa: E402
from obsnet.learn.commands import plain, prepare_records  # noqa: E402
from obsnet.learn.networks import AzimuthNetworkConfig  # noqa: E402
from obsnet.learn.prepare import ArchiveData, TwinData  # noqa: E402
from obsnet.learn.task import TrainerConfig  # noqa: E402

NOTHING = TwinData(train=0, validation=0, test=0, quiet_train=0, quiet_validation=0)
CONFIGS = str(Path(__file__).resolve().parents[2] / "configs")


def composed(name, *overrides):
    with hydra.initialize_config_dir(CONFIGS, version_base=None):
        return hydra.compose(name, list(overrides))


@pytest.mark.parametrize("experiment", ["azimuth", "finetune"])
def test_experiments_compose_and_build(experiment):
    values = plain(composed("train", f"experiment={experiment}", "out=x"))
    assert build(TrainerConfig, values["trainer"]).epochs > 0
    assert build(AzimuthNetworkConfig, values["network"]).gates == 6
    assert build(AzimuthTaskConfig, values["labels"]).reach_m == 60e3
    assert values["task"] == "azimuth" and (values["weights"] is None) == (experiment == "azimuth")


def folder_of(experiment, seed, number=0):
    overrides = [f"experiment={experiment}", f"trainer.seed={seed}", f"hydra.job.num={number}"]
    with hydra.initialize_config_dir(CONFIGS, version_base=None):
        made = hydra.compose("train", overrides, return_hydra_config=True)
    return made.hydra.run.dir, f"{made.hydra.sweep.dir}/{made.hydra.sweep.subdir}"


def test_each_experiment_and_seed_has_its_folder():
    assert folder_of("azimuth", 0)[0] == "runs/azimuth-0"
    assert folder_of("finetune", 0)[0] != folder_of("azimuth", 0)[0]
    assert folder_of("azimuth", 3)[1] != folder_of("azimuth", 0)[1]
    assert folder_of("azimuth", 0, 1)[1] != folder_of("azimuth", 0, 0)[1]


def test_records_compose_and_build():
    twin = plain(composed("prepare"))["data"]
    assert twin.pop("kind") == "twin" and build(TwinData, twin).courses == "obsea"
    archive = plain(composed("prepare", "data=archive", "station=example"))["data"]
    assert archive.pop("kind") == "archive" and build(ArchiveData, archive).absence_known is False


def test_the_station_may_say_what_ocean_its_table_is_of():
    known = composed("prepare", "data=archive", "station=example", "+station.ocean.propagation_file=table.nc")
    assert plain(known)["data"]["ocean"] == {"propagation_file": "table.nc"}
    without = composed("prepare", "data=archive", "station=example", "~station.ocean")
    values = plain(without)["data"]
    del values["kind"]
    assert build(ArchiveData, values).ocean == ArchiveData().ocean


def test_an_archive_needs_a_station(tmp_path):
    with pytest.raises(ConfigError, match=r"station\.waveforms.*give station=NAME"):
        prepare_records(composed("prepare", "data=archive", f"out={tmp_path}"))


def test_a_misspelt_key_is_named(tmp_path):
    config = composed("prepare", "+data.trian=3", f"out={tmp_path}")
    with pytest.raises(ConfigError, match=r"data\.trian.*'train'"):
        prepare_records(config)


def test_an_archive_needs_its_parts(tmp_path):
    config = composed("prepare", "data=archive", "station=example", "station.waveforms=''", f"out={tmp_path}")
    with pytest.raises(ConfigError, match="waveforms, stationxml"):
        prepare_records(config)


def test_a_set_is_not_mixed_with_another(tmp_path):
    from obsnet.learn.prepare import prepare

    with pytest.raises(ConfigError, match="no prepared record"):
        prepare(tmp_path, NOTHING)
    with pytest.raises(ConfigError, match="another first_seed"):
        prepare(tmp_path, replace(NOTHING, first_seed=5))
