from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from obsnet.errors import ConfigError  # noqa: E402
from obsnet.learn.azimuth import (  # noqa: E402
    ABSENT,
    HERE,
    ROW_CELLS,
    UNKNOWN,
    AzimuthTaskConfig,
    at_turn,
    augmented,
    loss,
    minute_losses,
    presence,
)
from obsnet.learn.calibration import Outputs, calibration_error, metrics  # noqa: E402
from obsnet.learn.networks import AzimuthNetwork, AzimuthNetworkConfig, parameters  # noqa: E402

SMALL = AzimuthNetworkConfig(frequencies=20, hidden=6, gates=3, harmonics=12, azimuths=60, width=8)


def inputs(seed=0, rows=2, width=20):
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * np.pi * torch.rand(rows, ROW_CELLS, width, generator=generator)
    angle[:, :, 5] = 1.0
    invariants = torch.rand(rows, ROW_CELLS, 12, width, generator=generator)
    return invariants, torch.stack([torch.cos(angle), torch.sin(angle)], 1), torch.zeros(rows)


def turned(phasor, degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return torch.stack([c * phasor[:, 0] - s * phasor[:, 1], s * phasor[:, 0] + c * phasor[:, 1]], 1)


def network(config=SMALL):
    torch.manual_seed(0)
    return AzimuthNetwork(config).eval()


def labels(turn, state, rows=1, minutes=1, watched=1.0):
    return {
        "turn": torch.tensor(turn, dtype=torch.float32).reshape(rows, minutes, -1),
        "state": torch.tensor(state).reshape(rows, minutes, -1),
        "doubled": torch.zeros(rows),
        "weight": torch.ones(rows, minutes),
        "watched": torch.full((rows,), watched),
    }


def test_turning_the_sensor_turns_the_map():
    net, (invariants, phasor, doubled) = network(), inputs()
    with torch.no_grad():
        before = net(invariants, phasor, doubled)
        for steps in (1, 7, 30):
            after = net(invariants, turned(phasor, steps * 360 / 60), doubled)
            torch.testing.assert_close(after, before.roll(steps, 2), atol=2e-4, rtol=1e-3)
        half = net(invariants, turned(phasor, 3.0), doubled)
    expected = (before + before.roll(1, 2)) / 2
    assert (half - expected).abs().max() < 0.15 * (before.max() - before.min())


def test_without_refinement_an_azimuth_does_not_hear_its_neighbours():
    net = network(replace(SMALL, kernel=1))
    around = torch.zeros(1, 12, 60)
    around[0, :, 10] = 1.0
    with torch.no_grad():
        heard = net.last(net.refine(net.enter(around)))[0, 0]
        refined = network().enter(around)[0]
        silent = network().enter(torch.zeros_like(around))[0]
    assert (heard != heard[30]).nonzero().flatten().tolist() == [10]
    assert ((refined != silent).any(0)).nonzero().flatten().tolist() == list(range(7, 14))
    invariants, phasor, doubled = inputs()
    with torch.no_grad():
        before = net(invariants, phasor, doubled)
        after = net(invariants, turned(phasor, 90.0), doubled)
    torch.testing.assert_close(after, before.roll(15, 2), atol=2e-4, rtol=1e-3)


def test_the_network_is_small():
    assert parameters(AzimuthNetwork()) < 20_000


def test_minutes_know_their_own_window_alone():
    net, (invariants, phasor, doubled) = network(), inputs()
    other = invariants.clone()
    other[:, 18:] = 0.5
    with torch.no_grad():
        before, after = net(invariants, phasor, doubled), net(other, phasor, doubled)
    torch.testing.assert_close(before[:, :4], after[:, :4])
    assert not torch.allclose(before[:, 4:], after[:, 4:])


def test_cells_without_data_say_nothing():
    net, (invariants, phasor, doubled) = network(), inputs()
    phasor[:, :, 6:9] = 0
    invariants[:, 6:9] = 0
    empty = net(invariants * 0, phasor * 0, doubled)
    assert torch.allclose(empty, empty[:, :1, :1].expand_as(empty), atol=1e-5)
    assert torch.isfinite(net(invariants, phasor, doubled)).all()


def test_the_loss_is_the_posterior_written_out():
    config = AzimuthTaskConfig(prior_odds=0.5)
    ratio = torch.randn(1, 1, 60, generator=torch.Generator().manual_seed(3))
    odds = 0.5 / 60 * ratio.exp().sum()
    none = minute_losses(ratio, labels([0.0], [ABSENT]), config)
    assert float(none) == pytest.approx(float(torch.log(1 + odds)), rel=1e-5)
    one = minute_losses(ratio, labels([0.25], [HERE]), config)
    rest = torch.cat([ratio[0, 0, :12], ratio[0, 0, 19:]]).exp().sum()
    expected = -torch.log(0.5 / 60 * ratio[0, 0, 15].exp() / (1 + odds)) + torch.log(1 + 0.5 / 60 * rest)
    assert float(one) == pytest.approx(float(expected), rel=1e-4)


def test_the_sector_of_an_unknown_ship_says_nothing():
    config = AzimuthTaskConfig()
    ratio = torch.zeros(1, 1, 60)
    loud = ratio.clone()
    loud[0, 0, 14:17] = 9.0
    beside = labels([0.25], [UNKNOWN])
    torch.testing.assert_close(minute_losses(loud, beside, config), minute_losses(ratio, beside, config))
    two = labels([0.25, 0.75], [UNKNOWN, HERE])
    torch.testing.assert_close(minute_losses(loud, two, config), minute_losses(ratio, two, config))


def test_a_loud_ship_does_not_lift_the_rest_of_the_circle():
    config, batch = AzimuthTaskConfig(), labels([0.25], [HERE])
    ratio = torch.full((1, 1, 60), -3.0)
    ratio[0, 0, 15] = 12.0
    lifted = ratio.clone()
    lifted[0, 0, 30:] = 3.0
    assert float(minute_losses(lifted, batch, config)) > 2 + float(minute_losses(ratio, batch, config))


def test_where_absence_is_not_known_it_is_asked_where_the_ship_is_not_whether():
    config, ais = AzimuthTaskConfig(unseen=0.1), labels([0.25], [HERE], watched=0.0)
    ratio = torch.full((1, 1, 60), -5.0)
    ratio[0, 0, 15] = 10.0
    cost = float(minute_losses(ratio, ais, config))
    assert cost == pytest.approx(-np.log(0.9), abs=0.01)
    assert float(minute_losses(ratio + 7.0, ais, config)) == pytest.approx(cost, abs=1e-5)
    unseen = ratio.clone()
    unseen[0, 0, 45] = 40.0  # another vessel, which AIS does not show
    assert float(minute_losses(unseen, ais, config)) == pytest.approx(np.log(60 / 0.1), abs=1e-3)
    assert float(minute_losses(unseen, labels([0.25], [HERE]), config)) > 30.0
    assert (
        float(minute_losses(unseen, labels([0.25, 0.75], [HERE, UNKNOWN], watched=0.0), config)) < cost + 0.01
    )


def test_an_adaptation_to_passages_holds_presence_where_it_was():
    config, ratio = AzimuthTaskConfig(), torch.randn(2, 3, 60, generator=torch.Generator().manual_seed(1))
    turn, state = np.full((2, 3, 1), 0.25), np.full((2, 3, 1), ABSENT)
    batch = labels(turn, state, rows=2, minutes=3, watched=0.0) | {"weight": torch.zeros(2, 3)}
    before = presence(ratio)
    assert float(loss(ratio, batch, config, before)) == 0.0
    assert float(loss(ratio + 2.0, batch, config, before)) == pytest.approx(4.0, rel=1e-5)
    assert float(loss(ratio + 2.0, batch | {"watched": torch.ones(2)}, config, before)) == 0.0


@pytest.mark.parametrize("unseen", [0.0, 1.0, float("nan")])
def test_a_chance_lies_between_never_and_always(unseen):
    with pytest.raises(ConfigError, match="unseen"):
        AzimuthTaskConfig(unseen=unseen)


def test_two_ships_are_two_peaks():
    config = AzimuthTaskConfig()
    batch = labels([0.25, 0.75], [HERE, HERE])
    ratio = torch.full((1, 1, 60), -5.0)
    one, two = ratio.clone(), ratio.clone()
    one[0, 0, 15] = two[0, 0, 15] = two[0, 0, 45] = 10.0
    assert float(minute_losses(two, batch, config)) < 0.1
    assert float(minute_losses(one, batch, config)) > 3.0


def test_the_trained_ratio_is_a_likelihood_ratio():
    """One azimuth of twelve, a symptom of known chances: gradient descent must find the Bayes factor of a ship there."""
    generator = torch.Generator().manual_seed(1)
    odds, count = 0.8, 20_000
    ship = torch.rand(count, generator=generator) < odds / (1 + odds)
    symptom = torch.rand(count, generator=generator) < torch.where(ship, 0.9, 0.2)
    free = torch.zeros(2, requires_grad=True)
    optimiser = torch.optim.LBFGS([free], max_iter=50, line_search_fn="strong_wolfe")
    batch = labels(np.zeros((count, 1)), np.where(ship, HERE, ABSENT), rows=count)

    def closure():
        optimiser.zero_grad()
        others = torch.full((count, 1, 11), -30.0)
        ratio = torch.cat([free[symptom.long()][:, None, None], others], 2)
        value = minute_losses(ratio, batch, AzimuthTaskConfig(prior_odds=odds, beside_deg=1.0)).mean()
        value.backward()
        return value

    optimiser.step(closure)
    np.testing.assert_allclose(free.detach(), np.log([12 * 0.1 / 0.8, 12 * 0.9 / 0.2]), atol=0.1)


def test_augmentation_keeps_what_the_rows_say():
    _, phasor, doubled = inputs()
    turn = torch.full((2, 10, 1), 1.0 / (2 * np.pi))
    batch = {
        "invariants": torch.ones(2, ROW_CELLS, 12, 20),
        "phasor": phasor,
        "doubled": doubled,
        "turn": turn,
    }
    after = augmented(batch, torch.Generator().manual_seed(4), AzimuthTaskConfig(forget_share=1.0))
    angle = torch.atan2(after["phasor"][:, 1, 0, 5], after["phasor"][:, 0, 0, 5]) / (2 * np.pi) % 1.0
    torch.testing.assert_close(angle, after["turn"][:, 0, 0], atol=1e-5, rtol=0)
    assert not torch.allclose(after["turn"], turn)
    assert after["invariants"][:, :, [0, 10, 11]].abs().max() == 0


def test_reading_between_azimuths_goes_round_the_circle():
    values = torch.arange(4.0).reshape(1, 1, 4)
    read = at_turn(values, torch.tensor([[[0.125, 0.875, 0.999999]]]))
    torch.testing.assert_close(read, torch.tensor([[[0.5, 1.5, 0.0]]]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_exact_ratios_are_calibrated_however_many_ships_a_set_holds(share):
    """One number a minute, of unit variance, larger by 2 with a ship: 2x − 2 is its log-likelihood ratio."""
    rng = np.random.default_rng(0)
    ship = torch.tensor(rng.uniform(size=(40, 500)) < share)
    exact = 2.0 * (torch.tensor(rng.standard_normal((40, 500))) + 2.0 * ship) - 2.0
    state = torch.where(ship, HERE, ABSENT)[..., None]
    batch = {
        "state": state,
        "turn": torch.zeros(40, 500, 1),
        "weight": torch.ones(40, 500),
        "watched": torch.ones(40),
        "doubled": torch.zeros(40),
    }
    said = Outputs(exact[..., None].expand(40, 500, 24), batch, np.arange(40))
    assert metrics(said.ratio, said, AzimuthTaskConfig())["ece"] < 0.02


def test_calibration_error_sees_overconfidence():
    seen = np.arange(1000) % 2 == 0
    assert calibration_error(np.full(1000, 0.5), seen) < 1e-9
    assert calibration_error(np.full(1000, 0.95), seen) == pytest.approx(0.45)
