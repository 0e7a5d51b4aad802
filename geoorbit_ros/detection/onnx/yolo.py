"""YOLO models in ONNX files, of any of the layouts that exporters write."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.class_names import COCO_91, COCO_NAMES, shorten, vehicle_class
from geoorbit_ros.core.plugins import register
from geoorbit_ros.detection.detector import DetectorSettings, ModelError, as_bgr, detection_rows
from geoorbit_ros.detection.onnx.choose import choose_layout
from geoorbit_ros.detection.onnx.layouts import Candidates, GridLayout, TransformerLayout
from geoorbit_ros.detection.onnx.model_input import (
    GREY,
    Letterbox,
    ModelInput,
    centred,
    cornered,
    stretched,
)
from geoorbit_ros.detection.onnx.session import load_session

MAX_CANDIDATES = 30000
"""More boxes than this before suppression are cut to the best: Ultralytics' default `max_nms`."""


def suppress(
    boxes: NDArray[np.floating],
    score: NDArray[np.floating],
    group: NDArray[np.integer],
    max_iou: float,
) -> NDArray[np.int64]:
    """Indices of the boxes that stay, highest score first.

    Args:
        boxes: (N, 4) left, top, right, bottom.
        score: (N,).
        group: (N,) boxes of different groups never suppress each other.
        max_iou: Intersection over union above which the lesser box goes.
    """
    if not len(boxes):
        return np.empty(0, dtype=np.int64)
    best = np.argsort(-score, kind="stable")[:MAX_CANDIDATES]
    edges = np.column_stack([boxes[best, :2], boxes[best, 2:] - boxes[best, :2]])
    # Its annotations ask for lists; arrays work, without an object per number.
    arrays: tuple[Any, Any, Any] = (
        edges.astype(np.float64),
        score[best].astype(np.float32),
        group[best].astype(np.int32),
    )
    kept = cv2.dnn.NMSBoxesBatched(*arrays, -1.0, max_iou)
    return np.asarray(best[np.asarray(kept, dtype=np.int64).ravel()])


MAX_DETECTIONS = 300
"""Boxes of one image at most: Ultralytics' default `max_det`."""


