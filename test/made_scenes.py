"""Scenes and runs for the tests."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.scenes.camera import PinholeCamera, look_at
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.road_plan import Road, Start
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import DetectorFaults, Scene, load_scene
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.truth import visible_lanes

Array = NDArray[np.float64]

FAULTLESS = DetectorFaults(
    edge_noise_px=0.0,
    edge_noise_share=0.0,
    miss_rate=0.0,
    min_height_px=0.0,
    occluded_share=1.0,
    id_switch_per_minute=0.0,
    class_error=0.0,
    false_tracks=0,
    time_jitter_s=0.0,
)


def changed(scene: Scene, **updates: object) -> Scene:
    """The scene with other values at its top level, validated again."""
    return Scene.model_validate(dict(scene) | updates)


@cache
def run_of(name: str, seed: int = 1, duration_s: float = 10.0, faultless: bool = False) -> SceneRun:
    """A run of a shipped scene, made once."""
    scene = load_scene(name)
    return simulate(changed(scene, detector=FAULTLESS) if faultless else scene, duration_s, seed)


def camera_of(scene: Scene) -> PinholeCamera:
    """The scene's camera."""
    placed = place_roads(scene)
    pole, target = scene.camera.pole, scene.camera.look_at
    return look_at(
        np.append(placed[pole.road].point(pole.along_m, pole.right_m), scene.camera.height_m),
        np.append(placed[target.road].point(target.along_m, target.right_m), 0.0),
        scene.camera.horizontal_fov_deg,
        scene.camera.image_size,
    )


def true_lanes(scene: Scene) -> list[Lane]:
    """The lanes that the scene's camera could see; no traffic needed."""
    return [visible.lane for visible in visible_lanes(place_roads(scene), camera_of(scene))]


def turned(scene: Scene, angle_deg: float) -> Scene:
    """The scene turned counter-clockwise about the origin."""
    rotation = rotation_of(angle_deg)
    roads: list[Road] = []
    for road in scene.roads:
        start = road.start
        if start is not None:
            x, y = rotation @ (start.x_m, start.y_m)
            start = Start(x_m=x, y_m=y, heading_deg=start.heading_deg - angle_deg)
        roads.append(road.model_copy(update={"start": start}))
    return changed(scene, roads=roads)


def rotation_of(angle_deg: float) -> Array:
    """(2, 2) counter-clockwise."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[cos, -sin], [sin, cos]])


def pole_camera(height_m: float = 8.0) -> PinholeCamera:
    """A camera above the origin that looks north, 1000x600 pixels."""
    centre, target = np.array([0.0, 0.0, height_m]), np.array([0.0, 40.0, 0.0])
    return look_at(centre, target, 60.0, (1000, 600))


def view_of(*vehicles: tuple[float, float, float, tuple[float, float, float]]) -> View:
    """Vehicles (x, y, heading in degrees, size), numbered from 0."""
    x, y, heading_deg, size = zip(*vehicles, strict=True)
    count = len(vehicles)
    return View(
        np.arange(count),
        np.column_stack([x, y]).astype(float),
        np.radians(np.array(heading_deg, dtype=float)),
        np.array(size, dtype=float),
        np.full(count, 2),
    )
