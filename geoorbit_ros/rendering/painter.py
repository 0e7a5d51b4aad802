"""Draws vehicles: shaded faces over the image, with smooth edges."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import LARGE_CLASSES
from geoorbit_ros.rendering.conditions import Colour, Illumination
from geoorbit_ros.rendering.occlusion import Outlines
from geoorbit_ros.rendering.solid import Material, Solid
from geoorbit_ros.rendering.vehicle_solids import vehicle_solid
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View

NEAR_M = 1.0
"""Vehicles with a corner nearer than this are not drawn, nor have they a box: their projection is
unbounded."""
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
_REMEMBERED = 4000
"""Shades that are kept. Chosen: more take memory, fewer are computed again."""
_HEADING_STEP_RAD = 0.02
"""Headings within this share a shade. Chosen: light changes by 2 %; smaller takes more time."""
_SMALLEST_PX = 0.8
"""Faces of a smaller radius are left out: they are not seen."""
_BOUNCE = 0.45
"""Light from the ground on a face that looks down, as a share of the sky's on one that looks up.
Chosen by appearance: the ground reflects about half."""
CAR_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.30, (0.84, 0.85, 0.85)),
    (0.19, (0.09, 0.085, 0.08)),
    (0.16, (0.36, 0.35, 0.34)),
    (0.10, (0.62, 0.61, 0.60)),
    (0.10, (0.48, 0.25, 0.12)),
    (0.06, (0.10, 0.09, 0.52)),
    (0.03, (0.20, 0.32, 0.16)),
    (0.03, (0.40, 0.52, 0.60)),
    (0.03, (0.12, 0.34, 0.68)),
)
"""Shares and colours of cars. Shares: BASF Color Report 2022, rounded; colours chosen by
appearance."""
LARGE_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.45, (0.84, 0.84, 0.83)),
    (0.15, (0.50, 0.26, 0.10)),
    (0.15, (0.12, 0.12, 0.58)),
    (0.10, (0.14, 0.62, 0.76)),
    (0.15, (0.38, 0.38, 0.38)),
)
"""Shares and colours of trucks' cabs and of buses. Chosen by appearance."""
CARGO_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.6, (0.82, 0.82, 0.81)),
    (0.12, (0.46, 0.32, 0.16)),
    (0.12, (0.30, 0.42, 0.26)),
    (0.16, (0.55, 0.56, 0.56)),
)
"""Shares and colours of trucks' bodies. Chosen by appearance."""
_FIXED: dict[Material, Colour] = {
    Material.GLASS: (0.06, 0.055, 0.05),
    Material.DARK: (0.075, 0.075, 0.075),
    Material.TYRE: (0.085, 0.085, 0.085),
    Material.HEADLIGHT: (0.72, 0.74, 0.74),
    Material.TAIL_LIGHT: (0.10, 0.08, 0.50),
    Material.PLATE: (0.75, 0.78, 0.78),
    Material.CHROME: (0.48, 0.48, 0.48),
}
"""Colours of what is not painted. Chosen by appearance."""
_GLOSS: dict[Material, float] = {
    Material.PAINT: 0.08,
    Material.GLASS: 0.15,
    Material.HEADLIGHT: 0.10,
    Material.CHROME: 0.05,
}
"""Share of the sky that a material mirrors. Chosen by appearance; glass more than paint."""
_HEADLIGHT_GLOW: Colour = (0.85, 0.95, 1.0)
"""Light of a lit headlight's glass. Chosen by appearance: warm white."""
_TAIL_GLOW: Colour = (0.12, 0.10, 0.75)
"""Light of a lit tail light's glass. Chosen by appearance: red."""


@dataclass(frozen=True, slots=True)
class Body:
    """A vehicle placed in the image.

    Attributes:
        solid: Its shape.
        vehicle: Its number.
        coco_class: Its class.
        heading_rad: Counter-clockwise from east.
        xy: (2,) middle of its footprint.
        outline_m: (H, 3) corners of its convex hull in the map.
        outline: (H, 2) the same in the image.
        box: (4,) left, top, right, bottom of the outline.
        depth_m: Mean depth of the outline.
        camera: (3,) the camera's place in the vehicle's own axes.
    """

    solid: Solid
    vehicle: int
    coco_class: int
    heading_rad: float
    xy: NDArray[np.float64]
    outline_m: NDArray[np.float64]
    outline: NDArray[np.float64]
    box: NDArray[np.float64]
    depth_m: float
    camera: NDArray[np.float64]


