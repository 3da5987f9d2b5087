from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lightning")
zarr = pytest.importorskip("zarr")

from torch.utils.data import DataLoader  # noqa: E402

from obsnet.detectors.learned_range import LearnedRangeDetector, RangeCalibration, presence_ratio  # noqa: E402
from obsnet.detectors.range_features import RangeFeaturesConfig  # noqa: E402
from obsnet.errors import ConfigError, ModelError  # noqa: E402
from obsnet.layout import from_posix  # noqa: E402
from obsnet.learn.dataset import PreparedSet, Record, packed_table  # noqa: E402
from obsnet.learn.range_calibration import Heard, calibrate, looked_at, measure  # noqa: E402
from obsnet.learn.range_examples import RangeExamplesConfig  # noqa: E402
from obsnet.learn.range_export import export_range, range_parity  # noqa: E402
from obsnet.learn.range_network import RangeNetworkConfig, place_loss  # noqa: E402
from obsnet.learn.range_records import HydrophoneData, draw_record, prepare_hydrophone  # noqa: E402
from obsnet.learn.range_training import (  # noqa: E402
    RangeExamples,
    RangeTaskConfig,
    cepstrogram_of,
    finetune,
    known_minutes,
    restored,
    train,
    truth_of,
)
from obsnet.learn.task import TrainerConfig  # noqa: E402
from obsnet.ocean.bottom import Bottom  # noqa: E402
from obsnet.ocean.rays import propagation, tdoa  # noqa: E402
from obsnet.ocean.sound_speed import SoundSpeed  # noqa: E402
from obsnet.signals.spectra import SpectraConfig  # noqa: E402

START = 1_369_130_400.0
QUEFRENCY = np.arange(513) * 0.02
TASK = RangeTaskConfig(examples=RangeExamplesConfig(hypotheses=12, every=4, beliefs=1, least_empty=4))


def record(name, split, seed, ship):
    """Forty minutes of noise in which a ship may approach."""
    table = propagation(SoundSpeed.constant(1500.0), 4000.0, Bottom(), np.arange(0.0, 60e3, 140.0))
    times = START + 10.24 * np.arange(235)
    minutes = START + 60.0 * np.arange(40)
    values = np.random.default_rng(seed).standard_normal((235, 513))
    if ship:
        for pair in ("1-3", "3-5"):
            lag = QUEFRENCY - tdoa(table, pair, 20e3 - 6.0 * (times - START)).values[:, None]
            values += 4.0 * np.cos(2 * np.pi * 15.0 * lag) * np.exp(-(lag**2) / (2 * 0.05**2))
    distance = np.where(ship, 20e3 - 6.0 * (minutes - START), np.nan)[:, None]
    arrays = {
        "frame_time": times, "cepstra": values.astype(np.float16), "quefrency": QUEFRENCY, "minute": minutes,
        "range_m": distance.astype("f4"), "range_rate_mps": np.where(np.isfinite(distance), -6.0, np.nan).astype("f4"),
        "azimuth_deg": np.zeros((40, 1), "f4"), "known": np.ones((40, 1), bool),
    }  # fmt: skip
    attributes = {"id": name, "split": split, "depth_m": 4000.0, "absence_known": True, "station": "XX.A"}
    return Record(attributes, arrays | packed_table(table))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    made = PreparedSet(tmp_path_factory.mktemp("prepared"))
    for i, (split, ship) in enumerate(
        [("train", True), ("train", False), ("validation", True), ("validation", False)]
    ):
        made.write(record(f"r{i}", split, i, ship))
    return made


