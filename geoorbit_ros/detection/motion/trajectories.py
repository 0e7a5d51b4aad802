"""Vehicles are what travels.

Boxes are followed until they have driven some of their own lengths. Leaves, flags, water, edges of
dashes and poles move too, but stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.vehicle_shapes import Box

Array = NDArray[np.float64]

STEP_S = 0.09
"""Time after which boxes are compared with where they were. Chosen: by then far ones have moved,
too; after longer a vehicle may be taken for another."""
LONGEST_S = 0.6
"""After a longer pause nothing is compared. Chosen: a vehicle at 30 m/s is 18 m farther by then."""
FIRST_STEP = 1.2
"""A vehicle moves at most so many diagonals of its box in the first step. Chosen: larger pairs
neighbours, smaller needs more frames per second."""
OFF_COURSE = 0.4
"""Farther than so many diagonals from where its course leads it is another vehicle. Chosen: larger
pairs neighbours, smaller loses vehicles whose box flickers."""
ALIKE = 0.25
"""Boxes of one vehicle are this equal in width and height, as a natural logarithm. Chosen: larger
pairs neighbours, smaller misses vehicles that turn."""
TRAVELLED = 2.0
"""A vehicle has travelled when it is so many square roots of its box's area away. Chosen: swaying
leaves move by their own size; larger forgets vehicles that are seen for a short way."""
MOVED = 1.0
"""From here on it is followed wherever it goes, also among leaves. Chosen: larger loses more of
the first vehicle on a road, smaller follows leaves."""
SAME = 0.3
"""Overlap with where it should be, from which a box is the same vehicle. Chosen: boxes of vehicles
that turn overlap less; smaller follows neighbours."""
STAYED = 0.5
"""What is less than so many square roots of its box's area from where it was first seen has stayed.
Chosen: larger takes slow vehicles for leaves, smaller misses what sways."""
STAYED_PER_S = 0.3
"""And less than so many in a second: far vehicles that come head on move their own size in one or
two. Chosen: larger takes them for leaves, smaller misses what sways slowly."""
STAYING_STEPS = 5
"""Least number of steps of what stays. Chosen: larger misses what flickers, smaller takes vehicles
that begin to move for leaves."""
STRAIGHTNESS = 0.85
"""Least share of the way that leads away from the start. Chosen: what sways goes back and forth;
larger forgets vehicles in sharp bends."""
MIN_STEPS = 4
"""Least number of steps. Chosen: two or three may be chance."""
KEPT_SHARE = 0.12
"""A box is kept after so many square roots of its area. Chosen: a vehicle that creeps counts no
more than one that drives; smaller gives more boxes of the same."""
TEACHES = 5
"""A trajectory teaches sizes and directions from so many boxes on that are one vehicle by itself.
Chosen: in real films vehicles have seven and more; pieces of vehicles, leaves and lights that seem
to travel have three and fewer. Larger learns later."""
MOST_KEPT = 60
"""Boxes kept of one trajectory. Chosen: more only repeat each other."""
_IMPOSSIBLE = 1e6
"""More than any assignment within the limits costs."""


@dataclass(slots=True)
class _Trajectory:
    """One vehicle, or something else that moves.

    `kept` are boxes and directions that are not handed on yet, `alone` those of one vehicle by
    itself while they are too few to teach, `counted` the observations that were handed on as
    staying.
    """

    first: Array
    last: Array
    born_ns: int
    stamp_ns: int
    last_kept: Array
    velocity: Array = field(default_factory=lambda: np.zeros(2))
    way_px: float = 0.0
    steps: int = 0
    count: int = 0
    moving: bool = False
    travelled: bool = False
    counted: int = 0
    kept: list[tuple[Array, Array, bool]] = field(default_factory=list)
    alone: list[tuple[Array, Array, bool]] = field(default_factory=list)
    teaches: bool = False


@dataclass(frozen=True, slots=True)
class Travelled:
    """Boxes of vehicles that have travelled.

    Attributes:
        boxes: (N, 4) left, top, right, bottom.
        direction: (N, 2) unit vectors, right and down, along which each vehicle drove there.
        isolated: (N,) which boxes are those of one vehicle by itself.
        vehicles: How many of these vehicles were not known to travel before.
        teaching: How many have had `TEACHES` isolated boxes now, and not before.
        stayed: (M, 4) boxes of what was followed and stayed where it was.
    """

    boxes: Array
    direction: Array
    isolated: NDArray[np.bool_]
    vehicles: int
    teaching: int
    stayed: Array


class Trajectories:
    """Follows boxes from image to image and tells which have travelled, and which stay."""

    def __init__(self) -> None:
        self._open: list[_Trajectory] = []
        self._last_ns: int | None = None

    def add(self, stamp_ns: int, boxes: list[Box], whole: list[bool]) -> Travelled:
        """Follow the boxes of an image.

        Args:
            stamp_ns: Capture time.
            boxes: Of everything that moves.
            whole: Which of them are one isolated vehicle, wholly in the image.

        Returns:
            Boxes of vehicles that are now known to have travelled, and what stayed.
        """
        last_ns = self._last_ns
        elapsed_s = np.inf if last_ns is None else (stamp_ns - last_ns) / 1e9
        if 0.0 <= elapsed_s < STEP_S:
            return _NOTHING
        self._last_ns = stamp_ns
        oldest_ns = stamp_ns - round(LONGEST_S * 1e9)
        ended = [t for t in self._open if t.stamp_ns < oldest_ns]
        stayed = [box for trajectory in ended for box in _stayed(trajectory, 1)]
        self._open = [t for t in self._open if oldest_ns <= t.stamp_ns <= stamp_ns]
        now = np.array(boxes, dtype=np.float64).reshape(-1, 4)
        pairs = self._pairs(stamp_ns, now)
        found: list[tuple[Array, Array, bool]] = []
        vehicles = teaching = 0
        for k, m in pairs:
            trajectory, before = self._open[k], self._open[k].travelled
            taught = trajectory.teaches
            _extend(trajectory, stamp_ns, now[m], whole=whole[m])
            vehicles += trajectory.travelled and not before
            if trajectory.travelled:
                found += _handed_on(trajectory)
                teaching += trajectory.teaches and not taught
        taken = {m for _, m in pairs}
        self._open += [
            _Trajectory(box, box, stamp_ns, stamp_ns, box)
            for m, box in enumerate(now)
            if m not in taken
        ]
        for k, _ in pairs:
            stayed += _stayed(self._open[k], STAYING_STEPS)
        known = np.array([box for box, _, _ in found]).reshape(-1, 4)
        directions = np.array([direction for _, direction, _ in found]).reshape(-1, 2)
        isolated = np.array([alone for _, _, alone in found], dtype=bool)
        still = np.array(stayed).reshape(-1, 4)
        return Travelled(known, directions, isolated, vehicles, teaching, still)

    def follows(self, stamp_ns: int, box: Box) -> bool:
        """Whether a box is where something should be that has left its place."""
        for trajectory in self._open:
            if trajectory.moving and trajectory.stamp_ns <= stamp_ns:
                elapsed_s = (stamp_ns - trajectory.stamp_ns) / 1e9
                course = trajectory.last + np.tile(trajectory.velocity * elapsed_s, 2)
                if _overlap(course, np.array(box, dtype=np.float64)) > SAME:
                    return True
        return False

    def _pairs(self, stamp_ns: int, now: Array) -> list[tuple[int, int]]:
        """Trajectories and the boxes that go on with them: the cheapest within the limits."""
        if not self._open or not len(now):
            return []
        last = np.array([t.last for t in self._open])
        elapsed_s = np.array([(stamp_ns - t.stamp_ns) / 1e9 for t in self._open])
        velocity = np.array([t.velocity for t in self._open])
        known = np.array([t.steps > 0 for t in self._open])
        course = feet(last) + velocity * elapsed_s[:, None]
        off = np.linalg.norm(course[:, None] - feet(now)[None], axis=2)
        size, size_last = np.log(now[:, 2:] - now[:, :2]), np.log(last[:, 2:] - last[:, :2])
        unlike = np.abs(size_last[:, None] - size[None]).max(axis=2)
        diagonal = np.hypot(*(last[:, 2:] - last[:, :2]).T)
        limit = (np.where(known, OFF_COURSE, FIRST_STEP) * diagonal)[:, None]
        possible = (off < limit) & (unlike < ALIKE)
        cost = np.where(possible, off / limit + unlike / ALIKE, _IMPOSSIBLE)
        rows, columns = scipy.optimize.linear_sum_assignment(cost)
        some = possible[rows, columns]
        return list(zip(rows[some].tolist(), columns[some].tolist(), strict=True))


def _stayed(trajectory: _Trajectory, steps: int) -> list[Array]:
    """Its last box once for each observation that is not counted yet, if it stays in its place.

    Args:
        trajectory: What was followed.
        steps: With fewer steps it can't be told yet.
    """
    box, side = trajectory.last, _side(trajectory.first, trajectory.last)
    away = float(np.hypot(*_way(trajectory.first, box)))
    seen_s = (trajectory.stamp_ns - trajectory.born_ns) / 1e9
    stays = away <= min(STAYED, STAYED_PER_S * seen_s) * side
    if trajectory.travelled or trajectory.steps < steps or not stays:
        return []
    new = trajectory.steps + 1 - trajectory.counted
    trajectory.counted += new
    return [box] * new


def _extend(trajectory: _Trajectory, stamp_ns: int, box: Array, *, whole: bool) -> None:
    """Go on with the vehicle's next box."""
    elapsed_s = (stamp_ns - trajectory.stamp_ns) / 1e9
    share = 0.5 if trajectory.steps else 1.0  # steps of whole pixels are noisy
    step = _way(trajectory.last, box)
    trajectory.velocity = (1.0 - share) * trajectory.velocity + share * step / elapsed_s
    trajectory.last, trajectory.stamp_ns = box, stamp_ns
    trajectory.steps += 1
    side = float(np.sqrt(np.prod(box[2:] - box[:2])))
    moved = _way(trajectory.last_kept, box)
    length = float(np.hypot(*moved))
    if length >= KEPT_SHARE * side:
        trajectory.way_px += length
        trajectory.last_kept = box
        trajectory.count += 1
        if trajectory.count <= MOST_KEPT:
            trajectory.kept.append((box, moved / length, whole))
    away = float(np.hypot(*_way(trajectory.first, box)))
    side = _side(trajectory.first, box)  # what comes near grows on its way
    if trajectory.steps >= MIN_STEPS and away >= STRAIGHTNESS * trajectory.way_px:
        trajectory.moving |= away >= MOVED * side
        trajectory.travelled |= away >= TRAVELLED * side


