"""Where vehicles drive in the image, and which way the road runs there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.trajectories import Travelled, feet
from geoorbit_ros.detection.motion.vehicle_shapes import Box

MEMORY = 1200
"""Places that are remembered with their direction, the latest. Chosen: more take time, fewer forget
quiet places."""
NEAREST = 15
"""So many places nearest to one give the direction there. Chosen: more look farther around,
fewer are noisier."""
AGREED = 0.9
"""Least agreement of these directions, as the length of their mean, 1 if all are parallel.
Chosen: larger has no direction in bends, smaller has one in junctions."""
CELL_PX = 8
"""Where vehicles drove is kept in cells of so many pixels. Chosen: larger takes in the verge,
smaller has gaps where few drove."""
FOOT_SHARE = 0.5
"""The lower part of a box that stands on the road. Chosen: larger takes in what the box hides,
smaller has gaps where few drove."""
CLUTTER = 10.0
"""Where fewer boxes were seen that did not travel, vehicles may be. Chosen: boxes are followed ten
times a second; larger admits leaves for longer, smaller knows too little."""
MIN_ROAD_CELLS = 40
"""Of a smaller road it is not told how much is covered. Chosen: smaller, one vehicle covers it."""
DRIVEN = 1.0
"""Where so many boxes of vehicles that travelled were seen, on average over a box's lower part,
there is a road: vehicles may stand there, too. Chosen: one vehicle gives about eight; larger needs
more of them, smaller takes the verge for road."""


class RoadAxes:
    """Learns from vehicles that have travelled.

    Traffic either way counts the same: the direction is that of a line.
    """

    def __init__(self) -> None:
        self._places = np.empty((MEMORY, 2))
        self._turns = np.empty(MEMORY, dtype=np.complex128)  # direction squared: of a line
        self._count = 0
        self._driven = np.zeros((0, 0), dtype=np.float32)
        self._clutter = np.zeros((0, 0), dtype=np.float32)

    def add(self, travelled: Travelled) -> None:
        """Note where vehicles travelled, in which direction, and where something only moved."""
        alone = travelled.isolated
        places, directions = feet(travelled.boxes[alone]), travelled.direction[alone]
        for place, direction in zip(places, directions, strict=True):
            at = self._count % MEMORY
            self._places[at] = place
            self._turns[at] = complex(*direction) ** 2
            self._count += 1
        self._driven = _counted(self._driven, travelled.boxes)
        self._clutter = _counted(self._clutter, travelled.stayed)

    def at(self, x: float, bottom: float) -> tuple[float, float] | None:
        """Unit vector (right, down) along the road, upwards in the image; None where unknown."""
        known = min(self._count, MEMORY)
        if known < NEAREST:
            return None
        off = np.abs(self._places[:known] - (x, bottom)).sum(axis=1)
        near = np.argpartition(off, NEAREST - 1)[:NEAREST]
        mean = complex(self._turns[near].mean())
        if abs(mean) < AGREED:
            return None
        along = np.sqrt(mean / abs(mean))
        if along.imag > 0.0:
            along = -along
        return float(along.real), float(along.imag)

    def on_road(self, box: Box) -> bool:
        """Whether a vehicle may be where a box stands: not where things move and never travel."""
        clutter = self._clutter[_cells(np.array(box, dtype=np.float64))]
        return not clutter.size or bool(clutter.mean() < CLUTTER) or self.is_driven(box)

    def is_driven(self, box: Box) -> bool:
        """Whether vehicles have travelled where a box stands."""
        driven = self._driven[_cells(np.array(box, dtype=np.float64))]
        return bool(driven.size and driven.mean() >= DRIVEN)

    def covered_share(self, moving: NDArray[np.uint8]) -> float:
        """Share of the road that moving pixels (H, W) cover; NaN while the road is not known."""
        road = self._driven >= DRIVEN
        if np.count_nonzero(road) < MIN_ROAD_CELLS:
            return float("nan")
        size = (-(-moving.shape[1] // CELL_PX), -(-moving.shape[0] // CELL_PX))
        covered = np.asarray(cv2.resize(moving, size, interpolation=cv2.INTER_AREA)) > 127
        rows, columns = (min(a, b) for a, b in zip(road.shape, covered.shape, strict=True))
        return float(covered[:rows, :columns][road[:rows, :columns]].mean())


def _counted(cells: NDArray[np.float32], boxes: NDArray[np.float64]) -> NDArray[np.float32]:
    """The cells, larger if need be, with one added wherever one of the boxes (N, 4) stands."""
    for rows, columns in map(_cells, boxes):
        height, width = cells.shape
        if rows.stop > height or columns.stop > width:
            more = ((0, max(rows.stop - height, 0)), (0, max(columns.stop - width, 0)))
            cells = np.pad(cells, more)
        cells[rows, columns] += 1.0
    return cells


def _cells(box: NDArray[np.float64]) -> tuple[slice, slice]:
    """Rows and columns of the cells that the lower part of a box covers."""
    left, top, right, bottom = np.maximum(box, 0.0)
    first = bottom - FOOT_SHARE * (bottom - top)
    row, column = int(first // CELL_PX), int(left // CELL_PX)
    return slice(row, int(bottom // CELL_PX) + 1), slice(column, int(right // CELL_PX) + 1)
