"""The tensor, whose memory is used again, holds what the published steps give."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.detection.onnx.model_input import Letterbox, ModelInput, centred, cornered

CANVAS = (320, 256)
SIZES = [(1920, 1080), (640, 480), (1920, 1080), (97, 1511), (320, 256), (7, 5), (640, 480)]


def made_image(size: tuple[int, int], seed: int) -> NDArray[np.uint8]:
    random = np.random.default_rng(seed)
    return random.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


def published(box: Letterbox, image: NDArray[np.uint8], yolox: bool) -> NDArray[np.float32]:
    """Scaled, with a grey border, turned to planes: a new array at every step."""
    scaled = cv2.resize(image, box.scaled_size, interpolation=cv2.INTER_LINEAR)
    left, top = box.offset
    right = box.canvas_size[0] - left - box.scaled_size[0]
    bottom = box.canvas_size[1] - top - box.scaled_size[1]
    grey = (114, 114, 114)
    canvas = cv2.copyMakeBorder(scaled, top, bottom, left, right, cv2.BORDER_CONSTANT, value=grey)
    planes = canvas.astype(np.float32).transpose(2, 0, 1)
    return planes if yolox else planes[::-1] / np.float32(255.0)


def letterboxes(sizes: Sequence[tuple[int, int]], yolox: bool) -> list[Letterbox]:
    return [(cornered if yolox else centred)(size, CANVAS) for size in sizes]


@pytest.mark.parametrize("yolox", [False, True])
def test_images_of_changing_size_leave_nothing_behind(yolox: bool) -> None:
    scale = 1.0 if yolox else 1.0 / 255.0
    kept = ModelInput(np.float32, 1, scale=scale, swap=not yolox)
    for seed, box in enumerate(letterboxes(SIZES, yolox)):
        image = made_image(box.image_size, seed)
        np.testing.assert_allclose(
            kept.filled([box], [image])[0], published(box, image, yolox), rtol=1e-6
        )


@pytest.mark.parametrize("batch", [0, 4])
def test_batches_may_grow_and_shrink(batch: int) -> None:
    kept = ModelInput(np.float32, batch, scale=1.0 / 255.0, swap=True)
    boxes = letterboxes(SIZES, yolox=False)
    images = [made_image(size, seed) for seed, size in enumerate(SIZES)]
    for part in (slice(0, 2), slice(1, 5), slice(3, 4), slice(2, 6)):
        tensor = kept.filled(boxes[part], images[part])
        count = len(boxes[part])
        assert tensor.shape == (batch or count, 3, CANVAS[1], CANVAS[0])
        for found, box, image in zip(tensor[:count], boxes[part], images[part], strict=True):
            np.testing.assert_allclose(found, published(box, image, yolox=False), rtol=1e-6)


def test_another_canvas_takes_other_memory() -> None:
    """Exports with a dynamic shape get a canvas of the image's own shape."""
    kept = ModelInput(np.float16, 0, scale=1.0 / 255.0, swap=True)
    for seed, size in enumerate([(320, 180), (180, 240), (320, 180)]):
        box, image = centred(size, CANVAS, stride=32), made_image(size, seed)
        tensor = kept.filled([box], [image])
        assert tensor.dtype == np.float16
        wanted = published(box, image, yolox=False).astype(np.float16)
        np.testing.assert_array_almost_equal_nulp(tensor[0], wanted, nulp=1)
