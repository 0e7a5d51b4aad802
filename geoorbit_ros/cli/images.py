"""Images as commands read them: opened, shown with progress, boxes kept when a run ends early."""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.cli.signals import Interrupted, told_to_end
from geoorbit_ros.core.errors import (
    GeoOrbitError,
    InputFileError,
    NoTrafficError,
    ParameterError,
    PluginError,
)
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.detection.detector import Detector, DetectorSettings
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.frames.source import (
    FrameSource,
    FrameSourceError,
    LeftOut,
    SourceOptions,
    StampedImage,
)

SPACING_S = 0.25
"""Time between the images of a warm-up. Chosen: smaller, the warm-up takes longer; larger, a
vehicle that stops for a moment looks like the road."""
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
    """

    fps: float | None = None
    duration_s: float | None = None
    start: str | None = ""
    left_out: LeftOut | None = None

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
        if last_ns is None or stamp_ns - last_ns >= SPACING_S * 1e9:
            last_ns = stamp_ns
            yield stamp_ns, image


RESUME_SUFFIX = ".resume"
"""What a command that ended early needs to go on lies beside its output, under this suffix."""
SAVE_PERIOD_S = 60.0
"""Between two savings of it. Chosen: larger, a process that is killed loses more; smaller, long
runs write more."""
LEAD_S = LONGEST_S
"""Images before the place where a run goes on that are looked at again by a detector that learns:
as many as it would have learned from."""


class KeptBoxes:
    """Boxes of the images so far, so that a run that ends early can go on.

    Args:
        output: The command's output.
        settings: What the boxes depend on, as words; another run must have the same.
        resumable: Whether the images can be had again; a stream's can't.
        lead_s: How much before the place where a run goes on the detector must see again.

    Attributes:
        file: Where they are kept.
    """

    def __init__(
        self, output: Path, settings: Mapping[str, str], *, resumable: bool, lead_s: float
    ) -> None:
        self.file = output.with_name(output.name + RESUME_SUFFIX)
        self._settings, self._resumable, self._lead_s = dict(settings), resumable, lead_s
        self._boxes: dict[int, NDArray[np.void]] = {}
        self._loaded_to_ns: int | None = None
        self._saved_s = time.monotonic()

    def load(self) -> None:
        """Take what an earlier run has kept.

        Raises:
            ParameterError: There is nothing, or it belongs to other options.
            InputFileError: It is damaged.
        """
        if not self._resumable:
            raise ParameterError("option --resume", "a stream", "a recording")
        if not self.file.is_file():
            expected = f"{self.file}, which a run that ends early leaves"
            raise ParameterError("option --resume", "no such run", expected)
        try:
            with np.load(self.file, allow_pickle=False) as content:
                before = json.loads(str(content["settings"]))
                stamps, counts, rows = (content[key] for key in ("stamp_ns", "count", "rows"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            expected = "what a run that ended early has left; run again without --resume"
            raise InputFileError(str(self.file), f"{type(error).__name__}", expected) from None
        for key, value in self._settings.items():
            if before.get(key) != value:
                found = f"{key} {value}, which was {before.get(key)} before"
                raise ParameterError("option --resume", found, "the same images and options")
        parts = np.split(rows.astype(DETECTION_DTYPE), np.cumsum(counts)[:-1])
        self._boxes = dict(zip(stamps.tolist(), parts, strict=True))
        self._loaded_to_ns = max(self._boxes, default=None)

    def of(self, stamp_ns: int) -> NDArray[np.void] | None:
        """Boxes of an image that has been looked at before."""
        return self._boxes.get(stamp_ns)

    def is_lead(self, stamp_ns: int) -> bool:
        """Whether an image lies shortly before the place where the run goes on."""
        loaded_to_ns = self._loaded_to_ns
        return loaded_to_ns is not None and stamp_ns > loaded_to_ns - self._lead_s * 1e9

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Keep the boxes of one image; saves them now and then."""
        self._boxes[stamp_ns] = rows
        if time.monotonic() - self._saved_s > SAVE_PERIOD_S:
            self.save()

    def save(self) -> bool:
        """Write them down; whether a run can go on from them."""
        if not (self._resumable and self._boxes):
            return False
        count = np.array([len(rows) for rows in self._boxes.values()], np.int64)
        rows = np.concatenate([np.empty(0, DETECTION_DTYPE), *self._boxes.values()])
        with atomic_output(self.file) as path, path.open("wb") as file:
            stamps = np.array(list(self._boxes), np.int64)
            text = np.array(json.dumps(self._settings))
            np.savez(file, settings=text, stamp_ns=stamps, count=count, rows=rows)
        self._saved_s = time.monotonic()
        return True

    def remove(self) -> None:
        """Take them away: the run is complete."""
        if self._resumable:
            self.file.unlink(missing_ok=True)


