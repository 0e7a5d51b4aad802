"""Text in images that can be read on any background. OpenCV's font has ASCII only."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK = (0, 0, 0)
"""Of the rim."""


def write_text(
    image: NDArray[np.uint8],
    text: str,
    at: tuple[int, int],
    size: float,
    colour: tuple[int, int, int],
    thickness: int = 1,
) -> None:
    """Draw `text` with a black rim, its lower left corner `at`, into `image`.

    The rim is the same text drawn around: since OpenCV 5 thicker letters are also wider, so a thick
    black text would not lie behind a thin coloured one.
    """
    step = max(round(size), 1)
    for dx, dy in itertools.product((-step, 0, step), repeat=2):
        place = (at[0] + dx, at[1] + dy)
        cv2.putText(image, text, place, _FONT, size, _BLACK, thickness, cv2.LINE_AA)
    cv2.putText(image, text, at, _FONT, size, colour, thickness, cv2.LINE_AA)


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Pixels that `write_text` takes from left to right, the rim included."""
    return int(cv2.getTextSize(text, _FONT, size, thickness)[0][0]) + 2 * max(round(size), 1)
