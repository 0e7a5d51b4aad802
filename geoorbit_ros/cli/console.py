"""What every command prints with: one console, one progress display, one table style."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.table import Table

    from geoorbit_ros.learning.processes import Progress


_PIPED_WIDTH = 120
"""Columns where no terminal has any: rich's 80 cut tables in log files."""


def _make_console(*, stderr: bool) -> Console:
    known = (sys.stderr if stderr else sys.stdout).isatty() or "COLUMNS" in os.environ
    return Console(stderr=stderr, highlight=False, width=None if known else _PIPED_WIDTH)


console = _make_console(stderr=False)
"""Results: standard output."""
error_console = _make_console(stderr=True)
"""Progress and errors: standard error, so that results can be piped."""

_Item = TypeVar("_Item")
_MIN_REDRAW_S = 0.1


def make_progress() -> RichProgress:
    """A progress display on standard error that vanishes when it ends; silent when piped."""
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=error_console,
        transient=True,
        disable=not error_console.is_terminal,
    )


def track(items: Iterable[_Item], description: str, total: float | None = None) -> Iterator[_Item]:
    """Yield `items` under a progress bar, redrawn at most ten times a second."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with make_progress() as progress:
        task = progress.add_task(description, total=total)
        drawn = 0.0
        for done, item in enumerate(items):
            now = time.monotonic()
            if now - drawn >= _MIN_REDRAW_S:
                progress.update(task, completed=done)
                drawn = now
            yield item


@contextmanager
def status(text: str) -> Iterator[None]:
    """A spinner beside `text` while something of unknown length runs."""
    if not error_console.is_terminal:
        yield
        return
    with error_console.status(text):
        yield


def say(text: str) -> None:
    """Print a sentence below a table, indented like it."""
    from rich.padding import Padding

    console.print(Padding(text, (0, 0, 0, 1)))


def make_table(title: str, columns: str) -> Table:
    """An empty table; `columns` are its headings, `>` before one aligns it to the right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for column in columns.split("|"):
        right = column.startswith(">")
        table.add_column(column.lstrip(">"), justify="right" if right else "left", no_wrap=True)
    return table


@contextmanager
def shown_progress() -> Iterator[Progress]:
    """A callback that shows each step as a bar of its own; finished ones vanish."""
    with make_progress() as bars:
        task = bars.add_task("preparing", total=1.0)

        def report(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        yield report
