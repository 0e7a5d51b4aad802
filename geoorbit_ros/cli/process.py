"""`geoorbit process`: a camera's images in, everything out: boxes, tracks, lanes, report, video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    CalibrationOption,
    ClassNamesOption,
    DatumOption,
    DurationOption,
    EstimatorOption,
    FpsOption,
    MinScoreOption,
    ModelOption,
    SourceArgument,
    UpdatePeriodOption,
    load_calibration,
    parse_names,
)

DETECTIONS, TRACKS, VIDEO = "detections.txt", "tracks.txt", "annotated.mp4"


def process(
    source: SourceArgument,
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; must not exist.")],
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    video: Annotated[
        bool, typer.Option("--video", help="Also write annotated.mp4: boxes, trails, lanes.")
    ] = False,
    fps: FpsOption = None,
    duration: DurationOption = None,
    camera_id: Annotated[
        str | None, typer.Option("--camera-id", help="Name of the camera in the files.")
    ] = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    datum: DatumOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
) -> None:
    """Find vehicles, tracks and lanes in a video or any other source of images, offline.

    Without a model a recording is looked at twice, first to learn the road. Into the folder go
    detections.txt and tracks.txt (MOTChallenge text), tracks.csv (for [bold]geoorbit
    lanes[/bold]), lanes.geojson and report.html: all of them or none.

    Example: [bold]geoorbit process north.mp4 --calibration calibration.csv --out north[/bold]
    """
    from geoorbit_ros.cli.camera_run import CameraJob, open_camera, warm_up_detector
    from geoorbit_ros.cli.console import console, error_console, print_lanes, status
    from geoorbit_ros.detection.detector import DetectorSettings, make_detector, without_effect
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.mot_text import write_mot

    check_new_folder(out)
    homography, origin = load_calibration(calibration, datum)
    settings = DetectorSettings(min_score, class_names=parse_names(class_names))
    with status("loading"):
        detector = make_detector(model, settings)
    if note := without_effect(detector, settings):
        error_console.print(note, soft_wrap=True)
    name = camera_id or _name(source)
    job = CameraJob(name, calibration, homography, origin, detector, estimator, update_period_s)
    with open_camera(source, fps, duration) as images, atomic_output(out) as folder:
        folder.mkdir()
        warm_up_detector(detector, images, duration)
        job.find_lanes(images, duration, folder / VIDEO if video else None)
        seen = job.run.seen
        write_mot(folder / DETECTIONS, ((k, d) for k, (_, d, _) in enumerate(seen, 1)))
        write_mot(folder / TRACKS, ((k, t) for k, (_, _, t) in enumerate(seen, 1)))
        job.write(folder)
    print_lanes(job.lane_map, f"Lanes of {name}")
    console.print(f" {len(seen)} images; wrote {out}", soft_wrap=True)


def _name(source: str) -> str:
    """`north` of `videos/north.mp4`, `on_ramp_merge` of `scene:on_ramp_merge?seed=2`."""
    return Path(source.partition("?")[0].rpartition(":")[2]).stem or "camera"
