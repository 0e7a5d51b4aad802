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
    MinScoreOption,
    ModelOption,
    SourceArgument,
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
    road_image: Annotated[
        Path | None,
        typer.Option("--road-image", help="Also draw where vehicles drive, as a .png or .jpg."),
    ] = None,
    picture: Annotated[Path | None, typer.Option("--picture", hidden=True)] = None,
) -> None:
    """Find the vehicles in every image of a camera.

    Without a model, the camera must stand still: everything that moves on the road is a vehicle.
    A recording is looked at twice, first to learn the road. With [bold]--model[/bold], any YOLO
    export to ONNX (v8, v10, 11, 12, 26, YOLOX) does.

    Example: [bold]geoorbit detect north.mp4 --out det.txt[/bold], then
    [bold]geoorbit track --detections det.txt --fps 25 --out tracks.txt[/bold]
    """
    from geoorbit_ros.cli.camera_run import open_images, warm_up_detector
    from geoorbit_ros.cli.console import console, error_console, status
    from geoorbit_ros.detection.detector import DetectorSettings, make_detector, without_effect
    from geoorbit_ros.storage.mot_text import write_mot

    if picture:
        error_console.print("--picture is now --road-image; the old name works for one release")
        road_image = picture
    if road_image and road_image.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        expected = "a name that ends in .png or .jpg"
        raise ParameterError("option --road-image", str(road_image), expected)
    names = parse_names(class_names)
    with status("loading"):
        settings = DetectorSettings(min_score, class_names=names)
        detector = make_detector(model, settings)
    if note := without_effect(detector, settings):
        error_console.print(note, soft_wrap=True)
    run = _Run(detector, road_image)
    with open_images(source, fps, duration) as images:
        warm_up_detector(detector, images, duration)
        boxes = write_mot(out, run.frames(images, duration))
    console.print(f" {boxes} boxes in {run.count} images, by {detector.name}.")
    console.print(f" Wrote {out}" + (f" and {road_image}" if road_image else ""), soft_wrap=True)


class _Run:
    """Runs a detector over images, and keeps what the image of the road needs."""

    def __init__(self, detector: Detector, road_image: Path | None) -> None:
        self.count = 0
        self._detector, self._road_image = detector, road_image
        self._segments: RoadSegments | None = None

    def frames(
        self, images: FrameSource, duration_s: float | None
    ) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Number and rows of every image; at the end, draws the image of the road."""
        from geoorbit_ros.cli.camera_run import shown_images
        from geoorbit_ros.detection.road_segments import RoadSegments
        from geoorbit_ros.report.image_overlay import draw_segments, write_image

        for stamp_ns, image in shown_images(images, duration_s, "finding vehicles"):
            rows = self._detector.detect(stamp_ns, image)
            self.count += 1
            if self._segments is None:
                self._segments = RoadSegments((image.shape[1], image.shape[0]))
            self._segments.add(stamp_ns, rows)
            last = image
            yield self.count, rows
        if not self.count:
            raise ParameterError(images.name, "no images", "at least one")
        if self._road_image and self._segments:
            write_image(self._road_image, draw_segments(last, self._segments))
