"""Scenes for `calibrate.py`: cameras more varied than `random_scene`'s, and fleets of other sizes.

`random_scene` places its cameras as a person would: 7 to 20 m high, 45 to 90 degrees wide. Here
height, tilt and field of view are drawn on their own, the camera rolls a little, and all vehicles
of a place are larger or smaller than usual, by an amount that nobody tells the estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames, join_frames
from geoorbit_ros.scenes import random_scene as roads
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import DetectorModel
from geoorbit_ros.scenes.moving_traffic import MovingTraffic
from geoorbit_ros.scenes.roads import lane_chains, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import START_NS, scene_camera
from geoorbit_ros.scenes.traffic import simulate_traffic
from geoorbit_ros.scenes.truth import visible_lanes

HEIGHT_M, TILT_DEG, FIELD_OF_VIEW_DEG = (5.0, 25.0), (5.0, 45.0), (20.0, 100.0)
ROLL_SIGMA_DEG = 1.0
FLEET = 0.04
"""The fleet's mean sizes are uniformly up to this share above or below the usual ones."""
DISTORTION = 0.35
"""With a lens, k1 is uniformly between minus this and 0, but so weak that the whole image shows
something: beyond `FOLD` of it the model has no image."""
FOLD = 0.8 * 4.0 / 27.0
SEEN_M = 25.0
"""A lane counts as seen from this length on: less than `random_scene` asks for, since a steep
camera on a short pole sees no more of a road."""
SEEN_SHARE = 0.6
TRIES = 4000


@dataclass(frozen=True)
class Watched:
    """A camera's boxes and the camera.

    Attributes:
        name: Of the scene.
        frames: `PIXEL_TRACK_DTYPE` boxes as a tracker reports them.
        camera: The true camera.
        height_m: Above the road.
        tilt_deg: Of the optical axis, below the horizontal.
        field_of_view_deg: From left to right.
        roll_deg: About the optical axis.
        fleet: What all vehicle sizes were multiplied with.
    """

    name: str
    frames: Frames
    camera: PinholeCamera
    height_m: float
    tilt_deg: float
    field_of_view_deg: float
    roll_deg: float
    fleet: float


def calibration_scene(seed: int) -> Scene:
    """A scene whose camera has any height, tilt and field of view with which the road is seen.

    Raises:
        RandomSceneError: `TRIES` cameras all see too little.
    """
    random = np.random.default_rng([seed, 21])
    draft, left_m = roads._draft(random, seed)
    placed = None
    for _ in range(TRIES):
        camera = _camera(random, draft, left_m)
        if camera is None:
            continue
        scene = Scene.model_validate({**draft, "camera": camera})
        placed = placed or place_roads(scene)
        lanes = visible_lanes(placed, scene_camera(scene, placed))
        seen = [lane for lane in lanes if lane.lane.length_m >= SEEN_M]
        if len(seen) >= max(SEEN_SHARE * len(lane_chains(placed)), 1):
            return scene
    raise roads.RandomSceneError(f"calibration scene {seed}", "useless cameras", "one that sees")


def _camera(
    random: np.random.Generator, draft: dict[str, Any], left_m: float
) -> dict[str, Any] | None:
    right_m = draft["roads"][0]["lanes"] * draft["lane_width_m"]
    height = float(random.uniform(*HEIGHT_M))
    away = height / math.tan(math.radians(random.uniform(*TILT_DEG)))
    aim_right = float(random.uniform(-left_m, right_m))
    beside = float(random.uniform(2.0, 30.0))
    pole_right = right_m + beside if random.uniform() < 0.5 else -left_m - beside
    across = pole_right - aim_right
    if away <= abs(across):
        return None
    look_m = roads.BEFORE_M + float(random.uniform(-30.0, 30.0))
    along = math.sqrt(away**2 - across**2) * float(random.choice([-1.0, 1.0]))
    sizes = [[1280, 720], [1920, 1080], [3840, 2160]]
    return {
        "pole": roads._point(draft["roads"], look_m + along, pole_right),
        "height_m": height,
        "look_at": roads._point(draft["roads"], look_m, aim_right),
        "horizontal_fov_deg": float(random.uniform(*FIELD_OF_VIEW_DEG)),
        "image_size": sizes[int(random.integers(len(sizes)))],
        "fps": float(random.uniform(5.0, 30.0)),
    }


def rolled(camera: PinholeCamera, roll_rad: float) -> PinholeCamera:
    """The same camera, turned about its optical axis."""
    width, height = camera.image_size
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    middle = np.array([[1.0, 0.0, width / 2], [0.0, 1.0, height / 2], [0.0, 0.0, 1.0]])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    matrix = middle @ turn @ np.linalg.inv(middle) @ camera.matrix
    return PinholeCamera(matrix, camera.centre_m, camera.focal_px, camera.image_size, camera.lens)


def behind_lens(camera: PinholeCamera, share: float) -> PinholeCamera:
    """The same camera with a barrel distortion, `share` of the strongest."""
    width, height = camera.image_size
    corner = 0.25 * (width**2 + height**2) / camera.focal_px**2
    k1 = -share * min(DISTORTION, FOLD / corner)
    focal, middle = camera.focal_px, (width / 2, height / 2)
    return replace(camera, lens=Lens(focal, focal, *middle, camera.image_size, k1))


def watch(
    seed: int, duration_s: float, fleet_spread: float = FLEET, distorted: bool = False
) -> Watched:
    """Let traffic drive through a scene and see it with the camera's detector and tracker."""
    scene = calibration_scene(seed)
    placed = place_roads(scene)
    random = np.random.default_rng([seed, 22])
    roll = math.radians(ROLL_SIGMA_DEG) * float(np.clip(random.standard_normal(), -2.5, 2.5))
    fleet = 1.0 + fleet_spread * float(random.uniform(-1.0, 1.0))
    upright = scene_camera(scene, placed)
    camera = rolled(upright, roll)
    if distorted:
        camera = behind_lens(camera, float(np.random.default_rng([seed, 23]).uniform()))
    record = simulate_traffic(scene, placed, duration_s, seed)
    record.vehicle_sizes[:] *= fleet
    traffic, model = MovingTraffic(record, scene, seed), DetectorModel(camera, scene.detector, seed)
    found = []
    for k in range(int(duration_s * scene.camera.fps)):
        time_s = k / scene.camera.fps
        rows, _ = model.detect(time_s, traffic.at(time_s)[0])
        found.append((START_NS + round(time_s * 1e9), rows))
    axis = upright.matrix[2, :3]
    tilt = math.degrees(math.asin(-axis[2] / float(np.linalg.norm(axis))))
    return Watched(
        scene.name,
        join_frames(found, PIXEL_TRACK_DTYPE),
        camera,
        scene.camera.height_m,
        tilt,
        scene.camera.horizontal_fov_deg,
        math.degrees(roll),
        fleet,
    )
