"""Boxes of tracked vehicles as shapes over the image they were seen in."""

from __future__ import annotations

from colorsys import hsv_to_rgb

import numpy as np
from foxglove.messages import (
    Color,
    ImageAnnotations,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    TextAnnotation,
    Timestamp,
)
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_PREDICTED

GOLDEN = 0.618034
"""Successive ids get hues far apart (golden ratio)."""
THICKNESS_PX = 2.0
FONT_PX = 14.0


def box_annotations(stamp_ns: int, rows: NDArray[np.void]) -> ImageAnnotations:
    """One rectangle and one label per vehicle; predicted boxes are drawn thin.

    Args:
        stamp_ns: Capture time of the image.
        rows: (N,) `PIXEL_TRACK_DTYPE`.
    """
    stamp = Timestamp(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    shapes, labels = [], []
    for row in rows:
        colour = track_colour(int(row["track_id"]))
        x, y, w, h = (float(row[key]) for key in ("x", "y", "width", "height"))
        left, top, right, bottom = x - w / 2, y - h / 2, x + w / 2, y + h / 2
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        predicted = bool(row["flags"] & FLAG_PREDICTED)
        shapes.append(
            PointsAnnotation(
                timestamp=stamp,
                type=PointsAnnotationType.LineLoop,
                points=[Point2(x=a, y=b) for a, b in corners],
                outline_color=colour,
                thickness=0.5 * THICKNESS_PX if predicted else THICKNESS_PX,
            )
        )
        labels.append(
            TextAnnotation(
                timestamp=stamp,
                position=Point2(x=left, y=top),
                text=str(row["track_id"]),
                font_size=FONT_PX,
                text_color=colour,
            )
        )
    return ImageAnnotations(timestamp=stamp, points=shapes, texts=labels)


def track_colour(track_id: int) -> Color:
    """The same colour for the same id, in every viewer."""
    r, g, b = hsv_to_rgb(track_id * GOLDEN % 1.0, 0.7, 1.0)
    return Color(r=r, g=g, b=b, a=1.0)
