"""One progress bar for the steps of training and evaluation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geoorbit_ros.learning.workers import Progress


@contextmanager
def shown_progress() -> Iterator[Progress]:
    """A callback that shows each step as a bar of its own; finished ones vanish."""
    from geoorbit_ros.cli.console import make_progress

    with make_progress() as bars:
        task = bars.add_task("preparing", total=1.0)

        def report(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        yield report
