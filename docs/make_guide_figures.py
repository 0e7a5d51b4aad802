"""Draws the figures of docs/guide-pole.md: the picture of `geoorbit calibrate`, right and wrong.

    .venv/bin/python docs/make_guide_figures.py

A minute of the scene `motorway_4x4`. For the wrong one the image is said to be half as wide again,
so that the camera's axis is not in the middle of what is seen.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from geoorbit_ros.cli.main import main as geoorbit

IMAGES = Path(__file__).parent / "images"
WIDTH = 960


def main() -> None:
    """Make the traffic, calibrate twice, and shrink the pictures."""
    with TemporaryDirectory() as folder:
        scene, out = f"{folder}/pole", f"{folder}/calibration.csv"
        geoorbit(
            ["scene", "run", "motorway_4x4", "--duration", "60", "--seed", "1", "--out", scene]
        )
        tracks = ["calibrate", "--tracks", f"{scene}/tracks.csv", "--out", out]
        for name, size in (("pole-right.png", "1920x1080"), ("pole-wrong.png", "2880x1080")):
            geoorbit([*tracks, "--image-size", size])
            drawn = cv2.imread(f"{folder}/calibration.png")
            assert drawn is not None
            height = round(drawn.shape[0] * WIDTH / drawn.shape[1])
            small = cv2.resize(drawn, (WIDTH, height), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(IMAGES / name), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