@register("detector", "yolo")
class OnnxYolo:
    """A YOLO model that finds vehicles.

    Preprocessing follows the predictor of the family that writes the layout: YOLOX wants BGR from 0
    to 255 in the top left corner; transformers the image over the whole canvas, of which DETR and
    RF-DETR are given deviations from ImageNet's mean; the others RGB from 0 to 1 in the middle.

    Args:
        path: An `.onnx` file.
        settings: How it is run.

    Raises:
        ModelError: A file for another task, damaged, of other shapes, or without vehicles.
        ParameterError: An execution provider that is not there.
    """

    def __init__(self, path: Path, settings: DetectorSettings | None = None) -> None:
        self.settings = settings or DetectorSettings()
        self._model = load_session(path, self.settings.providers, self.settings.threads)
        place, canvas = self._model.place, self._model.canvas
        # The first run also shows the shapes that a dynamic export leaves open, and warms up.
        level = GREY if self._model.dtype is np.uint8 else GREY / 255.0
        grey = np.full((1, 3, canvas[1], canvas[0]), level, dtype=self._model.dtype)
        outputs = self._model.run(grey.repeat(self._model.batch or 1, axis=0))
        given: Mapping[int, str] = dict(enumerate(self.settings.class_names))
        self._boxes, self._layout, self.names, count = choose_layout(
            outputs, canvas, self._model.metadata, given, place
        )
        self._coco = vehicle_classes(self.names, count, place)
        self._wanted = np.flatnonzero(self._coco >= 0)
        self._yolox = isinstance(self._layout, GridLayout) and not self._layout.rgb
        self._flat = self._boxes.of(outputs).ndim == 2
        self.remarks = tuple(_remarks(self.names, place))
        scale = 1.0 if self._yolox else 1.0 / 255.0
        self._input = ModelInput(
            self._model.dtype,
            self._model.batch,
            scale=scale,
            swap=not self._yolox,
            normalised=isinstance(self._layout, TransformerLayout) and self.names is COCO_91,
        )

    @classmethod
    def from_settings(cls, settings: DetectorSettings) -> Self:
        """The model that the settings name."""
        if settings.model is None:
            raise ModelError("detector 'yolo'", "no file", "an .onnx file as model")
        return cls(settings.model, settings)

    @property
    def name(self) -> str:
        """File, layout and input size."""
        width, height = self._model.canvas
        return f"{Path(self._model.place).name} ({self._layout.name}, {width}x{height})"

    def warm_up(self, images: Iterable[tuple[int, NDArray[np.generic]]]) -> None:
        """See `Detector`: a model learns nothing from images."""

    def detect(self, stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
        """See `Detector`; the stamp is not used."""
        return self.detect_batch([image])[0]

    def detect_batch(self, images: Sequence[NDArray[np.generic]]) -> list[NDArray[np.void]]:
        """Vehicles in each of several images, in one run where the model and the sizes allow it.

        Raises:
            ImageError: An image that `Detector.detect` would refuse.
            ModelError: The model fails.
        """
        pixels = [as_bgr(image) for image in images]
        boxes = [self._letterbox((each.shape[1], each.shape[0])) for each in pixels]
        same = len({box.canvas_size for box in boxes}) == 1 and not self._flat
        most = (self._model.batch or len(boxes)) if same else 1
        rows: list[NDArray[np.void]] = []
        for start in range(0, len(boxes), max(most, 1)):
            part = slice(start, start + max(most, 1))
            outputs = self._model.run(self._input.filled(boxes[part], pixels[part]))
            output = np.asarray(self._boxes.of(outputs), np.float32)
            rows += map(self._read, boxes[part], [output] if self._flat else output)
        return rows

    def _letterbox(self, size: tuple[int, int]) -> Letterbox:
        canvas, metadata = self._model.canvas, self._model.metadata
        if self._yolox:
            return cornered(size, canvas)
        if isinstance(self._layout, TransformerLayout) or self._model.size_name:
            return stretched(size, canvas)
        return centred(size, canvas, metadata.stride if metadata.dynamic else 0)

    def _read(self, box: Letterbox, output: NDArray[np.float32]) -> NDArray[np.void]:
        options = self.settings
        found = self._layout.candidates(output, box.canvas_size, self._wanted, options.min_score)
        finite = np.isfinite(found.boxes).all(axis=1)
        found = Candidates(found.boxes[finite], found.score[finite], found.model_class[finite])
        if options.any_class or not self._layout.suppressed:
            group = np.zeros_like(found.model_class) if options.any_class else found.model_class
            kept = suppress(found.boxes, found.score, group, options.max_iou)[:MAX_DETECTIONS]
            found = Candidates(found.boxes[kept], found.score[kept], found.model_class[kept])
        classes = self._coco[found.model_class]
        return detection_rows(box.to_image(found.boxes), found.score, classes, box.image_size)


def _remarks(names: Mapping[int, str], place: str) -> Iterable[str]:
    """What a user should know about the names of a model's classes."""
    other = [name for name in names.values() if vehicle_class(name) is None]
    if other and tuple(names.values()) != COCO_NAMES:
        taken = shorten([name for name in names.values() if vehicle_class(name) is not None])
        yield (
            f"{place}: taken for vehicles: {taken}; not taken: {shorten(other)}. Names are English "
            "words such as car, van, truck, bus, motorcycle; class names can be given as an option"
        )


def vehicle_classes(names: Mapping[int, str], count: int, place: str) -> NDArray[np.int64]:
    """(count,) COCO number of each of a model's classes, -1 where it is no vehicle.

    Raises:
        ModelError: Not one vehicle among the names.
    """
    found = np.full(count, -1, dtype=np.int64)
    for number, name in names.items():
        coco = vehicle_class(name)
        if 0 <= number < count and coco is not None:
            found[number] = coco
    if (found < 0).all():
        said = f"classes {shorten(list(names.values()))}" if names else "no class names"
        expected = "at least one of car, van, truck, bus, motorcycle (option class_names)"
        raise ModelError(place, said, expected)
    return found
