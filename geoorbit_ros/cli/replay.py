"""`geoorbit replay`: a bag through the real node graph; `geoorbit demo`: with the bundled one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    CalibrationOption,
    CameraIdOption,
    CameraInfoOption,
    DatumOption,
    EstimatorOption,
    ImageSizeOption,
    RoadImageOption,
    StrictOption,
    UpdatePeriodOption,
    read_options,
)

if TYPE_CHECKING:
    from geoorbit_ros.cli.camera_input import CameraInput
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.nodes.support.bag_replay import ReplayRequest

DEMO_BAG = "bags/demo"
"""Folder of the share folder: `bag`, `calibration.csv`, `truth.geojson`."""


def replay(
    bag: Annotated[Path, typer.Argument(help="Tracked boxes: a rosbag2 bag with tracks_px.")],
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Where the lane map goes: lanes.geojson.")],
    rate: Annotated[
        float,
        typer.Option(min=0.0, max=1000.0, help="Speed; 0 plays as fast as the nodes can."),
    ] = 10.0,
    camera_id: CameraIdOption = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    image: RoadImageOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
    database: Annotated[
        Path | None, typer.Option("--database", help="Also record into this trajectory database.")
    ] = None,
    domain_id: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=232,
            help="ROS domain, for example of RViz; default: a free one, this machine only.",
        ),
    ] = None,
    strict: StrictOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Show what the nodes log.")] = False,
) -> None:
    """Replay a bag through the real nodes: bag_player, homography, lane_geometry (and recorder).

    No frame is lost at any rate, and the lane map is, byte for byte, that of
    [bold]geoorbit lanes[/bold]: it depends on the recording's time alone.

    Example: [bold]geoorbit replay north_bag --calibration calibration.csv --rate 10
    --out lanes.geojson[/bold]
    """
    from geoorbit_ros.cli.console import console, print_lanes, print_remarks
    from geoorbit_ros.cli.images import road_background
    from geoorbit_ros.nodes.support.bag_replay import ReplayRequest

    options = read_options(None, None, "coco", strict)
    named = (camera_id, image_size, datum, out, options, image, camera_info)
    camera = load_camera(None, bag, calibration, *named)
    datum_deg = (camera.datum.latitude_deg, camera.datum.longitude_deg)
    size, quiet = camera.image_size, not verbose
    request = ReplayRequest(
        bag, calibration, camera.camera_id, datum_deg, size, rate, estimator, update_period_s,
        database, road_background(image) if image else None, domain_id, quiet, camera_info,
    )  # fmt: skip
    with as_the_nodes_take_it(camera) as played:
        lane_map, elapsed_s = _run(replace(request, bag=played), camera, out)
    recorded_s = (camera.frames.stamp_ns[-1] - camera.frames.stamp_ns[0]) / 1e9
    print_lanes(lane_map, f"Lanes of {camera.camera_id}")
    print_remarks(camera.input_report)
    said = f" Replayed {len(camera.frames)} frames, {recorded_s:.1f} s, in {elapsed_s:.1f} s;"
    console.print(f"{said} wrote {out}", soft_wrap=True)


def demo(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for lanes.geojson and report.html.")
    ] = Path("geoorbit-demo"),
    rate: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Speed; 0 plays as fast as the nodes can.")
    ] = 10.0,
) -> None:
    """See it work: replay a small bundled bag through the real nodes, score it, write a report.

    The bag is a synthetic camera over a bending road, a minute long, so the true lanes are known.

    Example: [bold]geoorbit demo --out geoorbit-demo[/bold]
    """
    from geoorbit_ros.cli.console import as_typed, console
    from geoorbit_ros.cli.lanes import score
    from geoorbit_ros.cli.report import report
    from geoorbit_ros.core.resources import share_path

    folder = share_path(DEMO_BAG)
    bag, calibration, truth = (
        folder / name for name in ("bag", "calibration.csv", "truth.geojson")
    )
    lanes, page = out / "lanes.geojson", out / "report.html"
    console.print("A minute of simulated traffic goes through the nodes bag_player, homography and")
    console.print("lane_geometry. Its true lanes are known, so the result can be compared.\n")
    replay(bag=bag, calibration=calibration, out=lanes, rate=rate)
    score(lanes, truth)
    report(calibration=calibration, out=page, bag=bag, lanes=lanes, truth=truth)
    console.print(f"\nOpen {page.resolve().as_uri()}", soft_wrap=True)
    console.print(f"Next, with your own tracks and control points: {as_typed('lanes --help')}")


@contextmanager
def as_the_nodes_take_it(camera: CameraInput) -> Iterator[Path]:
    """The camera's bag; where its boxes had to be put right, a bag with the right ones."""
    from geoorbit_ros.storage.track_bag import write_track_bag

    if not camera.input_report.faults and camera.bag_topic == f"/{camera.camera_id}/tracks_px":
        yield camera.source
        return
    with TemporaryDirectory(prefix="geoorbit_replay_") as folder:
        bag = Path(folder) / "bag"
        write_track_bag(bag, camera.camera_id, camera.frames)
        yield bag


def _run(request: ReplayRequest, camera: CameraInput, out: Path) -> tuple[LaneMap, float]:
    """Replay under a progress bar and write the lanes; the lanes, and the time it took in s."""
    from geoorbit_ros.cli.console import make_progress
    from geoorbit_ros.core.errors import NoTrafficError
    from geoorbit_ros.lanes.geojson import read_lanes
    from geoorbit_ros.nodes.support.bag_replay import replay_bag
    from geoorbit_ros.storage.atomic import atomic_output

    start, frames = time.monotonic(), len(camera.frames)
    with atomic_output(out) as path:
        with make_progress() as progress:
            task = progress.add_task(f"replaying {camera.source}", total=frames)
            text = replay_bag(request, lambda done: progress.update(task, completed=done))
        path.write_text(text, encoding="utf-8")
        lane_map = read_lanes(path)
        if not lane_map.lanes:
            found = f"{frames} frames, no vehicle driving along a lane"
            raise NoTrafficError(str(camera.source), found, "vehicles driving by")
    return lane_map, time.monotonic() - start