class Painter:
    """Places and paints vehicles.

    Args:
        camera: The camera.
        light: What lights them.
        seed: Decides on their colours.
    """

    def __init__(self, camera: PinholeCamera, light: Illumination, seed: int) -> None:
        self._camera = camera
        self._light = light
        self._seed = seed
        self._colours: OrderedDict[tuple[object, ...], NDArray[np.float64]] = OrderedDict()

    def place(self, view: View) -> list[Body | None]:
        """The vehicles as bodies; None for one that reaches behind the camera."""
        if not len(view.vehicle):
            return []
        solids = [
            vehicle_solid(coco_class, *(round(value, 4) for value in size))
            for coco_class, size in zip(view.coco_class.tolist(), view.size.tolist(), strict=True)
        ]
        counts = np.array([len(solid.hull) for solid in solids])
        local = np.concatenate([solid.corners[solid.hull] for solid in solids])
        cos, sin = np.cos(view.heading), np.sin(view.heading)
        world = _turned(local, np.repeat(cos, counts), np.repeat(sin, counts))
        world[:, :2] += np.repeat(view.xy, counts, axis=0)
        pixel, depth = self._camera.project(world)
        start = np.append(0, np.cumsum(counts))
        boxes = np.column_stack(
            [np.minimum.reduceat(pixel, start[:-1]), np.maximum.reduceat(pixel, start[:-1])]
        )
        nearest = np.minimum.reduceat(depth, start[:-1])
        away = np.tile(self._camera.centre_m, (len(solids), 1))
        away[:, :2] -= view.xy
        camera = _turned(away, cos, -sin)
        return [
            None
            if nearest[k] <= NEAR_M
            else Body(
                solid,
                int(view.vehicle[k]),
                int(view.coco_class[k]),
                float(view.heading[k]),
                view.xy[k],
                world[start[k] : start[k + 1]],
                pixel[start[k] : start[k + 1]],
                boxes[k],
                float(depth[start[k] : start[k + 1]].mean()),
                camera[k],
            )
            for k, solid in enumerate(solids)
        ]

    def paint(self, image: NDArray[np.uint8], body: Body) -> None:
        """Draw a vehicle over an image (H, W, 3)."""
        height, width = image.shape[:2]
        left, top = max(int(body.box[0]) - 2, 0), max(int(body.box[1]) - 2, 0)
        right, bottom = min(int(body.box[2]) + 2, width), min(int(body.box[3]) + 2, height)
        if right <= left or bottom <= top:
            return
        area = image[top:bottom, left:right]
        size = right - left, bottom - top
        samples = _samples(size[0] * size[1])
        fine_size = size[0] * samples, size[1] * samples
        fine = cv2.resize(area, fine_size, interpolation=cv2.INTER_NEAREST)
        solid = body.solid
        world = _turned(solid.corners, np.cos(body.heading_rad), np.sin(body.heading_rad))
        world[:, :2] += body.xy
        pixel, _ = self._camera.project(world)
        # Coordinates of pixel centres: a subpixel's middle lies half a subpixel inside.
        corners = ((pixel - (left, top)) * samples - 0.5) * (1 << _SHIFT)
        corners = np.rint(corners).astype(np.int32)
        colours = self._shaded(body).tolist()
        smallest_m = _SMALLEST_PX * body.depth_m / self._camera.focal_px
        for face in _seen(body, smallest_m).tolist():
            cv2.fillConvexPoly(fine, corners[solid.faces[face]], colours[face], cv2.LINE_8, _SHIFT)
        area[:] = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)

    def _shaded(self, body: Body) -> NDArray[np.float64]:
        """(F, 3) colours of the faces in light and haze, grey levels."""
        # Light changes little with the heading: one shade serves for all within a step.
        step = round(body.heading_rad / _HEADING_STEP_RAD)
        key = body.vehicle, body.coco_class, body.solid.size_m, step
        colour = self._colours.get(key)
        if colour is None:
            colour = self._in_light(body, step * _HEADING_STEP_RAD)
            self._colours[key] = colour
            if len(self._colours) > _REMEMBERED:
                self._colours.popitem(last=False)
        clear = np.exp(-body.depth_m / self._light.haze_m)
        return np.asarray(clear * colour + 255.0 * (1.0 - clear) * np.array(self._light.horizon))

    def _in_light(self, body: Body, heading_rad: float) -> NDArray[np.float64]:
        light, normals = self._light, body.solid.normals
        sun = _turned(light.sun_direction[None], np.cos(heading_rad), -np.sin(heading_rad))[0]
        up = 0.5 * (1.0 + normals[:, 2])
        sky = (up + _BOUNCE * (1.0 - up))[:, None] * np.array(light.ambient)
        direct = np.maximum(normals @ sun, 0.0)[:, None] * np.array(light.sun)
        large = body.coco_class in LARGE_CLASSES
        table = material_colours(body.vehicle, large, self._seed, light.headlights)
        albedo, gloss, glow = table[:, body.solid.materials]
        facing = np.clip(normals[:, 2], 0.0, 1.0)[:, None]
        horizon, zenith = np.array(light.horizon), np.array(light.zenith)
        mirrored = horizon + facing * (zenith - horizon)
        colour = albedo * (sky + direct) + gloss * mirrored + glow
        return np.asarray(255.0 * np.clip(colour, 0.0, 1.0))


