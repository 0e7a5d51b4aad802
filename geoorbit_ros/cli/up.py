"""`geoorbit up`: a fleet of cameras from one file, kept running until Ctrl-C; `geoorbit fleet`."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.input_report import InputReport, Treatment

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from geoorbit_ros.fleet.fleet_file import Fleet
    from geoorbit_ros.fleet.plan import ProcessPlan

OTHERS = 0o077
"""Bits of a file's mode by which others than its owner may do anything with it."""
SIZES = ("image_width", "image_height", "image_sizes")
"""Parameters that follow from the images of a video or scene."""
app = typer.Typer(help="What a fleet file can say.", no_args_is_help=True)

STEP_S = 0.2
"""Longest time between two looks at the processes. Chosen: larger, Ctrl-C takes longer."""


def up(
    fleet: Annotated[str, typer.Argument(help="A fleet file, or the name of a shipped fleet.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of logs, recordings and state; default: out/FLEET."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Start this process only; may be given again."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be started, and end.")
    ] = False,
    duration_s: Annotated[
        float | None, typer.Option("--duration", min=0.1, help="End by itself after so many s.")
    ] = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Start nothing when a camera or service can't be used."),
    ] = False,
) -> None:
    """Start every process of a fleet, watch them, and replace those that end or hang.

    Each camera's nodes share a process; the federated server and the twin have their own. A camera
    or service that can't use what the file gives it is told once and left out, and the command
    ends with 2. Ctrl-C ends all of them within five seconds. [bold]geoorbit status[/bold] shows how
    they are, from another terminal.

    Example: [bold]geoorbit up demo[/bold]
    """
    from rich.markup import escape

    from geoorbit_ros.cli.console import print_remarks, say
    from geoorbit_ros.storage.ownership import Ownership

    report = InputReport(fleet, "cameras")
    try:
        content, plans, folder = _plan(fleet, out, only or [], dry_run, strict, report)
    except GeoOrbitError as error:
        for sentence in report.sentences():
            if sentence not in str(error):
                say(escape(sentence))
        raise
    if dry_run:
        _print_plan(content, plans, folder)
    print_remarks(report)
    if not dry_run:
        folder.mkdir(parents=True, exist_ok=True)
        with Ownership(folder / ".up.lock", str(folder)):
            _watch(fleet, content, plans, folder, duration_s)
    if any(remark.treatment is Treatment.LEFT_OUT for remark in report.remarks):
        raise typer.Exit(2)


def _plan(
    fleet: str,
    out: Path | None,
    only: Sequence[str],
    dry_run: bool,
    strict: bool,
    report: InputReport,
) -> tuple[Fleet, tuple[ProcessPlan, ...], Path]:
    """What is started of a fleet, and its output folder; `report` takes what is left out."""
    from geoorbit_ros.cli.console import status
    from geoorbit_ros.fleet.fleet_io import load_fleet
    from geoorbit_ros.fleet.plan import plan_fleet, select
    from geoorbit_ros.fleet.prepare import leave_out, leave_out_missing, prepare

    content, file = load_fleet(fleet, report)
    folder = (out or Path("out") / content.name).absolute()
    base = file.parent.absolute()
    expected = "a fleet whose cameras and services can all be used"
    content = leave_out_missing(content, base, report)
    report.check(strict, expected)
    plans = select(plan_fleet(content, base, folder), only)
    content = leave_out(content, _plugin_faults(file, plans), report)
    report.check(strict, expected)
    _warn_of_readers(content, base)
    if dry_run:
        return content, select(plan_fleet(content, base, folder), only), folder
    with status("looking at the cameras"):
        plans = prepare(content, base, folder, only, report)
    report.check(strict, expected)
    return content, plans, folder


def _plugin_faults(file: Path, plans: Sequence[ProcessPlan]) -> dict[str, str]:
    """What is wrong with the plug-ins of each process."""
    faults = {}
    for plan in plans:
        try:
            _check_plugins(file, [plan])
        except GeoOrbitError as error:
            faults[plan.name] = str(error)
    return faults


def _warn_of_readers(fleet: Fleet, base: Path) -> None:
    """Say which files with passwords other users of this host can read."""
    from geoorbit_ros.cli.console import error_console

    for camera in fleet.cameras:
        if camera.password_file is None:
            continue
        file = base / camera.password_file
        if file.stat().st_mode & OTHERS:
            text = f"{camera.id}: other users can read {file}; chmod 600 ends that"
            error_console.print(text, soft_wrap=True, markup=False)


