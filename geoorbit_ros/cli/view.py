"""`geoorbit view`: the running graph, or a bag, for Foxglove-compatible viewers."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import DomainOption, ImageSizeOption

if TYPE_CHECKING:
    from geoorbit_ros.nodes.support.composition import Composition
    from geoorbit_ros.nodes.viewer import ViewerNode

DISCOVERY_S = 15.0
"""For a camera to be seen in the graph. Chosen: discovery takes two seconds on an idle machine."""


def view(
    bag: Annotated[
        Path | None, typer.Option(help="Play this bag again and again; default: the live graph.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="With --bag: control points, to see lanes, too.")
    ] = None,
    camera_id: Annotated[
        str | None, typer.Option(help="With --bag: which of its cameras; default: its only one.")
    ] = None,
    image_size: ImageSizeOption = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 lets other machines look.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8765,
    topics: Annotated[str, typer.Option(help="Regular expression of the topics offered.")] = ".*",
    layout: Annotated[
        Path | None, typer.Option(help="Write a layout for the cameras in the graph here.")
    ] = None,
    domain_id: DomainOption = None,
) -> None:
    """Serve images with boxes, tracks, lanes, maps and diagnostics to viewers, until Ctrl-C.

    Open [bold]ws://HOST:PORT[/bold] in a Foxglove-compatible viewer; `--layout FILE` writes a
    layout for it. A topic costs nothing until a viewer looks at it.

    Example: [bold]geoorbit view --bag bags/demo/bag --calibration bags/demo/calibration.csv[/bold]
    """
    from geoorbit_ros.cli.console import console
    from geoorbit_ros.cli.signals import told_to_end
    from geoorbit_ros.nodes.support.composition import Composition
    from geoorbit_ros.nodes.viewer import ViewerNode

    if bag is None and domain_id is None:
        domain_id = int(os.environ.get("ROS_DOMAIN_ID", "0"))
    with Composition(domain_id, quiet=True) as nodes, told_to_end() as end:
        if bag is not None:
            _add_bag(nodes, bag, calibration, camera_id, image_size)
        settings = {"host": host, "port": port, "topics": topics}
        viewer = nodes.make(ViewerNode, "", settings)
        console.print(f"Viewers: [bold]ws://{host}:{viewer.server.port}[/bold]")
        if layout is not None:
            _write_layout(nodes, viewer, layout)
            console.print(f"Layout:  {layout}")
        console.print("Ctrl-C ends it.")
        while not end.is_set():
            nodes.spin()


def _write_layout(nodes: Composition, viewer: ViewerNode, file: Path) -> None:
    """Wait until the graph shows cameras, then write a layout for them."""
    import json

    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.viewer.layout import make_layout

    def cameras() -> list[str]:
        named = [topic.split("/") for topic in viewer.server.topics]
        return sorted({parts[1] for parts in named if parts[2:] == ["lanes"]})

    nodes.wait(lambda: bool(cameras()), DISCOVERY_S, "a camera's topic 'lanes' in the graph")
    with atomic_output(file) as path:
        path.write_text(json.dumps(make_layout(cameras()), indent=1), encoding="utf-8")


def _add_bag(
    nodes: Composition,
    bag: Path,
    calibration: Path | None,
    camera_id: str | None,
    image_size: str | None,
) -> None:
    from geoorbit_ros.cli.console import print_remarks
    from geoorbit_ros.cli.inputs import ASSUMED_SIZE, with_image_size
    from geoorbit_ros.nodes.bag_player import BagPlayerNode
    from geoorbit_ros.nodes.homography import HomographyNode
    from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
    from geoorbit_ros.storage.track_bag import read_track_bag

    content = read_track_bag(bag, camera_id, with_image_size(image_size))
    width, height = content.report.image_size or ASSUMED_SIZE
    print_remarks(content.report)
    camera = content.camera_id or "camera"
    if calibration is not None:
        nodes.make(LaneGeometryNode, camera, {})
        ground: dict[str, object] = {"calibration_file": str(calibration)}
        size = {"image_width": width, "image_height": height}
        nodes.make(HomographyNode, camera, ground | size)
    nodes.make(BagPlayerNode, camera, {"bag": str(bag), "camera_id": camera, "loop": True})
