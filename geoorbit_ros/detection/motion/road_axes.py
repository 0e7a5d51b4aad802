"""Which way the road runs in the image at each place, learnt from vehicles that drive along it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.vehicle_shapes import Box

STEP_S = 0.1
"""Time after which vehicles are compared with where they were. Chosen: by then far ones have moved,
too; after longer a vehicle may be taken for another."""
LONGEST_S = 0.5
"""After a longer pause nothing is compared. Chosen: a vehicle at 30 m/s is 15 m farther by then."""
MOST_STEP = 1.0
"""A vehicle moves at most so many diagonals of its box in between; farther off is another one.
Chosen: larger pairs neighbours, smaller needs more frames per second."""
LEAST_STEP_PX = 2.0
"""Shorter steps have no direction. Chosen: edges are found to half a pixel."""
ALIKE = 0.2
"""Boxes of one vehicle are this equal in width and height, as a natural logarithm. Chosen: larger
pairs neighbours, smaller misses vehicles that turn."""
MEMORY = 1200
"""Steps that are remembered, the latest. Chosen: more take time, fewer forget quiet places."""
NEAREST = 15
"""So many steps nearest to a place give the direction there. Chosen: more look farther around,
fewer are noisier."""
AGREED = 0.9
"""Least agreement of these steps, as the length of their mean direction, 1 if all are parallel.
Chosen: larger has no direction in bends, smaller has one in junctions."""


class RoadAxes:
    """The direction of the road at each place, from how single vehicles moved there.

    Traffic either way counts the same: the direction is that of a line.
    """

    def __init__(self) -> None:
        self._places = np.empty((MEMORY, 2))
        self._turns = np.empty(MEMORY, dtype=np.complex128)  # direction squared: of a line
        self._count = 0
        self._last = np.empty((0, 4))
        self._last_ns: int | None = None

    def add(self, stamp_ns: int, boxes: list[Box]) -> None:
        """Note boxes left, top, right, bottom of single vehicles in an image."""
        elapsed_s = np.inf if self._last_ns is None else (stamp_ns - self._last_ns) / 1e9
        if 0.0 <= elapsed_s < STEP_S:
            return
        now = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        if 0.0 <= elapsed_s <= LONGEST_S:
            self._pair(now)
        self._last, self._last_ns = now, stamp_ns

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

    def _pair(self, now: NDArray[np.float64]) -> None:
        """Remember the steps of vehicles that are nearest to each other, and alike."""
        then = self._last
        if not len(now) or not len(then):
            return
        size, size_then = now[:, 2:] - now[:, :2], then[:, 2:] - then[:, :2]
        foot, foot_then = _feet(now), _feet(then)
        apart = np.linalg.norm(foot[:, None] - foot_then[None, :], axis=2)
        near = apart.argmin(axis=1)
        k = np.arange(len(now))
        step = apart[k, near]
        alike = np.abs(np.log(size / size_then[near])).max(axis=1) < ALIKE
        held = alike & (apart.argmin(axis=0)[near] == k)
        held &= (step >= LEAST_STEP_PX) & (step < MOST_STEP * np.linalg.norm(size, axis=1))
        for i in np.flatnonzero(held):
            move = foot[i] - foot_then[near[i]]
            at = self._count % MEMORY
            self._places[at] = 0.5 * (foot[i] + foot_then[near[i]])
            self._turns[at] = (complex(*move) / step[i]) ** 2
            self._count += 1


def _feet(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) middle of the lower edge."""
    return np.column_stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]])
