"""Node parameters: declared from `params/<node>.yaml`, handed out as one frozen typed struct.

The schema files are in the format of PickNik's generate_parameter_library (type, default_value,
description, read_only, validation), so that its documentation generator reads them too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from functools import lru_cache
from textwrap import wrap
from typing import Any, Generic, TypeVar

import yaml
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from geoorbit_ros.core.addresses import masked
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.input_report import decimal_comma
from geoorbit_ros.core.plugins import FORM, FROM_FILES, expected, is_name, registered
from geoorbit_ros.core.resources import share_path

_TYPES: dict[str, type] = {"bool": bool, "int": int, "double": float, "string": str}
_WORDS = {"bool": "true or false", "int": "a whole number", "double": "a number", "string": "text"}

_JSON_TYPES = {"bool": "boolean", "int": "integer", "double": "number", "string": "string"}

_BOOLS = dict.fromkeys(("true", "yes", "on", "1"), True) | dict.fromkeys(
    ("false", "no", "off", "0"), False
)
"""Words for true and false, as YAML 1.1 and people have them."""

Struct = TypeVar("Struct")
Value = bool | int | float | str


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter of a schema.

    Attributes:
        name: As in the node and in the struct.
        kind: `bool`, `int`, `double` or `string`.
        default: Value unless overridden. A NaN default means "not given" and stays acceptable.
        description: One sentence for `ros2 param describe`.
        read_only: Fixed once the node runs.
        bounds: Least and greatest value, both included.
        above: The value must be greater than this.
        choices: The only values accepted.
        not_empty: Whether an empty string is refused.
        renamed_from: What it was called before; that name still works, with a warning.
        address: Whether it may be an address with a password, which no other node is told.
        plugin: Kind of `core.plugins` whose names are accepted, and files where it takes them.
    """

    name: str
    kind: str
    default: Value
    description: str
    read_only: bool = False
    bounds: tuple[float, float] | None = None
    above: float | None = None
    choices: tuple[Value, ...] = ()
    not_empty: bool = False
    renamed_from: str = ""
    plugin: str = ""
    address: bool = False

    @property
    def expected(self) -> str:
        """What a value must be, as words."""
        if self.plugin:
            return expected(self.plugin)
        if self.choices:
            return " or ".join(str(choice) for choice in self.choices)
        words = _WORDS[self.kind]
        if self.bounds:
            words += f" from {self.bounds[0]:g} to {self.bounds[1]:g}"
        if self.above is not None:
            words += f" above {self.above:g}"
        return f"{words}, not empty" if self.not_empty else words

    def json_schema(self) -> dict[str, Any]:
        """The same rules as JSON schema, for editors."""
        schema: dict[str, Any] = {"type": _JSON_TYPES[self.kind], "description": self.description}
        if not (isinstance(self.default, float) and math.isnan(self.default)):
            schema["default"] = self.default
        if self.bounds:
            schema["minimum"], schema["maximum"] = self.bounds
        if self.above is not None:
            schema["exclusiveMinimum"] = self.above
        if self.choices:
            schema["enum"] = list(self.choices)
        if self.plugin:
            names: dict[str, Any] = {"enum": list(registered(self.plugin))}
            own = {"pattern": r"\.py:[A-Za-z_]\w*$", "description": FORM}
            schema |= {"anyOf": [names, own]} if self.plugin in FROM_FILES else names
        return schema

    def checked(self, value: object, place: str) -> Value:
        """The value in the parameter's type.

        What can mean only one thing is taken for it: a whole number for a `double` and the other
        way round, a number written as text (`"10"`, `10,5`), yes, no, on and off for a `bool`.

        Raises:
            ParameterError: Wrong type, or outside what the schema allows.
        """
        wanted, given = _TYPES[self.kind], value
        value = _in_type(value, wanted)
        if type(value) is wanted and self._allows(value):
            return value  # type: ignore[return-value]  # its type is one of _TYPES
        found = repr(masked(given)) if isinstance(given, str) else str(given)
        raise ParameterError(f"{place}, parameter '{self.name}'", found, self.expected)

    def _allows(self, value: Any) -> bool:
        if isinstance(value, float) and math.isnan(value):
            return isinstance(self.default, float) and math.isnan(self.default)
        return (
            (self.bounds is None or self.bounds[0] <= value <= self.bounds[1])
            and (self.above is None or value > self.above)
            and (not self.choices or value in self.choices)
            and (not self.plugin or is_name(self.plugin, value))
            and not (self.not_empty and value == "")
        )


