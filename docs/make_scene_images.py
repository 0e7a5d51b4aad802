"""Makes the image of docs/scenes.md: four shipped scenes in four kinds of light and weather.

    .venv/bin/python docs/make_scene_images.py

The same version of the code gives the same image.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene

PATH = Path(__file__).parent / "images" / "scenes-rendered.jpg"
TILE = (640, 360)
QUALITY = 78
SHOTS: tuple[tuple[str, Conditions, float, int], ...] = (
    # Scene, conditions, second, seed.
    ("off_ramp_diverge", Conditions("day"), 9.0, 3),
    ("urban_turn", Conditions("dusk"), 5.0, 3),
    ("straight_3x3", Conditions("night"), 1.0, 3),
    ("motorway_4x4", Conditions("day", rain=True), 3.0, 3),
)


def shot(name: str, conditions: Conditions, second: float, seed: int) -> NDArray[np.uint8]:
    """One frame of a scene, at twice the size that is shown."""
    size = 2 * TILE[0], 2 * TILE[1]
    frames = render_scene(load_scene(name), second + 1.0, seed, conditions, 1.0, size)
    image = [frame.image for frame in frames][int(second)]
    return np.asarray(cv2.resize(image, TILE, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def main() -> None:
    """Write the image."""
    a, b, c, d = (shot(*values) for values in SHOTS)
    image = np.vstack([np.hstack([a, b]), np.hstack([c, d])])
    if not cv2.imwrite(str(PATH), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY]):
        raise OSError(f"{PATH} can't be written")
    print(f"{PATH}: {PATH.stat().st_size} bytes")


if __name__ == "__main__":
    main()
