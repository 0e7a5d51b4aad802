"""The image of a roadside camera, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.background import make_background
from geoorbit_ros.rendering.conditions import Conditions, Illumination, illumination
from geoorbit_ros.rendering.lamps import Lamps, LightPools
from geoorbit_ros.rendering.lens_view import LensView
from geoorbit_ros.rendering.occlusion import draw_order, visible_shares
from geoorbit_ros.rendering.painter import Body, Painter, in_image, outlines_of
from geoorbit_ros.rendering.road_surface import Roads, surface_of
from geoorbit_ros.rendering.sensor import Rain, Sensor
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View

COARSE = 2
"""Pixels per shadow pixel: shadows have soft edges. Chosen: 1 takes more time."""
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
_SOFT = 0.6
"""Blur in shadow pixels. The sun's penumbra is centimetres wide: more would put a dark halo, large
beside a far vehicle, where a camera shows none. Chosen by appearance."""
_FAR_PX = 20000.0
"""OpenCV's polygons take no larger coordinates."""
_LOW_M = 0.6
"""Corners below this make the outline of what touches the ground. Chosen: the height of a sill."""
_BENEATH = 0.62
"""Share of light that is missing beneath a vehicle. Chosen by appearance."""
_MIRROR = 0.30
"""Share of the light from a wet road that the mirrored vehicle takes away. Chosen by appearance."""