def _in_type(value: object, wanted: type) -> object:
    """A value in the type that is wanted, if it can mean nothing else; otherwise as it is."""
    if isinstance(value, str) and wanted is bool:
        return _BOOLS.get(value.strip().lower(), value)
    if isinstance(value, str) and wanted in (int, float):
        number = decimal_comma(value.strip())
        try:
            value = float(value) if number is None else number
        except ValueError:
            return value
    if wanted is float and type(value) is int:
        return float(value)
    if wanted is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if wanted is str and type(value) in (int, float):
        return str(value)
    return value


@lru_cache
def load_schema(name: str) -> tuple[ParameterSpec, ...]:
    """The schema `params/<name>.yaml`, in the order of the file.

    Raises:
        ParameterError: A key or type that is not part of the format.
    """
    file = share_path(f"params/{name}.yaml")
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    return tuple(_spec(key, entry, str(file)) for key, entry in content[name].items())


def _spec(name: str, entry: dict[str, Any], place: str) -> ParameterSpec:
    """One entry of a schema file; validators carry the format's trailing `<>`."""
    rest = dict(entry)
    rules = {key.removesuffix("<>"): value for key, value in rest.pop("validation", {}).items()}
    where = f"{place}, parameter '{name}'"
    if rest.get("type") not in _TYPES:
        raise ParameterError(where, f"type {rest.get('type')}", " or ".join(_TYPES))
    unknown = (
        set(rest) - {"type", "default_value", "description", "read_only", "renamed_from"}
    ) | (set(rules) - {"bounds", "gt", "one_of", "not_empty", "plugin", "address"})
    if unknown or "default_value" not in rest or not rest.get("description"):
        found = f"keys {', '.join(sorted({*rest, *rules}))}"
        expected_keys = "type, default_value, description, read_only, renamed_from, rules"
        raise ParameterError(where, found, expected_keys)
    return ParameterSpec(
        name=name,
        kind=rest["type"],
        default=_TYPES[rest["type"]](rest["default_value"]),
        description=str(rest["description"]).strip(),
        read_only=bool(rest.get("read_only", False)),
        bounds=tuple(rules["bounds"]) if "bounds" in rules else None,
        above=rules["gt"][0] if "gt" in rules else None,
        renamed_from=str(rest.get("renamed_from", "")),
        plugin=rules["plugin"][0] if "plugin" in rules else "",
        choices=tuple(rules["one_of"][0]) if "one_of" in rules else (),
        not_empty="not_empty" in rules,
        address="address" in rules,
    )


def spec_by_name(schema: str) -> dict[str, ParameterSpec]:
    """The parameters of a schema by their names, those of before a renaming included."""
    specs = load_schema(schema)
    old = {spec.renamed_from: spec for spec in specs if spec.renamed_from}
    return old | {spec.name: spec for spec in specs}


def nearest(name: str, known: Iterable[str]) -> str:
    """What a person who wrote a name that is not known can write: the nearest one, or all."""
    close = get_close_matches(name, known := sorted(known), n=1)
    return f"'{close[0]}'?" if close else f"one of {', '.join(known)}"


def undeclared(schema: str, node: Node, overrides: Iterable[str]) -> list[str]:
    """A sentence for each parameter that was given and that the node has not."""
    mine = spec_by_name(schema)
    names = [spec.name for spec in load_schema(schema)]
    place = f"node '{node.get_fully_qualified_name()}'"
    return [
        f"{place}: parameter '{name}' has no effect: found no such parameter, "
        f"expected {nearest(name, names)}"
        for name in overrides
        if name not in mine and not node.has_parameter(name) and "." not in name
    ]


