"""Writes control points as `calibration.csv`, with what is known of the camera above them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geoorbit_ros.calibration.control_points import (
    GEODETIC_COLUMNS,
    LOCAL_COLUMNS,
    PIXEL_COLUMNS,
    SIGMA_COLUMNS,
    ControlPoints,
)
from geoorbit_ros.storage.atomic import atomic_output


def write_control_points(
    path: str | Path, points: ControlPoints, comments: Sequence[str] = ()
) -> None:
    """Write a file that `read_control_points` reads back; whole or not at all.

    Args:
        path: The file; one that is there is replaced.
        points: The points, their sigmas, and the facts about their camera.
        comments: Lines for people, above all others, without the `#`.

    Raises:
        InputFileError: Nothing can be written there.
    """
    with atomic_output(path) as file:
        file.write_text(control_points_text(points, comments), encoding="utf-8")


def control_points_text(points: ControlPoints, comments: Sequence[str] = ()) -> str:
    """The text of such a file.

    Positions are latitude and longitude where the datum is known, to nine decimals of a degree
    (0.1 mm), else metres. Columns of sigmas are there when a point has one.
    """
    geodetic = points.datum is not None
    columns = [*PIXEL_COLUMNS, *(GEODETIC_COLUMNS if geodetic else LOCAL_COLUMNS)]
    ground = points.datum.to_geodetic(points.local_m) if points.datum else points.local_m
    digits = 9 if geodetic else 4
    rows = [
        [f"{x:.6f}", f"{y:.6f}", f"{a:.{digits}f}", f"{b:.{digits}f}"]
        for (x, y), (a, b) in zip(points.pixel, ground, strict=True)
    ]
    for name, sigma in zip(SIGMA_COLUMNS, (points.sigma_px, points.sigma_m), strict=True):
        if sigma is not None and np.isfinite(sigma).any():
            columns.append(name)
            for row, value in zip(rows, sigma, strict=True):
                row.append(f"{value:.4g}" if np.isfinite(value) else "")
    head = [*(f"# {line}" for line in comments), *points.facts.lines()]
    return "\n".join([*head, ",".join(columns), *map(",".join, rows), ""])
