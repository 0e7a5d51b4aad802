"""What every command prints with: one console, progress, tables of lanes and scores, units."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console

from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.table import Table

    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.lanes.geojson import LaneFile
    from geoorbit_ros.learning.processes import Progress
    from geoorbit_ros.metrics.lane_score import LaneScore


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
"""Between two drawings of a progress bar. Chosen: smaller costs time, larger looks stuck."""


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


def as_typed(arguments: str) -> str:
    """`geoorbit ARGUMENTS` as the user types it here: `./dev run ARGUMENTS` in a clone."""
    return f"{os.environ.get('GEOORBIT_COMMAND', 'geoorbit')} {arguments}"


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


_STYLE = {"confirmed": "green", "tentative": "yellow"}


def print_lanes(lane_map: LaneMap, title: str = "Lanes") -> None:
    """Print one row per lane, from left to right, and what traffic tentative lanes still need."""
    from geoorbit_ros.core.lane_order import lane_numbers, left_to_right
    from geoorbit_ros.report.text import compass, number, summary_sentence, tentative_sentences

    table = make_table(
        title,
        ">lane\nid|>lane\nno.|status|towards|>width m|>vehicles|>confi-\ndence|>length\nm|>± m",
    )
    numbers = lane_numbers(lane_map.lanes)
    for lane in left_to_right(lane_map.lanes):
        table.add_row(
            str(lane.lane_id),
            str(numbers[lane.lane_id]),
            f"[{_STYLE[lane.status]}]{lane.status}[/]",
            f"{compass(lane.heading_deg):>2} {lane.heading_deg:3.0f}°",
            f"{number(lane.width_m)} ± {number(lane.width_sigma_m)}",
            number(lane.vehicles, 0),
            number(lane.confidence),
            number(lane.length_m, 0),
            number(lane.sigma_m),
        )
    console.print(table)
    for sentence in tentative_sentences(lane_map):
        say(sentence)
    say(summary_sentence(lane_map.lanes))


def print_remarks(*reports: InputReport) -> None:
    """Say what was done with the rows of files, a sentence per kind of fault; doubts in red."""
    from rich.markup import escape

    from geoorbit_ros.core.input_report import Treatment

    for report in reports:
        for remark, sentence in zip(report.remarks, report.sentences(), strict=True):
            text = escape(f"{Path(report.place).name}: {sentence}")
            say(f"[red]Doubtful.[/] {text}" if remark.treatment is Treatment.DOUBTFUL else text)


def read_lanes_aloud(path: Path, datum: Datum | None = None) -> LaneFile:
    """A lane file; what was repaired or left out in it goes to standard error.

    Raises:
        InputFileError: It can't be used.
    """
    from geoorbit_ros.lanes.geojson import read_lane_file

    file = read_lane_file(path, datum)
    for sentence in file.report.sentences():
        error_console.print(f"{path.name}: {sentence}", soft_wrap=True, markup=False)
    return file


def print_score(score: LaneScore) -> None:
    """Print one row per true lane, and the totals as sentences."""
    from geoorbit_ros.report.text import number, score_sentences

    table = make_table(
        "Compared with the true lanes",
        ">truth|>vehicles|>lane\nid|status|>error m|>95 % m|>bias m|>width m|>covered",
    )
    for row in score.lanes:
        if row.lane_id is None:
            table.add_row(
                str(row.truth_id), number(row.vehicles, 0), "–", "[red]missed[/]", *["–"] * 5
            )
            continue
        table.add_row(
            str(row.truth_id),
            number(row.vehicles, 0),
            str(row.lane_id),
            f"[{_STYLE[str(row.status)]}]{row.status}[/]",
            number(row.mean_m),
            number(row.p95_m),
            number(row.bias_m, signed=True),
            number(row.width_error_m, signed=True),
            f"{row.coverage:.0%}",
        )
    console.print(table)
    for sentence in score_sentences(score):
        say(sentence)


_EPOCH_NS = 10**17
"""Later than 1973: the clock counts from 1970. Earlier: from the start of some recording."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
"""Stamps count from here (POSIX)."""


def format_size(size_bytes: int) -> str:
    """`479.7 kB`; powers of 1000."""
    for unit, scale in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.1f} {unit}"
    return f"{size_bytes} bytes"


def count_of(number: int, noun: str, plural: str | None = None) -> str:
    """`1 camera`, `2 cameras`."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"


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
