"""Vehicles as solids: faces with materials, in metres about the middle of the footprint."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

CAR, MOTORCYCLE, BUS, TRUCK = 2, 3, 5, 7
"""COCO classes."""
SUV_HEIGHT_M, VAN_HEIGHT_M, SEMITRAILER_LENGTH_M = 1.62, 2.02, 12.5
"""From this size on a car is drawn as an SUV, a van; a truck as a semitrailer."""


class Material(IntEnum):
    """What a face is made of."""

    PAINT = 0
    GLASS = 1
    DARK = 2
    TYRE = 3
    CARGO = 4
    HEADLIGHT = 5
    TAIL_LIGHT = 6
    PLATE = 7
    CHROME = 8


@dataclass(frozen=True, slots=True)
class Solid:
    """A vehicle's shape; x forward, y left, z up.

    Attributes:
        size_m: Length, width and height.
        corners: (V, 3) metres.
        hull: Corner numbers on the convex hull of the whole.
        faces: Corner numbers of each convex face.
        normals: (F, 3) outward.
        offsets: (F,) a point p is before a face when normal · p exceeds its offset.
        radii: (F,) half of each face's extent, metres.
        materials: (F,) `Material` of each.
        order_ahead: (F,) faces in the order of drawing for a camera ahead of `pivot_m`.
        order_behind: (F,) the same for one behind it.
        pivot_m: x between the parts that stand behind each other.
        lamps: (L, 3) places of the head lights, then of as many tail lights.
    """

    size_m: tuple[float, float, float]
    corners: NDArray[np.float64]
    hull: NDArray[np.intp]
    faces: list[NDArray[np.intp]]
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    radii: NDArray[np.float64]
    materials: NDArray[np.int64]
    order_ahead: NDArray[np.intp]
    order_behind: NDArray[np.intp]
    pivot_m: float
    lamps: NDArray[np.float64]


@lru_cache(maxsize=4096)
def vehicle_solid(coco_class: int, length_m: float, width_m: float, height_m: float) -> Solid:
    """The solid of a vehicle; it touches all sides of its length, width and height."""
    builder = _Builder(length_m, width_m, height_m)
    if coco_class == TRUCK and length_m >= SEMITRAILER_LENGTH_M:
        _lorry(builder, cab_m=2.3, gap_m=0.9, axles=(-0.43, -0.36, -0.29, 0.19, 0.41))
    elif coco_class == TRUCK:
        _lorry(builder, cab_m=2.0, gap_m=0.25, axles=(-0.30, 0.38))
    elif coco_class == BUS:
        _bus(builder)
    elif coco_class == MOTORCYCLE:
        _motorcycle(builder)
    elif height_m < SUV_HEIGHT_M:
        _car(builder, roof=(-0.27, 0.06), belt=(-0.46, 0.27), nose=0.66)
    elif height_m < VAN_HEIGHT_M:
        _car(builder, roof=(-0.44, 0.05), belt=(-0.495, 0.24), nose=0.72)
    else:
        _van(builder)
    return builder.solid()


class _Builder:
    """Collects faces; lengths along and across are shares of the vehicle's, heights too."""

    def __init__(self, length_m: float, width_m: float, height_m: float) -> None:
        self.size = np.array([length_m, width_m, height_m])
        self._corners: list[NDArray[np.float64]] = []
        self._faces: list[NDArray[np.intp]] = []
        self._normals: list[NDArray[np.float64]] = []
        self._materials: list[Material] = []
        self._tiers: list[int] = []
        self._middles: list[float] = []
        self._lamps: list[tuple[float, float, float]] = []
        self._count = 0
        self._part = (0, 0.0)

    def part(self, tier: int, middle: float = 0.0) -> None:
        """Begin a part with its middle at x = `middle`; higher tiers cover lower ones.

        No two parts of a tier have one middle, and those of one tier stand behind each other.
        """
        self._part = tier, middle * float(self.size[0])

    def face(self, points: list[tuple[float, float, float]], material: Material) -> None:
        """A convex face; its corners run counter-clockwise seen from outside."""
        # No patch stands out of the vehicle's box.
        corners = np.clip(np.array(points), [-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]) * self.size
        normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)  # Newell's method
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            return
        self._corners.append(corners)
        self._faces.append(np.arange(self._count, self._count + len(corners)))
        self._normals.append(normal / length)
        self._materials.append(material)
        self._tiers.append(self._part[0])
        self._middles.append(self._part[1])
        self._count += len(corners)

    def prism(
        self,
        profile: list[tuple[float, float, float]],
        top: list[Material],
        side: Material,
    ) -> None:
        """A convex side view, drawn across the vehicle.

        Args:
            profile: (x, z, half width) of its corners, clockwise seen from the left: from the
                lower rear over the top to the lower front.
            top: Material of the band from each corner to the next, one fewer than corners.
            side: Material of both sides.
        """
        for (xa, za, wa), (xb, zb, wb), material in zip(
            profile[:-1], profile[1:], top, strict=True
        ):
            self.face([(xa, -wa, za), (xb, -wb, zb), (xb, wb, zb), (xa, wa, za)], material)
        left = [(x, w, z) for x, z, w in profile]
        right = [(x, -w, z) for x, z, w in reversed(profile)]
        self.face(left, side)
        self.face(right, side)

    def box(
        self, x: tuple[float, float], w: float, z: tuple[float, float], material: Material
    ) -> None:
        """An upright box, half width `w`."""
        (a, b), (low, high) = x, z
        self.prism([(a, low, w), (a, high, w), (b, high, w), (b, low, w)], [material] * 3, material)

    def side_panel(self, points: list[tuple[float, float, float]], material: Material) -> None:
        """The same patch (x, z, half width) on both sides, clockwise seen from the left."""
        self.face([(x, w, z) for x, z, w in points], material)
        self.face([(x, -w, z) for x, z, w in reversed(points)], material)

    def end_panel(
        self, x: float, y: tuple[float, float], z: tuple[float, float], material: Material
    ) -> None:
        """A patch on the front (x > 0) or the rear."""
        (a, b), (low, high) = y, z
        ring = [(x, a, low), (x, b, low), (x, b, high), (x, a, high)]
        self.face(ring if x > 0 else ring[::-1], material)

    def wheels(self, axles: tuple[float, ...], radius_m: float) -> None:
        """Tyres with hubs on both sides."""
        length, _, height = self.size
        self.part(3)
        for radius, material in ((radius_m, Material.TYRE), (0.55 * radius_m, Material.CHROME)):
            for x in axles:
                angle = -np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
                ring = [
                    (
                        x + radius * float(np.cos(a)) / length,
                        (radius_m + radius * float(np.sin(a))) / height,
                        0.5,
                    )
                    for a in angle
                ]
                self.side_panel(ring, material)

    def lamps(self, front_z: float, rear_z: float, spread: float) -> None:
        """Lamp places; one in the middle when `spread` is 0."""
        sides = (-spread, spread) if spread > 0.0 else (0.0,)
        self._lamps = [(0.5, y, front_z) for y in sides] + [(-0.5, y, rear_z) for y in sides]

    def solid(self) -> Solid:
        """What was collected."""
        corners, normals = np.concatenate(self._corners), np.array(self._normals)
        tiers, middles = np.array(self._tiers), np.array(self._middles)
        length_m, width_m, height_m = self.size.tolist()
        return Solid(
            (length_m, width_m, height_m),
            corners,
            np.asarray(ConvexHull(corners).vertices, dtype=np.intp),
            self._faces,
            normals,
            np.array([n @ c.mean(axis=0) for n, c in zip(normals, self._corners, strict=True)]),
            np.array([0.5 * np.linalg.norm(np.ptp(c, axis=0)) for c in self._corners]),
            np.array(self._materials, dtype=np.int64),
            np.lexsort((middles, tiers)),
            np.lexsort((-middles, tiers)),
            float(0.5 * (middles.min() + middles.max())),
            np.array(self._lamps) * self.size,
        )


