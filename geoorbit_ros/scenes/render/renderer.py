"""The picture of a roadside camera, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.render.background import make_background
from geoorbit_ros.scenes.render.conditions import Conditions, illumination
from geoorbit_ros.scenes.render.headlights import Headlights
from geoorbit_ros.scenes.render.occlusion import draw_order, visible_shares
from geoorbit_ros.scenes.render.painter import Body, Painter, silhouettes
from geoorbit_ros.scenes.render.rain import Rain
from geoorbit_ros.scenes.render.road_surface import Roads, surface_of
from geoorbit_ros.scenes.render.sensor import Sensor
from geoorbit_ros.scenes.render.shadows import Shadows


@dataclass(frozen=True, slots=True)
class TrueBoxes:
    """Where the vehicles are in the picture.

    Attributes:
        boxes: (N, 4) left, top, right, bottom of each vehicle, whole and unclipped, in pixels;
            NaN when it is not in front of the camera.
        visible: (N,) share of each that is in the picture and not hidden by another vehicle.
    """

    boxes: NDArray[np.float64]
    visible: NDArray[np.float64]


class SceneRenderer:
    """Makes pictures of vehicles on roads. No SUMO, no clock: the same input gives the same bits.

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
        self._headlights: Headlights | None = None
        if light.headlights > 0.0:
            self._headlights = Headlights(camera, background.albedo, light.headlights, wet)
        self._rain = Rain(camera.image_size, self.conditions.light, seed) if wet else None
        self._sensor = Sensor(camera.image_size, self.conditions, light.noise, seed)

    def render(self, vehicles: View, time_s: float) -> NDArray[np.uint8]:
        """The picture (H, W, 3) blue, green, red at `time_s`."""
        bodies = self._painter.place(vehicles)
        order = draw_order(vehicles, self.camera.centre_m)
        placed = [body for body in (bodies[k] for k in order) if body is not None]
        return self._picture(vehicles, self._in_view(placed), time_s)

    def render_with_boxes(
        self, vehicles: View, time_s: float
    ) -> tuple[NDArray[np.uint8], TrueBoxes]:
        """The picture, and where the vehicles are in it."""
        bodies = self._painter.place(vehicles)
        order = draw_order(vehicles, self.camera.centre_m)
        outlines = silhouettes(bodies)
        visible = visible_shares(outlines, order, self.camera.image_size)
        placed = [body for body in (bodies[k] for k in order) if body is not None]
        picture = self._picture(vehicles, self._in_view(placed), time_s)
        boxes = outlines.boxes + np.tile(self._sensor.sway_px(time_s), 2)
        return picture, TrueBoxes(boxes, visible)

    def _in_view(self, bodies: list[Body]) -> list[Body]:
        """Bodies near enough to the image to show in it, be it by their shadow."""
        width, height = self.camera.image_size
        low, high = np.array([-0.5 * width, -0.5 * height]), np.array([1.5 * width, 1.5 * height])
        return [
            body
            for body in bodies
            if np.all(body.pixel.max(axis=0) > low) and np.all(body.pixel.min(axis=0) < high)
        ]

    def _picture(self, vehicles: View, bodies: list[Body], time_s: float) -> NDArray[np.uint8]:
        picture = self._empty.copy()
        self._shadows.darken(picture, bodies, self._sensor.sunshine(time_s))
        if self._headlights:
            self._headlights.light_road(picture, bodies)
        for body in bodies:
            self._painter.paint(picture, body, vehicles)
            if self._headlights:  # now: a nearer vehicle hides the lamps too
                self._headlights.add_glare(picture, body)
        if self._rain:
            picture = self._rain.fall(picture, time_s)
        return self._sensor.expose(picture, time_s)
