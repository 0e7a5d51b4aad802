"""What every detector does, and the images it takes."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.plugin_methods import Returns, WrongResult, what
from geoorbit_ros.core.tables import DETECTION_DTYPE, RANGES, range_fault, table_fault

Image = NDArray[np.uint8]
"""(H, W, 3) uint8, blue green red."""

MIN_SIDE_PX = 2
"""Least width and height: a smaller image has only a border."""


class ModelError(GeoOrbitError):
    """A model file that can't be used."""


class ImageError(GeoOrbitError):
    """An image that can't be used."""


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Settings of all detectors; each takes its own.

    Attributes:
        min_score: Boxes that score less are dropped.
        max_iou: Of two boxes that overlap more than this, the lesser goes.
        any_class: Whether boxes of different classes suppress each other too, as detectors give a
            van a second box as a truck.
        class_names: Names of the model's classes; empty takes those in the file.
        providers: onnxruntime's execution providers, best first; empty takes the best there is.
        threads: Threads within one operator on the CPU; 0 leaves it to onnxruntime.
        model: File of the model.
    """

    min_score: float = 0.25
    max_iou: float = 0.7
    any_class: bool = True
    class_names: tuple[str, ...] = ()
    providers: tuple[str, ...] = ()
    threads: int = 0
    model: Path | None = None


@runtime_checkable
class Detector(Protocol):
    """Finds vehicles in one image after the other of one camera."""

    @property
    def name(self) -> str:
        """What finds the vehicles, in a few words for a person."""

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        """Learn from stamps and images of a recording before they come to `detect`.

        Callers may leave it out; a few images a second are enough.
        """

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """Vehicles in one image.

        Args:
            stamp_ns: Capture time; increases from call to call unless the source starts again.
            image: (H, W, 3) uint8 BGR; grey (H, W) and BGRA are taken too. Its size may change.

        Returns:
            (N,) `DETECTION_DTYPE` in pixels of `image`, highest score first; scores from 0 to 1,
            classes are COCO numbers from 0 to 79, or -1 where it is not known.

        Raises:
            ImageError: An image that is none of these.
        """


def make_detector(model: Path | None = None, settings: DetectorSettings | None = None) -> Detector:
    """The detector that a user names.

    Args:
        model: An `.onnx` file, the name of a registered detector, or `FILE.py:CLASS`; None takes
            the package's own network.
        settings: All other settings.

    Raises:
        ModelError: A model that can't be used.
        ParameterError: An execution provider that is not there, or a file without such a class.
    """
    name = "network" if model is None else str(model)
    if not (plugins.is_file(name) or name in plugins.registered("detector")):
        name = "yolo"
    settings = replace(settings or DetectorSettings(), model=model)
    return plugins.make(
        "detector",
        name,
        Detector,  # type: ignore[type-abstract]
        settings,
        place="model",
        adapt=lambda made: _adapted(made, name),
        returns=_returns(settings),
    )


def _returns(settings: DetectorSettings) -> Mapping[str, Returns]:
    """What a plug-in must return; of one that takes no settings, weak boxes are dropped."""

    def check(plugin: object, _: tuple[Any, ...], rows: NDArray[np.void]) -> NDArray[np.void]:
        if fault := table_fault(rows, DETECTION_DTYPE) or range_fault(rows):
            raise WrongResult(fault)
        weak = rows["score"] < settings.min_score
        return rows if isinstance(plugin, plugins.TakesSettings) else rows[~weak]

    def check_name(_: object, __: object, name: object) -> str:
        if not isinstance(name, str) or not name.strip():
            raise WrongResult(repr(name) if isinstance(name, str) else what(name))
        return name

    rows = f"(N,) rows of DETECTION_DTYPE, {RANGES}"
    return {"detect": Returns(rows, check), "name": Returns("a text, not empty", check_name)}


@runtime_checkable
class HasRemarks(Protocol):
    """A detector that has something to say about its model."""

    remarks: tuple[str, ...]


@runtime_checkable
class HasDoubt(Protocol):
    """A detector that notices when its boxes may be wrong."""

    @property
    def doubt(self) -> str:
        """Why, in one sentence; empty while nothing says so."""


def doubt_of(detector: Detector) -> str:
    """Why the boxes of a detector may be wrong; empty where nothing says so."""
    return detector.doubt if isinstance(detector, HasDoubt) else ""


def without_effect(detector: Detector, settings: DetectorSettings) -> str | None:
    """A sentence about settings that a plug-in does not take; None: there are none."""
    if not settings.class_names or isinstance(detector, plugins.TakesSettings):
        return None
    return f"class names have no effect: {type(detector).__name__} has no method `from_settings`"


def remarks_on(detector: Detector, settings: DetectorSettings) -> Iterator[str]:
    """Sentences that a user should read: settings without effect, and the detector's own."""
    if note := without_effect(detector, settings):
        yield note
    if isinstance(detector, HasRemarks):
        yield from detector.remarks


