"""What a plug-in's class must have, and its methods made to say what went wrong, and where."""

from __future__ import annotations

import inspect
import traceback
import types
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
from typing import Any

from geoorbit_ros.core.errors import GeoOrbitError, ParameterError, PluginError

NEARLY_EQUAL = 0.8
"""Similarity of two names (difflib's ratio) from which one is taken for the other, misspelt.
Chosen: larger misses `combin` for `combine`, smaller warns about unrelated helpers."""
_NOT_OWN = {"geoorbit_ros", "builtins", "typing", "abc"}
"""Packages whose classes a plug-in may derive from, and which are none of the user's."""
MADE = "from_settings"
_told: dict[Any, Any] = {}
"""Warnings that were shown."""


class WrongResult(Exception):  # noqa: N818 - always turned into a PluginError
    """What a method of a plug-in returned in place of what it should."""


@dataclass(frozen=True, slots=True)
class Returns:
    """What a method or attribute of a plug-in must give.

    Attributes:
        expected: In words, for errors.
        check: Takes the plug-in, the arguments and the result, and gives the result to hand on;
            raises WrongResult.
    """

    expected: str
    check: Callable[[Any, tuple[Any, ...], Any], Any]


def what(found: object) -> str:
    """A value of a wrong type, in words."""
    kind = type(found).__name__
    kind = f"numpy {kind}" if type(found).__module__ == "numpy" else kind
    return "None" if found is None else f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


ARRAYS = "a dict of numpy arrays by name, none of objects"


def checked_arrays(_: object, __: object, state: object) -> dict[str, Any]:
    """Hand on the arrays of a plug-in's `state`, as a file can keep them.

    Raises:
        WrongResult: It is something else.
    """
    import numpy as np  # names can be listed without it

    if not isinstance(state, Mapping):
        raise WrongResult(what(state))
    for name, array in state.items():
        if not isinstance(name, str):
            raise WrongResult(f"the key {name!r}, which is no text")
        if not isinstance(array, np.ndarray) or array.dtype.hasobject:
            found = "an array of objects" if isinstance(array, np.ndarray) else what(array)
            raise WrongResult(f"{found} as '{name}'")
    return dict(state)


def called(
    own: Callable[..., Any],
    file: Path,
    method: str,
    returns: Returns | None,
    *given: Any,
    **named: Any,
) -> Any:
    """What a method of a plug-in returns, checked. `SystemExit` is a mistake as well.

    Args:
        own: The method, not bound.
        file: The plug-in's, for errors.
        method: Class and method, for errors.
        returns: What it must return; None: anything.
        given: The plug-in, then the arguments.
        named: Arguments by name.

    Raises:
        PluginError: It failed, or returned something else.
    """
    try:
        result = own(*given, **named)
        return returns.check(given[0], given[1:], result) if returns else result
    except GeoOrbitError:
        raise
    except WrongResult as error:
        place = f"{file}{definition(file, own)}, {method}"
        wanted = returns.expected if returns else "no error"
        raise PluginError(place, str(error), wanted) from error
    except (Exception, SystemExit) as error:  # whatever the user's method does
        place = f"{file}{line_of(file, error) or definition(file, own)}, {method}"
        raise PluginError(place, in_words(error), "no error") from error


def guarded(
    found: type,
    file: Path,
    base: type,
    returns: Mapping[str, Returns],
    optional: Iterable[type] = (),
) -> type:
    """A subclass whose methods tell what went wrong in the file, and where.

    Args:
        found: The plug-in's class.
        file: Where it stands.
        base: Protocol or base class that it must satisfy.
        returns: What methods and properties must give, those of its base classes included.
        optional: Protocols that it may satisfy.

    Raises:
        ParameterError: A method that takes other arguments.
    """
    also = [one for one in optional if members(one) <= set(dir(found))]
    roots = [base, *also, *(one for one in found.__mro__ if not _is_own(one))]
    known = {name: part for root in reversed(roots) for name, part in vars(root).items()}
    _check_signatures(found, known, file)
    told = {n for n in (*members(base), *dir(found)) if n[0] != "_" and _is_missing(found, base, n)}
    known_names = {n for root in (*roots, *optional) for n in members(root)}
    _warn_of_misspelt(found, known_names, told, file)
    parts: dict[str, Any] = {"__module__": found.__module__, "__doc__": found.__doc__}
    lacks = {name for one in optional if one not in also for name in members(one)}
    for name in {*(n for root in (base, *also) for n in members(root)), *returns} - lacks:
        own = inspect.getattr_static(found, name, None)
        if is_stub(own, base, name):
            continue
        if inspect.isfunction(own):
            parts[name] = _guard(found, own, file, returns.get(name))
        elif isinstance(own, property) and own.fget is not None:
            get = _guard(found, own.fget, file, returns.get(name))
            parts[name] = property(get, own.fset, own.fdel)
    return types.new_class(found.__name__, (found,), {}, lambda body: body.update(parts))


def members(root: type) -> set[str]:
    """Public methods and properties that a class defines."""
    kinds = (types.FunctionType, property, classmethod, staticmethod)
    return {name for name, part in vars(root).items() if name[0] != "_" and isinstance(part, kinds)}


def is_stub(own: object, base: type, name: str) -> bool:
    """Whether a class has not got a method: that of a protocol, or an abstract one."""
    of_protocol = getattr(base, "_is_protocol", False) and own is vars(base).get(name)
    return own is None or of_protocol or getattr(own, "__isabstractmethod__", False)


