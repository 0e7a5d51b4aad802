"""Ctrl-C for commands that run until they are told to end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event
from types import FrameType


@contextmanager
def told_to_end() -> Iterator[Event]:
    """An event that SIGINT and SIGTERM set, instead of an exception in the middle of a callback.

    A second signal ends the process at once.
    """
    event = Event()

    def note(number: int, _frame: FrameType | None) -> None:
        event.set()
        signal.signal(number, signal.SIG_DFL)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
