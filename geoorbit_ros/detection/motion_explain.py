"""Which vehicles a patch of moving pixels consists of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion_silhouettes import Silhouettes
from geoorbit_ros.detection.motion_sizes import Box, VehicleSizes

Mask = NDArray[np.uint8]

CAR_PX = 10.0
"""Patches are looked at so small that cars are so high."""
KINDS = ((1.0, 1.0), (1.05, 1.35), (1.5, 1.9), (2.2, 2.1))
"""Width and height of vehicles that are tried, in cars: cars, vans, lorries seen from two sides."""
KIND_COST = (0.25, 0.3, 0.7, 1.0)
"""Evidence that one more vehicle needs, in cars' areas."""
EMPTY_COST = 1.0
"""Price of a pixel that a vehicle should cover and doesn't, beside one that none covers."""
MOST = 6
"""Vehicles in one patch."""
SIZE_STEP = 0.15
"""Sizes closer than this, as a natural logarithm, are taken for one."""
ROW_STEP = 3
"""Sizes are looked up in every so manieth row."""
ROUNDS = 2
"""So often each vehicle is moved to where it fits best beside the others."""
NEAR, HIDDEN = 0.35, 0.12
"""Edges are moved so far, in sizes of the box, outwards and inwards: farther in, another vehicle
hides them."""
MIN_SEEN = 0.35
"""Share of its box that a vehicle fills beside the others."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Vehicles that together look like the patch.

    Attributes:
        boxes: (N, 4) left, top, right, bottom, in the image.
        misfit: Share of the pixels that are wrong.
    """

    boxes: NDArray[np.float64]
    misfit: float


def explain(
    pixels: Mask, corner: tuple[int, int], sizes: VehicleSizes, shapes: Silhouettes
) -> Explanation:
    """The few vehicles of known size and outline whose union is most like the patch.

    Args:
        pixels: (H, W) 0 or 1.
        corner: Where its (0, 0) is in the image.
        sizes: How large a car is at each place.
        shapes: What outline vehicles have there.
    """
    height, width = pixels.shape
    left, top = corner
    _, car_px = sizes.car((left, top, left + width, top + height))
    scale = min(CAR_PX / car_px, 1.0)
    size = (max(round(width * scale), 2), max(round(height * scale), 2))
    small = cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    seen = np.asarray(small, dtype=np.float32)
    zoom = size[0] / width, size[1] / height
    models = _models(size, corner, zoom, sizes, shapes)
    chosen = _choose(models, seen)
    free = _free(chosen, models, seen.shape)
    misfit = float(np.abs(1.0 - free - seen).sum() / seen.sum())
    boxes = np.array([models[k].box(x, y) for k, x, y in chosen], dtype=np.float64).reshape(-1, 4)
    return Explanation(boxes / [*zoom, *zoom] + [left, top, left, top], misfit)


@dataclass(frozen=True, slots=True)
class _Model:
    """A vehicle of one size, which may stand in some rows.

    Attributes:
        cover: (h, w) what it covers.
        first, last: Rows between which its lowest row is, the last one excluded.
        cost: Price in pixels.
    """

    cover: NDArray[np.float32]
    first: int
    last: int
    cost: float

    def box(self, x: int, bottom: int) -> tuple[int, int, int, int]:
        """Left, top, right, bottom of one."""
        height, width = self.cover.shape
        return x, bottom - height, x + width, bottom


_Place = tuple[int, int, int]
"""Index of a model, left column, row below the lowest."""


