"""What lies on the ground of a scene: pavement, painted lines, worn lanes, as strips in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Line = NDArray[np.float64]
"""(K, 2) points in the map frame."""


RAIL_BESIDE_M = 0.55
"""Distance of a guard rail's shadow from the edge line. Chosen: nearer than half a shoulder, where
it may be taken for a line."""


@dataclass(frozen=True, slots=True)
class Strip:
    """A band on the ground between two lines with as many points.

    Attributes:
        left_m: (K, 2) one side.
        right_m: (K, 2) the other side, point by point beside `left_m`.
    """

    left_m: Line
    right_m: Line

    def quads(self) -> NDArray[np.float64]:
        """(K-1, 4, 2) one quadrilateral per piece."""
        a, b = self.left_m, self.right_m
        return np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1)


@dataclass(slots=True)
class RoadSurface:
    """All that lies flat on the ground.

    Attributes:
        paved: Asphalt, shoulders included.
        lanes: The lanes alone, for wear and to keep other roads' lines off them.
        solid: Middle lines of solid markings.
        yellow: Middle lines of solid markings in yellow.
        dashed: Middle lines of dashed markings, with the lengths of dash and gap in metres.
    """

    paved: list[Strip] = field(default_factory=list)
    lanes: list[Strip] = field(default_factory=list)
    solid: list[Line] = field(default_factory=list)
    yellow: list[Line] = field(default_factory=list)
    dashed: list[tuple[Line, float, float]] = field(default_factory=list)

    def paint(self, width_m: float) -> list[Strip]:
        """All bands painted white, `width_m` wide."""
        strips = [band(line, width_m) for line in self.solid if len(line) > 1]
        for line, dash_m, gap_m in self.dashed:
            strips.extend(band(piece, width_m) for piece in dashes(line, dash_m, gap_m))
        return strips

    def yellow_paint(self, width_m: float) -> list[Strip]:
        """All bands painted yellow, `width_m` wide."""
        return [band(line, width_m) for line in self.yellow if len(line) > 1]

    def shaded(self, every_m: float, gantry_m: float, rail_m: float) -> list[Strip]:
        """Shadows: bands across all pavement, and along both sides of solid lines.

        Args:
            every_m: Distance between those across.
            gantry_m: Their length along the road.
            rail_m: Width of those along it, `RAIL_BESIDE_M` from the solid lines.
        """
        strips = []
        for strip in self.paved:
            arc = arc_length(strip.left_m)
            for begin in np.arange(0.5 * every_m, arc[-1] - gantry_m, every_m):
                at = np.array([begin, begin + gantry_m])
                strips.append(
                    Strip(*(along(side, arc, at) for side in (strip.left_m, strip.right_m)))
                )
        for line in (*self.solid, *self.yellow):
            if len(line) > 1:
                strips += [band(shifted(line, side * RAIL_BESIDE_M), rail_m) for side in (-1, 1)]
        return strips

    def lane_wear(self, offset_m: float, width_m: float) -> list[Strip]:
        """A band `width_m` wide along every lane, `offset_m` to the left of its middle."""
        strips = []
        for lane in self.lanes:
            middle = 0.5 * (lane.left_m + lane.right_m)
            strips.append(band(shifted(middle, offset_m), width_m))
        return strips


def arc_length(line: Line) -> NDArray[np.float64]:
    """(K,) metres along a line."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))


def shifted(line: Line, left_m: float | NDArray[np.float64]) -> Line:
    """The line `left_m` to its left; a number, or one (K,) per point."""
    along = np.gradient(line, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    normal /= np.maximum(np.hypot(*normal.T), 1e-9)[:, None]
    return np.asarray(line + np.reshape(left_m, (-1, 1)) * normal)


def band(line: Line, width_m: float) -> Strip:
    """The band of a width about a line."""
    return Strip(shifted(line, 0.5 * width_m), shifted(line, -0.5 * width_m))


def dashes(line: Line, dash_m: float, gap_m: float) -> list[Line]:
    """Pieces of a line; each has its ends, and the line's own points between them."""
    arc = arc_length(line)
    pieces = []
    for start in np.arange(0.0, arc[-1], dash_m + gap_m):
        end = min(start + dash_m, arc[-1])
        if end - start < 0.5:
            continue
        at = np.concatenate([[start], arc[(arc > start) & (arc < end)], [end]])
        pieces.append(along(line, arc, at))
    return pieces


def along(line: Line, arc: NDArray[np.float64], at: NDArray[np.float64]) -> Line:
    """Points of a line at the arc lengths `at`."""
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])


def inside(points: Line, strip: Strip) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie in a strip: crossings of a ray towards east, counted."""
    ring = np.concatenate([strip.left_m, strip.right_m[::-1]])
    low, high = ring.min(axis=0), ring.max(axis=0)
    found: NDArray[np.bool_] = np.all((points >= low) & (points <= high), axis=1)
    some = np.flatnonzero(found)
    if len(some) == 0:
        return found
    x, y = points[some, 0, None], points[some, 1, None]
    x1, y1 = ring.T
    x2, y2 = np.roll(ring, -1, axis=0).T
    spans = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    found[some] = (spans & (x < crossing)).sum(axis=1) % 2 == 1
    return found


def outside_of(line: Line, strips: Sequence[Strip]) -> list[Line]:
    """The pieces of a line that lie in none of the strips."""
    covered = np.zeros(len(line), bool)
    for strip in strips:
        covered |= inside(line, strip)
    edges = np.flatnonzero(np.diff(np.concatenate([[1], covered.astype(np.int8), [1]])))
    return [line[a:b] for a, b in edges.reshape(-1, 2) if b - a > 1]
