"""`geoorbit lanes`: tracks in, lane map out, offline. `geoorbit score`: a map against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.cli.camera_input import load_camera
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
    RoadImageOption,
    StrictOption,
    TrackFpsOption,
    TracksOption,
    UpdatePeriodOption,
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
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    image: RoadImageOption = None,
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

    The same tracks give the same lanes every time, here and from [bold]geoorbit replay[/bold]. With
    an image of the camera, lane boundaries follow the painted lines where they are seen.

    Example: [bold]geoorbit lanes --tracks tracks.csv --calibration calibration.csv
    --out lanes.geojson --report report.html[/bold]
    """
    from geoorbit_ros.cli.console import console, print_lanes, print_remarks
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.storage.atomic import atomic_output

    options = read_options(fps, columns, classes, strict)
    named = (camera_id, image_size, datum, out, options, image, camera_info)
    camera = load_camera(tracks, bag, calibration, *named, long=True)
    recording = Recording()
    with atomic_output(out) as path:
        ground = camera.ground_tracks()
        lane_map = camera.find_lanes(
            recording.tee(ground) if report else ground, make_mapper(estimator, update_period_s)
        )
        view = None
        if image:
            lane_map, view = camera.follow_paint(lane_map, image)
        write_lanes(path, lane_map, camera.datum, camera_id=camera.camera_id, estimator=estimator)
    if report:
        from geoorbit_ros.cli.report import describe_method, save_report

        method = describe_method(estimator, update_period_s)
        save_report(report, camera, lane_map, recording, method, image=view)
    print_lanes(lane_map, f"Lanes of {camera.camera_id}")
    print_remarks(*camera.reports())
    console.print(f" Wrote {out}" + (f" and {report}" if report else ""), soft_wrap=True)


def score(
    lanes: Annotated[Path, typer.Argument(help="Detected lanes: lanes.geojson.")],
    truth: Annotated[
        Path, typer.Argument(help="True lanes: the same format; centrelines with lane_id suffice.")
    ],
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the score as JSON instead of a table.")
    ] = False,
    require: Annotated[
        bool,
        typer.Option(
            "--require",
            help="Exit with 1 unless every lane with 8 vehicles or more is confirmed, every lane "
            "with 3 to 7 is there, and none is invented or in the wrong direction.",
        ),
    ] = False,
) -> None:
    """Compare a lane map with the truth: matched one to one, missed and invented lanes counted.

    A detected lane matches a true one within half a lane width (1.75 m, on average over their
    common length) and 45° of direction. Errors are distances from the true centreline, of confirmed
    lanes.

    Example: [bold]geoorbit score lanes.geojson truth.geojson --require[/bold]
    """
    from geoorbit_ros.cli.console import print_score, read_lanes_aloud
    from geoorbit_ros.metrics.score import score_lanes

    detected = read_lanes_aloud(lanes)
    true = read_lanes_aloud(truth, detected.datum).lane_map
    result = score_lanes(detected.lane_map.lanes, true.lanes)
    if json_output:
        import json

        typer.echo(json.dumps(result.as_dict(), indent=2, allow_nan=False))
    else:
        print_score(result)
    if require and not result.passed:
        raise typer.Exit(1)