P, G, D, C = Material.PAINT, Material.GLASS, Material.DARK, Material.CARGO


def _car(b: _Builder, roof: tuple[float, float], belt: tuple[float, float], nose: float) -> None:
    """A body with a cabin on it."""
    radius = 0.33 / b.size[2]
    sill, waist = 0.42 * radius, 0.60
    b.part(0)
    b.box((-0.46, 0.46), 0.44, (0.02, 1.3 * radius), D)
    b.part(1)
    body = [
        (-0.485, sill, 0.47),
        (-0.5, 0.34, 0.485),
        (-0.485, 0.56, 0.49),
        (belt[0] - 0.005, waist, 0.495),
        (belt[1], waist, 0.495),
        (0.455, nose * waist + 0.06, 0.47),
        (0.5, 0.30, 0.455),
        (0.485, sill, 0.45),
    ]
    b.prism(body, [P, P, P, P, P, P, P], P)
    _car_ends(b)
    b.part(2)
    inner = 0.40
    cabin = [(belt[0], waist, 0.49), (roof[0], 1.0, inner), (roof[1], 1.0, inner)]
    cabin.append((belt[1], waist, 0.49))
    b.prism(cabin, [G, P, G], P)
    _side_windows(b, roof, belt, waist, inner)
    b.wheels((-0.29, 0.31), 0.33)


