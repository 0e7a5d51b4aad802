"""`geoorbit camera`: from a video or stream to a working fleet entry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import CalibrationOption

if TYPE_CHECKING:
    from geoorbit_ros.calibration.plane import Homography

app = typer.Typer(help="Set up cameras of a fleet.", no_args_is_help=True)

PICTURE, TRACKS, LANES, REPORT = "calibration.png", "tracks.csv", "lanes.geojson", "report.html"


@app.command("add")
def add(
    source: Annotated[
        str,
        typer.Argument(help="Video file, address of a stream, folder of images, or scene:NAME."),
    ],
    calibration: CalibrationOption,
    camera_id: Annotated[str, typer.Option("--camera-id", help="Its name: letters, digits, _.")],
    fleet: Annotated[
        Path, typer.Option("--fleet", help="The fleet file to add it to; made if not there.")
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for picture, lanes and report; must not exist.")
    ],
    model: Annotated[
        Path | None,
        typer.Option("--model", help="YOLO model in an ONNX file. Without it: whatever moves."),
    ] = None,
    duration: Annotated[
        float, typer.Option("--duration", min=1.0, metavar="SECONDS", help="How long to watch.")
    ] = 60.0,
) -> None:
    """Check a camera's calibration, watch it for a minute, and add it to a fleet file.

    Draws the control points with their errors into an image, says how far the camera can see,
    finds lanes, and says what traffic is still missing. The fleet file is changed last, when all
    of it has worked.

    Example: [bold]geoorbit camera add north.mp4 --calibration north.csv --camera-id north
    --fleet fleet.yaml --out north_check[/bold]
    """
    import cv2

    from geoorbit_ros.cli.camera_run import CameraRun, WatchedMapper, warm_up_detector
    from geoorbit_ros.cli.console import console, say, status
    from geoorbit_ros.cli.inputs import DEFAULT_ESTIMATOR, CameraInput, load_calibration
    from geoorbit_ros.cli.process import DEFAULT_FPS, opened_source, shown_images
    from geoorbit_ros.cli.report import describe_method, save_report
    from geoorbit_ros.cli.tables import print_lanes
    from geoorbit_ros.detection.detector import make_detector
    from geoorbit_ros.fleet.fleet_entry import add_camera, check_new_camera, relative
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.lanes.pipeline import map_lanes
    from geoorbit_ros.report.calibration_image import draw_calibration
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.track_csv import write_track_csv

    check_new_folder(out)
    check_new_camera(fleet, camera_id)
    homography, origin = load_calibration(calibration, None)
    with status("loading"):
        detector = make_detector(model)
    estimator, period_s = DEFAULT_ESTIMATOR, 5.0
    mapper = WatchedMapper(make_estimator(estimator), update_period_s=period_s)
    run, recording = CameraRun(homography, detector, mapper), Recording()
    with opened_source(source, None, duration) as images, atomic_output(out) as folder:
        folder.mkdir()
        warm_up_detector(detector, images, duration)
        _, first = next(iter(images))
        cv2.imwrite(str(folder / PICTURE), draw_calibration(first, homography))
        size = (first.shape[1], first.shape[0])
        _print_calibration(homography, size)
        fps = images.fps or DEFAULT_FPS
        ground = run.ground_tracks(shown_images(images, duration), None, fps)
        lane_map = map_lanes(recording.tee(ground), mapper, images.name)
        write_lanes(folder / LANES, lane_map, origin, camera_id=camera_id, estimator=estimator)
        frames = run.track_frames()
        write_track_csv(folder / TRACKS, frames)
        camera = CameraInput(
            camera_id, folder / TRACKS, calibration, frames, homography, origin, size
        )
        method = f"{detector.name}; {describe_method(estimator, period_s)}"
        save_report(folder / REPORT, camera, lane_map, recording, method)
    print_lanes(lane_map, f"Lanes of {camera_id} after {duration:g} s")
    entry: dict[str, object] = {
        "id": camera_id,
        "source": relative(Path(source), fleet) if Path(source).exists() else source,
        "calibration": relative(calibration, fleet),
        "image_size": list(size),
        "datum": {"latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg},
    }
    if model is not None:
        entry["model"] = relative(model, fleet)
    add_camera(fleet, entry, fleet.stem)
    say(f"Look at {out / PICTURE} and {out / REPORT}.")
    console.print(f" Camera {camera_id} is in {fleet}: geoorbit up {fleet}", soft_wrap=True)


def _print_calibration(homography: Homography, image_size: tuple[int, int]) -> None:
    from geoorbit_ros.cli.console import console, make_table, say
    from geoorbit_ros.report.calibration_image import REACH_M, reach

    table = make_table("Control points", ">point|>pixel x|>pixel y|>error px|>error m|used")
    residual = homography.residual
    for k, (x, y) in enumerate(homography.points.pixel):
        used = "[green]yes[/]" if residual.inlier[k] else "[red]no[/]"
        errors = (f"{residual.pixel_error[k]:.2f}", f"{residual.ground_error_m[k]:.3f}")
        table.add_row(str(k + 1), f"{x:.0f}", f"{y:.0f}", *errors, used)
    console.print(table)
    far = reach(homography, image_size)
    say(
        f"It sees {far.farthest_m:.0f} m of road along the middle of the image, up to where a "
        f"pixel is {REACH_M:g} m on the ground."
    )