def _check_plugins(file: Path, plans: Sequence[ProcessPlan]) -> None:
    """Load every plug-in as its node will: its mistakes are told before anything starts.

    Raises:
        GeoOrbitError: A file without such a class, or a class that its node can't use.
    """
    from geoorbit_ros.core.errors import ParameterError, PluginError
    from geoorbit_ros.detection.detector import make_detector
    from geoorbit_ros.federated.strategies.strategy import make_strategy
    from geoorbit_ros.fleet.plan import chosen_plugins
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.tracking.tracker import make_tracker

    makers: dict[str, Callable[[str], object]] = {
        "detector": lambda name: make_detector(Path(name)),
        "estimator": make_estimator,
        "strategy": make_strategy,
        "tracker": make_tracker,
    }
    for place, kind, name in chosen_plugins(plans):
        try:
            makers[kind](name)
        except (ParameterError, PluginError) as error:
            where = f"{file}{_line_of(name, file)}, {place}, {error.place}"
            raise ParameterError(where, error.found, error.expected) from error


def _line_of(plugin: str, file: Path) -> str:
    """Where the fleet file first names a plug-in; its path may stand there relative to the file."""
    lines = file.read_text(encoding="utf-8").splitlines()
    found = next((k for k, line in enumerate(lines, 1) if Path(plugin).name in line), None)
    return f", line {found}" if found else ""


def _watch(
    name: str, fleet: Fleet, plans: Sequence[ProcessPlan], folder: Path, duration_s: float | None
) -> None:
    """Keep the processes running until Ctrl-C, or for `duration_s`."""
    from rich.markup import escape

    from geoorbit_ros.cli.console import as_typed, console, count_of
    from geoorbit_ros.cli.signals import told_to_end
    from geoorbit_ros.fleet.supervisor import Supervisor

    began = time.monotonic()

    def say(process: str, text: str) -> None:
        console.print(
            f"[dim]{time.monotonic() - began:7.1f} s[/dim]  [bold]{process}[/bold]  {escape(text)}"
        )

    environment = {}
    if fleet.domain_id is not None:
        environment["ROS_DOMAIN_ID"] = str(fleet.domain_id)
    supervisor = Supervisor(plans, folder, environment, say)
    domain = environment.get("ROS_DOMAIN_ID") or os.environ.get("ROS_DOMAIN_ID", "0")
    number = count_of(len(plans), "process", "processes")
    console.print(f"Fleet {fleet.name}: {number}, ROS domain {domain}. Ctrl-C ends it.")
    console.print(f"To see its state, in another terminal: {as_typed(f'status {name}')}")
    console.print(f"Logs: {folder / 'logs'}", soft_wrap=True)
    announced = False
    with told_to_end() as end:
        try:
            while not end.is_set():
                if duration_s is not None and time.monotonic() - began > duration_s:
                    break
                supervisor.step(STEP_S)
                if len(refused := supervisor.refused) == len(plans):
                    break
                if not announced and supervisor.settled:
                    announced = True
                    without = f", without {', '.join(refused)}" if refused else ""
                    say("fleet", f"{len(plans) - len(refused)} of {number} started{without}")
        finally:
            ending = time.monotonic()
            supervisor.stop()
            say("fleet", f"stopped in {time.monotonic() - ending:.1f} s")
    if supervisor.refused:
        raise typer.Exit(2)


def _print_plan(fleet: Fleet, plans: Sequence[ProcessPlan], folder: Path) -> None:
    from geoorbit_ros.cli.console import console, make_table, say
    from geoorbit_ros.core.addresses import masked

    table = make_table(f"Fleet {fleet.name}", "process|node|parameters set")
    asked = {c.id for c in fleet.cameras if c.kind in ("scene", "file") and not c.image_size}
    for plan in plans:
        name = plan.name
        for node in plan.nodes:
            hidden = SIZES if node.namespace in asked or (asked and not node.namespace) else ()
            shown = {key: value for key, value in node.parameters.items() if key not in hidden}
            values = ", ".join(f"{k}={masked(str(v))}" for k, v in shown.items())
            table.add_row(name, node.executable, values)
            name = ""
    for column in table.columns[2:]:
        column.no_wrap, column.overflow = False, "fold"
    console.print(table)
    if asked:
        say(f"Image sizes of {', '.join(sorted(asked))} are asked for when they are started.")
    say(f"Nothing was started. Logs, recordings and state would go to {folder}.")


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