def _car_ends(b: _Builder) -> None:
    b.end_panel(0.497, (-0.44, -0.27), (0.38, 0.46), Material.HEADLIGHT)
    b.end_panel(0.497, (0.27, 0.44), (0.38, 0.46), Material.HEADLIGHT)
    b.end_panel(0.498, (-0.22, 0.22), (0.24, 0.38), D)
    b.end_panel(-0.496, (-0.48, -0.30), (0.46, 0.56), Material.TAIL_LIGHT)
    b.end_panel(-0.496, (0.30, 0.48), (0.46, 0.56), Material.TAIL_LIGHT)
    b.end_panel(-0.498, (-0.14, 0.14), (0.34, 0.42), Material.PLATE)
    b.lamps(0.42, 0.51, 0.36)


def _side_windows(
    b: _Builder,
    roof: tuple[float, float],
    belt: tuple[float, float],
    waist: float,
    inner: float,
) -> None:
    """Two panes between three pillars."""

    def point(share: float, up: float) -> tuple[float, float, float]:
        low = belt[0] + share * (belt[1] - belt[0])
        high = roof[0] + share * (roof[1] - roof[0])
        return low + up * (high - low), waist + up * (1.0 - waist), 0.49 + up * (inner - 0.49)

    for start, end in ((0.09, 0.49), (0.54, 0.94)):
        b.side_panel([point(start, 0.1), point(start, 0.86), point(end, 0.86), point(end, 0.1)], G)


def _van(b: _Builder) -> None:
    """One box with a short nose."""
    low = 0.3 / b.size[2]
    b.part(0)
    b.box((-0.46, 0.46), 0.44, (0.02, 0.2), D)
    b.part(1, 0.4)
    nose = [(0.27, low, 0.49), (0.27, 0.60, 0.49), (0.44, 0.50, 0.46), (0.5, 0.32, 0.45)]
    b.prism([*nose, (0.49, low, 0.45)], [P, P, P, D], P)
    b.end_panel(0.5, (-0.42, -0.25), (0.30, 0.38), Material.HEADLIGHT)
    b.end_panel(0.5, (0.25, 0.42), (0.30, 0.38), Material.HEADLIGHT)
    b.part(2, -0.1)
    body = [(-0.495, low, 0.5), (-0.5, 0.5, 0.5), (-0.485, 0.97, 0.46), (-0.45, 1.0, 0.44)]
    body += [(0.16, 1.0, 0.44), (0.33, 0.585, 0.485), (0.29, low, 0.5)]
    b.prism(body, [P, P, P, P, G, P], P)
    window = [(0.06, 0.60, 0.49), (0.06, 0.88, 0.465), (0.19, 0.88, 0.465), (0.28, 0.60, 0.485)]
    b.side_panel(window, G)
    b.end_panel(-0.5, (-0.4, 0.4), (0.62, 0.86), G)
    b.end_panel(-0.5, (-0.48, -0.38), (0.30, 0.52), Material.TAIL_LIGHT)
    b.end_panel(-0.5, (0.38, 0.48), (0.30, 0.52), Material.TAIL_LIGHT)
    b.lamps(0.34, 0.42, 0.36)
    b.wheels((-0.30, 0.33), 0.34)


