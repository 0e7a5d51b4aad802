"""Which vehicle hides which: the order of drawing, and how much of each is seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.detector_model import View

_TOUCH_M = 0.05
"""Footprints that overlap less than this count as apart. Chosen: less than the error of a simulated
position; larger draws touching vehicles in the wrong order."""


@dataclass(frozen=True, slots=True)
class Outlines:
    """Outlines of the vehicles in an image, drawn or not.

    Attributes:
        hulls: Convex outline (K, 2) of each vehicle, pixels, unclipped; None when not in front.
        boxes: (N, 4) left, top, right, bottom of the outlines, unclipped; NaN when not in front.
    """

    hulls: list[NDArray[np.float32] | None]
    boxes: NDArray[np.float64]


def draw_order(view: View, camera_m: NDArray[np.float64]) -> list[int]:
    """Vehicles from the farthest to the nearest, so that a nearer one is drawn over it.

    Two footprints apart have a line along one of their sides between them; only the one on the
    camera's side of it can hide the other. Distance alone would draw a car over the trailer that
    it drives behind.

    Args:
        view: The vehicles.
        camera_m: (3,) the camera's place.
    """
    count = len(view.xy)
    distance = np.hypot(*(view.xy - camera_m[:2]).T)
    hides = _can_hide(view, camera_m[:2])
    nearer = distance[:, None] < distance[None, :]
    # after[i, j]: i must be drawn after j. Where footprints overlap, both can hide: distance says.
    after = hides & (~hides.T | nearer)
    np.fill_diagonal(after, False)
    order: list[int] = []
    waiting = np.ones(count, bool)
    while waiting.any():
        ready = waiting & ~(after & waiting[None, :]).any(axis=1)
        if not ready.any():  # three in a circle: break it at the farthest
            ready = waiting
        ready_at = np.flatnonzero(ready)
        for k in ready_at[np.argsort(-distance[ready_at], kind="stable")]:
            order.append(int(k))
            waiting[k] = False
            if ready is waiting:
                break
    return order


def _can_hide(view: View, camera_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N, N) whether the first of a pair may hide the second."""
    cos, sin = np.cos(view.heading), np.sin(view.heading)
    ahead, left = np.column_stack([cos, sin]), np.column_stack([-sin, cos])
    half = 0.5 * view.size[:, :2]
    corners = view.xy[:, None] + np.stack(
        [
            a * half[:, :1] * ahead + b * half[:, 1:] * left
            for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ],
        axis=1,
    )
    sides = np.stack([ahead, -ahead, left, -left], axis=1)  # (N, 4, 2) outward
    reach = np.stack([half[:, 0], half[:, 0], half[:, 1], half[:, 1]], axis=1)
    start = np.einsum("nek,nk->ne", sides, view.xy) + reach  # a side lies at this coordinate
    camera_outside = np.einsum("nek,k->ne", sides, camera_m) > start
    beyond = np.einsum("nek,mck->nemc", sides, corners).min(axis=3) - start[..., None]
    apart = beyond > -_TOUCH_M  # (i, side, j): j lies wholly beyond that side of i
    behind_it = (apart & ~camera_outside[..., None]).any(axis=1)  # j cannot hide i
    before_it = (apart & camera_outside[..., None]).any(axis=1)  # i cannot hide j
    return np.asarray(~(behind_it.T | before_it))


def visible_shares(
    outlines: Outlines, order: list[int], image_size: tuple[int, int]
) -> NDArray[np.float64]:
    """(N,) share of each outline that lies in the image and is not hidden by others."""
    width, height = image_size
    owner = np.zeros((height, width), np.int32)
    drawn: dict[int, tuple[tuple[slice, slice], int, float]] = {}
    for k in order:
        hull = outlines.hulls[k]
        if hull is None:
            continue
        left, top, right, bottom = outlines.boxes[k]
        low = max(int(left), 0), max(int(top), 0)
        high = min(int(right) + 1, width), min(int(bottom) + 1, height)
        if low[0] >= high[0] or low[1] >= high[1]:
            continue
        at = slice(low[1], high[1]), slice(low[0], high[0])
        cv2.fillConvexPoly(owner, np.rint((hull - 0.5) * 16).astype(np.int32), k + 1, cv2.LINE_8, 4)
        drawn[k] = (
            at,
            max(int(np.count_nonzero(owner[at] == k + 1)), 1),
            _share_inside(hull, outlines.boxes[k], image_size),
        )
    shares = np.zeros(len(outlines.hulls))
    for k, (at, area, inside) in drawn.items():
        shares[k] = inside * np.count_nonzero(owner[at] == k + 1) / area
    return shares


def _share_inside(
    hull: NDArray[np.float32], box: NDArray[np.float64], image_size: tuple[int, int]
) -> float:
    width, height = image_size
    if box[0] >= 0 and box[1] >= 0 and box[2] <= width and box[3] <= height:
        return 1.0
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    shared, _ = cv2.intersectConvexConvex(hull, frame)
    return float(shared / max(cv2.contourArea(hull), 1e-6))