def lacking(made: object, base: type) -> list[str]:
    """What an object lacks of a protocol, and abstract methods that it does not define."""
    names = dict.fromkeys([*vars(base), *dir(type(made))])
    return [n for n in names if n not in _own_attributes(made) and _is_missing(type(made), base, n)]


def _is_missing(kind: type, base: type, name: str) -> bool:
    own = inspect.getattr_static(kind, name, None)
    wanted = name in members(base) or getattr(own, "__isabstractmethod__", False)
    return name[0] != "_" and wanted and is_stub(own, base, name)


def _own_attributes(made: object) -> dict[str, object]:
    """Attributes of an object itself; empty where it has slots."""
    return getattr(made, "__dict__", {})


def misspelt(kind: type, wanted: str) -> str:
    """A method of the user's whose name nearly equals the wanted one; empty: none."""
    names = [name for one in kind.__mro__ if _is_own(one) for name in members(one)]
    return next(iter(get_close_matches(wanted, names, 1, NEARLY_EQUAL)), "")


def check_made(found: type, file: Path, place: str) -> None:
    """Whether a class can be made in one of the two ways.

    Raises:
        ParameterError: It takes other arguments.
    """
    own = inspect.getattr_static(found, MADE, None)
    if own is None:
        made, given, wanted = (
            inspect.getattr_static(found, "__init__"),
            ["self"],
            f"{found.__name__}(), without arguments",
        )
        wanted += f"; for settings, write a class method {MADE}(cls, settings)"
    else:
        wanted = f"@classmethod {MADE}(cls, settings)"
        made = own.__func__ if isinstance(own, classmethod | staticmethod) else own
        given = ["settings"] if isinstance(own, staticmethod) else ["cls", "settings"]
        if inspect.isfunction(own):
            found_text = f"{found.__name__}.{MADE}, which is no class method"
            raise ParameterError(f"{place}{definition(file, own)}", found_text, wanted)
    if not inspect.isfunction(made):
        return
    try:
        inspect.signature(made).bind(*given)
    except TypeError:
        text = f"{found.__name__}.{made.__name__}{inspect.signature(made)}"
        raise ParameterError(f"{place}{definition(file, made)}", text, wanted) from None


def line_of(file: Path, error: BaseException) -> str:
    """`, line 7`: where in the file an error came from, as far as that is known."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""


def definition(file: Path, own: Any) -> str:
    """`, line 7`: where a method begins, if it stands in the file."""
    code = own.__code__ if inspect.isfunction(own) else None
    inside = code is not None and code.co_filename == str(file)
    return f", line {code.co_firstlineno}" if code is not None and inside else ""


def in_words(error: BaseException) -> str:
    """An exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _is_own(one: type) -> bool:
    return one.__module__.partition(".")[0] not in _NOT_OWN


def _own_parts(found: type) -> list[tuple[str, Any]]:
    """Public names of the user's classes, and what they stand for."""
    own = [one for one in found.__mro__ if _is_own(one)]
    return [(name, part) for one in own for name, part in vars(one).items() if name[0] != "_"]


def _check_signatures(found: type, known: Mapping[str, Any], file: Path) -> None:
    for name, own in _own_parts(found):
        wanted = known.get(name)
        if not inspect.isfunction(wanted):
            continue
        names, by_name = _parameters(wanted)
        expected = f"{name}({', '.join([*names, *by_name])})"
        function = own.__func__ if isinstance(own, staticmethod | classmethod) else own
        if not callable(own):
            place = f"{file}, {found.__name__}.{name}"
            raise ParameterError(place, f"{what(own)}, which is no method", expected)
        if not inspect.isfunction(function):
            continue  # an object that can be called: what it takes shows when it is
        try:
            names = names[1:] if isinstance(own, staticmethod) else names
            inspect.signature(function).bind(*names, **dict.fromkeys(by_name))
        except TypeError:
            text = f"{found.__name__}.{name}{inspect.signature(function)}"
            raise ParameterError(f"{file}{definition(file, function)}", text, expected) from None


def _parameters(wanted: Callable[..., Any]) -> tuple[Sequence[str], Sequence[str]]:
    """Names of what a method takes by place, and by name only."""
    parts = inspect.signature(wanted).parameters.values()
    by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    by_name = [part.name for part in parts if part.kind is inspect.Parameter.KEYWORD_ONLY]
    return [part.name for part in parts if part.kind in by_place], by_name


def _warn_of_misspelt(found: type, known: set[str], told: set[str], file: Path) -> None:
    """Warn of methods that nobody calls; those whose lack is an error are `told` there."""
    own = dict(_own_parts(found))
    for name, part in own.items():
        if name in known or not inspect.isfunction(part):
            continue
        open_names = sorted({*known, MADE} - set(own))
        close = get_close_matches(name, open_names, 1, NEARLY_EQUAL)
        if close and close[0] not in told:
            text = f"{found.__name__}.{name} is never called: is it meant to be {close[0]}?"
            line = part.__code__.co_firstlineno
            warnings.warn_explicit(text, UserWarning, str(file), line, registry=_told)


def _guard(found: type, own: Any, file: Path, returns: Returns | None) -> Callable[..., Any]:
    """The method, which raises PluginError for a mistake."""
    method = f"{found.__name__}.{own.__name__}"

    @wraps(own)
    def call(plugin: Any, *arguments: Any, **named: Any) -> Any:
        return called(own, file, method, returns, plugin, *arguments, **named)

    return call
