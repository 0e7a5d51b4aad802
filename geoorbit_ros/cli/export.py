"""`geoorbit export`: a lane map for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.cli.inputs import DrivingSideOption


class ExportFormat(StrEnum):
    """What programs read."""

    GEOJSON = "geojson"
    SUMO = "sumo"
    OPENDRIVE = "opendrive"
    LANELET2 = "lanelet2"


SUFFIXES = {
    ExportFormat.GEOJSON: ".geojson",
    ExportFormat.SUMO: ".net.xml",
    ExportFormat.OPENDRIVE: ".xodr",
    ExportFormat.LANELET2: ".osm",
}


def export(
    lanes: Annotated[Path, typer.Argument(help="A lane map: lanes.geojson.")],
    target: Annotated[ExportFormat, typer.Option("--format", help="Format of the file.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="The file; default: beside the lane map.")
    ] = None,
    tentative: Annotated[
        bool, typer.Option("--tentative", help="Lanes without enough traffic yet, too.")
    ] = False,
    driving_side: DrivingSideOption = None,
) -> None:
    """Write a lane map as GeoJSON, SUMO network, OpenDRIVE or Lanelet2 map.

    Each lane keeps its id, status, confidence, width with error and the vehicles seen; the map its
    camera, estimator and time.

    Example: [bold]geoorbit export lanes.geojson --format opendrive[/bold]
    """
    from dataclasses import replace

    from geoorbit_ros.cli.console import console, read_lanes_aloud
    from geoorbit_ros.cli.inputs import parse_driving_side
    from geoorbit_ros.core.errors import NoTrafficError
    from geoorbit_ros.exchange.lanelet2 import to_lanelet2
    from geoorbit_ros.exchange.opendrive import to_opendrive
    from geoorbit_ros.exchange.sumo import to_sumo
    from geoorbit_ros.lanes.geojson import LaneFile, dumps_lanes
    from geoorbit_ros.roadnet.driving_side import MapEvidence, choose_side
    from geoorbit_ros.storage.atomic import atomic_output

    def to_geojson(file: LaneFile) -> str:
        names = {"camera_id": file.camera_id, "estimator": file.estimator}
        return dumps_lanes(file.lane_map, file.datum, **names)

    def as_sumo(file: LaneFile) -> str:
        given = parse_driving_side(driving_side)
        side = choose_side(given, MapEvidence({}, {}, 0.0), file.datum, str(lanes))
        console.print(f" {side.sentence}", soft_wrap=True)
        return to_sumo(file, side.side)

    writers = {
        ExportFormat.GEOJSON: to_geojson,
        ExportFormat.SUMO: as_sumo,
        ExportFormat.OPENDRIVE: to_opendrive,
        ExportFormat.LANELET2: to_lanelet2,
    }
    file = read_lanes_aloud(lanes)
    if not tentative:
        kept = file.lane_map.confirmed
        file = replace(file, lane_map=replace(file.lane_map, lanes=kept))
    if not file.lane_map.lanes:
        found = "no confirmed lane" if not tentative else "no lane"
        raise NoTrafficError(str(lanes), found, "lanes (tentative ones with --tentative)")
    stem = lanes.with_suffix("") if lanes.suffix == ".geojson" else lanes
    target_file = out or stem.with_name(f"{stem.name}.exported{SUFFIXES[target]}")
    text = writers[target](file)
    with atomic_output(target_file) as path:
        path.write_text(text, encoding="utf-8")
    console.print(f"{len(file.lane_map.lanes)} lanes as {target.value}: {target_file}")
