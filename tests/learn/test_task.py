from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lightning")
pytest.importorskip("zarr")

from torch import nn  # noqa: E402
from torch.utils.data import TensorDataset  # noqa: E402

from obsnet.errors import ConfigError  # noqa: E402
from obsnet.learn.task import TrainerConfig, fit  # noqa: E402

TRAINER = TrainerConfig(epochs=4, batch=16, learning_rate=1e-2)


class Sum:
    """The sum of four numbers, learned from noisy ones through dropout; may be stopped at a batch."""

    def __init__(self, stop=None, first=0.0):
        torch.manual_seed(0)
        self.network = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.2), nn.Linear(8, 1))
        self.network[2].bias.data.fill_(first)
        self.left = stop

    def loss(self, batch, training, generator):
        if self.left is not None:
            self.left -= 1
            if self.left < 0:
                raise OSError("the power fails")
        x = batch["x"] + training * 0.3 * torch.randn(batch["x"].shape, generator=generator)
        return ((self.network(x) - batch["x"].sum(1, keepdim=True)) ** 2).mean()


class Numbers(TensorDataset):
    def __getitem__(self, index):
        return {"x": super().__getitem__(index)[0]}


def numbers(count):
    return Numbers(torch.randn(count, 4, generator=torch.Generator().manual_seed(count)))


def trained(folder, problem=None, config=TRAINER, **settings):
    problem = problem or Sum()
    loss = fit(problem, numbers(200), numbers(50), folder, config, {"data": "a"} | settings, False)
    return loss, problem.network.state_dict()


def test_an_interrupted_training_goes_on_as_it_would_have(tmp_path):
    """Order, noise and dropout of the epochs left are those of a training that nothing stopped."""
    loss, whole = trained(tmp_path / "whole")
    epoch = 13 + 4
    with pytest.raises(OSError, match="power"):
        trained(tmp_path / "cut", Sum(stop=2 * epoch + 3))
    resumed = Sum()
    again, weights = trained(tmp_path / "cut", resumed)
    assert again == loss
    assert all(torch.equal(weights[name], whole[name]) for name in whole)


def test_a_finished_training_stays_as_it_is(tmp_path):
    first, again = trained(tmp_path), trained(tmp_path)
    assert again[0] == first[0]
    assert all(torch.equal(again[1][name], values) for name, values in first[1].items())


def test_a_training_that_ran_out_of_time_may_have_more(tmp_path):
    with pytest.raises(ConfigError, match="more minutes"):
        trained(tmp_path, config=replace(TRAINER, max_minutes=0.001, epochs=3))
    trained(tmp_path, config=replace(TRAINER, max_minutes=5.0, epochs=3))


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"data": "b"}, "data = 'a', not 'b'"),
        ({"config": replace(TRAINER, epochs=2)}, "trainer.epochs = 4, not 2"),
        ({"config": replace(TRAINER, seed=3)}, "trainer.seed = 0, not 3"),
        ({"problem": Sum(first=0.5)}, "first weights"),
    ],
)
def test_a_folder_belongs_to_one_training(tmp_path, other, named):
    trained(tmp_path)
    before = (tmp_path / "last.ckpt").read_bytes()
    with pytest.raises(ConfigError, match=rf"{named}.*name another folder"):
        trained(tmp_path, **other)
    assert (tmp_path / "last.ckpt").read_bytes() == before


def test_a_checkpoint_that_says_not_what_it_is_of_is_refused(tmp_path):
    trained(tmp_path)
    held = torch.load(tmp_path / "last.ckpt", weights_only=True)
    torch.save({name: held[name] for name in held if name != "settings"}, tmp_path / "last.ckpt")
    with pytest.raises(ConfigError, match=r"last\.ckpt.*name another folder"):
        trained(tmp_path)
    (tmp_path / "last.ckpt").write_bytes(b"half")
    with pytest.raises(ConfigError, match=r"last\.ckpt cannot be read.*name another folder"):
        trained(tmp_path)
