"""Images as commands read them: opened, shown with their progress, and counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.addresses import read_password, with_password
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.storage.frames.source import (
    FrameSource,
    FrameSourceError,
    LeftOut,
    SourceOptions,
    StampedImage,
)

SPACING_S = 0.1
"""Time between the images of a warm-up. Chosen: smaller, the warm-up takes longer; larger, vehicles
can't be followed from one image to the next."""
LONGEST_S = 120.0
"""Length of a warm-up; of a longer recording, the beginning is used. Chosen: larger, the command
starts later; smaller, a queue that stands the whole time looks like the road."""
DEFAULT_FPS = 25.0
"""Frame rate where a source has none of its own: of the annotated video, and to estimate how far a
command is. It has no influence on tracks and lanes, which go by the stamps."""


@dataclass(frozen=True, slots=True)
class ImageOptions:
    """What the options of a command say about its images.

    Attributes:
        fps: Option `--fps`.
        duration_s: Option `--duration`.
        start: Option `--start-time`; None: the file's own, empty: none.
        left_out: Collects images that can't be used; None: the first ends the command.
        password_file: Option `--password-file`.
        max_fps: Option `--max-fps`.
    """

    fps: float | None = None
    duration_s: float | None = None
    start: str | None = ""
    left_out: LeftOut | None = None
    password_file: Path | None = None
    max_fps: float = 0.0

    def source_options(self, report: Callable[[str], None]) -> SourceOptions:
        """The same for `open_frame_source`."""
        from geoorbit_ros.cli.console import parse_time

        options = SourceOptions(fps=self.fps, own_start=self.start is None, report=report)
        if self.start:
            options = replace(options, start_ns=parse_time(self.start, "option --start-time"))
        if self.left_out is not None:
            options = replace(options, on_bad_frame=self.left_out)
        if self.duration_s is not None:  # what is there is enough, and said
            options = replace(options, on_cut=lambda _error: None)
        return options


def open_images(source: str, options: ImageOptions) -> FrameSource:
    """A source as a user names it, scenes included; says what it assumes.

    Raises:
        GeoOrbitError: It can't be opened, or is a stream and no duration is given.
    """
    from geoorbit_ros.cli.console import error_console, status
    from geoorbit_ros.rendering.frame_source import SCENES
    from geoorbit_ros.storage.frames.open_source import open_frame_source

    def say(text: str) -> None:
        error_console.print(text, style="dim", soft_wrap=True)

    if options.password_file is not None:
        place = "option --password-file"
        source = with_password(source, read_password(options.password_file, place), place)
    with status("opening"):
        images = open_frame_source(source, options.source_options(say), SCENES)
    if images.live and options.duration_s is None:
        raise ParameterError("option --duration", "none for a stream", "how many seconds to take")
    for sentence in images.remarks.sentences():
        say(f"{images.name}: {sentence}")
    return images


def open_camera(source: str, options: ImageOptions) -> FrameSource:
    """As `open_images`; a stream is read in a thread, so that none of its images waits in it."""
    from geoorbit_ros.storage.frames.feed import LiveFrames

    images = open_images(source, options)
    return LiveFrames(images) if images.live else images


def first_image(images: FrameSource) -> NDArray[np.uint8]:
    """The first image that can be used.

    Raises:
        FrameSourceError: There is none.
    """
    for _, image in images:
        return image
    raise FrameSourceError(images.name, "no image that can be used", "at least one")


def first_view(source: str) -> NDArray[np.uint8]:
    """The first image of a source.

    Raises:
        GeoOrbitError: There is none.
    """
    with open_images(source, ImageOptions(duration_s=0.0)) as images:
        return first_image(images)


def road_background(source: str) -> NDArray[np.uint8]:
    """The road without vehicles: a still image as it is, of a film the median of its beginning.

    Raises:
        FrameSourceError: No image that can be used.
    """
    from geoorbit_ros.markings.road_image import SPACING_S as BACKGROUND_SPACING_S
    from geoorbit_ros.markings.road_image import RoadBackground

    background = RoadBackground()
    with open_images(source, ImageOptions(duration_s=LONGEST_S, left_out=LeftOut())) as images:
        last_ns: int | None = None
        for stamp_ns, image in shown_images(images, LONGEST_S, "looking at the road"):
            if last_ns is None or stamp_ns - last_ns >= BACKGROUND_SPACING_S * 1e9:
                background.add(image)
                last_ns = stamp_ns
        road = background.image()
    if road is None:
        raise FrameSourceError(images.name, "no image that can be used", "at least one")
    return road


def check_images(images: FrameSource, left_out: LeftOut | None, used: int) -> None:
    """Add the images that were left out to the source's remarks.

    Raises:
        FrameSourceError: Most of them could not be used.
    """
    if left_out is None:
        return
    left_out.report_to(images.remarks, used)
    expected = "images of one size that can be read"
    try:
        images.remarks.check(strict=False, expected=expected)
    except InputFileError as error:
        raise FrameSourceError(error.place, error.found, expected) from None


def shown_images(
    images: FrameSource, duration_s: float | None, what: str
) -> Iterator[StampedImage]:
    """The images of the first `duration_s` under a progress bar that says `what` is done."""
    from geoorbit_ros.cli.console import track

    counts = [images.frame_count] if images.frame_count else []
    if duration_s is not None and (images.fps or images.live):
        counts.append(round(duration_s * (images.fps or DEFAULT_FPS)))
    first_ns: int | None = None
    for stamp_ns, image in track(images, what, min(counts, default=None)):
        first_ns = stamp_ns if first_ns is None else first_ns
        if duration_s is not None and stamp_ns - first_ns >= duration_s * 1e9:
            return
        yield stamp_ns, image


def warm_up_detector(
    detector: Detector,
    images: FrameSource,
    duration_s: float | None,
    left_out: LeftOut | None = None,
) -> None:
    """Let the detector see a recording once, under a progress bar; a stream can't be seen twice.

    A detector that learns nothing takes no image, so that nothing is read. What was left out then
    is forgotten: the images will be seen again.
    """
    if not images.live:
        detector.warm_up(_some(images, min(duration_s or LONGEST_S, LONGEST_S)))
    if left_out is not None:
        left_out.clear()


def _some(images: FrameSource, duration_s: float) -> Iterator[StampedImage]:
    from geoorbit_ros.cli.console import track

    count = images.frame_count
    if images.fps:
        count = min(count or 10**9, round(duration_s * images.fps))
    first_ns = last_ns = None
    for stamp_ns, image in track(images, "learning the road", count):
        first_ns = stamp_ns if first_ns is None else first_ns
        if stamp_ns - first_ns >= duration_s * 1e9:
            return
        if last_ns is None or stamp_ns - last_ns >= 0.99 * SPACING_S * 1e9:
            last_ns = stamp_ns
            yield stamp_ns, image


_VARYING_RATIO = 1.5
"""Intervals between images whose 95th percentile is this many times their 5th vary. Chosen: larger
lets wrong times pass; smaller calls the jitter of a camera so."""


def note_varying_rate(images: FrameSource, stamps_ns: Sequence[int]) -> None:
    """Remark on images that come at varying intervals, which a file of numbered frames loses."""
    steps = np.diff(np.array(stamps_ns, np.int64)) / 1e9
    if images.live or len(steps) < 3:
        return
    low, high = np.quantile(steps, (0.05, 0.95))
    if high > _VARYING_RATIO * low:
        text = f"images come {low:.3f} to {high:.3f} s apart: their numbers don't tell their times"
        images.remarks.note(Treatment.NOTED, f"{text}, which geoorbit process keeps")
