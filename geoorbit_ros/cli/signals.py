"""What a command does when it is told to end: SIGINT (Ctrl-C) and SIGTERM are treated alike."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from typing import Any

EXIT_INTERRUPTED = 130
"""128 + SIGINT: what a shell reports for a command that Ctrl-C has ended."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAME_S = 0.5
"""Signals that follow the first one within this time count as the same. Chosen: `timeout` sends its
signal twice; larger, somebody who presses Ctrl-C again waits longer."""
AGAIN_S = 0.02
"""An interruption that was seen to get lost comes again so much later. Chosen: larger, the command
goes on for longer; much smaller, it may come before the place where it got lost is left."""
LOST_S = 0.5
"""After this time it is looked whether it got lost unseen, again and again. Chosen: as `SAME_S`."""


class Interrupted(KeyboardInterrupt):
    """The process was told to end.

    A class of its own: Python ends itself by SIGINT, whatever status it was given, once a plain
    KeyboardInterrupt has passed the `exec` in which a dataclass is made (CPython 3.11, pythonrun.c,
    `run_eval_code_obj`).
    """


class Interruption:
    """A context manager in which a signal raises KeyboardInterrupt, and a later one ends at once.

    An interruption ends with the context, and so does an error that came after a signal: some
    libraries turn an interruption into an error of their own.

    Python drops an exception that is raised in a destructor or a weak reference's callback, and
    prints it. An interruption that is dropped there comes again a moment later, and isn't printed.
    Libraries drop one without a word, where they look something up and take any exception for "not
    there". So it comes again, too, if nothing is cleaning up after it some time later.

    Args:
        ends_process: Whether the process ends with the context: later signals are then ignored,
            where they would be handled by what is already taken down.

    Attributes:
        came: Whether a signal has come.
    """

    def __init__(self, *, ends_process: bool) -> None:
        self.came = False
        self._ends_process = ends_process
        self._over = False
        self._first_s = 0.0
        self._handlers: dict[int, Any] = {}

    def over(self) -> None:
        """Nothing is left that could be interrupted."""
        self._over = True

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:  # a script's background job
                    self._handlers[number] = signal.signal(number, self._interrupt)
            self._handlers[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._interrupt_again)
            self._hook, sys.unraisablehook = sys.unraisablehook, self._on_dropped
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if self._handlers:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in self._handlers.items():
            signal.signal(number, signal.SIG_IGN if self._ends_process else handler)
        if self._handlers and not self._ends_process:
            sys.unraisablehook = self._hook
        return isinstance(error, KeyboardInterrupt) or (self.came and isinstance(error, Exception))

    def _interrupt(self, *_: object) -> None:
        now = time.monotonic()
        if not self.came:
            self.came, self._first_s = True, now
            signal.setitimer(signal.ITIMER_REAL, LOST_S, LOST_S)
            raise Interrupted
        if now - self._first_s > SAME_S:
            os._exit(EXIT_INTERRUPTED)

    def _interrupt_again(self, *_: object) -> None:
        if not self._over and not _is_handled(sys.exception()):
            raise Interrupted

    def _on_dropped(self, dropped: sys.UnraisableHookArgs) -> None:
        if self.came and isinstance(dropped.exc_value, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S, LOST_S)
        else:
            self._hook(dropped)


def _is_handled(error: BaseException | None) -> bool:
    """Whether `error`, which is being handled, is an interruption or was raised while one was."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__context__
    return False


@contextmanager
def told_to_end(then: Callable[[], None] = lambda: None) -> Iterator[Event]:
    """An event that SIGINT and SIGTERM set, for commands that run until they are told to end.

    A later signal ends the process at once.

    Args:
        then: Called after the event is set, between two steps of the main thread.
    """
    event = Event()
    first_s = 0.0

    def note(*_: object) -> None:
        nonlocal first_s
        if not event.is_set():
            first_s = time.monotonic()
            event.set()
            then()
        elif time.monotonic() - first_s > SAME_S:
            os._exit(EXIT_INTERRUPTED)

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
