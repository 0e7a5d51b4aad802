"""YAML files that people write, checked by a pydantic model.

What is wrong is said in one sentence with file, line, key, value and expectation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from geoorbit_ros.core.errors import InputFileError

Model = TypeVar("Model", bound=BaseModel)
Key = tuple[str | int, ...]
"""Keys and list positions on the way from the file's top to a value."""

_EXPECTED = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing", "finite_number"), "a finite number"),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "keys with values"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    "string_type": "a text",
    "string_pattern_mismatch": "letters, digits and _, a letter first",
}
"""Pydantic's error types in plain words."""


class WrongValue(ValueError):  # noqa: N818 - pydantic collects it, users see InputFileError
    """A value that contradicts another one; raised in validators.

    Args:
        key: Where the value is, below the validated model.
        found: The value.
        expected: What would have been accepted.
    """

    def __init__(self, key: Key, found: object, expected: str) -> None:
        self.key = key
        self.found = found
        self.expected = expected
        super().__init__(f"{spell(key)}: found {found}, expected {expected}")


def spell(key: Iterable[str | int]) -> str:
    """`roads[2].path[0].radius_m`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


class StrictModel(BaseModel):
    """Immutable, without unknown keys, NaN or infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_yaml(file: Path, model: type[Model], kind: str) -> Model:
    """Read a file and check it.

    Args:
        file: In UTF-8.
        model: What it must be.
        kind: What such a file is called, for messages: `scene`, `fleet`.

    Raises:
        InputFileError: No such file, broken YAML, or the first value that the model refuses.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "no text in UTF-8"
        raise InputFileError(str(file), reason.lower(), f"a {kind} file in YAML") from error
    try:
        return model.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise _broken_yaml(error, str(file), kind) from error
    except ValidationError as error:
        raise _wrong_value(error, text, str(file), kind, _keys(model)) from error


def _keys(model: type[BaseModel]) -> list[str]:
    """All keys that a file of this model may have somewhere."""
    schema = model.model_json_schema()
    parts = [schema, *schema.get("$defs", {}).values()]
    return [key for part in parts for key in part.get("properties", {})]


def _broken_yaml(error: yaml.YAMLError, file: str, kind: str) -> InputFileError:
    mark = problem = None
    if isinstance(error, yaml.MarkedYAMLError):
        mark, problem = error.problem_mark, error.problem
    place = f"{file}, line {mark.line + 1}" if mark else file
    found = f"broken YAML ({problem})" if problem else "broken YAML"
    return InputFileError(place, found, f"a {kind} file")


def _wrong_value(
    error: ValidationError, text: str, file: str, kind: str, known_keys: list[str]
) -> InputFileError:
    errors = error.errors()
    # A misspelt key is also a missing one: say what was spelt.
    unknown = [e for e in errors if e["type"] == "extra_forbidden"]
    first = (unknown or errors)[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, WrongValue):
        key, found, expected = (*first["loc"], *cause.key), str(cause.found), cause.expected
    else:
        key = first["loc"]
        found, expected = _words(first, kind, known_keys)
    line, key = _find(text, key)
    place = f"{file}, line {line}" + (f", key '{spell(key)}'" if key else "")
    return InputFileError(place, found, expected)


def _words(error: Mapping[str, Any], kind: str, known_keys: list[str]) -> tuple[str, str]:
    """What was found and expected, from pydantic's error."""
    if error["type"] == "missing" or error["input"] is None:
        return "nothing", _EXPECTED.get(error["type"], "a value")
    if error["type"] == "extra_forbidden":
        close = get_close_matches(str(error["loc"][-1]), known_keys, n=1)
        return "an unknown key", f"'{close[0]}'?" if close else f"a key that {kind} files have"
    value = repr(error["input"])
    value = value if len(value) <= 60 else f"{value[:60]}..."
    return value, _EXPECTED.get(error["type"], error["msg"].removeprefix("Input should be "))


def _find(text: str, key: Sequence[str | int]) -> tuple[int, Key]:
    """Line of a key's value or, where it is missing, of what should hold it; the key, tidied.

    Pydantic puts names of union members between the keys; the file has none of them.
    """
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    line, found = 1, []
    for part in key:
        child = None
        if isinstance(node, yaml.MappingNode):
            for name, value in node.value:
                if name.value == part:
                    child, line = value, name.start_mark.line + 1
        elif (
            isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value)
        ):
            child = node.value[part]
            line = child.start_mark.line + 1
        if child is not None or part == key[-1]:
            found.append(part)
        node = child if child is not None else node
    return line, tuple(found)
