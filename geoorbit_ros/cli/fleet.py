"""`geoorbit fleet`: what a fleet file can say."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(help="What a fleet file can say.", no_args_is_help=True)


@app.callback()
def _fleet() -> None:
    """What a fleet file can say."""


@app.command("parameters")
def parameters(
    node: Annotated[
        str | None, typer.Argument(help="A node, such as detector. Default: all of them.")
    ] = None,
) -> None:
    """List the parameters of nodes: name, default and meaning.

    A fleet file sets them for a camera or a service under the key [bold]parameters[/bold].

    Example: [bold]geoorbit fleet parameters detector[/bold]
    """
    from geoorbit_ros.cli.console import console, make_table
    from geoorbit_ros.fleet.fleet_file import NODES, node_parameters

    for name in (node,) if node else NODES:
        table = make_table(name, "parameter|default|accepts|meaning")
        for column in table.columns[1:]:
            column.no_wrap, column.overflow = False, "fold"
        for spec in node_parameters(name):
            default = str(spec.default).lower() if spec.kind == "bool" else str(spec.default)
            table.add_row(spec.name, default, spec.expected, spec.description)
        console.print(table)
