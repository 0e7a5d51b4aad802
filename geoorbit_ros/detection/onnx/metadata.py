"""What an export says about itself, in the metadata of its file."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from geoorbit_ros.detection.detector import ModelError

DETECT = "detect"
DEFAULT_STRIDE = 32


@dataclass(frozen=True, slots=True)
class OnnxMetadata:
    """The entries that Ultralytics' exporter writes; other exporters leave them out.

    Attributes:
        task: `detect`; None when the file does not say.
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
    if task is not None and task != DETECT:
        raise ModelError(place, f"a model for the task '{task}'", f"one for the task '{DETECT}'")
    names = _value(entries, "names", place, {})
    if isinstance(names, list | tuple):
        names = dict(enumerate(names))
    _check(isinstance(names, dict), entries, "names", place)
    size = _value(entries, "imgsz", place, None)
    if isinstance(size, int):
        size = [size, size]
    sound = size is None or (isinstance(size, list | tuple) and len(size) == 2)
    _check(sound and all(isinstance(n, int) and n > 0 for n in size or ()), entries, "imgsz", place)
    stride = _value(entries, "stride", place, DEFAULT_STRIDE)
    _check(isinstance(stride, int) and stride > 0, entries, "stride", place)
    arguments = _value(entries, "args", place, {})
    end2end = _value(entries, "end2end", place, None)
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
    try:
        return ast.literal_eval(entries[key])
    except (ValueError, SyntaxError):
        _check(False, entries, key, place)


def _check(sound: bool, entries: Mapping[str, str], key: str, place: str) -> None:
    if not sound:
        found = f"{entries[key]!r:.80}"
        raise ModelError(f"{place}, metadata '{key}'", found, "what `yolo export` writes there")
