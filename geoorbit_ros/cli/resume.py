"""A run over images that may end early: what was found until then is kept, and gone on from."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.cli.images import LONGEST_S, ImageOptions, open_camera, warm_up_detector
from geoorbit_ros.cli.signals import Interrupted, told_to_end
from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.errors import (
    GeoOrbitError,
    InputFileError,
    NoTrafficError,
    ParameterError,
    PluginError,
)
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.detection.detector import (
    Detector,
    DetectorSettings,
    make_detector,
    remarks_on,
)
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.frames.feed import Thinning
from geoorbit_ros.storage.frames.source import FrameSource, LeftOut, StampedImage

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
            content = read_arrays(self.file, "what a run that ended early has left")
            before = json.loads(str(content["settings"]))
            stamps, counts, rows = (content[key] for key in ("stamp_ns", "count", "rows"))
        except (InputFileError, OSError, ValueError, KeyError) as error:
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


@contextmanager
def prepared_run(
    source: str,
    output: Path,
    options: ImageOptions,
    model: Path | None,
    settings: DetectorSettings,
    *,
    resume: bool | None,
) -> Iterator[tuple[FrameSource, DetectionRun]]:
    """Images, and a detector that has been warmed up on them, for the block.

    Args:
        source: The images, as the user names them; a stream is read in a thread of its own.
        output: What the command writes.
        options: What its options say about the images.
        model: Option `--model`.
        settings: Of the detector.
        resume: Option `--resume`; None: nothing is kept.

    Raises:
        GeoOrbitError: Images, model or an earlier run that can't be used.
    """
    from geoorbit_ros.cli.console import error_console, status

    with open_camera(source, options) as images:
        kept = (
            None
            if resume is None
            else _kept_boxes(source, output, images, options, model, settings)
        )
        if kept is not None and resume:
            kept.load()
        with status("loading"):
            detector = make_detector(model, settings)
        for note in remarks_on(detector, settings):
            error_console.print(note, soft_wrap=True)
        warm_up_detector(detector, images, options.duration_s, options.left_out)
        yield images, DetectionRun(detector, kept, options.left_out, options.max_fps)


def _kept_boxes(
    source: str,
    output: Path,
    images: FrameSource,
    options: ImageOptions,
    model: Path | None,
    settings: DetectorSettings,
) -> KeptBoxes:
    """Where a command keeps its boxes."""
    path = Path(source)
    depends = {
        "source": str(path.absolute()) if path.exists() else images.name,
        "size": f"{path.stat().st_size} bytes" if path.is_file() else "",
        "model": str(model),
        "min score": f"{settings.min_score:g}",
        "class names": ",".join(settings.class_names),
        "fps": str(options.fps),
        "start time": str(options.start),
        "max fps": f"{options.max_fps:g}",
    }
    # An ONNX model learns nothing from images; all others may.
    learns = model is None or model.suffix.lower() != ".onnx"
    return KeptBoxes(output, depends, resumable=not images.live, lead_s=LEAD_S * learns)


class DetectionRun:
    """Finds vehicles image by image.

    Args:
        detector: Finds them.
        kept: Keeps their boxes; None: what goes wrong is raised at once.
        left_out: Counts the images that can't be used; they keep their numbers.
        max_fps: Images per second of the recording that are looked at; 0: all. Others keep their
            numbers, too.

    Attributes:
        detector: As given.
        left_out: As given.
        thinning: Counts the images that were passed over.
        numbers: Number of every image so far, from 1.
        fault: What ended the run early, once some images have been looked at.
    """

    def __init__(
        self,
        detector: Detector,
        kept: KeptBoxes | None = None,
        left_out: LeftOut | None = None,
        max_fps: float = 0.0,
    ) -> None:
        self.numbers: list[int] = []
        self.thinning = Thinning(max_fps)
        self.detector, self.kept, self.left_out = detector, kept, left_out
        self.fault: GeoOrbitError | None = None

    def boxes(
        self, images: Iterable[StampedImage]
    ) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.void]]]:
        """Stamp, image and `DETECTION_DTYPE` rows; ends at the first fault.

        Raises:
            GeoOrbitError: A fault at the first image, or any where nothing is kept.
        """
        try:
            for stamp_ns, image in images:
                if not self.thinning.keep(stamp_ns):
                    continue
                rows = self._rows(stamp_ns, image)
                skipped = self.thinning.left_out
                skipped += 0 if self.left_out is None else self.left_out.count
                self.numbers.append(len(self.numbers) + skipped + 1)
                yield stamp_ns, image, rows
        except GeoOrbitError as error:
            if self.kept is None or not self.numbers:
                raise
            self.fault = error

    def rate(self, fps: float) -> float:
        """Images per second that are looked at, of a source with `fps`."""
        return min(fps, self.thinning.max_fps or fps)

    @property
    def looked_at(self) -> str:
        """How many images were looked at, in words."""
        count = len(self.numbers)
        passed = self.thinning.left_out
        return f"{count} of {count + passed} images" if passed else f"{count} images"

    def _rows(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.void]:
        before = None if self.kept is None else self.kept.of(stamp_ns)
        if before is not None:
            assert self.kept is not None
            if self.kept.is_lead(stamp_ns):
                self.detector.detect(stamp_ns, image)
            return before
        rows = self.detector.detect(stamp_ns, image)
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
