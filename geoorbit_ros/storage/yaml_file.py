"""YAML files that people write, checked by a pydantic model.

What is wrong is said in one sentence with file, line, key, value and expectation.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from geoorbit_ros.core.addresses import masked_text
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment, decimal_comma
from geoorbit_ros.storage.yaml_loader import MAX_YAML_BYTES, CoreLoader, load_core

Model = TypeVar("Model", bound=BaseModel)
Key = tuple[str | int, ...]
"""Keys and list positions on the way from the file's top to a value."""

_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
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
    """Immutable, without unknown keys, NaN or infinities.

    With an `InputReport` as validation context, a number with a decimal comma is read as one.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _decimal_comma(cls, value: object, info: ValidationInfo) -> object:
        kind = cls.model_fields[info.field_name].annotation if info.field_name else None
        report = info.context
        if not isinstance(report, InputReport) or kind not in (float, float | None):
            return value
        number = decimal_comma(value)
        if number is None:
            return value
        text = f"{info.field_name}: {value!r} is read as {number:g}"
        report.note(Treatment.REPAIRED, text)
        return number


@dataclass(frozen=True, slots=True)
class YamlText:
    """A YAML file as it was read.

    Attributes:
        file: Its path, for messages.
        kind: What such a file is called, for messages.
        text: Its text.
        content: Its keys and values.
    """

    file: str
    kind: str
    text: str
    content: dict[str, Any]

    def checked(
        self,
        model: type[Model],
        content: object,
        report: InputReport | None = None,
        prefix: Key = (),
    ) -> Model:
        """A part of the file as a model.

        Args:
            model: What it must be.
            content: The part.
            report: Takes what was repaired; None repairs nothing.
            prefix: Where it stands in the file.

        Raises:
            InputFileError: The first value that the model refuses.
        """
        try:
            return model.model_validate(content, context=report)
        except ValidationError as error:
            raise self._wrong_value(error, _keys(model), prefix) from error

    def refusal(self, key: Key, found: str, expected: str) -> InputFileError:
        """An error that names the line and the key of a value."""
        line, key = _find(self.text, key)
        place = f"{self.file}, line {line}" + (f", key '{spell(key)}'" if key else "")
        return InputFileError(place, found, expected)

    def _wrong_value(
        self, error: ValidationError, known_keys: list[str], prefix: Key
    ) -> InputFileError:
        errors = error.errors()
        # A misspelt key is also a missing one: say what was spelt.
        unknown = [e for e in errors if e["type"] == "invalid_key"]
        unknown += [e for e in errors if e["type"] == "extra_forbidden"]
        first = (unknown or errors)[0]
        cause = first.get("ctx", {}).get("error")
        if isinstance(cause, WrongValue):
            key, found, expected = (*first["loc"], *cause.key), str(cause.found), cause.expected
        else:
            key = first["loc"]
            found, expected = _words(first, self.kind, known_keys)
        return self.refusal((*prefix, *key), found, expected)


def read_yaml(file: Path, model: type[Model], kind: str) -> Model:
    """Read a file and check it.

    Args:
        file: In UTF-8 or UTF-16.
        model: What it must be.
        kind: What such a file is called, for messages: `scene`, `fleet`.

    Raises:
        InputFileError: No such file, broken YAML, or the first value that the model refuses.
    """
    text = read_text(file, kind)
    return text.checked(model, text.content)


def read_text(file: Path, kind: str, report: InputReport | None = None) -> YamlText:
    """Read a file as keys with values. Top keys that begin with `x-`, for anchors, are left out.

    Args:
        file: In UTF-8 or UTF-16.
        kind: What such a file is called, for messages.
        report: Takes what was repaired; None repairs nothing.

    Raises:
        InputFileError: No such file, broken YAML, or something else than keys with values.
    """
    expected = f"a {kind} file in YAML"
    try:
        if (size := file.stat().st_size) > MAX_YAML_BYTES:
            raise InputFileError(str(file), f"{size} bytes", f"{expected} of {MAX_YAML_BYTES}")
        data = file.read_bytes()
        text = data.decode("utf-16" if data[:2] in _UTF_16 else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "no text in UTF-8"
        raise InputFileError(str(file), reason.lower(), expected) from error
    try:
        content = _load(text)
    except yaml.YAMLError as error:
        spaced = _without_tabs(text) if report is not None else None
        if spaced is None or report is None:
            raise _broken_yaml(error, str(file), kind) from error
        text, content = spaced, _load(spaced)
        report.note(Treatment.REPAIRED, "tabs in the indentation are read as blanks")
    if content is None:
        raise InputFileError(str(file), "an empty file", expected)
    if not isinstance(content, dict):
        found = "a list" if isinstance(content, list) else "a text without keys"
        raise InputFileError(str(file), found, f"{expected}: keys with values, such as 'name: …'")
    kept = {str(key): value for key, value in content.items() if not str(key).startswith("x-")}
    return YamlText(str(file), kind, text, kept)


_END = re.compile(r"\n---\s*\Z")
"""The beginning of one more document, with nothing in it: so `ros2 topic echo` ends a message."""


def _load(text: str) -> object:
    return load_core(_END.sub("\n", text))


def _without_tabs(text: str) -> str | None:
    """The text with blanks for tabs, where it means one thing however wide they are."""
    found: list[tuple[str, object]] = []
    for width in (2, 4, 8):
        spaced = text.expandtabs(width)
        with suppress(yaml.YAMLError):  # then it does not mean the same
            found.append((spaced, _load(spaced)))
    same = bool(found) and all(content == found[0][1] for _, content in found)
    return found[0][0] if same and "\t" in text else None


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
    if problem and problem.startswith("key "):
        return InputFileError(place, problem, "each key once")
    if problem and "'\\t'" in problem:
        return InputFileError(place, "a tab in the indentation", f"blanks, as in a {kind} file")
    found = f"broken YAML ({problem})" if problem else "broken YAML"
    return InputFileError(place, found, f"a {kind} file")


def _words(error: Mapping[str, Any], kind: str, known_keys: list[str]) -> tuple[str, str]:
    """What was found and expected, from pydantic's error."""
    if error["type"] == "missing" or error["input"] is None:
        return "nothing", _EXPECTED.get(error["type"], "a value")
    if error["type"] == "invalid_key":
        return f"the key {error['input']}", "a word (in braces a comma separates: write 43.25)"
    if error["type"] == "extra_forbidden":
        close = get_close_matches(str(error["loc"][-1]), known_keys, n=1)
        return "an unknown key", f"'{close[0]}'?" if close else f"a key that {kind} files have"
    value = masked_text(repr(error["input"]))
    value = value if len(value) <= 60 else f"{value[:60]}..."
    if error["loc"] and error["loc"][-1] == "bool" and error["type"] == "bool_type":
        return value, "a number, a text, true or false"  # the first member of a union of these
    return value, _EXPECTED.get(error["type"], error["msg"].removeprefix("Input should be "))


def _find(text: str, key: Sequence[str | int]) -> tuple[int, Key]:
    """Line of a key's value or, where it is missing, of what should hold it; the key, tidied.

    Pydantic puts names of union members between the keys; the file has none of them.
    """
    node = yaml.compose(text, Loader=CoreLoader)
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
