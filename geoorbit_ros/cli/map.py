"""`geoorbit map`: road networks from OpenStreetMap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import DatumOption, DrivingSideOption, ForceOption

if TYPE_CHECKING:
    from geoorbit_ros.roadnet.map_build import BuiltMap

app = typer.Typer(help="Road networks for the digital twin.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `build` a command of its own while it is the only one."""


@app.command("build")
def build(
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; new or empty.")],
    area: Annotated[
        Path | None,
        typer.Argument(help="OpenStreetMap extract: .osm, .osm.gz, .osm.bz2, or JSON of Overpass."),
    ] = None,
    net: Annotated[
        Path | None, typer.Option("--net", help="A SUMO network there is, instead of an extract.")
    ] = None,
    datum: DatumOption = None,
    lane_width: Annotated[
        float,
        typer.Option(
            "--lane-width", min=2.0, max=6.0, help="Metres, for lanes whose width the map lacks."
        ),
    ] = 3.5,
    driving_side: DrivingSideOption = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse an extract that has any fault.")
    ] = False,
    force: ForceOption = False,
) -> None:
    """Make a SUMO network and an OpenDRIVE road of a map, by SUMO's own netconvert.

    Into the folder go network.net.xml, road.xodr (which CARLA opens), map.png, and map.json with
    the versions and options that made them. Coordinates are metres east and north of the datum.

    Example: [bold]geoorbit map build area.osm --out area[/bold]
    """
    from geoorbit_ros.cli.console import console, status
    from geoorbit_ros.cli.inputs import parse_datum, parse_driving_side
    from geoorbit_ros.core.errors import ParameterError
    from geoorbit_ros.roadnet.map_build import build_from_network, build_from_osm
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.twin.figures import save_network_figure

    origin, side = parse_datum(datum), parse_driving_side(driving_side)
    with atomic_output(out, overwrite=force) as folder:
        folder.mkdir()
        with status("building the network"):
            if area is not None and net is None:
                built = build_from_osm(area, folder, origin, lane_width, side, strict)
            elif net is not None and area is None:
                built = build_from_network(net, folder, origin, side)
            else:
                found = "neither" if area is None else "both"
                expected = "exactly one of them"
                raise ParameterError("an OpenStreetMap extract and --net", found, expected)
            save_network_figure(folder / "map.png", built.network)
    _print_map(built)
    console.print(f" Wrote {out}", soft_wrap=True)


def _print_map(built: BuiltMap) -> None:
    import numpy as np

    from geoorbit_ros.cli.console import console as screen
    from geoorbit_ros.cli.console import count_of, make_table, print_remarks, say

    network = built.network
    table = make_table("Lanes of the network", ">width m|>lanes|>km")
    outside = ~network.internal
    for width in np.unique(network.width_m[outside]):
        chosen = outside & (network.width_m == width)
        table.add_row(
            f"{width:.2f}", str(int(chosen.sum())), f"{network.length_m[chosen].sum() / 1e3:.2f}"
        )
    screen.print(table)
    datum = network.datum
    say(
        f"{count_of(built.opendrive, 'OpenDRIVE road')}; (0, 0) is at {datum.latitude_deg:.7f}, "
        f"{datum.longitude_deg:.7f}."
    )
    for sentence in built.said:
        say(sentence)
    print_remarks(built.report)
    if built.warnings:
        say(f"netconvert had {count_of(len(built.warnings), 'warning')} (map.json).")
