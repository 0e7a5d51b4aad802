"""`geoorbit process`: a camera's images in, everything out: boxes, tracks, lanes, report, video."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    CalibrationOption,
    CameraInput,
    ClassNamesOption,
    DatumOption,
    EstimatorOption,
    MinScoreOption,
    ModelOption,
    UpdatePeriodOption,
    load_calibration,
    parse_names,
)
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from geoorbit_ros.storage.frames.source import FrameSource, StampedImage

DETECTIONS, TRACKS, TRACKS_CSV = "detections.txt", "tracks.txt", "tracks.csv"
LANES, REPORT, VIDEO = "lanes.geojson", "report.html", "annotated.mp4"
DEFAULT_FPS = 25.0


def process(
    source: Annotated[
        str,
        typer.Argument(
            help="Video file, address of a stream, folder of images, or scene:NAME?seed=1."
        ),
    ],
    calibration: CalibrationOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; must not exist.")],
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    video: Annotated[
        bool, typer.Option("--video", help="Also write annotated.mp4: boxes, trails, lanes.")
    ] = False,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second of a folder of images.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option("--duration", min=0.1, metavar="SECONDS", help="Stop after this time."),
    ] = None,
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
    from geoorbit_ros.cli.camera_run import CameraRun, WatchedMapper, warm_up_detector
    from geoorbit_ros.cli.console import console, status
    from geoorbit_ros.cli.report import describe_method, save_report
    from geoorbit_ros.cli.tables import print_lanes
    from geoorbit_ros.detection.detector import DetectorSettings, make_detector
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.lanes.pipeline import map_lanes
    from geoorbit_ros.report.recording import Recording
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.mot_text import write_mot
    from geoorbit_ros.storage.track_csv import write_track_csv

    check_new_folder(out)
    homography, origin = load_calibration(calibration, datum)
    with status("loading"):
        detector = make_detector(
            model, DetectorSettings(min_score, class_names=parse_names(class_names))
        )
    mapper = WatchedMapper(make_estimator(estimator), update_period_s=update_period_s)
    run, recording = CameraRun(homography, detector, mapper), Recording()
    name = camera_id or _name(source)
    with opened_source(source, fps, duration) as images, atomic_output(out) as folder:
        folder.mkdir()
        warm_up_detector(detector, images, duration)
        ground = run.ground_tracks(
            shown_images(images, duration),
            folder / VIDEO if video else None,
            images.fps or DEFAULT_FPS,
        )
        lane_map = map_lanes(recording.tee(ground), mapper, images.name)
        write_mot(folder / DETECTIONS, ((k, d) for k, (_, d, _) in enumerate(run.seen, 1)))
        write_mot(folder / TRACKS, ((k, t) for k, (_, _, t) in enumerate(run.seen, 1)))
        frames = run.track_frames()
        write_track_csv(folder / TRACKS_CSV, frames)
        write_lanes(folder / LANES, lane_map, origin, camera_id=name, estimator=estimator)
        camera = CameraInput(
            name, folder / TRACKS_CSV, calibration, frames, homography, origin, run.image_size
        )
        method = f"{detector.name}; {describe_method(estimator, update_period_s)}"
        save_report(folder / REPORT, camera, lane_map, recording, method)
    print_lanes(lane_map, f"Lanes of {name}")
    console.print(f" {len(run.seen)} images; wrote {out}", soft_wrap=True)


def _name(source: str) -> str:
    """`north` of `videos/north.mp4`, `on_ramp_merge` of `scene:on_ramp_merge?seed=2`."""
    return Path(source.partition("?")[0].rpartition(":")[2]).stem or "camera"


def opened_source(source: str, fps: float | None, duration_s: float | None) -> FrameSource:
    """A source as a user names it, scenes included.

    Raises:
        GeoOrbitError: It can't be opened, or is a stream and nobody said for how long.
    """
    from geoorbit_ros.cli.console import error_console, status
    from geoorbit_ros.rendering.frame_source import SCENES
    from geoorbit_ros.storage.frames.feed import LiveFrames
    from geoorbit_ros.storage.frames.open_source import open_frame_source
    from geoorbit_ros.storage.frames.source import SourceOptions

    options = SourceOptions(fps=fps, report=lambda text: error_console.print(text, style="dim"))
    with status("opening"):
        images = open_frame_source(source, options, SCENES)
    if images.live and duration_s is None:
        raise ParameterError("option --duration", "none for a stream", "how many seconds to take")
    return LiveFrames(images) if images.live else images


def shown_images(images: FrameSource, duration_s: float | None) -> Iterator[StampedImage]:
    """The images of the first `duration_s` under a progress bar."""
    from geoorbit_ros.cli.console import track

    counts = [images.frame_count] if images.frame_count else []
    if duration_s is not None and (images.fps or images.live):
        counts.append(round(duration_s * (images.fps or DEFAULT_FPS)))
    first_ns: int | None = None
    for stamp_ns, image in track(images, "finding vehicles and lanes", min(counts, default=None)):
        first_ns = stamp_ns if first_ns is None else first_ns
        if duration_s is not None and stamp_ns - first_ns >= duration_s * 1e9:
            return
        yield stamp_ns, image
