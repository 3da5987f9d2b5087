"""ONNX files in, models that may be trusted out: what a model is, whether it is the one that was shipped, how it is run.

A file is looked at before onnxruntime sees it: its size, its digest, its operators, that it refers to no other file, and
the card in its metadata, which is authoritative for the representation that the model was trained on.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from obsnet.errors import ModelError

MOST_BYTES = 2_000_000
CARD_KEY = "obsnet"
MODELS = Path(__file__).resolve().parents[1] / "models"
OPERATORS = frozenset(
    [
        "Abs",
        "Add",
        "Cast",
        "Clip",
        "Concat",
        "Constant",
        "ConstantOfShape",
        "Conv",
        "Div",
        "Equal",
        "Erf",
        "Exp",
        "Expand",
        "Flatten",
        "Floor",
        "Gather",
        "Gemm",
        "Greater",
        "GreaterOrEqual",
        "Identity",
        "Less",
        "Log",
        "MatMul",
        "Max",
        "Min",
        "Mul",
        "Neg",
        "Not",
        "Pad",
        "Pow",
        "Reciprocal",
        "ReduceMax",
        "ReduceMean",
        "ReduceSum",
        "Relu",
        "Reshape",
        "Shape",
        "Sigmoid",
        "Sign",
        "Slice",
        "Softplus",
        "Split",
        "Sqrt",
        "Squeeze",
        "Sub",
        "Tanh",
        "Tile",
        "Transpose",
        "Unsqueeze",
        "Where",
    ]
)
"""Operators of the models; none reads files or runs code."""

NUMBERS = {
    "azimuth": (
        "grids.minutes",
        "grids.frequencies",
        "grids.azimuths",
        "representation.bin_s",
        "representation.features.fmax_hz",
        "representation.spectra.window_s",
        "representation.spectra.hop_s",
    ),
    "range": (
        "representation.features.range_step_m",
        "representation.features.range_rate_step_mps",
        "representation.spectra.window_s",
        "representation.spectra.hop_s",
        "representation.spectra.analysis_rate_hz",
        "calibration.slope",
    ),
}
"""What the card of each task must state as a number above 0; the calibration of an azimuth model is within its graph."""
LISTS = {"azimuth": ("channels",), "range": ("context", "globals")}
"""Of the representation, what must be a list of names."""


@dataclass(frozen=True)
class ModelCard:
    """What a model says of itself.

    Attributes
    ----------
    task : "azimuth" or "range".
    representation : parameters of the front end that it was trained on. grids : of input and output.
    calibration, metrics : fitted and measured on simulated records.
    data_digest, commit : of the training set and of the code. about : everything else.
    """

    task: str
    representation: dict[str, Any]
    grids: dict[str, Any]
    calibration: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    data_digest: str = ""
    commit: str = ""
    about: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> str:
        """As it stands in a file's metadata."""
        return json.dumps(vars(self), sort_keys=True, default=str)

    @classmethod
    def from_json(cls, text: str, where: str = "the model") -> ModelCard:
        """Read a card; `ModelError` where it is none."""
        try:
            values = json.loads(text)
            card = cls(**values)
        except (ValueError, TypeError, RecursionError) as error:
            raise ModelError(f"the card of {where} cannot be read: {error}; export the model again") from None
        if card.task not in ("azimuth", "range"):
            raise ModelError(f"the card of {where} is of no task of obsnet; export the model again")
        lists = [f"representation.{name}" for name in LISTS[card.task]]
        wanting = [name for name in NUMBERS[card.task] if not _is_positive(card.stated(name))]
        wanting += [name for name in lists if not isinstance(card.stated(name), list)]
        if wanting:
            raise ModelError(f"the card of {where} is incomplete: {wanting[0]}; export the model again")
        return card

    def stated(self, name: str) -> Any:
        """What the card says at a dotted name; None where it says nothing."""
        held: Any = vars(self)
        for key in name.split("."):
            held = held.get(key) if isinstance(held, dict) else None
        return held


