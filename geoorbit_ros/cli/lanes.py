"""`geoorbit lanes`: tracks in, lane map out, offline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    BagOption,
    CalibrationOption,
    CameraIdOption,
    ClassesOption,
    ColumnsOption,
    DatumOption,
    EstimatorOption,
    ImageSizeOption,
    StrictOption,
    TrackFpsOption,
    TracksOption,
    UpdatePeriodOption,
    load_camera,
    make_mapper,
    read_options,
)


def lanes(
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Where the lane map goes: lanes.geojson.")],
    tracks: TracksOption = None,
    bag: BagOption = None,
    camera_id: CameraIdOption = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    image_size: ImageSizeOption = "1920x1080",
    datum: DatumOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
    fps: TrackFpsOption = None,
    columns: ColumnsOption = None,
    classes: ClassesOption = "coco",
    strict: StrictOption = False,
    report: Annotated[
        Path | None, typer.Option("--report", help="Also write the HTML report here.")
    ] = None,
) -> None:
    """Find the lanes in a file of vehicle tracks, offline, without a ROS graph.

    The same tracks give the same lanes every time, here and from [bold]geoorbit replay[/bold].

    Example: [bold]geoorbit lanes --tracks tracks.csv --calibration calibration.csv
    --out lanes.geojson --report report.html[/bold]
    """
    from geoorbit_ros.cli.console import console, print_lanes, print_remarks
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.storage.atomic import atomic_output

    options = read_options(fps, columns, classes, strict)
    camera = load_camera(tracks, bag, calibration, camera_id, image_size, datum, out, options)
    recording = Recording()
    with atomic_output(out) as path:
        ground = camera.ground_tracks()
        lane_map = camera.find_lanes(
            recording.tee(ground) if report else ground, make_mapper(estimator, update_period_s)
        )
        write_lanes(path, lane_map, camera.datum, camera_id=camera.camera_id, estimator=estimator)
    if report:
        from geoorbit_ros.cli.report import describe_method, save_report

        method = describe_method(estimator, update_period_s)
        save_report(report, camera, lane_map, recording, method)
    print_lanes(lane_map, f"Lanes of {camera.camera_id}")
    print_remarks(*camera.reports())
    console.print(f" Wrote {out}" + (f" and {report}" if report else ""), soft_wrap=True)
