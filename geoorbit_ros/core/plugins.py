"""A class of the user's in a file of its own, named as `FILE.py:CLASS` like a built-in one."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

from geoorbit_ros.core.errors import ParameterError

FORM = "FILE.py:CLASS"
_PATTERN = re.compile(r"(?P<file>.+\.py):(?P<name>[A-Za-z_]\w*)")


def is_own_class(text: str) -> bool:
    """Whether a name has that form."""
    return _PATTERN.fullmatch(text) is not None


def file_of(text: str) -> str:
    """The file in such a name; any other text as it is."""
    match = _PATTERN.fullmatch(text)
    return match["file"] if match else text


def make_own(text: str, place: str, methods: tuple[str, ...]) -> Any:
    """An object of the class, made without arguments.

    Args:
        text: `FILE.py:CLASS`.
        place: For errors.
        methods: What it must have.

    Raises:
        ParameterError: No such file or class, one that fails when it is loaded or made, or that
            lacks a method.
    """
    match = _PATTERN.fullmatch(text)
    if match is None:
        raise ParameterError(place, repr(text), FORM)
    file, name = Path(match["file"]).absolute(), match["name"]
    if not file.is_file():
        raise ParameterError(place, f"no file {file}", FORM)
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        made = getattr(module, name)()
    except Exception as error:  # whatever the user's file does
        found = f"{type(error).__name__}: {error}"
        raise ParameterError(
            f"{place}, {file}", found, f"a class {name} without arguments"
        ) from error
    missing = [method for method in methods if not callable(getattr(made, method, None))]
    if missing:
        raise ParameterError(f"{place}, {file}", f"no method {', '.join(missing)}", f"in {name}")
    return made