@dataclass(frozen=True)
class ModelFile:
    """A file that has been looked at: its bytes, SHA-256, operators and card."""

    path: Path
    content: bytes = field(repr=False)
    digest: str
    operators: tuple[str, ...]
    card: ModelCard

    @classmethod
    def read(cls, path: str | Path, task: str | None = None) -> ModelFile:
        """Read and check a file.

        Raises
        ------
        ModelError : too large, no ONNX of obsnet, altered, of another task, or with parts that obsnet does not run.
        """
        path = Path(path)
        try:
            size = path.stat().st_size
            content = path.read_bytes() if size <= MOST_BYTES else b""
        except OSError as error:
            raise ModelError(f"cannot read the model {path}: {error.strerror}") from None
        if size > MOST_BYTES:
            raise ModelError(f"{path} has {size} bytes; models of obsnet have at most {MOST_BYTES}")
        digest = hashlib.sha256(content).hexdigest()
        _check_digest(path, digest)
        try:
            graph = _Graph.of(content)
        except (ValueError, IndexError, UnicodeDecodeError):
            raise ModelError(f"{path} is no ONNX model, or is damaged; get it again") from None
        strange = sorted(set(graph.operators) - OPERATORS)
        if strange:
            raise ModelError(f"{path} uses operators that obsnet does not run: {', '.join(strange[:5])}")
        if graph.external or graph.nested:
            kind = "data in other files" if graph.external else "graphs within operators"
            raise ModelError(f"{path} holds {kind}, which obsnet does not run; export it as one plain file")
        if CARD_KEY not in graph.metadata:
            raise ModelError(f"{path} carries no card of obsnet; export it with export/to_onnx.py")
        card = ModelCard.from_json(graph.metadata[CARD_KEY], str(path))
        if task is not None and card.task != task:
            raise ModelError(f"{path} is a model for {card.task}, not for {task}; give the other file")
        return cls(path, content, digest, tuple(sorted(set(graph.operators))), card)

    def session(self, threads: int = 1) -> Any:
        """An onnxruntime session: stated threads, no spinning, no arena, no telemetry.

        From 1.31 on, onnxruntime keeps a device's identity and sends what it does to its makers, unless told not to
        before it is imported.

        Raises
        ------
        ModelError : onnxruntime refuses the model.
        """
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
        import onnxruntime

        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.enable_cpu_mem_arena = options.enable_mem_pattern = False
        options.log_severity_level = 3
        for key in ("session.intra_op.allow_spinning", "session.inter_op.allow_spinning"):
            options.add_session_config_entry(key, "0")
        try:
            return onnxruntime.InferenceSession(self.content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no class of their own
            line = " ".join(str(error).split())[:160]
            raise ModelError(f"onnxruntime cannot load {self.path}: {line}") from None


def _is_positive(value: Any) -> bool:
    return isinstance(value, (int, float)) and 0 < value < np.inf


def shipped(task: str) -> Path:
    """The model of a task that comes with obsnet."""
    path = MODELS / f"{task}.onnx"
    if not path.is_file():
        raise ModelError(f"no learned {task} detector is shipped with this obsnet; use --detector analytic")
    return path


def check_shapes(
    session: Any, inputs: dict[str, tuple[int | None, ...]], output: tuple[int | None, ...]
) -> None:
    """Raise `ModelError` unless a session takes and gives float32 of these shapes; None is a free length."""
    found = {item.name: item for item in session.get_inputs()}
    given = session.get_outputs()
    if set(found) != set(inputs) or len(given) != 1:
        raise ModelError(f"the model takes {', '.join(found)}; expected {', '.join(inputs)}; export it again")
    for name, item, wanted in (
        *((name, found[name], shape) for name, shape in inputs.items()), (given[0].name, given[0], output)
    ):  # fmt: skip
        shape = tuple(size if isinstance(size, int) else None for size in item.shape)
        if item.type != "tensor(float)" or shape != wanted:
            raise ModelError(
                f"the model's {name} is {item.type} {shape}, its card says {wanted}; export it again"
            )


def run(session: Any, feeds: dict[str, np.ndarray]) -> np.ndarray:
    """The session's one output; `ModelError` where onnxruntime fails."""
    try:
        return np.asarray(session.run(None, feeds)[0])
    except Exception as error:  # onnxruntime's errors share no class of their own
        raise ModelError(f"onnxruntime failed: {' '.join(str(error).split())[:160]}") from None


def _check_digest(path: Path, digest: str) -> None:
    """A shipped file must be the one that was shipped; another the one that its ``.sha256`` names, where there is one."""
    beside = path.with_name(path.name + ".sha256")
    known: str | None = digest
    try:
        if path.resolve().parent == MODELS:
            known = json.loads((MODELS / "digests.json").read_text()).get(path.name)
        elif beside.is_file() and beside.stat().st_size < 1000:
            known = [*beside.read_text().split(), ""][0]
    except (OSError, ValueError):
        known = None
    if known != digest:
        raise ModelError(
            f"{path} was altered: its SHA-256 is not the one on record; reinstall or export it again"
        )


@dataclass
class _Graph:
    """What the wire format of an ONNX file says, read without onnxruntime."""

    operators: list[str] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    external: bool = False
    nested: bool = False

    @classmethod
    def of(cls, content: bytes) -> _Graph:
        """Read a ModelProto: 7 is its graph, 14 its metadata, 25 functions of its own."""
        found, graphs = cls(), 0
        for number, value in _fields(content):
            if number == 7 and isinstance(value, bytes):
                graphs += 1
                found._read_graph(value)
            elif number == 14 and isinstance(value, bytes):
                entry = {n: v.decode() for n, v in _fields(value) if isinstance(v, bytes)}
                found.metadata[entry.get(1, "")] = entry.get(2, "")
            elif number == 25:
                found.nested = True
        if graphs != 1 or not found.operators:
            raise ValueError("no graph")
        return found

    def _read_graph(self, graph: bytes) -> None:
        for number, value in _fields(graph):
            if number == 1 and isinstance(value, bytes):
                self._read_node(value)
            elif number == 5 and isinstance(value, bytes):
                self._read_tensor(value)
            elif number == 15:
                self.nested = True

    def _read_node(self, node: bytes) -> None:
        domain = ""
        for number, value in _fields(node):
            if number == 4 and isinstance(value, bytes):
                self.operators.append(value.decode())
            elif number == 7 and isinstance(value, bytes):
                domain = value.decode()
            elif number == 5 and isinstance(value, bytes):
                for inner, held in _fields(value):
                    self.nested |= inner in (6, 11)
                    if inner in (5, 10) and isinstance(held, bytes):
                        self._read_tensor(held)
        if domain not in ("", "ai.onnx"):
            self.operators.append(f"{domain}.{self.operators.pop()}")

    def _read_tensor(self, tensor: bytes) -> None:
        self.external |= any(number == 13 or (number == 14 and value) for number, value in _fields(tensor))


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Field numbers and values of a protocol buffer's message."""
    place = 0
    while place < len(message):
        key, place = _varint(message, place)
        kind = key & 7
        if kind == 0:
            value, place = _varint(message, place)
            yield key >> 3, value
            continue
        if kind == 2:
            length, place = _varint(message, place)
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
        else:
            raise ValueError("unknown wire type")
        if place + length > len(message):
            raise ValueError("cut short")
        yield key >> 3, message[place : place + length]
        place += length


def _varint(message: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 64:
        byte = message[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place
    raise ValueError("number too long")
