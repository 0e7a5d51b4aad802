"""A vehicle's shape: flat faces with materials, in metres about the middle of the footprint."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import scipy
from numpy.typing import NDArray


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


class SolidBuilder:
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
            np.asarray(scipy.spatial.ConvexHull(corners).vertices, dtype=np.intp),
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
