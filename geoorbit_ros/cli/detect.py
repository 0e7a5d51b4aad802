"""`geoorbit detect`: images in, boxes out, offline."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    ClassNamesOption,
    MinScoreOption,
    ModelOption,
    parse_names,
)
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.detection.detector import Detector
    from geoorbit_ros.detection.road_segments import RoadSegments
    from geoorbit_ros.storage.frames.source import FrameSource


def detect(
    source: Annotated[
        str,
        typer.Argument(
            help="Video file, address of a stream, folder of images, or scene:NAME?seed=1."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Where the boxes go: MOTChallenge text, frame,-1,x,y,w,h,conf,class,-1,-1"
        ),
    ],
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    duration: Annotated[
        float | None,
        typer.Option("--duration", min=0.1, metavar="SECONDS", help="Stop after this time."),
    ] = None,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second of a folder of images.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Also draw where vehicles drive, as a .png or .jpg."),
    ] = None,
) -> None:
    """Find the vehicles in every image of a camera.

    Without a model, the camera must stand still: everything that moves on the road is a vehicle.
    A recording is looked at twice, first to learn the road. With [bold]--model[/bold], any YOLO
    export to ONNX (v8, v10, 11, 12, 26, YOLOX) does.

    Example: [bold]geoorbit detect north.mp4 --out det.txt[/bold], then
    [bold]geoorbit track --detections det.txt --fps 25 --out tracks.txt[/bold]
    """
    from geoorbit_ros.cli.camera_run import warm_up_detector
    from geoorbit_ros.cli.console import console, status
    from geoorbit_ros.detection.detector import DetectorSettings, make_detector
    from geoorbit_ros.storage.mot_text import write_mot

    if picture and picture.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ParameterError("option --picture", str(picture), "a name that ends in .png or .jpg")
    names = parse_names(class_names)
    with status("loading"):
        detector = make_detector(model, DetectorSettings(min_score, class_names=names))
    run = _Run(detector, picture)
    with _opened(source, fps, duration) as images:
        warm_up_detector(detector, images, duration)
        boxes = write_mot(out, run.frames(images, duration))
    console.print(f" {boxes} boxes in {run.count} images, by {detector.name}.")
    console.print(f" Wrote {out}" + (f" and {picture}" if picture else ""), soft_wrap=True)


class _Run:
    """Runs a detector over images, and keeps what the picture needs."""

    def __init__(self, detector: Detector, picture: Path | None) -> None:
        self.count = 0
        self._detector, self._picture = detector, picture
        self._segments: RoadSegments | None = None

    def frames(
        self, images: FrameSource, duration_s: float | None
    ) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Number and rows of every image; at the end, draws the picture."""
        from geoorbit_ros.cli.console import track
        from geoorbit_ros.detection.road_segments import RoadSegments
        from geoorbit_ros.report.image_overlay import draw_segments, write_image

        counts = [images.frame_count] if images.frame_count else []
        if duration_s is not None and images.fps:
            counts.append(round(duration_s * images.fps))
        first_ns: int | None = None
        total = min(counts, default=None)
        for stamp_ns, image in track(images, "finding vehicles", total):
            first_ns = stamp_ns if first_ns is None else first_ns
            if duration_s is not None and stamp_ns - first_ns >= duration_s * 1e9:
                break
            rows = self._detector.detect(stamp_ns, image)
            self.count += 1
            if self._segments is None:
                self._segments = RoadSegments((image.shape[1], image.shape[0]))
            self._segments.add(stamp_ns, rows)
            last = image
            yield self.count, rows
        if not self.count:
            raise ParameterError(images.name, "no images", "at least one")
        if self._picture and self._segments:
            write_image(self._picture, draw_segments(last, self._segments))


def _opened(source: str, fps: float | None, duration_s: float | None) -> FrameSource:
    from geoorbit_ros.cli.console import error_console, status
    from geoorbit_ros.rendering.frame_source import SCENES
    from geoorbit_ros.storage.frames.open_source import open_frame_source
    from geoorbit_ros.storage.frames.source import SourceOptions

    options = SourceOptions(fps=fps, report=lambda text: error_console.print(text, style="dim"))
    with status("opening"):
        images = open_frame_source(source, options, SCENES)
    if images.live and duration_s is None:
        raise ParameterError("option --duration", "none for a stream", "how many seconds to take")
    return images