def _lorry(b: _Builder, cab_m: float, gap_m: float, axles: tuple[float, ...]) -> None:
    """A cab, and a box on a frame."""
    length, _, height = b.size
    floor, cab_top = 1.05 / height, min(3.1 / height, 0.9)
    cab, gap = 0.5 - cab_m / length, 0.5 - (cab_m + gap_m) / length
    b.part(0)
    b.box((-0.49, 0.48), 0.36, (0.35 / height, floor), D)
    b.part(1, 0.5 * (cab + 0.5))
    front = 0.5 - 0.12 / length
    shape = [
        (cab, 0.5 / height, 0.47),
        (cab, cab_top, 0.45),
        (front - 0.25 / length, cab_top, 0.45),
    ]
    shape += [(front, 0.55 * cab_top, 0.47), (0.5, 0.4 * cab_top, 0.47), (0.5, 0.35 / height, 0.47)]
    b.prism(shape, [P, P, P, P, P], P)
    tilt = 0.25 / float(length) / (0.45 * cab_top)

    def windscreen(z: float) -> float:
        return float(front - tilt * (z - 0.55 * cab_top))

    low, high = 0.60 * cab_top, 0.90 * cab_top
    screen = [(windscreen(low), -0.43, low), (windscreen(low), 0.43, low)]
    screen += [(windscreen(high), 0.42, high), (windscreen(high), -0.42, high)]
    b.face(screen, G)
    door = 0.5 * (cab + front)
    b.side_panel(
        [
            (door, low, 0.472),
            (door, high, 0.46),
            (front - 0.28 / length, high, 0.46),
            (front - 0.05 / length, low, 0.472),
        ],
        G,
    )
    b.end_panel(0.501, (-0.45, -0.30), (0.6 / height, 0.8 / height), Material.HEADLIGHT)
    b.end_panel(0.501, (0.30, 0.45), (0.6 / height, 0.8 / height), Material.HEADLIGHT)
    b.end_panel(0.501, (-0.28, 0.28), (0.55 / height, 0.38 * cab_top), D)
    b.part(1, 0.5 * (gap - 0.5))
    b.box((-0.5, gap), 0.5, (floor, 1.0), C)
    b.end_panel(-0.5, (-0.48, -0.32), (0.8 * floor, 0.98 * floor), Material.TAIL_LIGHT)
    b.end_panel(-0.5, (0.32, 0.48), (0.8 * floor, 0.98 * floor), Material.TAIL_LIGHT)
    b.lamps(0.7 / height, 0.9 * floor, 0.38)
    b.wheels(axles, 0.5)


def _bus(b: _Builder) -> None:
    """One long box with a row of windows."""
    low = 0.32 / b.size[2]
    b.part(0)
    b.box((-0.48, 0.48), 0.45, (0.02, 0.2), D)
    b.part(1)
    body = [(-0.495, low, 0.5), (-0.5, 0.5, 0.5), (-0.495, 0.96, 0.48), (-0.48, 1.0, 0.46)]
    body += [(0.48, 1.0, 0.46), (0.497, 0.92, 0.48), (0.5, 0.4, 0.5), (0.498, low, 0.5)]
    b.prism(body, [P, P, P, P, P, P, P], P)
    for k in range(8):
        start = -0.47 + 0.117 * k
        pane = [(start, 0.44, 0.5), (start, 0.80, 0.49), (start + 0.107, 0.80, 0.49)]
        b.side_panel([*pane, (start + 0.107, 0.44, 0.5)], G)
    b.end_panel(0.501, (-0.44, 0.44), (0.36, 0.86), G)
    b.end_panel(0.501, (-0.46, -0.30), (0.18, 0.25), Material.HEADLIGHT)
    b.end_panel(0.501, (0.30, 0.46), (0.18, 0.25), Material.HEADLIGHT)
    b.end_panel(-0.501, (-0.38, 0.38), (0.55, 0.80), G)
    b.end_panel(-0.501, (-0.47, -0.38), (0.25, 0.42), Material.TAIL_LIGHT)
    b.end_panel(-0.501, (0.38, 0.47), (0.25, 0.42), Material.TAIL_LIGHT)
    b.lamps(0.21, 0.34, 0.38)
    b.wheels((-0.28, 0.30), 0.48)


def _motorcycle(b: _Builder) -> None:
    """A machine with a rider."""
    b.part(0)
    b.box((-0.5, -0.22), 0.09, (0.0, 0.42), Material.TYRE)
    b.box((0.22, 0.5), 0.08, (0.0, 0.42), Material.TYRE)
    b.part(1)
    b.prism(
        [(-0.42, 0.28, 0.14), (-0.40, 0.56, 0.17), (0.22, 0.64, 0.2), (0.30, 0.28, 0.14)],
        [P, P, P],
        P,
    )
    b.part(2)
    b.box((0.17, 0.20), 0.5, (0.64, 0.68), D)
    b.part(3)
    b.prism(
        [(-0.22, 0.50, 0.28), (-0.16, 0.86, 0.30), (0.04, 0.86, 0.30), (0.14, 0.50, 0.26)],
        [D, D, D],
        D,
    )
    b.part(4)
    b.box((-0.10, 0.03), 0.17, (0.85, 1.0), P)
    b.lamps(0.55, 0.48, 0.0)
