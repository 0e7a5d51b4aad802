"""JSON that somebody else wrote: bounded in size, depth and range before anything is made of it."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from geoorbit_ros.core.errors import GeoOrbitError, MessageError

MAX_TEXT = 8_000_000
"""Characters of a message's text. Chosen: a lane map with its cross sections has 200,000; parsed,
a text takes up to thirty times its length in memory."""
MAX_DEPTH = 64
"""Lists in lists. Chosen: GeoJSON has 8; more only helps who wants to exhaust the parser."""
_WHOLE_DIGITS = 18
"""Numbers of so many digits fit in 64 bits."""

_STRINGS = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)


def read_json(
    text: str,
    place: str,
    expected: str,
    error: type[GeoOrbitError] = MessageError,
    max_text: int = MAX_TEXT,
) -> Any:
    """The value of a JSON text.

    Whole numbers beyond 64 bits become floats, so that every `int` of the result fits in columns
    and messages. A float may be infinite or not a number: who uses one as a number checks it.

    Args:
        text: The text.
        place: Where it is from, for the error.
        expected: What it should be, for the error.
        error: Class of the error.
        max_text: Most characters.

    Raises:
        GeoOrbitError: Of that class: too long, too deep, or no JSON. The line is part of the place.
    """
    if len(text) > max_text:
        raise error(place, f"{len(text)} characters", f"{expected} of {max_text} at most")
    depth = _depth(text)
    if depth > MAX_DEPTH:
        raise error(place, f"lists in lists, {depth} deep, too deep to read", expected)
    try:
        return json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as fault:
        raise error(f"{place}, line {fault.lineno}", fault.msg, expected) from None
    except (ValueError, RecursionError, MemoryError) as fault:
        raise error(place, fault or type(fault).__name__, expected) from None


def _whole(digits: str) -> int | float:
    if len(digits) <= _WHOLE_DIGITS:
        return int(digits)
    value = float(digits)
    return int(digits) if abs(value) < 2.0**63 else value


def _depth(text: str) -> int:
    """How deep lists and objects lie in each other, without a parser."""
    try:
        raw = np.frombuffer(_STRINGS.sub("", text).encode("utf-8", "replace"), np.uint8)
    except (MemoryError, UnicodeError):
        return MAX_DEPTH + 1
    step = np.isin(raw, np.frombuffer(b"[{", np.uint8)).astype(np.int8)
    step -= np.isin(raw, np.frombuffer(b"]}", np.uint8)).astype(np.int8)
    return int(np.cumsum(step, dtype=np.int64).max(initial=0))
