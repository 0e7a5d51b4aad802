"""`geoorbit twin`: the road's digital twin in SUMO."""

from collections.abc import Callable

import typer

from geoorbit_ros.cli.twin.demand import demand
from geoorbit_ros.cli.twin.forecast import forecast
from geoorbit_ros.cli.twin.map_check import patch, validate
from geoorbit_ros.cli.twin.replay import replay, routes

_COMMANDS: dict[str, Callable[..., None]] = {
    "validate": validate,
    "patch": patch,
    "replay": replay,
    "routes": routes,
    "forecast": forecast,
    "demand": demand,
}
app = typer.Typer(help="The road's digital twin in SUMO.", no_args_is_help=True)
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)
