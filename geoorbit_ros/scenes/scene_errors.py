"""What is wrong in a scene file, as one sentence with file, line, key, value and expectation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import yaml
from pydantic import ValidationError

from geoorbit_ros.core.errors import InputFileError

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


def broken_yaml(error: yaml.YAMLError, file: str) -> InputFileError:
    """The error for a file that is no YAML."""
    mark = getattr(error, "problem_mark", None)
    place = f"{file}, line {mark.line + 1}" if mark else file
    problem = getattr(error, "problem", None)
    found = f"broken YAML ({problem})" if problem else "broken YAML"
    return InputFileError(place, found, "a scene file")


def wrong_scene(
    error: ValidationError, text: str, file: str, known_keys: Iterable[str]
) -> InputFileError:
    """The error for the first value that a scene can't have.

    Args:
        error: What pydantic found.
        text: The file's content.
        file: Its name.
        known_keys: All keys that a scene file may have somewhere, to correct a misspelt one.
    """
    errors = error.errors()
    # A misspelt key is also a missing one: say what was spelt.
    unknown = [e for e in errors if e["type"] == "extra_forbidden"]
    first = (unknown or errors)[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, WrongValue):
        key, found, expected = (*first["loc"], *cause.key), str(cause.found), cause.expected
    else:
        key = first["loc"]
        found, expected = _words(first, list(known_keys))
    line, key = _find(text, key)
    place = f"{file}, line {line}" + (f", key '{spell(key)}'" if key else "")
    return InputFileError(place, found, expected)


def _words(error: Mapping[str, Any], known_keys: list[str]) -> tuple[str, str]:
    """What was found and expected, from pydantic's error."""
    if error["type"] == "missing" or error["input"] is None:
        return "nothing", _EXPECTED.get(error["type"], "a value")
    if error["type"] == "extra_forbidden":
        close = get_close_matches(str(error["loc"][-1]), known_keys, n=1)
        return "an unknown key", f"'{close[0]}'?" if close else "a key that scene files have"
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
