"""The list of commands, and `--version`.

Command modules import what they compute with inside their functions, so that `geoorbit --help`
answers at once.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import getdoc
from typing import Annotated

import typer

from geoorbit_ros import __version__
from geoorbit_ros.cli import bag, camera, database, scene, twin
from geoorbit_ros.cli import map as road_map
from geoorbit_ros.cli.calibrate import calibrate
from geoorbit_ros.cli.detect import detect
from geoorbit_ros.cli.export import export
from geoorbit_ros.cli.lanes import lanes, score
from geoorbit_ros.cli.process import process
from geoorbit_ros.cli.replay import demo, replay
from geoorbit_ros.cli.report import report
from geoorbit_ros.cli.status import status
from geoorbit_ros.cli.track import track
from geoorbit_ros.cli.traffic import traffic
from geoorbit_ros.cli.train import evaluate, federation, train
from geoorbit_ros.cli.up import app as fleet
from geoorbit_ros.cli.up import up
from geoorbit_ros.cli.view import view

_HELP = (
    "Live lane maps from roadside cameras.\n\n"
    "A camera on a pole, the tracks of the vehicles that drive by, and a few points whose pixel "
    "and position you know: enough to find every lane, its width and its direction of travel.\n\n"
    "Example: [bold]geoorbit demo[/bold] shows all of it; [bold]geoorbit lanes --help[/bold] "
    "explains one command."
)

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


_COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "calibrate": calibrate,
    "lanes": lanes,
    "process": process,
    "replay": replay,
    "detect": detect,
    "track": track,
    "score": score,
    "report": report,
    "traffic": traffic,
    "train": train,
    "evaluate": evaluate,
    "export": export,
    "up": up,
    "status": status,
    "view": view,
}
_GROUPS = {
    "scene": scene.app,
    "camera": camera.app,
    "fleet": fleet,
    "bag": bag.app,
    "db": database.app,
    "map": road_map.app,
    "twin": twin.app,
    "federation": federation,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)
for _name, _group in _GROUPS.items():
    app.add_typer(_group, name=_name)


def _reflow(commands: typer.Typer) -> None:
    """Let the terminal break the lines of help texts: typer keeps a docstring's own breaks."""
    for command in commands.registered_commands:
        text = command.help or getdoc(command.callback) or ""
        command.help = "\n\n".join(" ".join(p.split()) for p in text.split("\n\n"))
    for group in commands.registered_groups:
        if group.typer_instance:
            _reflow(group.typer_instance)


_reflow(app)
