"""Pictures of what a detector found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.road_segments import RoadSegments

HEAT_SHARE = 0.55
"""How much of the hottest colour covers the image."""
OUTLINE = (255, 255, 255)
EDGE = (60, 30, 20)


def draw_segments(image: Image, segments: RoadSegments) -> Image:
    """The image with the heat map of detections over it and the road segments outlined."""
    size = (image.shape[1], image.shape[0])
    strength = np.log1p(segments.heat)
    strength = strength / max(float(strength.max()), 1e-6)
    level = cv2.resize(strength, size, interpolation=cv2.INTER_LINEAR)
    heat = cv2.applyColorMap(np.asarray(255 * level, dtype=np.uint8), cv2.COLORMAP_INFERNO)
    share = (HEAT_SHARE * np.sqrt(level))[..., None]
    drawn = (image * (1.0 - share) + heat * share).astype(np.uint8)
    outlines = [np.rint(contour).astype(np.int32)[:, None] for contour in segments.contours]
    for colour, width in ((EDGE, 5), (OUTLINE, 2)):
        cv2.polylines(drawn, outlines, True, colour, width, cv2.LINE_AA)
    return np.asarray(drawn, dtype=np.uint8)


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a .png or .jpg.

    Raises:
        InputFileError: It can't be written there.
    """
    _, data = cv2.imencode(path.suffix, image)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InputFileError(str(path), error.strerror or str(error), "a place to write") from None
