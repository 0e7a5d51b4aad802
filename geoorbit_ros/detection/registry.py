"""Which detector a user gets."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.plugins import is_own_class, make_own
from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.detection.motion.detector import MotionDetector


def make_detector(
    model: Path | None = None,
    *,
    min_score: float = 0.25,
    max_iou: float = 0.7,
    any_class: bool = False,
    class_names: tuple[str, ...] = (),
    providers: tuple[str, ...] = (),
    threads: int = 0,
) -> Detector:
    """A YOLO model where a file is given, else whatever moves.

    Args:
        model: An `.onnx` file, or `FILE.py:CLASS` for a detector of one's own, which gets no
            settings; None finds moving vehicles by background subtraction.
        min_score: Boxes that score less are dropped.
        max_iou: Of two boxes of one class that overlap more than this, the lesser goes.
        any_class: Whether boxes of different classes suppress each other too.
        class_names: Names of the model's classes; empty takes those in the file.
        providers: onnxruntime's execution providers, best first; empty takes the best there is.
        threads: Threads within one operator on the CPU; 0 leaves it to onnxruntime.

    Raises:
        ModelError: A model that can't be used.
        ParameterError: An execution provider that is not there, or a file without such a class.
    """
    if model is None:
        return MotionDetector(min_score=min_score)
    if is_own_class(str(model)):
        return _plugin(str(model))
    # onnxruntime takes a quarter of a second to import, which only a model needs.
    from geoorbit_ros.detection.onnx.yolo import OnnxYolo, YoloOptions

    options = YoloOptions(min_score, max_iou, any_class, class_names, providers, threads)
    return OnnxYolo(model, options)


@runtime_checkable
class _Primes(Protocol):
    """A plug-in of before 0.1.0, whose `warm_up` is called `prime`."""

    name: str

    def prime(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None: ...

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]: ...


class _Renamed:
    """Such a plug-in as a `Detector`."""

    def __init__(self, own: _Primes) -> None:
        self._own = own

    @property
    def name(self) -> str:
        return self._own.name

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        self._own.prime(images)

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        return self._own.detect(stamp_ns, image)


def _plugin(model: str) -> Detector:
    own = make_own(model, "model", ("detect",))
    if isinstance(own, Detector):
        return own
    if not isinstance(own, _Primes):
        expected = "methods detect and warm_up, and a name"
        raise ParameterError(model, "no method warm_up, or no name", expected)
    text = f"{model}: the method `prime` is now called `warm_up`; the old name goes in 0.2.0"
    warnings.warn(text, FutureWarning, stacklevel=3)
    return _Renamed(own)
