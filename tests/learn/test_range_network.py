import numpy as np
import pytest

torch = pytest.importorskip("torch")

from obsnet.detectors.range_features import CONTEXT, RangeFeaturesConfig  # noqa: E402
from obsnet.errors import ConfigError  # noqa: E402
from obsnet.learn.networks import parameters  # noqa: E402
from obsnet.learn.range_network import RangeNetwork, RangeNetworkConfig, range_loss  # noqa: E402


def test_the_network_is_small_and_bounded():
    network = RangeNetwork(RangeNetworkConfig(bound=9.0)).eval()
    assert parameters(network) < 40_000
    ratio = network(100.0 * torch.randn(7, RangeFeaturesConfig().size))
    assert ratio.shape == (7,)
    assert ratio.abs().max() <= 9.0


def test_pairs_that_do_not_exist_change_nothing():
    config, network = RangeFeaturesConfig(), RangeNetwork().eval()
    features = torch.randn(4, config.size)
    size = int(np.prod(config.patch_shape))
    features[:, size :: len(CONTEXT)][:, :5] = torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0])
    changed = features.clone()
    changed[:, size // 5 * 2 : size] = 7.0
    assert torch.allclose(network(features), network(changed))
    changed[:, : size // 5] = 7.0
    assert not torch.allclose(network(features), network(changed))


def test_a_network_blind_to_ghosts_does_not_see_them():
    config = RangeFeaturesConfig()
    features = torch.randn(4, config.size)
    size = int(np.prod(config.patch_shape))
    features[:, size :: len(CONTEXT)][:, :5] = 1.0
    changed = features.clone()
    changed[:, size + CONTEXT.index("ghost") :: len(CONTEXT)][:, :5] += 3.0
    torch.manual_seed(0)
    blind, seeing = RangeNetwork(RangeNetworkConfig(blind=("ghost",))).eval(), RangeNetwork().eval()
    assert torch.allclose(blind(features), blind(changed))
    assert not torch.allclose(seeing(features), seeing(changed))
    with pytest.raises(ConfigError, match="blind may hold energy"):
        RangeNetworkConfig(blind=("exists",))


def test_the_loss_of_a_network_that_knows_nothing_is_that_of_the_prior():
    measure = torch.full((2, 10), float(np.log(0.1)))
    loss = range_loss(torch.zeros(2, 11), measure, torch.tensor([True, False]), 0.25)
    np.testing.assert_allclose(loss, -np.log([0.25, 0.75]), rtol=1e-5)


def test_masked_cells_count_for_nothing():
    measure = torch.full((1, 10), float(np.log(0.1)))
    ratio = torch.zeros(1, 11)
    ratio[0, 5] = 50.0
    measure[0, 4] = -np.inf
    assert float(range_loss(ratio, measure, torch.tensor([False]), 0.5)) < 1.0


def test_at_its_minimum_the_score_is_the_log_likelihood_ratio():
    """Three cells and a symbol that names one of them, rightly in 70 % of cases with a ship; without, any symbol."""
    generator = np.random.default_rng(0)
    prior, share = np.array([0.5, 0.3, 0.2]), 0.4
    ship = generator.random(20_000) < share
    cell = generator.choice(3, 20_000, p=prior)
    seen = np.where(ship & (generator.random(20_000) < 0.7), cell, generator.integers(0, 3, 20_000))
    score = torch.zeros(3, 3, requires_grad=True)
    optimizer = torch.optim.Adam([score], lr=0.05)
    measure = torch.tensor(np.log(prior), dtype=torch.float32).expand(20_000, 3)
    for _ in range(300):
        hypotheses = score[seen]
        ratio = torch.cat([hypotheses[np.arange(20_000), cell][:, None], hypotheses], dim=1)
        loss = range_loss(ratio, measure, torch.tensor(ship), share).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    expected = np.log((0.7 * np.eye(3) + 0.1) * 3)
    np.testing.assert_allclose(score.detach().numpy(), expected, atol=0.15)