def _models(
    size: tuple[int, int],
    corner: tuple[int, int],
    zoom: tuple[float, float],
    sizes: VehicleSizes,
    shapes: Silhouettes,
) -> list[_Model]:
    width, height = size
    x = corner[0] + 0.5 * width / zoom[0]
    shape = shapes.at(x, corner[1] + height / zoom[1])
    rows: dict[int, list[tuple[int, tuple[float, float]]]] = {}
    for bottom in range(ROW_STEP, height + ROW_STEP, ROW_STEP):
        low = min(bottom, height)
        car = sizes.car((int(x), 0, int(x), int(corner[1] + low / zoom[1])))
        rows.setdefault(round(math.log(car[1]) / SIZE_STEP), []).append((low, car))
    models = []
    for (kind_w, kind_h), cost in zip(KINDS, KIND_COST, strict=True):
        for alike in rows.values():
            car = alike[len(alike) // 2][1]
            w, h = round(kind_w * car[0] * zoom[0]), round(kind_h * car[1] * zoom[1])
            first, last = max(alike[0][0] - ROW_STEP + 1, h), alike[-1][0]
            if 2 <= w <= width + 1 and h >= 2 and first <= last:
                cover = np.asarray(cv2.resize(shape, (min(w, width), h)), dtype=np.float32)
                models.append(_Model(cover, first, last + 1, cost * w * h / kind_w / kind_h))
    return models


def _choose(models: list[_Model], seen: NDArray[np.float32]) -> list[_Place]:
    """The vehicles that explain the patch best: added one by one, then moved one by one."""
    worth = (1.0 + EMPTY_COST) * seen - EMPTY_COST
    chosen: list[_Place] = []
    for _ in range(ROUNDS):
        before = list(chosen)
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            better, _ = _best(models, worth * _free(others, models, seen.shape))
            chosen[k] = better or chosen[k]
        while len(chosen) < MOST:
            place, gain = _best(models, worth * _free(chosen, models, seen.shape))
            if place is None or gain <= 0.0:
                break
            chosen.append(place)
        if chosen == before or len(chosen) < 2:
            break
    return chosen


def _best(models: list[_Model], worth: NDArray[np.float32]) -> tuple[_Place | None, float]:
    """The place of the model that covers most of what is worth it, and what it gains."""
    place, most = None, -np.inf
    for k, model in enumerate(models):
        height = model.cover.shape[0]
        part = worth[model.first - height : model.last - 1]
        gain = cv2.matchTemplate(part, model.cover, cv2.TM_CCORR)
        _, high, _, (x, y) = cv2.minMaxLoc(gain)
        if high - model.cost > most:
            place, most = (k, x, model.first + y), high - model.cost
    return place, most


def _free(
    chosen: list[_Place], models: list[_Model], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """(H, W) what the chosen vehicles leave uncovered."""
    free = np.ones(shape, dtype=np.float32)
    for k, x, bottom in chosen:
        left, top, right, low = models[k].box(x, bottom)
        free[top:low, left:right] *= 1.0 - models[k].cover
    return free


def one_misfit(pixels: Mask, corner: tuple[int, int], box: Box, shapes: Silhouettes) -> float:
    """Share of the pixels that are wrong when the patch is one vehicle as large as its box."""
    shape = shapes.at(0.5 * (box[0] + box[2]), box[3])
    x, y = corner
    inside = pixels[box[1] - y : box[3] - y, box[0] - x : box[2] - x].astype(np.float32)
    small = cv2.resize(inside, shape.shape[::-1], interpolation=cv2.INTER_AREA)
    return float(np.abs(small - shape).sum() / max(small.sum(), 1e-6))


def refined(pixels: Mask, corner: tuple[int, int], boxes: NDArray[np.float64]) -> list[Box]:
    """Boxes (N, 4) moved to the edges of the patch where they are near.

    Those of which little is seen beside the others are left out.
    """
    left = boxes[np.argsort(-boxes[:, 3], kind="stable")]
    while True:
        owner = _owners(pixels.shape, corner, left)
        own = [(pixels > 0) & (owner == k) for k in range(len(left))]
        size = (left[:, 2:] - left[:, :2]).prod(axis=1)
        seen = np.array([np.count_nonzero(mine) for mine in own]) / size
        if len(left) < 2 or seen.min() >= MIN_SEEN:
            break
        left = np.delete(left, int(np.argmin(seen)), axis=0)
    return [_fitted(mine, corner, box) for mine, box in zip(own, left, strict=True)]


def _owners(
    shape: tuple[int, ...], corner: tuple[int, int], boxes: NDArray[np.float64]
) -> NDArray[np.intp]:
    """(H, W) index of the box that a pixel belongs to: of several the first, else the nearest."""
    x = np.arange(shape[1]) + 0.5 + corner[0]
    y = np.arange(shape[0]) + 0.5 + corner[1]
    half = 0.5 * (boxes[:, 2:] - boxes[:, :2])
    middle = boxes[:, :2] + half
    across = np.abs(x - middle[:, :1]) / half[:, :1]
    down = np.abs(y - middle[:, 1:]) / half[:, 1:]
    off = np.maximum(np.maximum(across[:, None], down[:, :, None]), 1.0)
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
