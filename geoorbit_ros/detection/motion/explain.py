"""Which vehicles a patch of moving pixels consists of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.lorries import LorrySearch, Outline, drawn
from geoorbit_ros.detection.motion.vehicle_shapes import Box, Silhouettes, VehicleSizes

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
ONE_GAIN = 0.03
"""Several vehicles must be more like a patch than one by this share of its pixels for each more."""
MOST_LORRIES = 3
GOOD = 0.12
"""An explanation less bad than this is not improved by lorries: their own misfit is as large."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Vehicles that together look like the patch.

    Attributes:
        boxes: (N, 4) left, top, right, bottom, in the image.
        misfit: Share of the pixels that are wrong.
        outlines: (N, 2) for each that is a lorry, points of its convex outline in the image.
    """

    boxes: NDArray[np.float64]
    misfit: float
    outlines: Sequence[Outline | None]

    @property
    def badness(self) -> float:
        """Misfit, and what each vehicle must bring."""
        return self.misfit + ONE_GAIN * (len(self.boxes) - 1)


def explain(
    pixels: Mask,
    corner: tuple[int, int],
    sizes: VehicleSizes,
    shapes: Silhouettes,
    search: LorrySearch | None = None,
) -> Explanation:
    """The few vehicles of known size and outline whose union is most like the patch.

    Args:
        pixels: (H, W) 0 or 1.
        corner: Where its (0, 0) is in the image.
        sizes: How large a car is at each place.
        shapes: What outline vehicles have there.
        search: Finds lorries longer than any usual size; without it there are none.
    """
    seen, zoom = _smaller(pixels, corner, sizes)
    models = _models(seen.shape[::-1], corner, zoom, sizes, shapes)
    best = _explained(seen, corner, zoom, models, [])
    if search is None or best.badness < GOOD:
        return best
    worth = (1.0 + EMPTY_COST) * seen - EMPTY_COST
    lorries: list[Outline] = []
    while len(lorries) < MOST_LORRIES:
        hull = search.best(worth, corner, zoom)
        if hull is None:
            break
        lorries.append(hull)
        other = _explained(seen, corner, zoom, models, lorries)
        if other.badness >= best.badness:
            break
        best = other
        worth = worth * (1.0 - drawn((hull - corner) * zoom, seen.shape))
    return best


def _smaller(
    pixels: Mask, corner: tuple[int, int], sizes: VehicleSizes
) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """The patch made so small that cars are `CAR_PX` high, and its pixels per pixel each way."""
    height, width = pixels.shape
    left, top = corner
    _, car_px = sizes.car((left, top, left + width, top + height))
    scale = min(CAR_PX / car_px, 1.0)
    size = (max(round(width * scale), 2), max(round(height * scale), 2))
    small = cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32), (size[0] / width, size[1] / height)


def _explained(
    seen: NDArray[np.float32],
    corner: tuple[int, int],
    zoom: tuple[float, float],
    models: list[_Model],
    lorries: list[Outline],
) -> Explanation:
    """The patch as these lorries and the vehicles that are most like what they leave."""
    covers = [drawn((hull - corner) * zoom, seen.shape) for hull in lorries]
    start = np.ones(seen.shape, dtype=np.float32)
    for cover in covers:
        start *= 1.0 - cover
    chosen = _choose(models, seen, start)
    free = start * _free(chosen, models, seen.shape)
    misfit = float(np.abs(1.0 - free - seen).sum() / seen.sum())
    boxes = np.array([models[k].box(x, y) for k, x, y in chosen], dtype=np.float64).reshape(-1, 4)
    left, top = corner
    placed = boxes / [*zoom, *zoom] + [left, top, left, top]
    spans = [np.concatenate([hull.min(axis=0), hull.max(axis=0)]) for hull in lorries]
    outlines = [None] * len(boxes) + lorries
    return Explanation(np.concatenate([placed, *(span[None] for span in spans)]), misfit, outlines)


@dataclass(frozen=True, slots=True)
class _Model:
    """A vehicle of one size, which may stand in some rows.

    Attributes:
        cover: (h, w) what it covers.
        first, last: Rows between which its lowest row is, the last one excluded.
        cost: Price in pixels.
        most: What it gains at most.
    """

    cover: NDArray[np.float32]
    first: int
    last: int
    cost: float
    most: float

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
                price = cost * w * h / kind_w / kind_h
                models.append(_Model(cover, first, last + 1, price, float(cover.sum()) - price))
    return sorted(models, key=lambda model: -model.most)


def _choose(
    models: list[_Model], seen: NDArray[np.float32], start: NDArray[np.float32]
) -> list[_Place]:
    """The vehicles that explain the patch best: added one by one, then moved one by one.

    `start` is what others leave uncovered.
    """
    worth = ((1.0 + EMPTY_COST) * seen - EMPTY_COST) * start
    chosen: list[_Place] = []
    for _ in range(ROUNDS):
        before = list(chosen)
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            better = _best(models, worth * _free(others, models, seen.shape), -np.inf)
            chosen[k] = better or chosen[k]
        if chosen and chosen == before:
            break
        while len(chosen) < MOST:
            place = _best(models, worth * _free(chosen, models, seen.shape), 0.0)
            if place is None:
                break
            chosen.append(place)
        if len(chosen) < 2:
            break
    return chosen


def _best(models: list[_Model], worth: NDArray[np.float32], least: float) -> _Place | None:
    """The place of the model that covers most of what is worth it, if it gains more than `least`.

    Models come in the order of what they gain at most.
    """
    place, most = None, least
    room = float(np.maximum(worth, 0.0).sum())
    for k, model in enumerate(models):
        if model.most <= most:
            break  # the others gain less still
        if room - model.cost <= most:
            continue
        height = model.cover.shape[0]
        part = worth[model.first - height : model.last - 1]
        gain = cv2.matchTemplate(part, model.cover, cv2.TM_CCORR)
        _, high, _, (x, y) = cv2.minMaxLoc(gain)
        if high - model.cost > most:
            place, most = (k, x, model.first + y), high - model.cost
    return place


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
