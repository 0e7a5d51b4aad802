"""Which vehicles share a blob of moving pixels, and where their edges are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.lorries import LorrySearch, Outline, drawn
from geoorbit_ros.detection.motion.vehicle_shapes import Box, VehicleOutlines, VehicleSizes

Mask = NDArray[np.uint8]

CAR_PX = 10.0
"""Blobs are looked at so small that cars are so high. Chosen: larger takes more time (up to 10 ms
of a frame), smaller misses hidden vehicles."""
KINDS = ((1.0, 1.0), (1.05, 1.35), (1.5, 1.9), (2.2, 2.1))
"""Width and height of vehicles that are tried, in cars: cars, vans, lorries seen from two sides.
Chosen: `VEHICLE_TYPES` of scenes has their sizes in metres."""
KIND_COST = (0.25, 0.3, 0.7, 1.0)
"""Evidence that one more vehicle of each kind needs, in cars' areas. Chosen: larger leaves vehicles
in one box, smaller finds vehicles in shadows."""
EMPTY_COST = 1.0
"""Price of a pixel that a vehicle should cover and doesn't, relative to one that no vehicle covers.
Chosen: larger leaves parts of a blob without a vehicle, smaller puts vehicles into gaps."""
MOST = 6
"""Vehicles in one blob at most. Chosen: more take more time; a longer row stays partly
unexplained."""
SIZE_STEP = 0.15
"""Sizes closer than this, as a natural logarithm, are taken for one. Chosen: smaller takes more
time."""
ROW_STEP = 3
"""Sizes are looked up in every third row, to save time. Chosen: larger tries fewer sizes."""
ROUNDS = 2
"""So often each vehicle is moved to where it fits best beside the others. Chosen: more take
time."""
ONE_GAIN = 0.03
"""Several vehicles must be more like a blob than one by this share of its pixels for each more.
Chosen: larger leaves vehicles in one box, smaller splits lorries."""
MOST_LORRIES = 3
"""Long lorries in one blob at most. Chosen: more take time."""
GOOD = 0.12
"""An explanation less bad than this is not improved by lorries. Chosen: their own misfit is as
large; smaller takes more time."""
NEAR = 0.35
"""Edges move outwards by at most this share of the box to where the blob ends. Chosen: larger takes
in neighbours, smaller cuts vehicles of unusual size."""
HIDDEN = 0.12
"""Edges move inwards by at most this share of the box. Chosen: farther in, another vehicle hides
them."""
OUTSIDE = 0.1
"""A pixel outside a lorry's outline counts as so far from its box, in halves of it. Chosen: more
than a pixel of a neighbour that lies in both boxes."""
MIN_SEEN = 0.35
"""Share of its box that a vehicle must fill beside the others. Chosen: larger misses hidden
vehicles, smaller keeps false ones."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Vehicles that together look like the blob.

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
        """Misfit, and the price of each vehicle after the first."""
        return self.misfit + ONE_GAIN * (len(self.boxes) - 1)


def explain(
    pixels: Mask,
    corner: tuple[int, int],
    sizes: VehicleSizes,
    outlines: VehicleOutlines,
    search: LorrySearch | None = None,
) -> Explanation:
    """The few vehicles of known size and outline whose union is most like the blob.

    Args:
        pixels: (H, W) 0 or 1.
        corner: Where its (0, 0) is in the image.
        sizes: How large a car is at each place.
        outlines: What outline vehicles have there.
        search: Finds lorries longer than any usual size; without it there are none.
    """
    seen, zoom = _smaller(pixels, corner, sizes)
    models = _models(seen.shape[::-1], corner, zoom, sizes, outlines)
    best = _explained(seen, corner, zoom, models, [])
    if search is None or best.badness < GOOD:
        return best
    value = (1.0 + EMPTY_COST) * seen - EMPTY_COST
    lorries: list[Outline] = []
    while len(lorries) < MOST_LORRIES:
        hull = search.best(value, corner, zoom)
        if hull is None:
            break
        lorries.append(hull)
        other = _explained(seen, corner, zoom, models, lorries)
        if other.badness >= best.badness:
            break
        best = other
        value = value * (1.0 - drawn((hull - corner) * zoom, seen.shape))
    return best


def _smaller(
    pixels: Mask, corner: tuple[int, int], sizes: VehicleSizes
) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """The blob made so small that cars are `CAR_PX` high, and its pixels per pixel each way."""
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
    """The blob as these lorries, and the vehicles that explain the rest best."""
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
    outlines: VehicleOutlines,
) -> list[_Model]:
    width, height = size
    x = corner[0] + 0.5 * width / zoom[0]
    shape = outlines.at(x, corner[1] + height / zoom[1])
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
    """The vehicles that explain the blob best: added one by one, then moved one by one.

    `start` is what others leave uncovered.
    """
    value = ((1.0 + EMPTY_COST) * seen - EMPTY_COST) * start
    chosen: list[_Place] = []
    for _ in range(ROUNDS):
        before = list(chosen)
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            better = _best(models, value * _free(others, models, seen.shape), -np.inf)
            chosen[k] = better or chosen[k]
        if chosen and chosen == before:
            break
        while len(chosen) < MOST:
            place = _best(models, value * _free(chosen, models, seen.shape), 0.0)
            if place is None:
                break
            chosen.append(place)
        if len(chosen) < 2:
            break
    return chosen


def _best(models: list[_Model], value: NDArray[np.float32], least: float) -> _Place | None:
    """The place of the model whose pixels gain most, if they gain more than `least`.

    Models come in the order of what they gain at most.
    """
    place, most = None, least
    room = float(np.maximum(value, 0.0).sum())
    for k, model in enumerate(models):
        if model.most <= most:
            break  # the others gain less still
        if room - model.cost <= most:
            continue
        height = model.cover.shape[0]
        part = value[model.first - height : model.last - 1]
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


def misfit_of_one(
    pixels: Mask, corner: tuple[int, int], box: Box, outlines: VehicleOutlines
) -> float:
    """Share of the pixels that are wrong when the blob is one vehicle as large as its box."""
    shape = outlines.at(0.5 * (box[0] + box[2]), box[3])
    x, y = corner
    inside = pixels[box[1] - y : box[3] - y, box[0] - x : box[2] - x].astype(np.float32)
    small = cv2.resize(inside, shape.shape[::-1], interpolation=cv2.INTER_AREA)
    return float(np.abs(small - shape).sum() / max(small.sum(), 1e-6))


def fit_edges(pixels: Mask, corner: tuple[int, int], found: Explanation) -> list[Box]:
    """The boxes of an explanation, moved to the edges of the blob where these are near.

    Vehicles of which little is seen beside the others are left out.
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
