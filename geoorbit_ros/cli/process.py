"""`geoorbit process`: a camera's images in, everything out: boxes, tracks, lanes, report, video."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    CalibrationOption,
    CameraInfoOption,
    ClassNamesOption,
    DatumOption,
    DurationOption,
    EstimatorOption,
    ForceOption,
    FpsOption,
    MaxFpsOption,
    MinScoreOption,
    ModelOption,
    PasswordFileOption,
    ResumeOption,
    SourceArgument,
    StartTimeOption,
    StrictImagesOption,
    UpdatePeriodOption,
    load_calibration,
    parse_names,
)

if TYPE_CHECKING:
    from geoorbit_ros.cli.camera_run import CameraJob
    from geoorbit_ros.storage.frames.source import FrameSource

DETECTIONS, TRACKS, VIDEO = "detections.txt", "tracks.txt", "annotated.mp4"


def process(
    source: SourceArgument,
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; new or empty.")],
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    video: Annotated[
        bool, typer.Option("--video", help="Also write annotated.mp4: boxes, trails, lanes.")
    ] = False,
    fps: FpsOption = None,
    max_fps: MaxFpsOption = 0.0,
    duration: DurationOption = None,
    camera_id: Annotated[
        str | None, typer.Option("--camera-id", help="Name of the camera in the files.")
    ] = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
    start_time: StartTimeOption = None,
    password_file: PasswordFileOption = None,
    resume: ResumeOption = False,
    force: ForceOption = False,
    strict: StrictImagesOption = False,
) -> None:
    """Find vehicles, tracks and lanes in a video or any other source of images, offline.

    Without a model a recording is looked at twice, first to learn the road. Into the folder go
    detections.txt and tracks.txt (MOTChallenge text), tracks.csv (for [bold]geoorbit
    lanes[/bold]), lanes.geojson, road.png (the road without vehicles) and report.html. Ctrl-C keeps
    what was found so far; [bold]--resume[/bold] goes on from there.

    Example: [bold]geoorbit process north.mp4 --calibration calibration.csv --out north[/bold]
    """
    from geoorbit_ros.cli.camera_run import CameraJob
    from geoorbit_ros.cli.images import ImageOptions
    from geoorbit_ros.cli.resume import EarlyEnd, prepared_run
    from geoorbit_ros.detection.detector import DetectorSettings
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.frames.source import LeftOut

    again = resume or force
    check_new_folder(out, overwrite=again)
    plane = load_calibration(calibration, datum, strict=strict, camera_info=camera_info)
    settings = DetectorSettings(min_score, class_names=parse_names(class_names))
    left_out = None if strict else LeftOut()
    options = ImageOptions(fps, duration, start_time, left_out, password_file, max_fps)
    with prepared_run(source, out, options, model, settings, resume=resume) as (images, run):
        name = camera_id or _name(source)
        job = CameraJob(name, calibration, *plane, run, estimator, update_period_s)
        with EarlyEnd(images, run, out) as early, atomic_output(out, overwrite=again) as folder:
            folder.mkdir()
            job.find_lanes(images, duration, folder / VIDEO if video else None)
            _write_boxes(job, folder)
            job.write(folder, images)
        _tell(job, images, out)
        early.finish()


def _tell(job: CameraJob, images: FrameSource, out: Path) -> None:
    from geoorbit_ros.cli.console import console, print_lanes, print_remarks

    print_lanes(job.lane_map, f"Lanes of {job.camera_id}")
    print_remarks(images.remarks, *job.reports)
    console.print(f" {job.detection.looked_at}; wrote {out}", soft_wrap=True)


def _write_boxes(job: CameraJob, folder: Path) -> None:
    """Write detections.txt and tracks.txt."""
    from geoorbit_ros.storage.mot_text import write_mot

    seen = list(zip(job.detection.numbers, job.run.seen, strict=True))
    write_mot(folder / DETECTIONS, ((number, rows) for number, (_, rows, _) in seen))
    write_mot(folder / TRACKS, ((number, rows) for number, (_, _, rows) in seen))


def _name(source: str) -> str:
    """`north` of `videos/north.mp4`, `on_ramp_merge` of `scene:on_ramp_merge?seed=2`.

    Of an address, the host: what follows it may be a password.
    """
    from geoorbit_ros.core.addresses import is_address, masked

    if Path(source).exists():
        return Path(source).absolute().stem
    if is_address(source):
        host = masked(source).partition("://")[2].rpartition("@")[2]
        return re.split("[/?:#]", host, maxsplit=1)[0] or "camera"
    return Path(source.partition("?")[0].partition(":")[2]).stem or "camera"
