"""A second process that works beside this one and sends what it has, piece by piece."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Generic, ParamSpec, Self, TypeVar

from geoorbit_ros.core.errors import GeoOrbitError

Parameters = ParamSpec("Parameters")
Item = TypeVar("Item")

ENDING_S = 5.0
"""A process that has sent everything, or was killed, is gone so soon. Chosen: longer waits for one
that the system holds."""


class HelperError(GeoOrbitError):
    """A helper process ended without a word."""


class HelperProcess(Generic[Item]):
    """Runs a generator in a process of its own; iterate over what it yields.

    Leaving the context ends the process, whatever it is doing. It does not outlive this one, and a
    Ctrl-C, which a terminal sends to both, is for this one alone.

    Args:
        function: A generator function of a module.
        args: Its arguments; they are pickled, as is what it yields.
        kwargs: The same, by name.
    """

    def __init__(
        self,
        function: Callable[Parameters, Iterator[Item]],
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> None:
        # Spawned: a fork would copy other threads' locks in whatever state they are.
        context = multiprocessing.get_context("spawn")
        self._receiving, sending = context.Pipe(duplex=False)
        self._come = deque[tuple[int, Any]]()
        self._process = context.Process(
            target=_run, args=(sending, function, args, kwargs), daemon=True
        )
        # The process takes this mask over.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            sending.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _: type[BaseException] | None,
        __: BaseException | None,
        ___: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process, whatever it is doing; again it does nothing."""
        if self._receiving.closed:
            return
        self._process.kill()
        self._process.join()
        self._process.close()
        self._receiving.close()

    def receive(self) -> None:
        """Take what has come so far, without waiting: a pipe that is full stops the process."""
        with contextlib.suppress(EOFError):  # it is told when it is waited for
            while self._receiving.poll():
                self._come.append(self._receiving.recv())

    def __iter__(self) -> Iterator[Item]:
        """What the generator yields.

        Raises:
            GeoOrbitError: What it raises.
            HelperError: The process ended before the generator did.
        """
        while True:
            try:
                kind, value = self._come.popleft() if self._come else self._receiving.recv()
            except EOFError:
                self._process.join(ENDING_S)
                found = f"its end with exit code {self._process.exitcode}"
                raise HelperError("helper process", found, "memory enough for both") from None
            if kind == _ERROR:
                raise value
            if kind == _END:
                return
            yield value


_ITEM, _ERROR, _END = range(3)


def _run(
    sending: Connection,
    function: Callable[..., Iterator[Any]],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
) -> None:
    """What the process does."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(BrokenPipeError):  # nobody listens any more
        try:
            for item in function(*args, **kwargs):
                sending.send((_ITEM, item))
        except Exception as error:  # whatever it is, it is raised again where it is waited for
            sending.send((_ERROR, _that_travels(error)))
        else:
            sending.send((_END, None))
    sending.close()


def _that_travels(error: Exception) -> Exception:
    """The error itself; a defect with its traceback, and as text where it can't be pickled."""
    if not isinstance(error, GeoOrbitError | OSError):
        error.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # what pickling raises depends on the error's class
        return RuntimeError("".join(traceback.format_exception(error)))
    return error


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
