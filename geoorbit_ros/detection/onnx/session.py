"""An ONNX file in onnxruntime: its metadata, its input and its outputs, all checked."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.detection.detector import ModelError

_PREFERRED = (
    "CUDAExecutionProvider",
    "ROCMExecutionProvider",
    "OpenVINOExecutionProvider",
    "CoreMLExecutionProvider",
    "CPUExecutionProvider",
)
"""Without a wish: of these, all that this onnxruntime has. TensorRT only on request: it compiles
for minutes first."""
_TYPES: dict[str, type[np.number]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_DEFAULT_SIDE_PX = 640
"""Width and height of an input of open size whose file doesn't say: the default of `yolo
export`."""
_ERRORS_ONLY = 3
"""onnxruntime's log level for errors and worse."""
_TASKS = ("detect", "segment")
MAX_METADATA = 200_000
"""Characters of an entry. Chosen: 600 class names have 15,000; Python's parser takes a thousand
times the length in memory, and a model is a file of somebody else."""
MAX_NUMBER = 1 << 20
"""Largest size, stride or class number that a model may name."""
_DEFAULT_STRIDE = 32
"""Inputs are multiples of this where the file doesn't say: the stride of all YOLO models without
P6."""


@dataclass(frozen=True, slots=True)
class OnnxMetadata:
    """The entries that Ultralytics' exporter writes; other exporters leave them out.

    Attributes:
        task: `detect` or `segment`; None when the file does not say.
        names: Name of each class; empty when the file does not say.
        stride: Sizes of the input are multiples of it.
        canvas: Width and height of the input; None when the file does not say.
        dynamic: Whether the input may be smaller than `canvas`.
        end2end: Whether the model needs no suppression; None when the file does not say.
    """

    task: str | None
    names: dict[int, str]
    stride: int
    canvas: tuple[int, int] | None
    dynamic: bool
    end2end: bool | None


def parse_metadata(entries: Mapping[str, str], place: str) -> OnnxMetadata:
    """The metadata of a model whose file is `place`.

    Raises:
        ModelError: A task that finds no boxes, or an entry that can't be read.
    """
    task = entries.get("task")
    if task is not None and task not in _TASKS:
        raise ModelError(place, f"a model for the task '{task}'", "one for the task 'detect'")
    names = _value(entries, "names", place, {})
    if isinstance(names, list | tuple):
        names = dict(enumerate(names))
    _check(isinstance(names, dict) and all(map(_is_number, names)), entries, "names", place)
    size = _value(entries, "imgsz", place, None)
    if isinstance(size, int):
        size = [size, size]
    sound = size is None or (isinstance(size, list | tuple) and len(size) == 2)
    _check(sound and all(_is_number(n, 1) for n in size or ()), entries, "imgsz", place)
    stride = _value(entries, "stride", place, _DEFAULT_STRIDE)
    _check(_is_number(stride, 1), entries, "stride", place)
    arguments = _value(entries, "args", place, {})
    end2end = _value(entries, "end2end", place, None)
    if isinstance(arguments, dict) and arguments.get("nms"):
        end2end = True
    return OnnxMetadata(
        task=task,
        names={int(number): str(name) for number, name in names.items()},
        stride=stride,
        canvas=(size[1], size[0]) if size else None,
        dynamic=isinstance(arguments, dict) and bool(arguments.get("dynamic", False)),
        end2end=None if end2end is None else bool(end2end),
    )


def _value(entries: Mapping[str, str], key: str, place: str, default: Any) -> Any:
    """An entry, which holds a Python literal as text."""
    if key not in entries:
        return default
    _check(len(entries[key]) <= MAX_METADATA, entries, key, place)
    try:
        return ast.literal_eval(entries[key])
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        _check(False, entries, key, place)


def _is_number(value: object, least: int = 0) -> bool:
    """Whether a value is a whole number of a sensible size, or in digits."""
    if isinstance(value, str) and value.isascii() and value.isdecimal() and len(value) < 8:
        value = int(value)
    return isinstance(value, int) and least <= value <= MAX_NUMBER


def _check(sound: bool, entries: Mapping[str, str], key: str, place: str) -> None:
    if not sound:
        found = f"{entries[key]!r:.80}"
        raise ModelError(f"{place}, metadata '{key}'", found, "what `yolo export` writes there")


@dataclass(frozen=True, slots=True)
class OnnxSession:
    """A loaded model.

    Attributes:
        place: Its file, for errors.
        session: The onnxruntime session.
        input_name: Of its image.
        size_name: Of the input that is told the size in which boxes are wanted; empty: none.
        metadata: What the file says about itself.
        canvas: Width and height of its input, at most where `metadata.dynamic`.
        batch: Images per run; 0 when any number is taken.
        dtype: Type of its input; uint8: samples from 0 to 255.
        channels_last: Whether its input is (B, H, W, 3).
    """

    place: str
    session: onnxruntime.InferenceSession
    input_name: str
    size_name: str
    metadata: OnnxMetadata
    canvas: tuple[int, int]
    batch: int
    dtype: type[np.number]
    channels_last: bool

    def run(self, tensor: NDArray[np.number]) -> list[NDArray[np.float32]]:
        """All outputs as float32 for a tensor (B, 3, H, W) of `dtype`.

        Raises:
            ModelError: The model fails on it.
        """
        size = tensor.shape[3], tensor.shape[2]
        if self.channels_last:
            tensor = np.ascontiguousarray(tensor.transpose(0, 2, 3, 1))
        try:
            given = {self.input_name: tensor}
            if self.size_name:  # Boxes are wanted in the canvas, as from other models.
                given[self.size_name] = np.array([size] * len(tensor), np.int64)
            outputs = self.session.run(None, given)
        except Exception as error:  # onnxruntime's classes share no other base
            found = f"a failure on an input of {'x'.join(map(str, tensor.shape))}: {_first(error)}"
            raise ModelError(self.place, found, "a model that runs on its own input") from None
        return [_float32(output) for output in outputs]


def load_session(path: Path, providers: Sequence[str] = (), threads: int = 0) -> OnnxSession:
    """Load a model file.

    Args:
        path: An `.onnx` file.
        providers: onnxruntime's execution providers, best first; none takes the best there is.
        threads: Threads within one operator on the CPU; 0 leaves it to onnxruntime.

    Raises:
        ModelError: No such file, one that onnxruntime can't load, or an input that is no image.
        ParameterError: A provider that this onnxruntime lacks.
    """
    place = str(path)
    if not path.is_file():
        raise ModelError(place, "no such file", "an ONNX model (yolo export format=onnx)")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    options.intra_op_num_threads = threads
    # Threads that spin between frames take the cores that other nodes need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(
            place, options, providers=_usable(providers, "providers")
        )
    except ParameterError:
        raise
    except Exception as error:  # onnxruntime's classes share no other base
        found = f"{path.stat().st_size} bytes that onnxruntime can't load ({_first(error)})"
        raise ModelError(place, found, "a whole ONNX model (yolo export format=onnx)") from None
    metadata = parse_metadata(session.get_modelmeta().custom_metadata_map, place)
    inputs = sorted(session.get_inputs(), key=lambda i: -len(i.shape))
    shape = list(inputs[0].shape) if inputs else []
    kind = inputs[0].type if inputs else ""
    sizes = [i.name for i in inputs[1:] if i.type == "tensor(int64)" and len(i.shape) == 2]
    sound = len(inputs) - len(sizes) == 1 and len(sizes) < 2
    sound = sound and len(shape) == 4 and kind in _TYPES
    channels_last = sound and shape[3] == 3 and shape[1] != 3
    if not sound or (isinstance(shape[1], int) and shape[1] != 3 and not channels_last):
        each = " and ".join(f"{'x'.join(map(str, i.shape))} {i.type}" for i in inputs)
        expected = "one input Bx3xHxW or BxHxWx3 of floats or bytes"
        raise ModelError(place, f"input {each or 'of nothing'}", expected)
    said = metadata.canvas or (_DEFAULT_SIDE_PX, _DEFAULT_SIDE_PX)
    sides = shape[1:3] if channels_last else shape[2:]
    height, width = (n if isinstance(n, int) else said[1 - k] for k, n in enumerate(sides))
    batch = shape[0] if isinstance(shape[0], int) else 0
    size_name = sizes[0] if sizes else ""
    known = (metadata, (width, height), batch, _TYPES[kind], channels_last)
    return OnnxSession(place, session, inputs[0].name, size_name, *known)


def _usable(wanted: Sequence[str], place: str) -> list[str]:
    available = onnxruntime.get_available_providers()
    missing = [name for name in wanted if name not in available]
    if missing:
        raise ParameterError(place, ", ".join(missing), f"of {', '.join(available)}")
    return list(wanted) or [name for name in _PREFERRED if name in available]


def _float32(output: object) -> NDArray[np.float32]:
    """Half precision becomes float32; anything but an array of floats stays, to be refused."""
    array = np.asarray(output)
    return array.astype(np.float32, copy=False) if array.dtype.kind == "f" else array


def _first(error: Exception) -> str:
    """The first line of onnxruntime's message, without its code."""
    line = str(error).strip().partition("\n")[0]
    return line.rpartition(" : ")[2][:160] if " : " in line else line[:160]