def _handed_on(trajectory: _Trajectory) -> list[tuple[Array, Array, bool]]:
    """Its new boxes, as isolated ones if it has had enough of these; then the earlier ones, too."""
    new, trajectory.kept = trajectory.kept, []
    if trajectory.teaches:
        return new
    trajectory.alone += [entry for entry in new if entry[2]]
    if len(trajectory.alone) < TEACHES:
        return [(box, direction, False) for box, direction, _ in new]
    trajectory.teaches = True
    alone, trajectory.alone = trajectory.alone, []
    return alone + [entry for entry in new if not entry[2]]


def _overlap(a: Array, b: Array) -> float:
    """Intersection over union of two boxes (4,)."""
    both = np.prod(np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0.0))
    return float(both / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - both))


def _side(first: Array, last: Array) -> float:
    """Square root of the area of a box between the two, pixels."""
    return float((np.prod(first[2:] - first[:2]) * np.prod(last[2:] - last[:2])) ** 0.25)


def _way(then: Array, now: Array) -> Array:
    """(2,) pixels right and down from one box (4,) to the other."""
    return np.asarray((feet(now[None]) - feet(then[None]))[0])


def feet(boxes: Array) -> Array:
    """(N, 2) middle of the lower edge of boxes (N, 4)."""
    return np.column_stack((0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]))


_NOTHING = Travelled(
    np.empty((0, 4)), np.empty((0, 2)), np.empty(0, dtype=bool), 0, 0, np.empty((0, 4))
)
