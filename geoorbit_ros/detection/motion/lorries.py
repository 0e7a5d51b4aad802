"""Long lorries: their outline is that of a car, drawn out along the road.

A lorry is wider than a car, higher, and several cars long. At its place it stands as cars do, so
its outline spans from that of its front to that of its rear end, each as large as the place says.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.road_axes import RoadAxes
from geoorbit_ros.detection.motion.vehicle_shapes import Box, VehicleOutlines, VehicleSizes

Outline = NDArray[np.float64]
"""(N, 2) points whose convex hull is a vehicle's outline, right and down in the image, pixels."""

WIDER = 1.3
"""Width of a lorry's outline in cars: 2.55 m over 1.85 m, and a little less, because a part of the
outline's width is a car's length."""
LENGTHS = (3.0, 2.4, 1.8, 1.2, 0.6, 0.0)
"""How far a lorry reaches beyond a car, in cars: from 5 m to trailers of 19 m. Chosen: finer steps
take more time."""
HEIGHTS = (2.5, 1.9, 1.4)
"""Height of a lorry's ends in cars. A row of cars is not higher than a car: that tells them apart.
The lowest with no length beyond a car is a van, and left out. Chosen: as `LENGTHS`."""
COARSER = 0.75
"""Lorries are looked for in blobs smaller by this than those for cars, to save time. Chosen:
smaller misses lorries between cars."""
SIZE_STEP = 0.3
"""Rows in which cars differ less than this in height, as a natural logarithm, are taken for one.
Chosen: smaller takes more time, larger draws lorries of the wrong size."""
LORRY_COST = 0.7
"""Evidence that a lorry needs, in cars' areas. Chosen: larger leaves lorries in pieces, smaller
joins cars to lorries."""
LEAST_SEEN = 0.5
"""Least gain of a lorry, as a share of that of one wholly seen. Chosen: larger misses hidden
lorries, smaller joins cars to lorries."""
MARGIN_PX = 2
"""An outline may reach so far beyond the blob: edges are blurred. Chosen: larger takes more
time."""
ROW_STEP = 2
"""Sizes are looked up in every second row, to save time. Chosen: larger places lorries less
exactly."""
_FINE = 16
"""Parts of a pixel that outlines are drawn to. Chosen: a sixteenth is less than the error of an
edge."""