def outlines_of(bodies: list[Body | None], image_size: tuple[int, int]) -> Outlines:
    """Outlines of bodies; no hull for those outside of the image."""
    hulls: list[NDArray[np.float32] | None] = []
    boxes = np.full((len(bodies), 4), np.nan)
    for k, body in enumerate(bodies):
        hulls.append(None)
        if body is None:
            continue
        boxes[k] = body.box
        if in_image(body.box, image_size):
            hulls[k] = np.asarray(cv2.convexHull(body.outline.astype(np.float32))[:, 0], np.float32)
    return Outlines(hulls, boxes)


def in_image(box: NDArray[np.float64], image_size: tuple[int, int], margin: float = 0.0) -> bool:
    """Whether a box (4,) reaches into the image, widened by a share of its size on every side."""
    wide, high = margin * image_size[0], margin * image_size[1]
    left, top, right, bottom = box.tolist()
    return bool(
        right > -wide
        and bottom > -high
        and left < image_size[0] + wide
        and top < image_size[1] + high
    )


def _turned(
    points: NDArray[np.float64],
    cos: NDArray[np.float64] | float,
    sin: NDArray[np.float64] | float,
) -> NDArray[np.float64]:
    """Points (N, 3) turned about the vertical."""
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, points[:, 2]])


def _seen(body: Body, smallest_m: float) -> NDArray[np.intp]:
    """Faces that look at the camera and are large enough to be seen, in the order of drawing."""
    solid = body.solid
    order = solid.order_ahead if body.camera[0] > solid.pivot_m else solid.order_behind
    seen = (solid.normals @ body.camera > solid.offsets) & (solid.radii > smallest_m)
    return order[seen[order]]


def _samples(area: int) -> int:
    """Subpixels per pixel and axis: many where vehicles are small."""
    return 4 if area < 4000 else 3 if area < 16000 else 2


def material_colours(
    vehicle: int, large: bool, seed: int, headlights: float
) -> NDArray[np.float64]:
    """(3, materials, 3): colour, share of mirrored sky, and own light of each material.

    Args:
        vehicle: Its number: the same one has the same colours.
        large: A truck or a bus.
        seed: Another seed paints all vehicles anew.
        headlights: Brightness of the lamps, 0 to 1.
    """
    random = np.random.default_rng([seed, 23, abs(vehicle)])
    table = np.zeros((3, len(Material), 3))
    for material, colour in _FIXED.items():
        table[0, material] = colour
    table[0, Material.PAINT] = _pick(LARGE_PAINTS if large else CAR_PAINTS, random)
    table[0, Material.CARGO] = _pick(CARGO_PAINTS, random)
    for material, share in _GLOSS.items():
        table[1, material] = share
    if headlights > 0.0:
        table[2, Material.HEADLIGHT] = np.array(_HEADLIGHT_GLOW) * min(1.0, 0.4 + headlights)
        table[2, Material.TAIL_LIGHT] = np.array(_TAIL_GLOW) * min(1.0, 0.3 + headlights)
    return table


def _pick(
    paints: tuple[tuple[float, Colour], ...], random: np.random.Generator
) -> NDArray[np.float64]:
    shares = np.array([share for share, _ in paints])
    chosen = paints[int(random.choice(len(paints), p=shares / shares.sum()))][1]
    return np.asarray(np.clip(np.array(chosen) * random.uniform(0.85, 1.15), 0.03, 0.9))
