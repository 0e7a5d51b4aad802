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
    ResumeOption,
    SourceArgument,
    StrictImagesOption,
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
    start_time: Annotated[
        str | None,
        typer.Option(
            "--start-time",
            metavar="TIME",
            help="When a recording begins: 2026-05-01T06:00, or seconds since 1970; default: as "
            "the file says.",
        ),
    ] = None,
    resume: ResumeOption = False,
    strict: StrictImagesOption = False,
) -> None:
    """Find vehicles, tracks and lanes in a video or any other source of images, offline.

    Without a model a recording is looked at twice, first to learn the road. Into the folder go
    detections.txt and tracks.txt (MOTChallenge text), tracks.csv (for [bold]geoorbit
    lanes[/bold]), lanes.geojson and report.html. Ctrl-C keeps what was found so far;
    [bold]--resume[/bold] goes on from there.

    Example: [bold]geoorbit process north.mp4 --calibration calibration.csv --out north[/bold]
    """
    from geoorbit_ros.cli.camera_run import CameraJob
    from geoorbit_ros.cli.console import console, error_console, print_lanes, print_remarks, status
    from geoorbit_ros.cli.images import (
        DetectionRun,
        EarlyEnd,
        ImageOptions,
        check_images,
        kept_boxes,
        open_camera,
        warm_up_detector,
    )
    from geoorbit_ros.detection.detector import DetectorSettings, make_detector, without_effect
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.frames.source import LeftOut
    from geoorbit_ros.storage.mot_text import write_mot

    if not resume:
        check_new_folder(out)
    homography, origin = load_calibration(calibration, datum)
    settings = DetectorSettings(min_score, class_names=parse_names(class_names))
    name = camera_id or _name(source)
    left_out = None if strict else LeftOut()
    options = ImageOptions(fps, duration, start_time, left_out)
    with open_camera(source, options) as images:
        kept = kept_boxes(out, images, source, model, settings, fps, start_time, resume=resume)
        with status("loading"):
            detector = make_detector(model, settings)
        if note := without_effect(detector, settings):
            error_console.print(note, soft_wrap=True)
        job = CameraJob(name, calibration, homography, origin, detector, estimator, update_period_s)
        run = job.run.detection = DetectionRun(detector, kept, left_out)
        warm_up_detector(detector, images, duration, left_out)
        with EarlyEnd(images, run, out) as early, atomic_output(out, overwrite=resume) as folder:
            folder.mkdir()
            job.find_lanes(images, duration, folder / VIDEO if video else None)
            check_images(images, left_out, len(run.numbers))
            seen = list(zip(run.numbers, job.run.seen, strict=True))
            write_mot(folder / DETECTIONS, ((k, d) for k, (_, d, _) in seen))
            write_mot(folder / TRACKS, ((k, t) for k, (_, _, t) in seen))
            job.write(folder, images)
        print_lanes(job.lane_map, f"Lanes of {name}")
        print_remarks(images.remarks)
        console.print(f" {len(seen)} images; wrote {out}", soft_wrap=True)
        early.finish()


def _name(source: str) -> str:
    """`north` of `videos/north.mp4`, `on_ramp_merge` of `scene:on_ramp_merge?seed=2`."""
    return Path(source.partition("?")[0].rpartition(":")[2]).stem or "camera"
