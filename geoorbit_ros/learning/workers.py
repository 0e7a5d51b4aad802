"""Work on many cameras at once, over the cores of this machine or of a cluster (joblib)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from joblib import Parallel, delayed

Item = TypeVar("Item")
Result = TypeVar("Result")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is."""


def quiet(_what: str, _share: float) -> None:
    """Progress that nobody watches."""


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
