"""`geoorbit status`: how the nodes of a running fleet are."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import DomainOption

if TYPE_CHECKING:
    from rich.console import RenderableType

    from geoorbit_ros.fleet.health import NodeReport, Row
    from geoorbit_ros.nodes.support.composition import Composition
    from geoorbit_ros.nodes.support.diagnostics import StatusListener

SETTLE_S, LISTEN_S = 3.0, 6.0
"""`--once` listens at least and, while something isn't healthy, at most this long: discovery takes
two seconds, every node speaks once a second."""
REDRAW_S = 0.5
"""Between two drawings. Nodes report every second: half of that shows each report at once."""


def status(
    fleet: Annotated[
        str | None,
        typer.Argument(help="The fleet: what of it is not heard is shown, too."),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Listen briefly, print once, end.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --once: for scripts.")] = False,
    wait_s: Annotated[
        float,
        typer.Option("--wait", min=0.0, help="With --once: wait so many s until all is healthy."),
    ] = 0.0,
    domain_id: DomainOption = None,
) -> None:
    """Show frame rates, latencies, drops, vehicles and lanes of every camera, live.

    Ends with 1 with --once when something is not healthy or nothing is heard.

    Example: [bold]geoorbit status demo --once --json[/bold]
    """
    from geoorbit_ros.cli.console import console, print_remarks
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.fleet.fleet_io import load_fleet
    from geoorbit_ros.fleet.health import rows
    from geoorbit_ros.fleet.plan import expected_nodes
    from geoorbit_ros.fleet.prepare import leave_out_missing
    from geoorbit_ros.nodes.support.composition import Composition
    from geoorbit_ros.nodes.support.diagnostics import StatusListener

    expected = None
    report = InputReport(fleet or "", "cameras")
    if fleet is not None:
        content, file = load_fleet(fleet, report)
        content = leave_out_missing(content, file.parent.absolute(), report)
        expected = expected_nodes(content)
        domain_id = content.domain_id if domain_id is None else domain_id
    with Composition(_domain(domain_id), quiet=True) as nodes:
        listener = nodes.add(StatusListener(nodes.context))
        if once:
            deadline = time.monotonic() + max(wait_s, LISTEN_S)
            settled = time.monotonic() + SETTLE_S
            while time.monotonic() < deadline:
                nodes.spin()
                found = rows(listener.reports(), expected)
                if time.monotonic() > settled and _healthy(found):
                    break
            cameras, services = rows(listener.reports(), expected)
            if as_json:
                content_json = _as_json(cameras, services) | {"remarks": list(report.sentences())}
                typer.echo(json.dumps(content_json, indent=2))
            else:
                console.print(_tables(cameras, services, listener.reports()))
                print_remarks(report)
            healthy = _healthy((cameras, services)) and not report.faults
            raise typer.Exit(0 if healthy else 1)
        print_remarks(report)
        _watch(nodes, listener, expected)


def _watch(
    nodes: Composition, listener: StatusListener, expected: Mapping[str, Sequence[str]] | None
) -> None:
    from rich.live import Live

    from geoorbit_ros.cli.console import console
    from geoorbit_ros.cli.signals import told_to_end
    from geoorbit_ros.fleet.health import rows

    drawn = 0.0
    with told_to_end() as end, Live(console=console, auto_refresh=False) as live:
        while not end.is_set():
            nodes.spin()
            if time.monotonic() - drawn >= REDRAW_S:
                heard = listener.reports()
                live.update(_tables(*rows(heard, expected), heard), refresh=True)
                drawn = time.monotonic()


def _domain(domain_id: int | None) -> int:
    import os

    return int(os.environ.get("ROS_DOMAIN_ID", "0")) if domain_id is None else domain_id


def _healthy(found: tuple[list[Row], list[Row]]) -> bool:
    everything = [*found[0], *found[1]]
    return bool(everything) and all(row.healthy for row in everything)


def _as_json(cameras: Sequence[Row], services: Sequence[Row]) -> dict[str, object]:
    def plain(row: Row) -> dict[str, object]:
        return {
            "name": row.name,
            "healthy": row.healthy,
            "nodes": row.nodes,
            "problems": list(row.problems),
            "values": {key: _number(value) for key, value in row.values.items()},
        }

    return {
        "healthy": _healthy((list(cameras), list(services))),
        "cameras": [plain(row) for row in cameras],
        "services": [plain(row) for row in services],
    }


def _number(value: str) -> object:
    try:
        return float(value) if "." in value or "e" in value else int(value)
    except ValueError:
        return value


def _tables(
    cameras: Sequence[Row], services: Sequence[Row], heard: Sequence[NodeReport]
) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    from geoorbit_ros.cli.console import make_table
    from geoorbit_ros.fleet.health import COLUMNS

    if not heard:  # a line for each node that is missing says no more
        return Text("No node heard yet: is the fleet up, on this ROS domain?")
    columns = [column for column in COLUMNS if column.title]
    titles = "|".join(f">{column.title}" for column in columns)
    table = make_table("Cameras", f" |camera|>nodes|{titles}")
    for row in cameras:
        values = [_cell(row, column.key) for column in columns]
        table.add_row(_mark(row), row.name, str(row.nodes), *values)
    parts: list[RenderableType] = [table] if cameras else []
    if services:
        other = make_table("Services", " |node|")
        for row in services:
            other.add_row(_mark(row), row.name, row.words)
        other.columns[-1].no_wrap, other.columns[-1].overflow = False, "fold"
        parts.append(other)
    for row in [*cameras, *services]:
        parts += [Text(f" {row.name}: {problem}", style="red") for problem in row.problems]
    return Group(*parts)


def _cell(row: Row, key: str) -> str:
    """A value of a camera; many lost frames stand out, by a sign beside their colour."""
    from geoorbit_ros.fleet.health import MAX_LOST_SHARE

    shown = _short(row.values.get(key, "–"))
    if key == "lost" and float(row.values.get("lost_share", 0.0)) > MAX_LOST_SHARE:
        return f"[yellow]{shown} ![/yellow]"
    return shown


def _short(value: str) -> str:
    """A number with at most one decimal, none from 100 on: a table is read at a glance."""
    try:
        number = float(value)
    except ValueError:
        return value
    return f"{number:.0f}" if abs(number) >= 100.0 or number == int(number) else f"{number:.1f}"


def _mark(row: Row) -> str:
    return "[green]ok[/green]" if row.healthy else "[bold red]fault[/bold red]"
