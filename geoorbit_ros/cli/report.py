"""`geoorbit report`: one HTML page about one camera's lanes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.camera_input import CameraInput, load_camera
from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    BagOption,
    CalibrationOption,
    CameraIdOption,
    CameraInfoOption,
    ClassesOption,
    ColumnsOption,
    DatumOption,
    EstimatorOption,
    ImageSizeOption,
    StrictOption,
    TrackFpsOption,
    TracksOption,
    UpdatePeriodOption,
    make_mapper,
    read_options,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.core.lanes import Lane, LaneMap
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.report.traffic.content import TrafficContent

INTERVAL_S = 900
"""Fifteen minutes, as `geoorbit traffic` has by default."""
MAX_STRETCH = 0.01
"""An image of the same view in another size has these proportions, up to rounding."""


def report(
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Where the page goes: report.html.")],
    tracks: TracksOption = None,
    bag: BagOption = None,
    lanes: Annotated[
        Path | None, typer.Option("--lanes", help="Show these lanes instead of finding them.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="True lanes, to draw and to score against.")
    ] = None,
    image: Annotated[
        str | None,
        typer.Option("--image", help="The camera's view, to draw the lanes over: image or video."),
    ] = None,
    camera_id: CameraIdOption = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
    fps: TrackFpsOption = None,
    columns: ColumnsOption = None,
    classes: ClassesOption = "coco",
    strict: StrictOption = False,
) -> None:
    """Write one HTML page with figures: vehicle paths, lanes, widths, confidence, traffic.

    The page needs no other file and no network. Without --lanes the lanes are found as
    [bold]geoorbit lanes[/bold] finds them.

    Example: [bold]geoorbit report --tracks tracks.csv --calibration calibration.csv
    --truth truth.geojson --out report.html[/bold]
    """
    from geoorbit_ros.cli.console import console, print_remarks, read_lanes_aloud
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.report.text import summary_sentence

    options = read_options(fps, columns, classes, strict)
    named = (camera_id, image_size, datum, out, options, image, camera_info)
    camera = load_camera(tracks, bag, calibration, *named)
    true = read_lanes_aloud(truth, camera.datum).lane_map.lanes if truth else None
    recording = Recording()
    ground = recording.tee(camera.ground_tracks())
    if lanes:
        file = read_lanes_aloud(lanes, camera.datum)
        lane_map = file.lane_map
        for _ in ground:
            pass
        method = f"{file.estimator or 'unknown'}, read from {lanes.name}"
    else:
        lane_map = camera.find_lanes(ground, make_mapper(estimator, update_period_s))
        method = describe_method(estimator, update_period_s)
    view = _view(image, camera.image_size) if image else None
    if image and not lanes:
        lane_map, _ = camera.follow_paint(lane_map, image)
    save_report(out, camera, lane_map, recording, method, true, view)
    print_remarks(*camera.reports())
    console.print(f"{summary_sentence(lane_map.lanes)} Wrote {out}", soft_wrap=True)


def _view(source: str, image_size: tuple[int, int]) -> NDArray[np.uint8]:
    """The first image of a source.

    Raises:
        GeoOrbitError: There is none, or it has other proportions than the images of the boxes.
    """
    from geoorbit_ros.cli.images import first_view
    from geoorbit_ros.core.errors import ParameterError

    view = first_view(source)
    height, width = view.shape[:2]
    if abs(width * image_size[1] / (height * image_size[0]) - 1.0) > MAX_STRETCH:
        found = f"{source}, {width}x{height} pixels"
        raise ParameterError(
            "option --image", found, "the proportions of {}x{}".format(*image_size)
        )
    return view


def save_report(
    out: Path,
    camera: CameraInput,
    lane_map: LaneMap,
    recording: Recording,
    method: str,
    truth: Sequence[Lane] | None = None,
    image: NDArray[np.uint8] | None = None,
) -> None:
    """Write the page for lanes that are already known; `image` is the camera's view."""
    from geoorbit_ros.report.page import ReportInput, write_report
    from geoorbit_ros.report.recording import provenance
    from geoorbit_ros.storage.atomic import atomic_output

    made = provenance(
        source=camera.source,
        calibration=camera.calibration,
        recording=recording,
        datum=camera.datum,
        image_size=camera.image_size,
        method=method,
    )
    counted = lane_map.lanes and recording.frame_count
    traffic = _traffic(camera, lane_map, recording) if counted else None
    content = ReportInput(
        camera.camera_id,
        lane_map,
        recording,
        camera.homography,
        camera.image_size,
        made,
        truth,
        camera.reports(),
        image,
        traffic,
    )
    with atomic_output(out) as path:
        write_report(path, content)


def _traffic(camera: CameraInput, lane_map: LaneMap, recording: Recording) -> TrafficContent:
    """What drove in the lanes, as `geoorbit traffic` counts it by default."""
    from geoorbit_ros.cli.console import status
    from geoorbit_ros.cli.inputs import time_zone
    from geoorbit_ros.report.traffic.content import traffic_content
    from geoorbit_ros.traffic.class_schemes import SCHEMES
    from geoorbit_ros.traffic.count import record
    from geoorbit_ros.traffic.counter import TrafficCounter
    from geoorbit_ros.traffic.interval_clock import IntervalClock, usual_gap_s

    counter = TrafficCounter(lane_map.lanes, camera.homography)
    clock = IntervalClock(INTERVAL_S, time_zone(None))
    with status("counting vehicles"):
        recorded = record(counter, [recording.frames()], usual_gap_s(camera.boxes))
        return traffic_content(camera.camera_id, recorded, SCHEMES["coco"], clock, recording.frames)


def describe_method(estimator: str, update_period_s: float) -> str:
    """Estimator and parameters in one line."""
    from geoorbit_ros.lanes.parameters import LaneParameters

    theta = LaneParameters()
    return (
        f"{estimator}, smoothing {theta.smoothing:g}, angle {theta.angle:g}, "
        f"width scale {theta.width_scale:g}, update period {update_period_s:g} s"
    )
