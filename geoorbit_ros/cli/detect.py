"""`geoorbit detect`: images in, boxes out, offline."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    ClassNamesOption,
    DurationOption,
    FpsOption,
    MaxFpsOption,
    MinScoreOption,
    ModelOption,
    PasswordFileOption,
    ResumeOption,
    SourceArgument,
    StrictImagesOption,
    parse_names,
)
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.cli.resume import DetectionRun
    from geoorbit_ros.detection.road_segments import RoadSegments
    from geoorbit_ros.storage.frames.source import FrameSource


def detect(
    source: SourceArgument,
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Where the boxes go: MOTChallenge text, frame,-1,x,y,w,h,conf,class,-1,-1"
        ),
    ],
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    duration: DurationOption = None,
    fps: FpsOption = None,
    max_fps: MaxFpsOption = 0.0,
    road_image: Annotated[
        Path | None,
        typer.Option("--road-image", help="Also draw where vehicles drive, as a .png or .jpg."),
    ] = None,
    password_file: PasswordFileOption = None,
    resume: ResumeOption = False,
    strict: StrictImagesOption = False,
    picture: Annotated[Path | None, typer.Option("--picture", hidden=True)] = None,
) -> None:
    """Find the vehicles in every image of a camera.

    Without a model, the camera must stand still: the package's own network
    sees each image beside the empty road.
    A recording is looked at twice, first to learn the road. With [bold]--model[/bold], any YOLO
    export to ONNX (v8, v10, 11, 12, 26, YOLOX) does. Ctrl-C keeps what was found so far;
    [bold]--resume[/bold] goes on from there.

    Example: [bold]geoorbit detect north.mp4 --out det.txt[/bold], then
    [bold]geoorbit track --detections det.txt --fps 25 --out tracks.txt[/bold]
    """
    from geoorbit_ros.cli.console import console, error_console, print_remarks
    from geoorbit_ros.cli.images import ImageOptions
    from geoorbit_ros.cli.resume import EarlyEnd, prepared_run
    from geoorbit_ros.detection.detector import DetectorSettings
    from geoorbit_ros.storage.frames.source import LeftOut
    from geoorbit_ros.storage.mot_text import write_mot

    if picture:
        error_console.print("--picture is now --road-image; the old name works for one release")
        road_image = picture
    if road_image and road_image.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        expected = "a name that ends in .png or .jpg"
        raise ParameterError("option --road-image", str(road_image), expected)
    settings = DetectorSettings(min_score, class_names=parse_names(class_names))
    left_out = None if strict else LeftOut()
    options = ImageOptions(fps, duration, "", left_out, password_file, max_fps)
    with prepared_run(source, out, options, model, settings, resume=resume) as (images, run):
        with EarlyEnd(images, run, out) as early:
            boxes = write_mot(out, _Frames(run, road_image).of(images, duration))
        print_remarks(images.remarks)
        console.print(f" {boxes} boxes in {run.looked_at}, by {run.detector.name}.")
        also = f" and {road_image}" if road_image else ""
        console.print(f" Wrote {out}{also}", soft_wrap=True)
        early.finish()


class _Frames:
    """Rows of a detector's images, and what the image of the road needs."""

    def __init__(self, run: DetectionRun, road_image: Path | None) -> None:
        self._run, self._road_image = run, road_image
        self._segments: RoadSegments | None = None

    def of(
        self, images: FrameSource, duration_s: float | None
    ) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Number and rows of every image; at the end, draws the image of the road."""
        from geoorbit_ros.cli.images import check_images, note_varying_rate, shown_images
        from geoorbit_ros.detection.road_segments import RoadSegments
        from geoorbit_ros.report.image_overlay import draw_segments, write_image

        stamps = []
        shown = shown_images(images, duration_s, "finding vehicles")
        for stamp_ns, image, rows in self._run.boxes(shown):
            if self._segments is None:
                self._segments = RoadSegments((image.shape[1], image.shape[0]))
            self._segments.add(stamp_ns, rows)
            last = image
            stamps.append(stamp_ns)
            yield self._run.numbers[-1], rows
        if not stamps:
            raise ParameterError(images.name, "no images", "at least one")
        check_images(images, self._run.left_out, len(stamps))
        note_varying_rate(images, stamps)
        if self._road_image and self._segments:
            write_image(self._road_image, draw_segments(last, self._segments))
