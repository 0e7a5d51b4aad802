"""Cameras, vehicles and renderers for the tests of images."""

from __future__ import annotations

from functools import cache

import numpy as np
from made_scenes import Array, changed, view_of
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Conditions, Light
from geoorbit_ros.rendering.renderer import SceneRenderer
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.roads import PlacedRoad, place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene
from geoorbit_ros.scenes.simulate import scene_camera

Image = NDArray[np.uint8]
SIZE = (640, 360)
CAR, SUV, VAN = (4.5, 1.82, 1.47), (4.8, 1.95, 1.75), (5.6, 2.0, 2.3)
TRUCK, SEMITRAILER, BUS = (9.0, 2.5, 3.4), (16.5, 2.55, 4.0), (12.0, 2.55, 3.2)
MOTORCYCLE = (2.2, 0.8, 1.5)
CLASSES = {CAR: 2, SUV: 2, VAN: 2, TRUCK: 7, SEMITRAILER: 7, BUS: 5, MOTORCYCLE: 3}


def small(scene: Scene, size: tuple[int, int] = SIZE) -> Scene:
    """The scene seen by a camera with fewer pixels."""
    return changed(scene, camera=scene.camera.model_copy(update={"image_size": size}))


@cache
def road_and_camera(name: str = "straight_3x3") -> tuple[dict[str, PlacedRoad], PinholeCamera]:
    """A shipped scene's roads and its camera, small."""
    scene = small(load_scene(name))
    placed = place_roads(scene)
    return placed, scene_camera(scene, placed)


@cache
def renderer(light: Light = "day", rain: bool = False, seed: int = 1) -> SceneRenderer:
    """Of the straight motorway, with an even light."""
    placed, camera = road_and_camera()
    return SceneRenderer(camera, placed, Conditions(light, rain, clouds=0.0), seed)


def on_road(
    along_m: float, right_m: float, size: tuple[float, float, float] = CAR, turn_deg: float = 0.0
) -> tuple[float, float, float, tuple[float, float, float]]:
    """A vehicle for `vehicles`: its place from the start of the road towards the camera's left."""
    placed, _ = road_and_camera()
    x, y = placed["north"].point(along_m, right_m)
    heading_deg = float(np.degrees(placed["north"].heading_rad[0]))
    return float(x), float(y), heading_deg + turn_deg, size


def vehicles(
    *those: tuple[float, float, float, tuple[float, float, float]], first: int = 0
) -> View:
    """A view of vehicles numbered from `first`, with the classes of their sizes."""
    view = view_of(*those)
    classes = np.array([CLASSES[size] for *_, size in those])
    return View(view.vehicle + first, view.xy, view.heading, view.size, classes)


def nothing() -> View:
    """No vehicle."""
    empty = np.empty(0)
    whole = np.empty(0, np.int64)
    return View(whole, np.empty((0, 2)), empty, np.empty((0, 3)), whole)


def difference(a: Image, b: Image) -> NDArray[np.int64]:
    """(H, W) largest difference of the channels."""
    return np.asarray(np.abs(a.astype(int) - b.astype(int)).max(axis=2))


def extent(mask: NDArray[np.bool_]) -> Array:
    """Left, top, right, bottom of the pixels that are set."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)
