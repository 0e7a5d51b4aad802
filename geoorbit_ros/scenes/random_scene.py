"""Scenes drawn at random: roadside cameras as varied as the roads of a country, for large studies.

A drawn scene is an ordinary `Scene`: it can be written as YAML, simulated and scored like one that
a person wrote.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.scenes.random_roads import (
    BEFORE_M,
    opposite_curve,
    random_carriageway,
    random_curve,
)
from geoorbit_ros.scenes.roads import PlacedRoad, lane_chains, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.scenes.truth import visible_lanes

SIDE_FRICTION_MPS2 = 1.5
"""Comfortable lateral acceleration: tight bends are driven slowly (AASHTO Green Book, 3.3)."""
SEEN_M = 40.0
"""A lane is seen when the camera sees this much of it. Chosen: twice the least of `truth`."""
SEEN_SHARE = 0.75
"""Share of the lanes that a camera must see. Chosen: more finds no place for wide junctions."""
MIN_CONTROL_POINTS = 8
"""Control points that must be in view. Chosen: twice the four that a homography needs."""
TRIES = 200
"""Places that are drawn before giving up. Measured: enough for all seeds below 1000."""


class RandomSceneError(GeoOrbitError):
    """No camera place could be drawn from which the road can be seen."""


def random_scene(seed: int) -> Scene:
    """A scene with everything about it drawn at random; the same seed gives the same scene.

    Any heading; one to five lanes, with an opposite carriageway of one to five in most scenes;
    straights, bends of 150 m radius and more, S-bends; lanes of 3.0 to 3.8 m, medians up to 12 m;
    in a fifth of the scenes a ramp that joins or leaves, a lane that ends or begins; 150 to 1800
    vehicles per hour and lane, up to 35 % of them large; a camera 7 to 20 m high, 8 to 40 m beside
    the road on either side, 45 to 90 degrees wide, 1280x720 to 3840x2160, 5 to 30 frames per
    second; a detector half to twice as noisy as the default one.

    A camera is placed as a person would place it: three quarters of the lanes are seen over at
    least `SEEN_M`, and control points can be taken.

    Args:
        seed: Any non-negative number.

    Raises:
        RandomSceneError: `TRIES` cameras all see too little; no seed below 1000 does this.
    """
    random = np.random.default_rng([seed, 6])
    draft, left_m = _draft(random, seed)
    placed: dict[str, PlacedRoad] = {}
    for _ in range(TRIES):
        camera = _camera(random, draft["roads"], draft["lane_width_m"], left_m)
        scene = Scene.model_validate({**draft, "camera": camera})
        placed = placed or place_roads(scene)
        if _usable(scene, placed, seed):
            return scene
    raise RandomSceneError(f"random scene {seed}", f"{TRIES} useless cameras", "one that sees")


def _usable(scene: Scene, placed: dict[str, PlacedRoad], seed: int) -> bool:
    camera = scene_camera(scene, placed)
    seen = [lane for lane in visible_lanes(placed, camera) if lane.lane.length_m >= SEEN_M]
    if len(seen) < SEEN_SHARE * len(lane_chains(placed)):
        return False
    datum = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
    return len(survey_control_points(placed, camera, datum, seed)) >= MIN_CONTROL_POINTS


def _draft(random: np.random.Generator, seed: int) -> tuple[dict[str, Any], float]:
    """Everything but a camera; how far the roads reach to the left of the main left border."""
    lanes, width = int(random.integers(1, 6)), float(random.uniform(3.0, 3.8))
    curve = random_curve(random)
    sharpest = max(abs(curvature) for _, curvature in curve)
    limit = float(random.choice([50.0, 70.0, 80.0, 100.0, 120.0]))
    speed = min(limit, 3.6 * math.sqrt(SIDE_FRICTION_MPS2 / max(sharpest, 1e-6)))
    events = ("join", "leave", "end", "begin") if lanes > 1 and sharpest < 1 / 400 else ()
    event = str(random.choice(events)) if events and random.uniform() < 0.5 else ""
    start = {"x_m": 0.0, "y_m": 0.0, "heading_deg": float(random.uniform(0, 360))}
    roads, flows = random_carriageway(random, "main", lanes, speed, curve, start, event)
    median = float(random.uniform(0.0, 12.0)) if random.uniform() < 0.65 else None
    left_m = 0.0
    if median is not None:
        count = int(np.clip(lanes + random.integers(-1, 2), 1, 5))
        mirrored, beginning = opposite_curve(curve, start, median)
        back, counterflows = random_carriageway(
            random, "back", count, speed, mirrored, beginning, ""
        )
        roads, flows = roads + back, flows + counterflows
        left_m = median + count * width
    trucks = float(random.uniform(0.0, 0.35))
    noise = float(np.exp(random.uniform(np.log(0.5), np.log(2.0))))
    draft = {
        "name": f"random_{seed}",
        "description": f"Drawn at random with seed {seed}.",
        "place": {
            "latitude_deg": float(random.uniform(-60, 60)),
            "longitude_deg": float(random.uniform(-180, 180)),
        },
        "lane_width_m": width,
        "roads": roads,
        "traffic": {
            "flows": flows,
            "mix": {
                "car": 0.7 * (1.0 - trucks),
                "suv": 0.22 * (1.0 - trucks),
                "van": 0.08 * (1.0 - trucks),
                "truck": 0.6 * trucks,
                "semitrailer": 0.3 * trucks,
                "bus": 0.1 * trucks,
            },
            "driver_offset_sigma_m": float(random.uniform(0.1, 0.3)),
            "wander_sigma_m": float(random.uniform(0.05, 0.2)),
            "keep_right": float(random.choice([0.0, 0.0, 1.0])),
            "early_lane_change": float(random.choice([0.1, 0.3, 1.0])),
        },
        "detector": {
            "edge_noise_px": 0.8 * noise,
            "edge_noise_share": 0.02 * noise,
            "miss_rate": 0.03 * noise,
        },
    }
    return draft, left_m


def _camera(
    random: np.random.Generator, roads: list[dict[str, Any]], lane_width_m: float, left_m: float
) -> dict[str, Any]:
    """A camera beside the roads that looks at their middle."""
    right_m = roads[0]["lanes"] * lane_width_m
    look_m = BEFORE_M + float(random.uniform(-30.0, 30.0))
    pole_m = look_m + float(random.uniform(20.0, 90.0) * random.choice([-1.0, 1.0]))
    lateral = float(random.uniform(8.0, 40.0))
    beside = right_m + lateral if random.uniform() < 0.5 else -left_m - lateral
    sizes = [[1280, 720], [1920, 1080], [3840, 2160]]
    return {
        "pole": _point(roads, pole_m, beside),
        "height_m": float(random.uniform(7.0, 20.0)),
        "look_at": _point(roads, look_m, 0.5 * (right_m - left_m)),
        "horizontal_fov_deg": float(random.uniform(45.0, 90.0)),
        "image_size": sizes[int(random.integers(len(sizes)))],
        "fps": float(random.uniform(5.0, 30.0)),
    }


def _point(roads: list[dict[str, Any]], along_m: float, right_m: float) -> dict[str, Any]:
    """A point beside the main carriageway, seen from that of its roads which it lies beside."""
    part = roads[0]
    for road in roads:
        length = sum(_length_m(piece) for piece in road["path"])
        part = road
        if along_m < length:
            break
        along_m -= length
    return {"road": part["id"], "along_m": along_m, "right_m": right_m}


def _length_m(piece: dict[str, float]) -> float:
    if "straight_m" in piece:
        return piece["straight_m"]
    return piece["radius_m"] * math.radians(abs(piece["turn_deg"]))