@dataclass(frozen=True, slots=True)
class LorrySearch:
    """Finds lorries in a blob.

    Attributes:
        hull: (N, 2) a car's convex outline there, right and down in shares of its box.
        along: Unit vector along the road, upwards in the image.
        cut: Whether the border of the image cuts the blob's left, top, right, bottom.
        sizes: How large a car is at each place.
    """

    hull: NDArray[np.float64]
    along: tuple[float, float]
    cut: tuple[bool, bool, bool, bool]
    sizes: VehicleSizes

    def best(
        self, value: NDArray[np.float32], corner: tuple[int, int], zoom: tuple[float, float]
    ) -> Outline | None:
        """The lorry whose pixels gain most, if one gains enough.

        Args:
            value: (h, w) gain of covering each pixel of a blob that was made smaller.
            corner: Where the blob's (0, 0) is in the image.
            zoom: Pixels of `value` per pixel of the image, right and down.
        """
        ground, margin, ratio = self._ground(value, zoom)
        origin = np.array(corner, dtype=np.float64) - margin / ratio
        middle = corner[0] + 0.5 * value.shape[1] / zoom[0]
        found, most = None, 0.0
        room = float(ground.clip(0.0).sum()) / LEAST_SEEN
        for first, last in self._rows(ground.shape[0], middle, origin[1], float(ratio[1])):
            foot = np.array([middle, origin[1] + 0.5 * (first + last) / ratio[1]])
            car = self._car(foot)
            cost = LORRY_COST * float((car * ratio).prod())
            hulls = (self._outlines(foot, car) - origin) * ratio
            lows = np.floor(hulls.min(axis=1))
            spans = (np.ceil(hulls.max(axis=1)) - lows).astype(int)
            row = float((foot[1] - origin[1]) * ratio[1])
            fits = (spans <= ground.shape[::-1]).all(axis=1) & (spans >= 2).all(axis=1)
            for k in np.flatnonzero(fits):
                (wide, tall), above = spans[k].tolist(), round(row - float(lows[k, 1]))
                top, bottom = max(first - above, 0), min(last - above + tall, ground.shape[0])
                if tall > bottom - top:
                    continue
                cover = drawn(hulls[k] - lows[k], (tall, wide))
                area = cv2.countNonZero(cover)
                if area - cost <= most or area > room:
                    continue  # however it lies
                mask = cover.astype(np.float32)
                gain = cv2.matchTemplate(ground[top:bottom], mask, cv2.TM_CCORR)
                _, high, _, (x, y) = cv2.minMaxLoc(gain)
                if high - cost > most and high > LEAST_SEEN * area:
                    most = high - cost
                    found = (hulls[k] - lows[k] + [x, top + y]) / ratio + origin
        return found

    def _ground(
        self, value: NDArray[np.float32], zoom: tuple[float, float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """The gain of covering each pixel, in a coarser image of the blob with a margin.

        Also the columns and rows added before it, and its pixels per pixel of the image. Beyond the
        border of the image it costs nothing.
        """
        coarse = cv2.resize(value, None, fx=COARSER, fy=COARSER, interpolation=cv2.INTER_AREA)
        height, width = coarse.shape
        side = (width // 2, height // 2) * 2
        add = [more if cut else MARGIN_PX for more, cut in zip(side, self.cut, strict=True)]
        ground = np.full((add[1] + height + add[3], add[0] + width + add[2]), -1.0, np.float32)
        right, low = add[0] + width, add[1] + height
        edges = (ground[:, : add[0]], ground[: add[1]], ground[:, right:], ground[low:])
        for edge, cut in zip(edges, self.cut, strict=True):
            if cut:
                edge[:] = 0.0
        ground[add[1] : low, add[0] : right] = coarse
        ratio = np.array(zoom, dtype=np.float64) * [width / value.shape[1], height / value.shape[0]]
        return ground, np.array(add[:2], dtype=np.float64), ratio

    def _rows(self, height: int, x: float, top: float, ratio: float) -> Iterator[tuple[int, int]]:
        """First row and last, excluded, of bands in which cars are about equally large."""
        first, known = 0, 0.0
        for row in range(0, height, ROW_STEP):
            log = float(np.log(self._car((x, top + row / ratio))[1]))
            if row == first:
                known = log
            elif log - known > SIZE_STEP:
                yield first, row
                first, known = row, log
        yield first, height + 1

    def _outlines(self, foot: NDArray[np.float64], car: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, N, 2) outlines of lorries of all sizes with their near end there, long ones first."""
        along = np.array(self.along)
        step = float((car / np.maximum(np.abs(along), 1e-3)).min())
        shifts = np.outer(LENGTHS, step * along)
        cars = np.array([self._car(foot + shift) for shift in shifts])
        base = self.hull * [WIDER, 1.0] - [0.5 * WIDER, 1.0]
        ends = base * np.column_stack([np.ones(len(HEIGHTS)), HEIGHTS])[:, None]
        far = ends * cars[:, None, None] + shifts[:, None, None]
        both = np.concatenate([np.broadcast_to(ends * car, far.shape), far], axis=2)
        return both.reshape(-1, 2 * len(base), 2)[:-1] + foot

    def _car(self, foot: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """(2,) width and height of a car that stands there."""
        x, bottom = int(foot[0]), int(foot[1])
        return np.array(self.sizes.car((x, 0, x, bottom)))


def lorry_search(
    box: Box,
    cut: tuple[bool, bool, bool, bool],
    sizes: VehicleSizes,
    outlines: VehicleOutlines,
    axes: RoadAxes,
) -> LorrySearch | None:
    """A search for lorries in a blob with this box; None where the road's direction isn't known.

    Args:
        box: Left, top, right, bottom.
        cut: Which of these the border of the image cuts.
        sizes: How large a car is at each place.
        outlines: What outline vehicles have there.
        axes: Which way the road runs there.
    """
    x = 0.5 * (box[0] + box[2])
    along = axes.at(x, 0.5 * (box[1] + box[3]))
    filled = (outlines.at(x, float(box[3])) > 0.5).astype(np.uint8)
    pieces, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if along is None or not pieces:
        return None
    cells = cv2.convexHull(np.concatenate(pieces))[:, 0].astype(np.float64)
    low, high = cells.min(axis=0), cells.max(axis=0)
    if (high - low).min() < 1.0:
        return None
    return LorrySearch((cells - low) / (high - low), along, cut, sizes)


def drawn(hull: Outline, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """(H, W) 1 within the convex hull of points (N, 2) counted from the corner, 0 elsewhere."""
    canvas = np.zeros(shape, dtype=np.uint8)
    corners = cv2.convexHull(np.rint((hull - 0.5) * _FINE).astype(np.int32))
    cv2.fillConvexPoly(canvas, corners, 1, cv2.LINE_8, 4)
    return canvas
