import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("zarr")
onnx = pytest.importorskip("onnx")

from obsnet.detectors.learned import LearnedAzimuthDetector  # noqa: E402
from obsnet.detectors.model_card import ModelFile  # noqa: E402
from obsnet.errors import ConfigError, ModelError  # noqa: E402
from obsnet.learn import azimuth_training as training  # noqa: E402
from obsnet.learn.azimuth import AzimuthRows, AzimuthTaskConfig, presence  # noqa: E402
from obsnet.learn.calibration import bounded, outputs  # noqa: E402
from obsnet.learn.dataset import NO_PHASOR, PreparedSet, Record  # noqa: E402
from obsnet.learn.export import export, parity  # noqa: E402
from obsnet.learn.networks import AzimuthNetworkConfig  # noqa: E402
from obsnet.learn.task import TrainerConfig, load_weights  # noqa: E402
from obsnet.output import locked  # noqa: E402
from obsnet.signals.spectra import SpectraConfig  # noqa: E402

NETWORK = AzimuthNetworkConfig(hidden=4, gates=2, harmonics=6, azimuths=24, width=4, kernel=3)
TRAINER = TrainerConfig(epochs=2, batch=4, patience=5)


def made_record(name, split, ship, seed):
    """Half an hour of cells: noise, and with a ship a tenth of the frequencies that point to it."""
    rng = np.random.default_rng(seed)
    minute = 1369130400.0 + 60.0 * np.arange(30)
    count, width = 3 * 34, 266
    first = int((minute[0] - 100.0 - 10.0) // 20)
    angle = rng.uniform(-1, 1, (count, width))
    azimuth = rng.uniform(0, 360)
    if ship:
        angle[:, 40:70] = (azimuth / 180 + 0.03 * rng.standard_normal((count, 30)) + 1) % 2 - 1
    invariants = rng.uniform(0, 0.4, (count, 12, width))
    invariants[:, 4, 40:70] += 0.5 * ship
    shape = (30, int(ship))
    arrays = {
        "cell_index": first + np.arange(count),
        "invariants": invariants.astype(np.float16),
        "phasor": (32767 * angle).astype(np.int16),
        "minute": minute,
        "azimuth_deg": np.full(shape, azimuth, np.float32),
        "range_m": np.full(shape, 2e4, np.float32),
        "known": np.ones(shape, bool),
    }
    attributes = {"id": name, "split": split, "source": "twin", "absence_known": True, "ambiguity_deg": 360}
    return Record(attributes, arrays)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    made = PreparedSet(tmp_path_factory.mktemp("prepared"))
    for split, number in (("train", 12), ("validation", 6), ("test", 4)):
        for i in range(number):
            made.write(made_record(f"{split}-{i}", split, i % 2 == 0, 100 * number + i))
    return made


@pytest.fixture(scope="module")
def run(prepared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    training.train(prepared, folder, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    return folder


def test_records_come_back_as_they_were_written(prepared):
    record, again = made_record("train-0", "train", True, 1200), prepared.read("train-0")
    for name, values in record.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], values)
    assert prepared.names("validation") == [f"validation-{i}" for i in range(6)]
    assert len(prepared.digest()) == 64 and prepared.digest() == PreparedSet(prepared.folder).digest()


def test_an_empty_folder_is_no_set(tmp_path):
    with pytest.raises(ConfigError, match=r"prepare\.py"):
        AzimuthRows(PreparedSet(tmp_path), "train")


def test_weights_say_where_they_come_from(run, prepared):
    _, about = load_weights(run / "weights.pt")
    assert about["data_digest"] == prepared.digest()
    assert about["trainer"]["seed"] == 0 and about["labels"]["prior_odds"] == pytest.approx(1.0)
    assert about["metrics"]["test_minutes_with"] == 60
    assert (run / "log" / "version_0" / "metrics.csv").read_text().count("\n") >= 3


def test_trained_weights_are_calibrated_anew_and_stay_as_they_are(run, prepared, tmp_path):
    other = PreparedSet(tmp_path / "other")
    for split, number in (("validation", 8), ("test", 2)):
        for i in range(number):
            other.write(made_record(f"{split}-{i}", split, i % 4 == 0, 9000 + 100 * number + i))
    none, labels, silent = replace(TRAINER, epochs=0), AzimuthTaskConfig(), lambda text: None
    first = run / "weights.pt"
    training.train(other, tmp_path / "new", NETWORK, labels, none, say=silent, begin_with=first)
    (state, before), (after, about) = load_weights(first), load_weights(tmp_path / "new" / "weights.pt")
    assert all(torch.equal(state[name], after[name]) for name in state)
    assert about["calibration"]["highest"] > before["calibration"]["highest"]  # more windows to tell from
    assert about["calibration"]["prior_odds"] == before["calibration"]["prior_odds"]
    assert about["metrics"]["validation_minutes_without"] == 3 * about["metrics"]["validation_minutes_with"]
    assert about["trained"]["data_digest"] == before["data_digest"] != about["data_digest"] == other.digest()
    again = tmp_path / "new" / "weights.pt"
    training.train(prepared, tmp_path / "newer", NETWORK, labels, none, say=silent, begin_with=again)
    assert load_weights(tmp_path / "newer" / "weights.pt")[1]["trained"] == about["trained"]
    card = ModelFile.read(export(again, tmp_path / "azimuth.onnx"), "azimuth").card
    assert card.about["trained"]["data_digest"] == before["data_digest"]
    assert card.data_digest == other.digest()


def test_no_epochs_train_nothing(run, prepared, tmp_path):
    none, silent = replace(TRAINER, epochs=0), lambda text: None
    with pytest.raises(ConfigError, match=r"trainer\.epochs"):
        training.train(prepared, tmp_path / "new", NETWORK, AzimuthTaskConfig(), none, say=silent)
    with pytest.raises(ConfigError, match=r"trainer\.epochs"):
        training.finetune(prepared, tmp_path / "new", run / "weights.pt", trainer=none, say=silent)
    assert not (tmp_path / "new").exists()


def test_the_same_seed_gives_the_same_weights(run, prepared, tmp_path):
    training.train(prepared, tmp_path, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    first, again = (load_weights(folder / "weights.pt")[0] for folder in (run, tmp_path))
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_training_goes_on_where_it_was_interrupted(run, prepared, tmp_path, monkeypatch):
    calls, loss = [], training.AzimuthProblem.loss

    def failing(*arguments):
        calls.append(arguments)
        if len(calls) == 20:
            raise OSError("the power fails")
        return loss(*arguments)

    monkeypatch.setattr(training.AzimuthProblem, "loss", failing)
    with pytest.raises(OSError, match="power"):
        training.train(prepared, tmp_path, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["epoch"] == 0
    training.train(prepared, tmp_path, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    whole, resumed = (load_weights(folder / "weights.pt")[0] for folder in (run, tmp_path))
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)


def test_a_folder_belongs_to_one_training(run, prepared, tmp_path):
    """More passages, or another experiment in its folder, are another training, not the old one under a new name."""
    grown = PreparedSet(tmp_path)
    for record in prepared.records():
        grown.write(record)
    grown.write(made_record("train-new", "train", True, 7))
    before = (run / "weights.pt").read_bytes()
    with pytest.raises(ConfigError, match=r"a training with data = .*; name another folder"):
        training.train(grown, run, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    with pytest.raises(ConfigError, match="name another folder"):
        training.finetune(prepared, run, run / "weights.pt", trainer=TRAINER, say=lambda text: None)
    assert (run / "weights.pt").read_bytes() == before


def test_one_training_at_a_time_in_a_folder(prepared, tmp_path):
    """Two seeds of a sweep that are given one folder would write into each other's weights."""
    with locked(tmp_path, alone=True), pytest.raises(ConfigError, match="another training is under way"):
        training.train(prepared, tmp_path, NETWORK, AzimuthTaskConfig(), TRAINER, say=lambda text: None)
    assert not (tmp_path / "weights.pt").exists()


def test_files_that_are_no_weights_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"train\.py"):
        load_weights(tmp_path / "none.pt")
    (tmp_path / "junk.pt").write_bytes(b"junk")
    with pytest.raises(ModelError, match="no weights"):
        load_weights(tmp_path / "junk.pt")


def test_bounds_keep_the_shape_of_a_map():
    ratio = torch.tensor([[1.0, 20.0, 18.0, -9.0]])
    torch.testing.assert_close(bounded(ratio, -8.0, 12.0), torch.tensor([[-7.0, 12.0, 10.0, -8.0]]))


@pytest.fixture(scope="module")
def model(run, tmp_path_factory):
    return export(run / "weights.pt", tmp_path_factory.mktemp("model") / "azimuth.onnx")


def test_the_file_says_what_pytorch_says(run, prepared, model):
    assert parity(run / "weights.pt", model, [prepared.folder]) < 1e-4
    assert model.stat().st_size < 2_000_000


def test_without_calibration_the_file_says_what_the_network_says(run, prepared, tmp_path):
    raw = export(run / "weights.pt", tmp_path / "raw.onnx", calibrate=False)
    assert parity(run / "weights.pt", raw, [prepared.folder], calibrate=False) < 1e-4
    assert ModelFile.read(raw, "azimuth").card.calibration["slope"] == [1.0, 1.0]


def test_parity_fails_for_other_weights(prepared, model, tmp_path):
    other = replace(TRAINER, seed=5, epochs=1)
    training.train(prepared, tmp_path, NETWORK, AzimuthTaskConfig(), other, say=lambda text: None)
    with pytest.raises(ModelError, match="differs"):
        parity(tmp_path / "weights.pt", model, [prepared.folder])


def test_the_card_travels_with_the_file(model, prepared):
    found = ModelFile.read(model, "azimuth")
    assert found.card.data_digest == prepared.digest()
    assert found.card.grids == {"minutes": 10, "frequencies": 266, "azimuths": 24}
    detector = LearnedAzimuthDetector(model=model)
    assert detector.card.representation["features"]["fmax_hz"] == 24.0


def test_a_model_that_does_not_fit_is_refused(model):
    with pytest.raises(ModelError, match="hop_s"):
        LearnedAzimuthDetector(spectra=SpectraConfig(hop_s=5.12), model=model)
    with pytest.raises(ModelError, match="up to 24 Hz"):
        LearnedAzimuthDetector(spectra=SpectraConfig(analysis_rate_hz=25.0), model=model)
    with pytest.raises(ModelError, match="not for range"):
        ModelFile.read(model, "range")


def altered(model, path, change):
    proto = onnx.load(model)
    change(proto)
    path.write_bytes(proto.SerializeToString())
    return path


def test_altered_files_are_refused(model, tmp_path):
    content = bytearray(model.read_bytes())
    content[len(content) // 2] ^= 1
    target = tmp_path / "azimuth.onnx"
    target.write_bytes(bytes(content))
    (tmp_path / "azimuth.onnx.sha256").write_text((model.parent / "azimuth.onnx.sha256").read_text())
    with pytest.raises(ModelError, match="altered"):
        ModelFile.read(target)
    for digest in (b"", b" \n", b"\xff\xfe"):
        (tmp_path / "azimuth.onnx.sha256").write_bytes(digest)
        with pytest.raises(ModelError, match="altered"):
            ModelFile.read(target)
    (tmp_path / "half.onnx").write_bytes(model.read_bytes()[: len(content) // 2])
    with pytest.raises(ModelError, match="damaged"):
        ModelFile.read(tmp_path / "half.onnx")
    (tmp_path / "large.onnx").write_bytes(bytes(2_000_001))
    with pytest.raises(ModelError, match="at most 2000000"):
        ModelFile.read(tmp_path / "large.onnx")


def test_models_that_could_do_more_than_compute_are_refused(model, tmp_path):
    def external(proto):
        tensor = proto.graph.initializer[0]
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="/etc/passwd")

    with pytest.raises(ModelError, match="other files"):
        ModelFile.read(altered(model, tmp_path / "external.onnx", external))

    def operator(proto):
        proto.graph.node[0].op_type = "PyOp"
        proto.graph.node[0].domain = "ai.onnx.contrib"

    with pytest.raises(ModelError, match=r"ai\.onnx\.contrib\.PyOp"):
        ModelFile.read(altered(model, tmp_path / "operator.onnx", operator))

    def nested(proto):
        graph = onnx.helper.make_graph([], "inner", [], [])
        proto.graph.node[0].attribute.append(onnx.helper.make_attribute("then_branch", graph))

    with pytest.raises(ModelError, match="graphs within"):
        ModelFile.read(altered(model, tmp_path / "nested.onnx", nested))

    def cardless(proto):
        del proto.metadata_props[:]

    with pytest.raises(ModelError, match="no card"):
        ModelFile.read(altered(model, tmp_path / "cardless.onnx", cardless))


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("grids", "minutes", None),
        ("grids", "azimuths", float("nan")),
        ("representation", "spectra", "x"),
        ("representation", "features", {}),
        ("representation", "channels", None),
    ],
)
def test_a_card_that_says_too_little_is_refused(model, tmp_path, section, key, value):
    def less(proto):
        card = json.loads(proto.metadata_props[0].value)
        card[section][key] = value
        proto.metadata_props[0].value = json.dumps(card)

    with pytest.raises(ModelError, match=f"incomplete: {section}.{key}"):
        ModelFile.read(altered(model, tmp_path / "less.onnx", less))


def test_the_card_of_an_adapted_model_tells_of_the_adaptation(run, prepared, tmp_path):
    about = load_weights(run / "weights.pt")[1]
    tuned = {
        "adapted": 1.0,
        "loss_before": 2.0,
        "loss_after": 1.5,
        "data_digest": "d",
        "set": {"commit": "c"},
    }
    for adapted in (1.0, 0.0):
        network = training.restored(run / "weights.pt")[0]
        told = about | {"finetune": tuned | {"adapted": adapted}}
        training.save_weights(tmp_path / "weights.pt", network, told)
        card = ModelFile.read(export(tmp_path / "weights.pt", tmp_path / "azimuth.onnx")).card
        if adapted:
            assert (card.data_digest, card.commit) == ("d", "c")
            assert card.metrics == {"held_out_loss_before": 2.0, "held_out_loss_after": 1.5}
            assert card.about["before"]["data_digest"] == prepared.digest()
        else:
            assert card.data_digest == prepared.digest() and card.metrics == about["metrics"]
            assert "own passages" not in card.about["trained_on"]


def test_minutes_without_data_say_nothing(tmp_path):
    record = made_record("gap", "train", True, 7)
    begin = record.arrays["cell_index"][0]
    lost = slice(30, 60)  # ten minutes
    record.arrays["phasor"][lost] = NO_PHASOR
    made = PreparedSet(tmp_path)
    made.write(record)
    rows = AzimuthRows(made, "train")
    weight = np.concatenate([rows.seen(item)[1] for item in range(len(rows))])
    minute, gap = record.arrays["minute"], 20.0 * (begin + np.array([lost.start, lost.stop])) + 10.0
    inside = (minute - 90.0 >= gap[0]) & (minute + 90.0 <= gap[1])
    assert inside.sum() == 7
    np.testing.assert_array_equal(weight == 0.0, inside)


def test_passages_of_which_nothing_is_known_adapt_nothing(run, tmp_path):
    made = PreparedSet(tmp_path / "set")
    for split in ("train", "validation"):
        silent = made_record(split, split, split == "train", 1)
        made.write(Record(silent.attributes | {"absence_known": False}, silent.arrays))
    with pytest.raises(ConfigError, match="validation"):
        training.finetune(made, tmp_path / "run", run / "weights.pt", say=lambda text: None)


def test_passages_alone_do_not_teach_that_there_always_is_a_ship(run, tmp_path):
    passages, sea = PreparedSet(tmp_path / "passages"), PreparedSet(tmp_path / "sea")
    for split, number in (("train", 8), ("validation", 4)):
        for i in range(number):
            ship = made_record(f"{split}-{i}", split, True, 500 * number + i)
            passages.write(Record(ship.attributes | {"absence_known": False}, ship.arrays))
    for i in range(4):
        sea.write(made_record(f"test-{i}", "test", False, 70 + i))
    trainer = replace(TRAINER, epochs=4, learning_rate=5e-3)
    training.finetune(passages, tmp_path / "new", run / "weights.pt", trainer=trainer, say=lambda text: None)
    network, _, about = training.restored(tmp_path / "new" / "weights.pt")
    assert about["finetune"]["adapted"]
    rows = AzimuthRows(sea, "test")
    before, after = (
        presence(outputs(each, rows).ratio).mean()
        for each in (training.restored(run / "weights.pt")[0], network)
    )
    assert float(after - before) < 0.2


def test_finetuning_keeps_the_old_weights_unless_held_out_passages_are_better(run, prepared, tmp_path):
    still = replace(TRAINER, epochs=1, learning_rate=1e-12)
    said = []
    found = training.finetune(prepared, tmp_path, run / "weights.pt", trainer=still, say=said.append)
    old, new = (load_weights(folder / "weights.pt")[0] for folder in (run, tmp_path))
    if not found["adapted"]:
        assert all(torch.equal(old[name], new[name]) for name in old)
        assert "kept the old" in said[-1]
    assert json.dumps(load_weights(tmp_path / "weights.pt")[1]["finetune"]["data_digest"])
    spoilt = replace(TRAINER, epochs=1, learning_rate=3.0)
    found = training.finetune(
        prepared, tmp_path / "spoilt", run / "weights.pt", trainer=spoilt, say=said.append
    )
    assert found["adapted"] == 0.0 and found["loss_after"] > found["loss_before"]
    spoilt_state = load_weights(tmp_path / "spoilt" / "weights.pt")[0]
    assert all(torch.equal(old[name], spoilt_state[name]) for name in old)