@pytest.fixture(scope="module")
def trained(prepared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    network = RangeNetworkConfig(hidden=8, code=4, head=8)
    found = train([prepared], folder, network, TASK, TrainerConfig(epochs=2, batch=8), say=lambda text: None)
    return folder / "weights.pt", found


def test_training_leaves_weights_that_say_what_they_are(trained):
    path, found = trained
    network, calibration, features, about = restored(path)
    assert about["task"] == "range"
    assert len(about["data_digest"]) == 64
    assert features == RangeFeaturesConfig()
    assert calibration.lowest < 0 < calibration.highest
    assert not network.training
    assert np.isfinite(found["validation_loss"])
    assert about["metrics"] == found


def test_trained_weights_are_calibrated_anew_for_another_look_and_stay_as_they_are(
    trained, prepared, tmp_path
):
    look = RangeCalibration(peaks=3, rates=3, least=4.0)
    none = TrainerConfig(epochs=0, batch=8)
    found = train(
        [prepared], tmp_path / "new", task=replace(TASK, look=look), trainer=none, say=lambda text: None, begin_with=trained[0]
    )  # fmt: skip
    (before, *_), (after, calibration, _, about) = (
        restored(trained[0]),
        restored(tmp_path / "new" / "weights.pt"),
    )
    assert all(torch.equal(before.state_dict()[name], values) for name, values in after.state_dict().items())
    assert (calibration.peaks, calibration.rates, calibration.least) == (3, 3, 4.0)
    assert about["trained"]["trainer"]["epochs"] == 2
    assert found["validation_loss"] == trained[1]["validation_loss"]
    first = tmp_path / "new" / "weights.pt"
    train([prepared], tmp_path / "newer", task=TASK, trainer=none, say=lambda text: None, begin_with=first)
    assert restored(tmp_path / "newer" / "weights.pt")[3]["trained"] == about["trained"]


def test_a_folder_belongs_to_one_training(trained, prepared):
    network = RangeNetworkConfig(hidden=8, code=4, head=8)
    trainer = TrainerConfig(epochs=2, batch=8)
    other = replace(TASK, patch_noise=0.1)
    with pytest.raises(ConfigError, match=r"task\.patch_noise = 0\.3, not 0\.1; name another folder"):
        train([prepared], trained[0].parent, network, other, trainer, say=lambda text: None)


def test_the_exported_model_says_the_same_and_detects(trained, prepared, tmp_path):
    model = export_range(trained[0], tmp_path / "range.onnx")
    assert range_parity(trained[0], model, [prepared.folder]) < 1e-4
    held = prepared.read("r2")
    detector = LearnedRangeDetector.from_model(held.table(), model)
    assert detector.file.card.task == "range"
    maps = detector.maps(cepstrogram_of(held), held.minute[5:8])
    assert np.isfinite(maps["range_llr"].values).all()
    with pytest.raises(ModelError, match="hop_s"):
        LearnedRangeDetector.from_model(held.table(), model, spectra=SpectraConfig(hop_s=5.12))


def test_adapting_keeps_what_is_better_and_needs_no_empty_sea(trained, prepared, tmp_path):
    ships = PreparedSet(tmp_path / "archive")
    for name in ("r0", "r2"):
        ships.write(prepared.read(name))
    trainer = TrainerConfig(epochs=1, batch=8, learning_rate=1e-3)
    found = finetune([ships], tmp_path / "run", trained[0], TASK, trainer, say=lambda text: None)
    _, calibration, _, about = restored(tmp_path / "run" / "weights.pt")
    assert calibration == restored(trained[0])[1]
    assert about["finetune"]["adapted"] == float(found["loss_after"] < found["loss_before"])
    wild = TrainerConfig(epochs=1, batch=8, learning_rate=30.0)
    kept = finetune([ships], tmp_path / "wild", trained[0], TASK, wild, say=lambda text: None)
    assert kept["adapted"] == 0.0
    old, new = (restored(path)[0].state_dict() for path in (trained[0], tmp_path / "wild" / "weights.pt"))
    assert all(torch.equal(old[name], new[name]) for name in old)


def test_an_adaptation_is_asked_where_the_ship_is_and_pays_for_another_presence():
    ratio = torch.randn(5, 9, generator=torch.Generator().manual_seed(1))
    measure = torch.full((5, 8), -np.log(8.0))
    said = place_loss(ratio, measure, ratio)
    expected = torch.logsumexp(ratio[:, 1:], 1) - np.log(8.0) - ratio[:, 0]
    torch.testing.assert_close(said, expected)
    torch.testing.assert_close(place_loss(ratio + 3.0, measure, ratio), said + 9.0)


def test_passages_are_asked_where_the_ship_is_not_whether(trained, prepared, tmp_path):
    ships = PreparedSet(tmp_path / "archive")
    for name in ("r0", "r2"):
        ships.write(prepared.read(name))
    once = TrainerConfig(epochs=1, batch=8)
    found = finetune([ships], tmp_path / "run", trained[0], TASK, once, say=lambda text: None)
    network = restored(trained[0])[0].eval()
    held, costs = RangeExamples([ships], "validation", TASK, empty=False), []
    for batch in DataLoader(held, 64):
        with torch.no_grad():
            said = network(batch["features"].flatten(0, 1)).reshape(batch["features"].shape[:2])
        costs.append(place_loss(said, batch["log_measure"], said))
    assert found["loss_before"] == pytest.approx(float(torch.cat(costs).mean()), rel=1e-4)


def test_records_give_back_what_was_heard_and_known(prepared):
    held = prepared.read("r0")
    assert cepstrogram_of(held).sizes == {"quefrency": 513, "time": 235}
    truth = truth_of(held)
    assert len(truth) == 40
    assert truth["range_m"].iloc[10] == pytest.approx(20e3 - 3600.0)
    arrays = held.arrays | {"known": np.arange(40)[:, None] < 30}
    part = Record(held.attributes, arrays)
    assert len(known_minutes(part)) == 30
    assert len(truth_of(part)) == 30
    silent = Record(held.attributes | {"absence_known": False}, prepared.read("r1").arrays)
    assert len(known_minutes(silent)) == 0
    seen = Record(held.attributes | {"absence_known": False}, held.arrays)
    near = (held.range_m <= 19e3).any(axis=1)
    assert 0 < near.sum() < len(near)
    np.testing.assert_array_equal(known_minutes(seen, 19e3), held.minute[near])


def test_hydrophone_records_are_prepared_once(tmp_path, monkeypatch):
    data = HydrophoneData(train=1, validation=1, hours=0.5)
    made = prepare_hydrophone(tmp_path, data)
    assert made.names("train") == ["range-train-00000"]
    held = made.read("range-validation-10000")
    assert cepstrogram_of(held).sizes["quefrency"] == 513
    assert set(truth_of(held)["time"].to_numpy()) <= set(from_posix(held.minute))
    assert len(known_minutes(held)) == len(held.minute)
    monkeypatch.setattr("obsnet.learn.range_records.draw_record", None)
    assert prepare_hydrophone(tmp_path, data).digest() == made.digest()


def test_hydrophone_records_are_not_mixed_with_others(tmp_path, monkeypatch):
    from obsnet.learn import range_records

    drawn = range_records.draw_record
    monkeypatch.setattr(range_records, "draw_record", lambda seed, hours, depth_m: drawn(0, 0.2, 0))
    data = HydrophoneData(train=1, validation=1)
    prepare_hydrophone(tmp_path, data)
    assert len(prepare_hydrophone(tmp_path, replace(data, train=2)).names()) == 3
    with pytest.raises(ConfigError, match="another hours, depth_m"):
        prepare_hydrophone(tmp_path, replace(data, hours=0.4, depth_m=3000.0))


def test_hydrophone_records_may_share_a_depth():
    assert draw_record(0, 0.2, depth_m=3000.0).ocean.depth_m == 3000.0
    assert abs(draw_record(0, 0.2).ocean.depth_m - 3000.0) > 100.0


def test_without_calibration_the_exported_ratios_are_the_networks_own(trained, prepared, tmp_path):
    raw = export_range(trained[0], tmp_path / "raw.onnx", calibrate=False)
    assert range_parity(trained[0], raw, [prepared.folder], calibrate=False) < 1e-4
    held = prepared.read("r2")
    detector = LearnedRangeDetector.from_model(held.table(), raw)
    said, _ = detector.scores(cepstrogram_of(held), held.minute[5:8])
    ratios = detector.ratios(cepstrogram_of(held), held.minute[5:8])
    looked = np.isfinite(said)
    np.testing.assert_allclose(ratios[looked], said[looked], atol=1e-3)


def test_sets_without_ships_are_refused(tmp_path):
    empty = PreparedSet(tmp_path)
    for i, split in enumerate(("train", "validation")):
        empty.write(record(f"r{i}", split, i, False))
    with pytest.raises(ConfigError, match="train records need windows with a ship"):
        train([empty], tmp_path / "run", task=TASK, say=lambda text: None)


def heard(seed, ship, strength, minutes=60):
    """A detector that sees a ship with some strength, in noise."""
    grid = RangeFeaturesConfig()
    generator = np.random.default_rng(seed)
    network = np.full((minutes, len(grid.range_rate), len(grid.range_m)), np.nan, np.float32)
    network[:, :, 40:60] = generator.normal(-1.0, 1.0, (minutes, 1, 20))
    place = generator.integers(100, 110, minutes)
    network[:, :, 100:110] = -3.0
    if ship:
        network[np.arange(minutes), :, place] = strength
    ships = [np.array([[140.0 * p, 0.0]]) if ship else np.empty((0, 2)) for p in place]
    cheap = generator.exponential(1.0, network.shape).astype(np.float32)
    return Heard(START + 60.0 * np.arange(minutes), network, cheap, ships)


def test_calibration_makes_overconfidence_honest():
    """Half of the strong claims are of records without a ship: what is claimed must come down to that."""
    records = [heard(k, True, 9.0) for k in range(3)]
    liars = [heard(10 + k, True, 9.0) for k in range(3)]
    records += [Heard(r.minutes, r.network, r.cheap, [np.empty((0, 2))] * len(r.minutes)) for r in liars]
    before = measure(records, RangeCalibration())
    after = measure(records, calibrate(records))
    assert before["ece"] > 0.2
    assert after["ece"] < 0.05
    assert after["nll"] < before["nll"]


def test_calibration_is_of_looks_at_every_minute():
    records = [heard(k, k % 2 == 0, 4.0) for k in range(6)]
    for record in records:
        record.cheap[::3] *= 0.2
        record.cheap[:, 5, 100] = np.maximum(record.cheap[:, 5, 100], 9.0 * (np.arange(60) % 3 > 0))
    every, some = (calibrate(records, start=RangeCalibration(least=least)) for least in (0.0, 8.0))
    assert replace(some, least=0.0) == every
    seen = looked_at(records, 8.0)[0]
    assert np.isnan(seen.network[::3]).all()
    np.testing.assert_array_equal(seen.network[1::3], records[0].network[1::3])


def test_calibrated_detections_are_counted_right():
    records = [heard(k, k % 2 == 0, 9.0) for k in range(6)]
    calibration = calibrate(records)
    found = measure(records, calibration)
    assert found["right"] > 0.95
    assert found["wrong"] + found["false_per_hour"] == 0.0
    assert found["smad_m"] < 150.0
    assert 0.0 < calibration.exponent <= 1.0


def test_presence_of_ratios_that_say_nothing_is_nothing():
    features = RangeFeaturesConfig()
    flat = np.zeros((2, len(features.range_rate), len(features.range_m)), np.float32)
    np.testing.assert_allclose(presence_ratio(flat, features), 0.0, atol=1e-3)
    np.testing.assert_allclose(presence_ratio(flat + 2.5, features), 2.5, atol=1e-3)
