"""Reading YAML of others: bounded in what it stands for, and by YAML 1.2's core schema."""

from __future__ import annotations

import re
from typing import Any

import yaml

MAX_YAML_BYTES = 16_000_000
"""Longest file. Chosen: a fleet of ten thousand cameras has 5 MB; PyYAML reads 0.2 MB a second."""
MAX_YAML_VALUES = 2_000_000
"""Most keys and values, those that anchors repeat (`*name`) counted each time. Chosen: ten times
such a fleet; a few lines of anchors in anchors can stand for billions."""


class BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader for files of others: what anchors repeat is bounded before it is made.

    Raises:
        yaml.MarkedYAMLError: More than `MAX_YAML_VALUES`, or an anchor within itself.
    """

    def construct_document(self, node: yaml.Node) -> Any:
        """The value of a document."""
        _values_in(node, {})
        return super().construct_document(node)


def _values_in(node: yaml.Node, known: dict[int, int]) -> int:
    """How many keys and values a node stands for."""
    found = known.get(id(node))
    if found is not None:
        if found == 0:
            problem = "an anchor that stands for itself"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return found
    known[id(node)], total = 0, 1
    if not isinstance(node, yaml.ScalarNode):
        for child in node.value:
            pair = child if isinstance(child, tuple) else (child,)
            total += sum(_values_in(part, known) for part in pair)
    if total > MAX_YAML_VALUES:
        problem = f"anchors that stand for more than {MAX_YAML_VALUES} values"
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
    known[id(node)] = total
    return total


class CoreLoader(BoundedLoader):
    """YAML 1.2's core schema (https://yaml.org/spec/1.2.2/#103-core-schema), each key once.

    In YAML 1.1, which PyYAML reads by itself, `no` is false, `010` is eight, `12:30` is 750, and
    the last of two equal keys counts.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping whose keys differ."""
        lines: dict[object, int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                problem = "a list or keys as a key"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            line = key.start_mark.line + 1
            if key.value in lines and key.tag != "tag:yaml.org,2002:merge":
                problem = f"key '{key.value}' a second time, first in line {lines[key.value]}"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            lines[key.value] = line
        return super().construct_mapping(node, deep)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; one that is not what its tag says is a fault of the file, as any other."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, OverflowError) as error:
            shown = str(node.value) if isinstance(node, yaml.ScalarNode) else "a value"
            shown = shown if len(shown) <= 60 else f"{shown[:60]}..."
            problem = f"'{shown}' is no {node.tag.rpartition(':')[2]}"
            mark = node.start_mark
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark) from error


def _whole(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    return int(text, 0) if text[:2] in ("0x", "0o") else int(text)


def _number(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    return float(loader.construct_scalar(node).replace(".inf", "inf").replace(".nan", "nan"))


_CORE: tuple[tuple[str, str, str], ...] = (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", "[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+0123456789.",
    ),
    ("null", "~|null|Null|NULL|", "~nN\0"),
    ("merge", "<<", "<"),
)
"""Tags of YAML's core schema, what is written for them, and how that may begin."""
CoreLoader.yaml_implicit_resolvers = {}
for _tag, _form, _begins in _CORE:
    _name = f"tag:yaml.org,2002:{_tag}"
    first = [letter if letter != "\0" else "" for letter in _begins]
    CoreLoader.add_implicit_resolver(_name, re.compile(f"^({_form})$"), first)
CoreLoader.add_constructor("tag:yaml.org,2002:int", _whole)
CoreLoader.add_constructor("tag:yaml.org,2002:float", _number)


def load_bounded(text: str) -> object:
    """The value of a YAML text of somebody else, as `yaml.safe_load` gives it.

    Raises:
        yaml.YAMLError: Broken, too long, too deep, or anchors that stand for too much.
    """
    return _loaded(text, BoundedLoader)


def load_core(text: str) -> object:
    """As `load_bounded`, by YAML 1.2's core schema, each key once."""
    return _loaded(text, CoreLoader)


def _loaded(text: str, loader: type[BoundedLoader]) -> object:
    if len(text) > MAX_YAML_BYTES:
        raise yaml.MarkedYAMLError(problem=f"{len(text)} characters of {MAX_YAML_BYTES} at most")
    try:
        return yaml.load(text, Loader=loader)
    except RecursionError as error:
        raise yaml.MarkedYAMLError(problem="lists in lists, too deep to read") from error
