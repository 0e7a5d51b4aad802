"""Size and outline of vehicles at each place of the image, learnt from the vehicles themselves."""

from __future__ import annotations

import math
from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

Box = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels."""

MEMORY_BOXES = 4000
"""Boxes that sizes are learnt from, the latest. Chosen: more take time, fewer forget quiet
places."""
REACH = 1.0
"""Sizes are known so far above and below the rows in which they were learnt, in shares of these
rows. Chosen: sizes learnt from far cars alone say nothing about near ones; smaller learns near ones
later."""
MIN_BOXES = 40
"""Boxes from which sizes are known, those of some five vehicles that travelled. Chosen: more learn
later, fewer learn from single lorries."""
MIN_VEHICLES = 4
"""And vehicles that they are of. Chosen: fewer learn from one bird or one light, more learn later
on quiet roads."""
TRIES = 150
"""Random pairs tried for the line of heights: with a third of the boxes cars, the chance that none
of the pairs is two cars is below 1e-6 (Fischler and Bolles 1981)."""
TOLERANCE = 0.2
"""Cars are this equal in height, as a natural logarithm. Chosen: larger takes in vans, smaller
leaves out small cars."""
BANDS = 12
"""The image is cut in so many bands of rows that count equally in the fit. Chosen: more have too
few boxes each, fewer let one queue decide."""
MIN_BAND = 12
"""A band with fewer boxes counts less. Chosen: fewer let single boxes decide."""
MIN_HEIGHT_PX = 3.0
"""No car is taken to be less high. Chosen: rows at the horizon would have none or a negative
height."""
CELLS = (8, 10)
"""Where roads bend, cars turn: how their size departs from the line is learnt in so many cells, by
height of the line and by column. Chosen: more need longer to learn, fewer blur bends."""
CELL_PRIOR = 6.0
"""Cars that the line counts for in each cell. Chosen: more learn bends later, fewer are noisier."""
CELL_BLUR = 0.6
"""1-sigma, in cells, by which neighbours count too: a cell by itself is noisy. Chosen: larger blurs
bends."""
MAX_BEND = 0.3
"""Largest departure of one box that is learnt, as a natural logarithm: more is another vehicle.
Chosen: larger learns from lorries, smaller learns sharp bends less."""
_MIN_SHARE = 0.3
"""Share of the boxes that must be cars for a fit to count. Chosen: larger learns nothing where
every second vehicle is a lorry, smaller learns from lorries."""
_ROW = (0, 2)
"""Terms of `_place` that heights depend on."""


def _blurred(table: NDArray[np.float64]) -> NDArray[np.float64]:
    edge = cv2.BORDER_ISOLATED
    return np.asarray(cv2.GaussianBlur(table, (0, 0), CELL_BLUR, borderType=edge), np.float64)


def _cell(value: float, low: float, high: float, count: int) -> tuple[int, float]:
    """The lower of the two cells around a value, and how far it is to the upper one."""
    at = (value - low) / max(high - low, 1e-6) * (count - 1)
    at = min(max(at, 0.0), count - 1.0)
    lower = min(int(at), count - 2)
    return lower, at - lower


class VehicleSizes:
    """The size of a car, by place.

    Attributes:
        known: Whether enough was seen.
    """

    def __init__(self) -> None:
        self.known = False
        self._boxes: deque[tuple[float, float, float, float]] = deque(maxlen=MEMORY_BOXES)
        self._height = np.zeros(2)
        self._shape = np.zeros(4)
        self._random = np.random.default_rng(1)
        self._scale = 1.0
        self._span = (0.0, 1.0, 0.0, 1.0)
        self._local = np.zeros((*CELLS, 2)).tolist()
        self._terms: tuple[float, ...] = (0.0,) * 6
        self._rows = (0.0, 0.0)
        self._vehicles = 0

    def knows(self, box: Box) -> bool:
        """Whether the size of a car is known where a box ends, not too far from where any were."""
        low, high = self._rows
        reach = REACH * (high - low)
        return self.known and low - reach <= box[3] <= high + reach

    def add(self, boxes: NDArray[np.float64], vehicles: int) -> None:
        """Note boxes (N, 4) left, top, right, bottom, each of one whole vehicle.

        Args:
            boxes: Of vehicles by themselves.
            vehicles: How many of these are new.
        """
        self._vehicles += vehicles
        self._boxes.extend(map(tuple, boxes.tolist()))

    def at(self, x: NDArray[np.float64], bottom: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) width and height of a car whose box ends at row `bottom`, its middle at `x`."""
        pairs = [self._at(*place) for place in zip(x.tolist(), bottom.tolist(), strict=True)]
        return np.array(pairs, dtype=np.float64).reshape(-1, 2)

    def car(self, box: Box) -> tuple[float, float]:
        """Width and height of a car that stands where the box ends."""
        return self._at(0.5 * (box[0] + box[2]), float(box[3]))

    def _at(self, x: float, bottom: float) -> tuple[float, float]:
        # Plain numbers: this is asked for hundreds of times in an image.
        u, v = x / self._scale, bottom / self._scale
        a, b, p, q, r, s = self._terms
        height = max(a + b * v, MIN_HEIGHT_PX)
        shape = math.exp(min(max(p + q * u + r * v + s * u * v, -1.0), 1.6))
        low, high, left, right = self._span
        k, down = _cell(math.log(height), low, high, CELLS[0])
        m, across = _cell(u, left, right, CELLS[1])
        wide = tall = 0.0
        for row, row_share in ((k, 1.0 - down), (k + 1, down)):
            for column, share in ((m, 1.0 - across), (m + 1, across)):
                more_wide, more_tall = self._local[row][column]
                wide += row_share * share * more_wide
                tall += row_share * share * more_tall
        return shape * height * math.exp(wide), height * math.exp(tall)

    def learn(self) -> None:
        """Fit anew to the boxes noted so far."""
        if len(self._boxes) < MIN_BOXES or self._vehicles < MIN_VEHICLES:
            return
        boxes = np.array(self._boxes)
        self._scale = float(np.abs(boxes).max())
        x, bottom = 0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]
        size = boxes[:, 2:] - boxes[:, :2]
        place = self._place(x, bottom)
        fit = self._line(place[:, _ROW], size[:, 1], self._weight(bottom))
        if fit is None:
            return
        self._height = fit
        self._rows = (float(np.quantile(bottom, 0.02)), float(np.quantile(bottom, 0.98)))
        car = np.abs(np.log(size[:, 1] / np.maximum(place[:, _ROW] @ fit, 0.1))) < TOLERANCE
        ratio = np.log(size[car, 0] / size[car, 1])
        shape = np.array([float(np.median(ratio)), 0.0, 0.0, 0.0])
        for _ in range(5):  # least absolute deviations by reweighting
            off = np.abs(ratio - place[car] @ shape)
            weight = 1.0 / np.maximum(off, 0.05)
            weighted = place[car] * weight[:, None]
            ridge = np.diag([0.0, 1.0, 1.0, 1.0]) * 0.01 * weight.sum()
            shape = np.linalg.solve(weighted.T @ place[car] + ridge, weighted.T @ ratio)
        self._shape = shape
        self._bend(place[car], size[car])
        self.known = True

    def _bend(self, place: NDArray[np.float64], size: NDArray[np.float64]) -> None:
        """How sizes (N, 2) depart from the line, cell by cell; little in cells with few cars."""
        line = place[:, _ROW] @ self._height
        wide = np.exp(np.clip(place @ self._shape, -1.0, 1.6)) * line
        off = np.log(size / np.column_stack([wide, line]))
        level, column = np.log(np.maximum(line, MIN_HEIGHT_PX)), place[:, 1]
        self._span = (*np.quantile(level, [0.0, 1.0]), *np.quantile(column, [0.0, 1.0]))
        low, high, left, right = self._span
        total = np.zeros((*CELLS, 2))
        count = np.zeros(CELLS)
        i = np.clip(np.rint((level - low) / max(high - low, 1e-6) * (CELLS[0] - 1)), 0, None)
        j = np.clip(np.rint((column - left) / max(right - left, 1e-6) * (CELLS[1] - 1)), 0, None)
        at = (i.astype(int), j.astype(int))
        np.add.at(count, at, 1.0)
        np.add.at(total, at, np.clip(off, -MAX_BEND, MAX_BEND))
        # Neighbours count too: a cell by itself is noisy.
        self._local = (_blurred(total) / (_blurred(count) + CELL_PRIOR)[..., None]).tolist()
        self._terms = (*self._height.tolist(), *self._shape.tolist())

    def _place(self, x: NDArray[np.float64], bottom: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = x / self._scale, bottom / self._scale
        return np.column_stack([np.ones_like(u), u, v, u * v])

    def _weight(self, bottom: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) sum 1: bands of rows count equally, however many vehicles stand still in one."""
        edges = np.linspace(bottom.min(), bottom.max() + 1.0, BANDS + 1)
        band = np.digitize(bottom, edges) - 1
        count = np.bincount(band, minlength=BANDS)
        weight = 1.0 / np.maximum(count, MIN_BAND)[band]
        return np.asarray(weight / weight.sum())

    def _line(
        self,
        place: NDArray[np.float64],
        height: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> NDArray[np.float64] | None:
        """Heights as a linear function of the row, by random samples (Fischler and Bolles 1981)."""
        best = _MIN_SHARE
        best_fit: NDArray[np.float64] | None = None
        for _ in range(TRIES):
            two = self._random.choice(len(height), 2, replace=False, p=weight)
            if abs(np.linalg.det(place[two])) < 0.02:
                continue
            fit = np.linalg.solve(place[two], height[two])
            if fit[1] <= 0.0:  # what stands lower in the image is nearer, hence larger
                continue
            near = np.abs(np.log(height / np.maximum(place @ fit, 0.1))) < TOLERANCE
            share = float(weight[near].sum())
            if share > best:
                best = share
                root = np.sqrt(weight[near]) / height[near]
                scaled = place[near] * root[:, None]
                best_fit = np.asarray(np.linalg.lstsq(scaled, height[near] * root, rcond=None)[0])
        return best_fit


SIDE = 16
"""Outlines are kept in a grid of so many cells each way, stretched to the vehicle's box. Chosen:
more take time, fewer lose windscreens and bonnets."""
MEMORY = 600
"""Outlines that are remembered, the latest. Chosen: more take memory, fewer forget quiet places."""
NEAREST = 25
"""So many outlines of vehicles nearest to a place are averaged. Chosen: more look farther around,
fewer are noisier."""
SHARPNESS = 2.0
"""Contrast of the averaged outline around one half. Chosen: larger ignores that vehicles differ,
smaller leaves its edges soft."""
FIRST_EXPONENT = 3.0
"""Shape used before any outline is known: between an ellipse (2) and a box (infinite). Chosen:
outlines seen from a pole lie between."""


class VehicleOutlines:
    """The usual outline of a vehicle at each place, from those of single vehicles.

    All vehicles of a road stand the same way at one place of it, whatever their size.
    """

    def __init__(self) -> None:
        self._shapes = np.empty((MEMORY, SIDE, SIDE), dtype=np.float32)
        self._places = np.empty((MEMORY, 2))
        self._count = 0
        at = np.abs((np.arange(SIDE) + 0.5) * (2.0 / SIDE) - 1.0) ** FIRST_EXPONENT
        self._first = (at[:, None] + at[None, :] < 1.0).astype(np.float32)

    def add(self, pixels: NDArray[np.uint8], box: Box, corner: tuple[int, int]) -> None:
        """Remember one vehicle: its pixels (H, W) 0 or 1, its box, where the pixels begin."""
        x, y = corner
        inside = pixels[box[1] - y : box[3] - y, box[0] - x : box[2] - x].astype(np.float32)
        k = self._count % MEMORY
        self._shapes[k] = cv2.resize(inside, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        self._places[k] = 0.5 * (box[0] + box[2]), box[3]
        self._count += 1

    def at(self, x: float, bottom: float) -> NDArray[np.float32]:
        """(SIDE, SIDE) share of vehicles there that cover each part of their box."""
        known = min(self._count, MEMORY)
        if known < NEAREST:
            return np.asarray(self._first, dtype=np.float32)
        off = np.abs(self._places[:known] - (x, bottom)).sum(axis=1)
        near = np.argpartition(off, NEAREST - 1)[:NEAREST]
        mean: NDArray[np.float32] = self._shapes[near].mean(axis=0)
        return np.asarray(np.clip(SHARPNESS * (mean - 0.5) + 0.5, 0.0, 1.0), dtype=np.float32)