@runtime_checkable
class _Primes(Protocol):
    """A plug-in of before 0.1.0, whose `warm_up` is called `prime`."""

    name: str

    def prime(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None: ...

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]: ...


class _Renamed:
    """Such a plug-in as a `Detector`."""

    def __init__(self, own: _Primes) -> None:
        self.name, self.warm_up, self.detect = own.name, own.prime, own.detect


def _adapted(made: object, model: str) -> object:
    if isinstance(made, Detector) or not isinstance(made, _Primes):
        return made
    text = f"{model}: the method `prime` is now called `warm_up`; the old name goes in 0.2.0"
    warnings.warn(text, FutureWarning, stacklevel=4)
    return _Renamed(made)


def as_bgr(image: NDArray[np.generic], place: str = "image") -> Image:
    """The image as (H, W, 3) uint8 BGR; grey becomes three equal channels, alpha is dropped.

    Raises:
        ImageError: Other dimensions, or samples that are not 8 bits: how bright a 16-bit sample
            is depends on the camera, so only its driver can convert it.
    """
    shape = image.shape
    channels = shape[2] if len(shape) == 3 else 1
    sound = len(shape) in (2, 3) and channels in (1, 3, 4) and min(shape[:2]) >= MIN_SIDE_PX
    if not sound or image.dtype != np.uint8:
        found = f"{' x '.join(map(str, shape)) or 'one number'} of {image.dtype}"
        expected = "height x width of 8-bit samples, grey, BGR or BGRA"
        raise ImageError(place, found, expected)
    pixels = np.asarray(image, dtype=np.uint8)
    if channels == 3:
        return np.ascontiguousarray(pixels)
    code = cv2.COLOR_BGRA2BGR if channels == 4 else cv2.COLOR_GRAY2BGR
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)


def detection_rows(
    boxes: NDArray[np.floating],
    score: NDArray[np.floating],
    class_id: NDArray[np.integer],
    image_size: tuple[int, int],
) -> NDArray[np.void]:
    """A `DETECTION_DTYPE` table, highest score first, of boxes cut to the image.

    Args:
        boxes: (N, 4) left, top, right, bottom in pixels.
        score: (N,) in [0, 1].
        class_id: (N,) COCO numbers.
        image_size: Width and height. What lies wholly outside is left out.
    """
    width, height = image_size
    cut = np.clip(boxes, 0.0, [width, height, width, height])
    size = cut[:, 2:] - cut[:, :2]
    inside = np.flatnonzero((size > 0.0).all(axis=1))
    kept = inside[np.argsort(-score[inside], kind="stable")]
    rows = np.zeros(len(kept), DETECTION_DTYPE)
    rows["x"], rows["y"] = (0.5 * (cut[kept, :2] + cut[kept, 2:])).T
    rows["width"], rows["height"] = size[kept].T
    rows["score"], rows["class_id"] = score[kept], class_id[kept]
    return rows
