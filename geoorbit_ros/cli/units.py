"""Sizes and times as people write them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from geoorbit_ros.core.errors import ParameterError

_EPOCH_NS = 10**17
"""Later than 1973: the clock counts from 1970. Earlier: from the start of some recording."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def format_size(size_bytes: int) -> str:
    """`479.7 kB`; powers of 1000."""
    for unit, scale in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.1f} {unit}"
    return f"{size_bytes} bytes"


def count_of(number: int, noun: str) -> str:
    """`1 camera`, `2 cameras`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def format_time(stamp_ns: int) -> str:
    """Date and time in UTC, or seconds when the clock plainly doesn't count from 1970."""
    if stamp_ns < _EPOCH_NS:
        return f"{stamp_ns / 1e9:.3f} s"
    return f"{_EPOCH + timedelta(microseconds=stamp_ns // 1000):%Y-%m-%d %H:%M:%S} UTC"


def parse_time(text: str, place: str) -> int:
    """Nanoseconds of `12.5` (seconds) or of an ISO 8601 date with or without time and offset.

    Raises:
        ParameterError: Neither.
    """
    try:
        return round(float(text) * 1e9)
    except (ValueError, OverflowError):
        pass  # not a number: a date
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ParameterError(
            place, f"'{text}'", "seconds, or a date and time such as 2026-05-01T06:00"
        ) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000
