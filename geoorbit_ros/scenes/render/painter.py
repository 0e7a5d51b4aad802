"""Draws vehicles: shaded faces over the picture, with smooth edges."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.render.conditions import Illumination
from geoorbit_ros.scenes.render.occlusion import Silhouettes
from geoorbit_ros.scenes.render.paints import material_colours
from geoorbit_ros.scenes.render.solids import BUS, TRUCK, Solid, vehicle_solid

NEAR_M = 1.0
"""Vehicles with a corner nearer than this are not drawn, nor have they a box."""
_SHIFT = 4
_REMEMBERED = 2000
_BOUNCE = 0.45
"""Light from the ground on a face that looks down, as a share of the sky's on one that looks up."""


@dataclass(frozen=True, slots=True)
class Body:
    """A vehicle placed in the picture.

    Attributes:
        solid: Its shape.
        index: Its row in the view.
        heading_rad: Counter-clockwise from east.
        xy: (2,) middle of its footprint.
        world: (V, 3) corners in the map.
        pixel: (V, 2) corners in the image.
        depth_m: Mean depth of its corners.
        camera: (3,) the camera's place in the vehicle's own axes.
    """

    solid: Solid
    index: int
    heading_rad: float
    xy: NDArray[np.float64]
    world: NDArray[np.float64]
    pixel: NDArray[np.float64]
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
        self._colours: OrderedDict[tuple[int, int], NDArray[np.float64]] = OrderedDict()

    def place(self, view: View) -> list[Body | None]:
        """The vehicles as bodies; None for one that reaches behind the camera."""
        return [self._body(view, k) for k in range(len(view.vehicle))]

    def _body(self, view: View, k: int) -> Body | None:
        length, width, height = (round(float(v), 4) for v in view.size[k])
        solid = vehicle_solid(int(view.coco_class[k]), length, width, height)
        cos, sin = np.cos(view.heading[k]), np.sin(view.heading[k])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        at = np.append(view.xy[k], 0.0)
        world = solid.corners @ turn + at
        pixel, depth = self._camera.project(world)
        if depth.min() <= NEAR_M:
            return None
        camera = turn @ (self._camera.centre_m - at)
        heading = float(view.heading[k])
        return Body(solid, k, heading, view.xy[k], world, pixel, float(depth.mean()), camera)

    def paint(self, picture: NDArray[np.uint8], body: Body, view: View) -> None:
        """Draw a vehicle over a picture (H, W, 3)."""
        height, width = picture.shape[:2]
        outline = body.pixel[body.solid.hull]
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 1, [width, height])
        if np.any(high <= low):
            return
        area = picture[low[1] : high[1], low[0] : high[0]]
        samples = _samples(area.shape[0] * area.shape[1])
        size = area.shape[1], area.shape[0]
        fine_size = size[0] * samples, size[1] * samples
        fine = cv2.resize(area, fine_size, interpolation=cv2.INTER_NEAREST)
        # Coordinates of pixel centres: a subpixel's middle lies half a subpixel inside.
        corners = ((body.pixel - low) * samples - 0.5) * (1 << _SHIFT)
        corners = np.rint(corners).astype(np.int32)
        colours = self._shaded(body, view).tolist()
        solid = body.solid
        for face in _seen(body):
            cv2.fillConvexPoly(fine, corners[solid.faces[face]], colours[face], cv2.LINE_8, _SHIFT)
        area[:] = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)

    def _shaded(self, body: Body, view: View) -> NDArray[np.float64]:
        """(F, 3) colours of the faces in the light, grey levels."""
        light, normals = self._light, body.solid.normals
        cos, sin = np.cos(body.heading_rad), np.sin(body.heading_rad)
        sun = light.sun_direction
        towards = np.array([cos * sun[0] + sin * sun[1], cos * sun[1] - sin * sun[0], sun[2]])
        up = 0.5 * (1.0 + normals[:, 2])
        sky = (up + _BOUNCE * (1.0 - up))[:, None] * np.array(light.ambient)
        direct = np.maximum(normals @ towards, 0.0)[:, None] * np.array(light.sun)
        materials = body.solid.materials
        table = self._material_colours(
            int(view.vehicle[body.index]), int(view.coco_class[body.index])
        )
        albedo, gloss, glow = table[0][materials], table[1][materials], table[2][materials]
        facing = np.clip(normals[:, 2], 0.0, 1.0)[:, None]
        mirrored = np.array(light.horizon) + facing * (
            np.array(light.zenith) - np.array(light.horizon)
        )
        colour = albedo * (sky + direct) + gloss * mirrored + glow
        clear = np.exp(-body.depth_m / light.haze_m)
        hazy = clear * np.clip(colour, 0.0, 1.0) + (1.0 - clear) * np.array(light.horizon)
        return np.asarray(255.0 * hazy)

    def _material_colours(self, vehicle: int, coco_class: int) -> NDArray[np.float64]:
        key = vehicle, coco_class
        found = self._colours.get(key)
        if found is None:
            large = coco_class in (BUS, TRUCK)
            found = material_colours(vehicle, large, self._seed, self._light.headlights)
            self._colours[key] = found
            if len(self._colours) > _REMEMBERED:
                self._colours.popitem(last=False)
        return found


def silhouettes(bodies: list[Body | None]) -> Silhouettes:
    """Outlines of bodies."""
    hulls: list[NDArray[np.float32] | None] = []
    boxes = np.full((len(bodies), 4), np.nan)
    for k, body in enumerate(bodies):
        if body is None:
            hulls.append(None)
            continue
        pixel = body.pixel[body.solid.hull]
        hulls.append(np.asarray(cv2.convexHull(pixel.astype(np.float32))[:, 0], np.float32))
        boxes[k] = [*pixel.min(axis=0), *pixel.max(axis=0)]
    return Silhouettes(hulls, boxes)


def _seen(body: Body) -> NDArray[np.intp]:
    """Faces that look at the camera, in the order of drawing."""
    solid = body.solid
    towards = np.einsum("fk,fk->f", solid.normals, body.camera - solid.centres)
    faces = np.flatnonzero(towards > 0.0)
    distance = np.abs(solid.middles[faces] - body.camera[0])
    return faces[np.lexsort((-distance, solid.tiers[faces]))]


def _samples(area: int) -> int:
    """Subpixels per pixel and axis: many where vehicles are small."""
    return 4 if area < 4000 else 3 if area < 16000 else 2
