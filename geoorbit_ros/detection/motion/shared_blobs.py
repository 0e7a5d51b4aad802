"""Where the edges of vehicles are that share a patch of moving pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.explain import Explanation
from geoorbit_ros.detection.motion.lorries import drawn
from geoorbit_ros.detection.motion.vehicle_shapes import Box

Mask = NDArray[np.uint8]

NEAR, HIDDEN = 0.35, 0.12
"""Edges are moved so far, in sizes of the box, outwards and inwards: farther in, another vehicle
hides them."""
OUTSIDE = 0.1
"""A pixel outside a lorry's outline is so far from its box, in halves of it."""
MIN_SEEN = 0.35
"""Share of its box that a vehicle fills beside the others."""


def refined(pixels: Mask, corner: tuple[int, int], found: Explanation) -> list[Box]:
    """Its boxes moved to the edges of the patch where they are near.

    Those of which little is seen beside the others are left out.
    """
    order = np.argsort(-found.boxes[:, 3], kind="stable")
    left = found.boxes[order]
    outlines = [found.outlines[k] for k in order]
    size = (left[:, 2:] - left[:, :2]).prod(axis=1)
    covers = [None if hull is None else drawn(hull - corner, pixels.shape) > 0 for hull in outlines]
    for k, hull in enumerate(outlines):
        if hull is not None:
            size[k] = cv2.contourArea(cv2.convexHull(hull.astype(np.float32)))
    while True:
        owner = _owners(pixels.shape, corner, left, covers)
        own = [(pixels > 0) & (owner == k) for k in range(len(left))]
        seen = np.array([np.count_nonzero(mine) for mine in own]) / size
        if len(left) < 2 or seen.min() >= MIN_SEEN:
            break
        worst = int(np.argmin(seen))
        left, size = np.delete(left, worst, axis=0), np.delete(size, worst)
        del covers[worst]
    return [_fitted(mine, corner, box) for mine, box in zip(own, left, strict=True)]


def _owners(
    shape: tuple[int, ...],
    corner: tuple[int, int],
    boxes: NDArray[np.float64],
    covers: list[NDArray[np.bool_] | None],
) -> NDArray[np.intp]:
    """(H, W) index of the box that a pixel belongs to: of several the first, else the nearest.

    Of a lorry, `covers` (H, W) tells which part of its box belongs to it.
    """
    x = np.arange(shape[1]) + 0.5 + corner[0]
    y = np.arange(shape[0]) + 0.5 + corner[1]
    half = 0.5 * (boxes[:, 2:] - boxes[:, :2])
    middle = boxes[:, :2] + half
    across = np.abs(x - middle[:, :1]) / half[:, :1]
    down = np.abs(y - middle[:, 1:]) / half[:, 1:]
    off = np.maximum(np.maximum(across[:, None], down[:, :, None]), 1.0)
    for k, cover in enumerate(covers):
        if cover is not None:
            off[k][~cover] += OUTSIDE
    return np.asarray(off.argmin(axis=0))


def _fitted(own: NDArray[np.bool_], corner: tuple[int, int], box: NDArray[np.float64]) -> Box:
    """The box, with edges where the vehicle's own pixels end, unless another one hides them."""
    columns, rows = np.flatnonzero(own.any(axis=0)), np.flatnonzero(own.any(axis=1))
    if len(columns):
        x, y = corner
        seen = np.array([columns[0] + x, rows[0] + y, columns[-1] + 1 + x, rows[-1] + 1 + y])
        size = np.tile(box[2:] - box[:2], 2)
        outward = np.array([-1, -1, 1, 1]) * (seen - box) / size
        box = np.where((outward < NEAR) & (outward >= -HIDDEN), seen, box)
    a, b, c, d = np.rint(box).astype(int).tolist()
    return a, b, c, d
