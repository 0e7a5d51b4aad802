"""One process for long work beside a node that must not be held up."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

NICENESS = 19
"""The lowest priority: whatever is live comes first, also where there are few cores."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class BackgroundProcess(Executor):
    """Runs one call at a time in a process that starts with the first, and is replaced if it dies.

    The call that it died of ends with `BrokenProcessPool`.
    """

    def __init__(self) -> None:
        self._pool = self._new()

    def submit(
        self,
        fn: Callable[Parameters, Result],
        /,
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> Future[Result]:
        """As `Executor.submit`."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._pool = self._new()
            return self._pool.submit(fn, *args, **kwargs)

    def kill(self) -> None:
        """End the process, whatever it does."""
        for process in list((self._pool._processes or {}).values()):
            process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _new() -> ProcessPoolExecutor:
        # Spawned: a fork would copy the middleware's threads in whatever state they are.
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, start_in_background)


def start_in_background() -> None:
    """Initialiser: low priority; ends when the process that started it ends, kill -9 included."""
    os.setpriority(os.PRIO_PROCESS, 0, NICENESS)  # nice() would add to what the node was given
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
