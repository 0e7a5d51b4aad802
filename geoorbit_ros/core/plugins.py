"""The registry of what can be exchanged: a class of the package by its name, or one's own file.

A class of the package registers itself: `@register("strategy", "fedavg")` above the class, in a
file of the folder of its kind, is all that is needed. Command line, node parameters, schemas and
docs list the names from here. A plug-in is a class in a file of the user's, `FILE.py:CLASS`.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
import types
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from geoorbit_ros.core.errors import GeoOrbitError, ParameterError
from geoorbit_ros.core.plugin_methods import (
    MADE,
    Returns,
    called,
    check_made,
    guarded,
    in_words,
    lacking,
    line_of,
    members,
    misspelt,
)

FORM = "FILE.py:CLASS"
FOLDERS = {
    "detector": "detection",
    "encoding": "federated/encodings",
    "estimator": "lanes/estimators",
    "strategy": "federated/strategies",
    "tracker": "tracking",
}
"""Folder of the package in which the classes of each kind stand."""
FROM_FILES = ("detector", "estimator", "strategy", "tracker")
"""Kinds that take plug-ins. An encoding needs a number that server and clients agree on."""

MAX_SHOWN = 8
"""Classes of a file that an error lists. Chosen: more make it long, fewer show less."""

_PACKAGE = Path(__file__).parents[1]
_PLUGIN = re.compile(r"(?P<file>.+\.py):(?P<name>[A-Za-z_]\w*)")
_DECORATOR = re.compile(r'^@(?:plugins\.)?register\("(\w+)", "(\w+)"\)$', re.MULTILINE)
_classes: dict[tuple[str, str], type] = {}

Class = TypeVar("Class", bound=type)
Made = TypeVar("Made")


@runtime_checkable
class TakesSettings(Protocol):
    """A class whose objects are made from settings; any other is made without arguments."""

    def from_settings(self, settings: Any) -> Any:
        """An object with these settings, a class method."""


def register(kind: str, name: str) -> Callable[[Class], Class]:
    """Decorator: users get the class below by this name.

    Write both as plain strings: the list of names is read from the source.

    Raises:
        ParameterError: No such kind, or a name that another class has.
    """
    if kind not in FOLDERS:
        raise ParameterError("register", f"kind '{kind}'", " or ".join(FOLDERS))

    def keep(made: Class) -> Class:
        known = _classes.setdefault((kind, name), made)
        if (known.__module__, known.__qualname__) != (made.__module__, made.__qualname__):
            raise ParameterError("register", f"{kind} '{name}' twice", "one class for each name")
        _classes[kind, name] = made
        return made

    return keep


@cache
def _modules(kind: str) -> dict[str, str]:
    """Module of each registered name, read from the source: nothing is imported for a list."""
    found: dict[str, str] = {}
    for path in sorted((_PACKAGE / FOLDERS[kind]).rglob("*.py")):
        module = ".".join(path.relative_to(_PACKAGE.parent).with_suffix("").parts)
        for of_kind, name in _DECORATOR.findall(path.read_text(encoding="utf-8")):
            if of_kind == kind:
                found[name] = module
    return found


def registered(kind: str) -> tuple[str, ...]:
    """Names of all classes of a kind."""
    added = [name for of_kind, name in _classes if of_kind == kind]
    return tuple(dict.fromkeys([*_modules(kind), *added]))


def expected(kind: str) -> str:
    """What a user may name, as words."""
    return " or ".join([*registered(kind), FORM] if kind in FROM_FILES else registered(kind))


def is_plugin(text: str) -> bool:
    """Whether a name has the form `FILE.py:CLASS`."""
    return _PLUGIN.fullmatch(text) is not None


def short_name(text: str) -> str:
    """Name for files and tables: the class of a plug-in, any other name as it is."""
    match = _PLUGIN.fullmatch(text)
    return match["name"] if match else text


def is_file(text: str) -> bool:
    """Whether a name means a Python file, with or without the name of the class."""
    return is_plugin(text) or text.endswith(".py")


def plugin_file(text: str) -> str:
    """The file in such a name; any other text as it is."""
    match = _PLUGIN.fullmatch(text)
    return match["file"] if match else text


def is_name(kind: str, name: str) -> bool:
    """Whether a user may name this: a registered class, or a plug-in where the kind takes them."""
    return name in registered(kind) or (kind in FROM_FILES and is_plugin(name))


def check_name(kind: str, name: str, place: str | None = None) -> None:
    """Refuse a name that no class has and that is no plug-in; nothing is imported.

    Raises:
        ParameterError: Such a name.
    """
    if kind in FROM_FILES and name.endswith(".py"):
        expected_class = f"the name of a class in it, too: write {FORM}"
        raise ParameterError(
            place or f"parameter '{kind}'", f"only the file {name}", expected_class
        )
    if not is_name(kind, name):
        raise ParameterError(place or f"parameter '{kind}'", repr(name), expected(kind))


def make(
    kind: str,
    name: str,
    base: type[Made],
    settings: object = None,
    *,
    place: str | None = None,
    adapt: Callable[[Any], Any] = lambda made: made,
    returns: Mapping[str, Returns] = types.MappingProxyType({}),
    optional: tuple[type, ...] = (),
) -> Made:
    """An object of a registered class or of a plug-in.

    Args:
        kind: Such as `strategy`.
        name: A registered name, or `FILE.py:CLASS`.
        base: Protocol or base class that the object must satisfy.
        settings: For classes that are made from settings (`TakesSettings`).
        place: For errors; default: the parameter of that kind.
        adapt: Makes an object of an older protocol one of today's.
        returns: What methods and attributes of a plug-in must give. The methods of `base`, and
            these, raise PluginError with file, line and method when they fail or return something
            else.
        optional: Protocols that a plug-in may satisfy; their methods do the same.

    Raises:
        ParameterError: No such name, file or class, or a class that fails when it is loaded or
            made, or lacks something.
        PluginError: An attribute that is not what it should be.
    """
    place = place or f"parameter '{kind}'"
    check_name(kind, name, place)
    match = _PLUGIN.fullmatch(name)
    if match is None:
        return _satisfying(adapt(_made(_registered_class(kind, name), settings)), base, place)
    file = Path(match["file"]).absolute()
    place = f"{place}, {file}"
    found = _from_file(file, match["name"], place)
    check_made(found, file, place)
    made = _started(guarded(found, file, base, returns, optional), settings, file, place)
    made = _satisfying(adapt(made), base, place)
    for part, wanted in returns.items():
        if not isinstance(vars(base).get(part, make), types.FunctionType):  # an attribute
            value = getattr(made, part)
            called(lambda _, value=value: value, file, f"{found.__name__}.{part}", wanted, made)
    return made


def _satisfying(made: Any, base: type[Made], place: str) -> Made:
    """Hand on an object that has all of a protocol or base class.

    Raises:
        ParameterError: It has not.
    """
    name, module = type(made).__name__, base.__module__
    if not getattr(base, "_is_protocol", False) and not isinstance(made, base):
        expected_class = f"class {name}({base.__name__}): from {module} import {base.__name__}"
        raise ParameterError(place, f"{name} without its base class", expected_class)
    if missing := lacking(made, base):
        near = [f"{close} for {part}" for part in missing if (close := misspelt(type(made), part))]
        found = f"{name} without {', '.join(missing)}" + (f" ({', '.join(near)}?)" if near else "")
        owners = (one for one in type(made).__mro__ if missing[0] in vars(one))
        owner = base if missing[0] in vars(base) else next(owners)
        needed = ", ".join(part for part in vars(owner) if part in {*members(base), *missing})
        where = f"{owner.__name__} in {owner.__module__.replace('.', '/')}.py"
        raise ParameterError(place, found, f"{needed}: all of {where}")
    assert isinstance(made, base)
    return made


def _registered_class(kind: str, name: str) -> type:
    if (kind, name) not in _classes:
        importlib.import_module(_modules(kind)[name])
    return _classes[kind, name]


def _made(found: type, settings: object) -> Any:
    return found.from_settings(settings) if isinstance(found, TakesSettings) else found()


class _AsItStands(SourceFileLoader):
    """Compiles a file each time: kept bytecode may be older than a change of the same second."""

    def get_code(self, fullname: str) -> types.CodeType:
        """The file's code; no bytecode is read, and none is left beside the user's file."""
        code = self.source_to_code(self.get_data(self.path), self.path)
        assert isinstance(code, types.CodeType)
        return code


def _from_file(file: Path, name: str, place: str) -> type:
    """The class of this name in a file."""
    if not file.is_file():
        raise ParameterError(place, f"no file {file}", FORM)
    # Its own name: a plug-in may be called as a library is. Dataclasses look into sys.modules.
    module_name = f"geoorbit_plugin_{file.stem}"
    loader = _AsItStands(module_name, str(file))
    spec = importlib.util.spec_from_file_location(module_name, file, loader=loader)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except GeoOrbitError:
        raise
    except (Exception, SystemExit) as error:  # whatever the user's file does
        line = line_of(file, error)
        raise ParameterError(place + line, in_words(error), "a file that can be loaded") from error
    found = vars(module).get(name)
    if isinstance(found, type):
        return found
    if found is not None:
        raise ParameterError(place, f"{name}, which is no class", f"a class {name}")
    classes = [key for key, one in vars(module).items() if _is_defined(one, module_name)]
    close = get_close_matches(name, classes, 1)
    shown = ", ".join(classes[:MAX_SHOWN]) + (" and more" if len(classes) > MAX_SHOWN else "")
    has = f"the file has {shown}" if classes else "the file has no class"
    wanted = f"'{close[0]}'?" if close else "the name of a class in the file"
    raise ParameterError(place, f"no class {name} ({has})", wanted)


def _is_defined(one: object, module: str) -> bool:
    return isinstance(one, type) and one.__module__ == module


def _started(found: type, settings: object, file: Path, place: str) -> Any:
    """An object of a plug-in's class."""
    try:
        return _made(found, settings)
    except GeoOrbitError:
        raise
    except (Exception, SystemExit) as error:  # whatever the user's class does
        how = f"{MADE}(settings)" if isinstance(found, TakesSettings) else "()"
        how = f"{found.__name__}.{how}" if how[0] != "(" else found.__name__ + how
        where = place + line_of(file, error)
        raise ParameterError(where, in_words(error), f"{how} without an error") from error
