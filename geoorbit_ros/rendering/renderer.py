"""The image of a roadside camera, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.background import make_background
from geoorbit_ros.rendering.conditions import Conditions, illumination
from geoorbit_ros.rendering.lamps import Lamps, LightPools
from geoorbit_ros.rendering.occlusion import draw_order, visible_shares
from geoorbit_ros.rendering.painter import Body, Painter, in_image, outlines_of
from geoorbit_ros.rendering.road_surface import Roads, surface_of
from geoorbit_ros.rendering.sensor import Rain, Sensor
from geoorbit_ros.rendering.shadows import Shadows
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View

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
        background = make_background(camera, surface_of(roads), light, wet, seed)
        self._empty = np.rint(255.0 * background.lit).astype(np.uint8)
        self._painter = Painter(camera, light, seed)
        self._shadows = Shadows(camera, light, wet)
        self._pools: LightPools | None = None
        self._lamps: Lamps | None = None
        if light.headlights > 0.0:
            self._pools = LightPools(camera, background.albedo, light.headlights)
            self._lamps = Lamps(camera, light.headlights, wet)
        self._rain = Rain(camera.image_size, self.conditions.light, seed) if wet else None
        self._sensor = Sensor(camera.image_size, self.conditions, light.noise, seed)

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
        outlines = outlines_of(bodies, self.camera.image_size)
        visible = visible_shares(outlines, [k for k, _ in order], self.camera.image_size)
        boxes = outlines.boxes + np.tile(self._sensor.sway_px(time_s), 2)
        return self._image(order, time_s), TrueBoxes(boxes, visible)

    def _sorted(self, vehicles: View, bodies: list[Body | None]) -> list[tuple[int, Body]]:
        """Bodies that show in the image, be it by their shadow, the farthest first."""
        size = self.camera.image_size
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
        if self._rain:
            image = self._rain.fall(image, time_s)
        return self._sensor.expose(image, time_s)
