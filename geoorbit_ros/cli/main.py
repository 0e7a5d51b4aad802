"""The `geoorbit` command: its commands, how errors end, `--version`.

Command modules import what they compute with inside their functions, so that `geoorbit --help`
answers at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated

import typer

from geoorbit_ros import __version__
from geoorbit_ros.core.errors import GeoOrbitError

EXIT_BAD_INPUT = 2

_HELP = """
Live lane maps from roadside cameras.

A camera on a pole, the tracks of the vehicles that drive by, and a few points whose pixel and
position you know: enough to find every lane, its width and its direction of travel.

Example: [bold]geoorbit demo[/bold] shows all of it; [bold]geoorbit lanes --help[/bold] explains
one command.
"""

app = typer.Typer(
    name="geoorbit",
    help=_HELP,
    no_args_is_help=True,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"geoorbit {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options before the command."""


def _register() -> None:
    for name in ("demo", "lanes", "replay", "score", "report"):
        if find_spec(f"geoorbit_ros.cli.{name}"):
            app.command(name)(getattr(import_module(f"geoorbit_ros.cli.{name}"), name))
    for name, module in (("scene", "scene"), ("bag", "bag"), ("db", "database")):
        if find_spec(f"geoorbit_ros.cli.{module}"):
            app.add_typer(import_module(f"geoorbit_ros.cli.{module}").app, name=name)


_register()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; what `geoorbit` on the command line calls.

    Args:
        arguments: Words after `geoorbit`; default: the process's.

    Returns:
        Exit code: 0 done, 1 a `--require` not met, 2 bad input (one sentence on standard error),
        130 interrupted. Any other exception is a defect and keeps its traceback.
    """
    try:
        app(args=None if arguments is None else list(arguments), prog_name="geoorbit")
    except GeoOrbitError as error:
        print(f"geoorbit: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


if __name__ == "__main__":
    sys.exit(main())
