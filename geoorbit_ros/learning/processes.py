"""Work in processes of their own: one beside a node, or one per core for many cameras."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from joblib import Parallel, delayed

NICENESS = 10
"""As forecasts have it. Linux gives live work nine times as much of a core that both want
(sched(7)). Chosen: with 19, the lowest priority, it is 68 times as much, and beside other work that
never rests a round took minutes; smaller holds up live work."""

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


class BackgroundProcess(Executor):
    """Runs one call at a time in a process that starts with the first, and is replaced if it dies.

    The call that it died of ends with `BrokenProcessPool`.
    """

    def __init__(self) -> None:
        self._pool = self._new()

    def submit(
        self,
        fn: Callable[Parameters, Returned],
        /,
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> Future[Returned]:
        """As `Executor.submit`."""
        # The process takes this mask over: a Ctrl-C, which a terminal sends to it as well, is for
        # the process that it works for, and it ends with that one.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._pool = self._new()
            return self._pool.submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def kill(self) -> None:
        """End the process at once."""
        for process in list((self._pool._processes or {}).values()):  # noqa: SLF001, kill_workers: 3.14
            process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _new() -> ProcessPoolExecutor:
        # Spawned: a fork would copy the middleware's threads in an undefined state.
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


Item = TypeVar("Item")
Result = TypeVar("Result")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is."""


def quiet(_what: str, _share: float) -> None:
    """Progress that is not shown."""


def spread(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    """Results in the order of `items`, as they come.

    With one worker everything runs here. Otherwise joblib's current backend is asked: processes of
    this machine, or whatever `joblib.parallel_config` has set (Dask, Ray).
    """
    if workers == 1 or len(items) < 2:
        yield from map(function, items)
        return
    jobs: Iterable[Result] = Parallel(n_jobs=workers, return_as="generator")(
        delayed(function)(item) for item in items
    )
    yield from jobs


def watched(
    results: Iterator[Result], total: int, what: str, progress: Progress
) -> Iterator[Result]:
    """The results, with each one's arrival reported."""
    progress(what, 0.0)
    for k, result in enumerate(results):
        yield result
        progress(what, (k + 1) / total)