class Shadows:
    """Darkens the ground about vehicles.

    Args:
        camera: The camera.
        light: Where the sun stands.
        wet: Whether the road mirrors the vehicles.
    """

    def __init__(self, camera: PinholeCamera, light: Illumination, wet: bool) -> None:
        width, height = camera.image_size
        self._camera = camera
        self._size = -(-width // COARSE), -(-height // COARSE)
        self._wet = wet
        sun = np.array(light.sun) * max(light.sun_direction[2], 0.0)
        shade = np.array(light.ambient)
        # What is left of each colour in the shadow of the sun, for every density of shadow.
        missing = sun / np.maximum(shade + sun, 1e-6)
        density = np.linspace(0.0, 1.0, 256)[:, None]
        self._left = np.rint(255.0 * (1.0 - missing * density)).astype(np.uint8)[:, None]
        self._cast = light.sun_direction[:2] / max(light.sun_direction[2], 0.1)
        self._sunny = bool(missing.max() > 0.15)

    def darken(self, image: NDArray[np.uint8], bodies: list[Body], sunshine: float) -> None:
        """Darken the ground in an image (H, W, 3); `sunshine` 0 to 1: how much the sun is out."""
        if not bodies:
            return
        width, height = self._size
        beneath = np.zeros((height, width), np.uint8)
        cast = np.zeros((height, width), np.uint8)
        outlines = np.concatenate([body.outline_m for body in bodies])
        start = np.append(0, np.cumsum([len(body.outline_m) for body in bodies]))
        flat = outlines[:, 2:] * 0.0
        if self._sunny:
            ground = np.hstack([outlines[:, :2] - outlines[:, 2:] * self._cast, flat])
            self._fill(cast, ground, start, round(255 * sunshine))
        if self._wet:
            mirrored = outlines * (1.0, 1.0, -1.0)
            self._fill(beneath, mirrored, start, round(255 * _MIRROR))
        low = outlines[:, 2] < _LOW_M
        ground = np.hstack([outlines[:, :2], flat])[low]
        self._fill(beneath, ground, np.append(0, np.cumsum(low))[start], round(255 * _BENEATH))
        rows = np.flatnonzero((cast | beneath).any(axis=1))
        if not len(rows):
            return
        top, bottom = max(rows[0] - 3, 0), min(rows[-1] + 4, height)
        soft = cv2.GaussianBlur(cast[top:bottom], (3, 3), _SOFT)
        below = cv2.GaussianBlur(255 - beneath[top:bottom], (3, 3), _SOFT)
        left = cv2.LUT(cv2.merge([soft] * 3), self._left.reshape(1, 256, 3))
        left = cv2.multiply(left, cv2.merge([below] * 3), scale=1.0 / 255.0)
        part = image[top * COARSE : bottom * COARSE]
        left = cv2.resize(
            left, (width * COARSE, (bottom - top) * COARSE), interpolation=cv2.INTER_LINEAR
        )[: part.shape[0], : part.shape[1]]
        cv2.multiply(part, left, dst=part, scale=1.0 / 255.0)

    def _fill(
        self,
        mask: NDArray[np.uint8],
        points_m: NDArray[np.float64],
        start: NDArray[np.int64],
        level: int,
    ) -> None:
        """Fill the convex hulls of points (N, 3); those of hull k are from `start[k]` on."""
        pixel, depth = self._camera.project(points_m)
        coarse = (pixel / COARSE - 0.5).astype(np.float32)
        for a, b in pairwise(start.tolist()):
            if b - a < 3 or depth[a:b].min() <= 1.0:
                continue
            hull = cv2.convexHull(coarse[a:b])
            if np.abs(hull).max() < _FAR_PX:
                corners = np.rint(hull * (1 << _SHIFT)).astype(np.int32)
                cv2.fillConvexPoly(mask, corners, level, cv2.LINE_AA, _SHIFT)


_MARGIN = 0.5
"""Vehicles this share of the image beyond its border can throw shadow or light into it. Chosen:
larger takes more time, smaller cuts long shadows."""


@dataclass(frozen=True, slots=True)
class TrueBoxes:
    """Where the vehicles are in the image.

    Attributes:
        boxes: (N, 4) left, top, right, bottom of each vehicle, whole and unclipped, in pixels;
            NaN when it is not in front of the camera.
        visible: (N,) share of each that is in the image and not hidden by another vehicle.
    """

    boxes: NDArray[np.float64]
    visible: NDArray[np.float64]


class SceneRenderer:
    """Makes images of vehicles on roads. No SUMO, no clock: the same input gives the same bits.

    The empty road is painted once, when the renderer is made (a few seconds).

    Args:
        camera: The camera, in the roads' map frame.
        roads: A scene's placed roads, or lanes of any origin.
        conditions: Light and weather.
        seed: Decides on the land, the sun's azimuth, the vehicles' colours and the noise.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        roads: Roads,
        conditions: Conditions | None = None,
        seed: int = 1,
    ) -> None:
        self.camera = camera
        self.conditions = conditions or Conditions()
        azimuth = float(np.random.default_rng([seed, 20]).uniform(0.0, 2.0 * np.pi))
        light = illumination(self.conditions, azimuth)
        wet = self.conditions.rain
        size = camera.image_size
        self._lens_view = None if camera.lens is None else LensView(camera)
        if self._lens_view:
            camera = self._lens_view.pinhole
        background = make_background(camera, surface_of(roads), light, self.conditions, seed)
        self._empty = np.rint(255.0 * background.lit).astype(np.uint8)
        self._painter = Painter(camera, light, seed)
        self._shadows = Shadows(camera, light, wet)
        self._pools: LightPools | None = None
        self._lamps: Lamps | None = None
        if light.headlights > 0.0:
            self._pools = LightPools(camera, background.albedo, light.headlights)
            self._lamps = Lamps(camera, light.headlights, wet)
        self._rain = Rain(size, self.conditions.light, seed) if wet else None
        self._sensor = Sensor(size, self.conditions, light.noise, seed)
        self._pinhole = camera

    def render(self, vehicles: View, time_s: float) -> NDArray[np.uint8]:
        """The image (H, W, 3) blue, green, red at `time_s`."""
        bodies = self._painter.place(vehicles)
        return self._image(self._sorted(vehicles, bodies), time_s)

    def render_with_boxes(
        self, vehicles: View, time_s: float
    ) -> tuple[NDArray[np.uint8], TrueBoxes]:
        """The image, and where the vehicles are in it."""
        bodies = self._painter.place(vehicles)
        order = self._sorted(vehicles, bodies)
        outlines = outlines_of(bodies, self._pinhole.image_size)
        if self._lens_view:
            outlines = self._lens_view.outlines(outlines)
        visible = visible_shares(outlines, [k for k, _ in order], self.camera.image_size)
        boxes = outlines.boxes + np.tile(self._sensor.sway_px(time_s), 2)
        return self._image(order, time_s), TrueBoxes(boxes, visible)

    def _sorted(self, vehicles: View, bodies: list[Body | None]) -> list[tuple[int, Body]]:
        """Bodies that show in the image, be it by their shadow, the farthest first."""
        size = self._pinhole.image_size
        near = [k for k, body in enumerate(bodies) if body and in_image(body.box, size, _MARGIN)]
        some = View(*(getattr(vehicles, name)[near] for name in View.__slots__))
        ordered = (near[k] for k in draw_order(some, self.camera.centre_m))
        return [(k, body) for k in ordered if (body := bodies[k]) is not None]

    def _image(self, order: list[tuple[int, Body]], time_s: float) -> NDArray[np.uint8]:
        bodies = [body for _, body in order]
        image = self._empty.copy()
        self._shadows.darken(image, bodies, self._sensor.sunshine(time_s))
        if self._pools:
            self._pools.light_road(image, bodies)
        glares = self._lamps.glares(bodies) if self._lamps else []
        for k, body in enumerate(bodies):
            self._painter.paint(image, body)
            if self._lamps:  # now: a nearer vehicle hides the lamps too
                self._lamps.draw(image, glares[k])
        if self._lens_view:
            image = self._lens_view.show(image)
        if self._rain:
            image = self._rain.fall(image, time_s)
        return self._sensor.expose(image, time_s)