def parameter_help(schema: str, about: str) -> str:
    """What `--help` of a node prints: how it is started, and its parameters."""
    lines = [
        f"usage: ros2 run geoorbit_ros {schema} [--ros-args [-r __ns:=/CAMERA] "
        "[-p NAME:=VALUE]... [--params-file FILE]]",
        "",
        " ".join(about.split()),
        "",
        "parameters:",
    ]
    for spec in load_schema(schema):
        default = repr(spec.default) if isinstance(spec.default, str) else spec.default
        lines.append(f"  {spec.name}: {spec.expected} (default: {default})")
        lines += wrap(
            " ".join(spec.description.split()),
            94,
            initial_indent=" " * 6,
            subsequent_indent=" " * 6,
        )
    return "\n".join(lines)


class NodeParameters(Generic[Struct]):
    """A node's parameters, checked when the node starts and again whenever one is set.

    Args:
        node: Declares the parameters; overrides from its constructor or the command line apply.
        struct: Frozen dataclass with exactly the parameters of the schema.
        schema: Name of the schema file.
        on_change: Called with the new struct after a parameter was set; may raise ParameterError
            to refuse it.

    Attributes:
        value: The parameters as they stand.

    Raises:
        ParameterError: Naming node, parameter, value and expectation.
    """

    def __init__(
        self,
        node: Node,
        struct: type[Struct],
        schema: str,
        on_change: Callable[[Struct], None] | None = None,
    ) -> None:
        self._place = f"node '{node.get_fully_qualified_name()}'"
        self._specs = {spec.name: spec for spec in load_schema(schema)}
        self._struct, self._on_change = struct, on_change
        names = {f.name for f in fields(struct)}  # type: ignore[arg-type]  # a dataclass
        if names != set(self._specs):
            odd = ", ".join(sorted(names ^ set(self._specs)))
            raise ParameterError(f"params/{schema}.yaml", odd, f"the fields of {struct.__name__}")
        values = {spec.name: self._declare(node, spec) for spec in self._specs.values()}
        self.value: Struct = struct(**values)
        node.add_on_set_parameters_callback(self._on_set)

    def _declare(self, node: Node, spec: ParameterSpec) -> Value:
        # Dynamic typing: rclpy's own check would refuse `rate:=10` for a double, with a message
        # that doesn't say what is expected. `checked` does both.
        descriptor = ParameterDescriptor(
            description=spec.description,
            additional_constraints=spec.expected,
            read_only=spec.read_only,
            dynamic_typing=True,
        )
        start = self._renamed(node, spec) if spec.renamed_from else spec.default
        # Where rclpy keeps what was given; no function of it tells before everybody is told.
        given = node._parameter_overrides.get(spec.name)  # noqa: SLF001
        if spec.address and given is not None and isinstance(given.value, str):
            node.declare_parameter(spec.name, masked(given.value), descriptor, ignore_override=True)
            return spec.checked(given.value, self._place)
        found = node.declare_parameter(spec.name, start, descriptor).value
        return spec.checked(found, self._place)

    @staticmethod
    def _renamed(node: Node, spec: ParameterSpec) -> Value:
        """The value that was given under the parameter's old name, else the default."""
        old = spec.renamed_from
        given: Value | None = node.declare_parameter(
            old, None, ParameterDescriptor(dynamic_typing=True)
        ).value
        node.undeclare_parameter(old)
        if given is None:
            return spec.default
        node.get_logger().warning(
            f"parameter '{old}' is now called '{spec.name}'; the old name ends with 0.2.0"
        )
        return given

    def _on_set(self, changes: Sequence[Parameter]) -> SetParametersResult:
        known = [change for change in changes if change.name in self._specs]
        try:
            new = {c.name: self._specs[c.name].checked(c.value, self._place) for c in known}
            current = {name: getattr(self.value, name) for name in self._specs}
            struct = self._struct(**(current | new))
            if new and self._on_change:
                self._on_change(struct)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.value = struct
        return SetParametersResult(successful=True)
