"""The registry of what can be exchanged: a class of the package by its name, or one's own file.

A class of the package registers itself: `@register("strategy", "fedavg")` above the class, in a
file of the folder of its kind, is all that is needed. Command line, node parameters, schemas and
docs list the names from here. A plug-in is a class in a file of the user's, `FILE.py:CLASS`.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
import traceback
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from geoorbit_ros.core.errors import GeoOrbitError, ParameterError, PluginError

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


class WrongResult(Exception):  # noqa: N818 - always turned into a PluginError
    """What a method of a plug-in returned in place of what it should."""


@dataclass(frozen=True, slots=True)
class Returns:
    """What a method of a plug-in must return.

    Attributes:
        expected: In words, for errors.
        check: Takes the plug-in, the arguments and the result, and gives the result to hand on;
            raises WrongResult.
    """

    expected: str
    check: Callable[[Any, tuple[Any, ...], Any], Any]


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
) -> Made:
    """An object of a registered class or of a plug-in.

    Args:
        kind: Such as `strategy`.
        name: A registered name, or `FILE.py:CLASS`.
        base: Protocol or base class that the object must satisfy.
        settings: For classes that are made from settings (`TakesSettings`).
        place: For errors; default: the parameter of that kind.
        adapt: Makes an object of an older protocol one of today's.
        returns: What methods of a plug-in must return. Those of `base`, and these, raise
            PluginError with file, line and method when they fail or return something else.

    Raises:
        ParameterError: No such name, file or class, or a class that fails when it is loaded or
            made, or lacks something.
    """
    place = place or f"parameter '{kind}'"
    check_name(kind, name, place)
    match = _PLUGIN.fullmatch(name)
    if match is None:
        made = _made(_registered_class(kind, name), settings)
    else:
        place = f"{place}, {Path(match['file']).absolute()}"
        file = Path(match["file"]).absolute()
        made = _from_file(
            file, match["name"], settings, place, lambda c: _guarded(c, file, base, returns)
        )
    made = adapt(made)
    if not isinstance(made, base):
        lacking = [part for part in vars(base) if part[0] != "_" and part not in dir(made)]
        found = f"{type(made).__name__} without {', '.join(lacking) or 'its base class'}"
        raise ParameterError(place, found, f"all of {base.__name__}")
    return made


def _registered_class(kind: str, name: str) -> type:
    if (kind, name) not in _classes:
        importlib.import_module(_modules(kind)[name])
    return _classes[kind, name]


def _made(found: type, settings: object) -> Any:
    return found.from_settings(settings) if isinstance(found, TakesSettings) else found()


def _from_file(
    file: Path, name: str, settings: object, place: str, guard: Callable[[type], type]
) -> Any:
    if not file.is_file():
        raise ParameterError(place, f"no file {file}", FORM)
    # Its own name: a plug-in may be called as a library is. Dataclasses look into sys.modules.
    module_name = f"geoorbit_plugin_{file.stem}"
    spec = importlib.util.spec_from_file_location(module_name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
        found = getattr(module, name)
        if not isinstance(found, type):
            raise ParameterError(place, f"{name}, which is no class", f"a class {name}")
        return _made(guard(found), settings)
    except GeoOrbitError:
        raise
    except Exception as error:  # whatever the user's file does
        line = _line(file, error)
        expected_class = f"a class {name} without arguments"
        raise ParameterError(place + line, _in_words(error), expected_class) from error


def _guarded(found: type, file: Path, base: type, returns: Mapping[str, Returns]) -> type:
    """A subclass whose methods tell what went wrong in the file, and where.

    Raises:
        ParameterError: A method that takes other arguments.
    """
    methods = {name: part for name, part in vars(base).items() if inspect.isfunction(part)}
    parts: dict[str, Any] = {"__module__": found.__module__, "__doc__": found.__doc__}
    complete = set(methods) <= set(dir(found))  # else `make` says what is missing
    for name in {*methods, *returns} & set(dir(found)):
        own = inspect.getattr_static(found, name)
        if name[0] != "_" and inspect.isfunction(own):
            if name in methods and complete:
                _check_signature(found, own, methods[name], file)
            parts[name] = _guard(found, own, file, returns.get(name))
    return types.new_class(found.__name__, (found,), {}, lambda body: body.update(parts))


def _check_signature(found: type, own: Any, wanted: Any, file: Path) -> None:
    names = list(inspect.signature(wanted).parameters)
    try:
        inspect.signature(own).bind(*names)
    except TypeError:
        place = f"{file}{_definition(file, own)}"
        method = f"{found.__name__}.{own.__name__}{inspect.signature(own)}"
        expected_method = f"{wanted.__name__}({', '.join(names)})"
        raise ParameterError(place, method, expected_method) from None


def _guard(found: type, own: Any, file: Path, returns: Returns | None) -> Callable[..., Any]:
    """The method, which raises PluginError for a mistake."""
    method = f"{found.__name__}.{own.__name__}"
    wanted = returns.expected if returns else "no error"

    @wraps(own)
    def call(plugin: Any, *arguments: Any, **named: Any) -> Any:
        try:
            result = own(plugin, *arguments, **named)
            return returns.check(plugin, arguments, result) if returns else result
        except GeoOrbitError:
            raise
        except WrongResult as error:
            place = f"{file}{_definition(file, own)}, {method}"
            raise PluginError(place, str(error), wanted) from error
        except Exception as error:  # whatever the user's method does
            line = _line(file, error) or _definition(file, own)
            raise PluginError(f"{file}{line}, {method}", _in_words(error), wanted) from error

    return call


def _line(file: Path, error: Exception) -> str:
    """`, line 7`: where in the file an error came from, as far as that is known."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""


def _definition(file: Path, own: Any) -> str:
    """`, line 7`: where a method begins, if it stands in the file."""
    code = own.__code__
    return f", line {code.co_firstlineno}" if code.co_filename == str(file) else ""


def _in_words(error: Exception) -> str:
    """An exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