def kept_boxes(
    output: Path,
    images: FrameSource,
    source: str,
    model: Path | None,
    settings: DetectorSettings,
    *times: object,
    resume: bool,
) -> KeptBoxes:
    """Where a command keeps its boxes; with those of an earlier run when it resumes one.

    Args:
        output: The command's output.
        images: Where the images come from.
        source: The same as the user names it.
        model: Option `--model`.
        settings: Of the detector.
        times: Options that change the stamps of the images.
        resume: Option `--resume`.

    Raises:
        ParameterError: Nothing can be resumed.
        InputFileError: What was kept is damaged.
    """
    path = Path(source)
    depends = {
        "source": str(path.absolute()) if path.exists() else images.name,
        "size": f"{path.stat().st_size} bytes" if path.is_file() else "",
        "model": str(model),
        "min score": f"{settings.min_score:g}",
        "class names": ",".join(settings.class_names),
        "times": ", ".join(map(str, times)),
    }
    # An ONNX model learns nothing from images; all others may.
    learns = model is None or model.suffix.lower() != ".onnx"
    kept = KeptBoxes(output, depends, resumable=not images.live, lead_s=LEAD_S * learns)
    if resume:
        kept.load()
    return kept


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


class DetectionRun:
    """Finds vehicles image by image.

    Args:
        detector: Finds them.
        kept: Keeps their boxes; None: what goes wrong is raised at once.
        left_out: Counts the images that can't be used; they keep their numbers.

    Attributes:
        numbers: Number of every image so far, from 1.
        fault: What ended the run early, once some images have been looked at.
    """

    def __init__(
        self,
        detector: Detector,
        kept: KeptBoxes | None = None,
        left_out: LeftOut | None = None,
    ) -> None:
        self.numbers: list[int] = []
        self.kept, self._left_out = kept, left_out or LeftOut()
        self.fault: GeoOrbitError | None = None
        self._detector = detector

    def boxes(
        self, images: Iterable[StampedImage]
    ) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.void]]]:
        """Stamp, image and `DETECTION_DTYPE` rows; ends at the first fault.

        Raises:
            GeoOrbitError: A fault at the first image, or any where nothing is kept.
        """
        try:
            for stamp_ns, image in images:
                rows = self._rows(stamp_ns, image)
                self.numbers.append(len(self.numbers) + self._left_out.count + 1)
                yield stamp_ns, image, rows
        except GeoOrbitError as error:
            if self.kept is None or not self.numbers:
                raise
            self.fault = error

    def _rows(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.void]:
        before = None if self.kept is None else self.kept.of(stamp_ns)
        if before is not None:
            assert self.kept is not None
            if self.kept.is_lead(stamp_ns):
                self._detector.detect(stamp_ns, image)
            return before
        rows = self._detector.detect(stamp_ns, image)
        if self.kept is not None:
            self.kept.add(stamp_ns, rows)
        return rows


class EarlyEnd:
    """A context manager in which Ctrl-C ends the images, and what was found is kept.

    Args:
        images: Of the run.
        run: The run, which keeps its boxes.
        output: What the command writes.
    """

    def __init__(self, images: FrameSource, run: DetectionRun, output: Path) -> None:
        assert run.kept is not None
        self._images, self._run, self._kept, self._output = images, run, run.kept, output
        self._signals = ExitStack()
        self._told = Event()

    def __enter__(self) -> Self:
        # In a thread of its own: the main thread may hold the lock that closing needs.
        def close() -> None:
            Thread(target=self._images.close, daemon=True).start()

        self._told = self._signals.enter_context(told_to_end(close))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Keep the boxes of a run whose results could not be made or written."""
        self._signals.close()
        early = self._told.is_set() or self._run.fault is not None
        if isinstance(error, NoTrafficError) and early:
            self._say(written=False)
            raise self._reason() from None
        wrong_input = isinstance(error, GeoOrbitError) and not isinstance(
            error, PluginError | InputFileError
        )
        if error is not None and self._run.numbers and not wrong_input:
            self._say(written=False)

    def finish(self) -> None:
        """Say what is there when the run ended early, and raise what ended it.

        Raises:
            GeoOrbitError: A fault in the images or the detector.
            Interrupted: Ctrl-C.
        """
        if self._told.is_set() or self._run.fault is not None:
            self._say(written=True)
            raise self._reason()
        self._kept.remove()

    def _reason(self) -> BaseException:
        return self._run.fault or Interrupted()

    def _say(self, *, written: bool) -> None:
        from geoorbit_ros.cli.console import error_console

        saved = self._kept.save()
        text = f"Ended early, after {len(self._run.numbers)} images."
        if written:
            text += f" What was found in them is in {self._output}."
        if saved:
            text += f" The same command with --resume goes on from there ({self._kept.file})."
        error_console.print(text, soft_wrap=True, markup=False)
