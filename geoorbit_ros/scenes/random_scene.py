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
from geoorbit_ros.scenes.roads import PlacedRoad, lane_chains, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.scenes.truth import visible_lanes

BEFORE_M = 330.0
"""Road before the middle of the view. Chosen: vehicles are at speed when they come into it."""
AFTER_M = 330.0
"""Road after the middle of the view, where those of the other carriageway come from. Chosen: as
`BEFORE_M`."""
MAX_RADIUS_M = 5000.0
"""Largest radius that a scene file may give to a bend."""

Piece = tuple[float, float]
"""Length in metres and curvature to the left in 1/m."""


def random_curve(random: np.random.Generator) -> list[Piece]:
    """The road's left border: straight, one bend, or an S."""
    kind = random.choice(["straight", "bend", "s"], p=[0.3, 0.4, 0.3])
    total = BEFORE_M + AFTER_M
    if kind == "straight":
        return [(total, 0.0)]
    # Uniform in curvature: as many roads between 150 m and 300 m as between 300 m and straight.
    curvature = _at_least(
        float(random.uniform(1 / MAX_RADIUS_M, 1 / 150) * random.choice([-1.0, 1.0]))
    )
    length = min(float(random.uniform(60.0, 300.0)), math.radians(100.0) / abs(curvature))
    if kind == "bend":
        before = BEFORE_M - float(random.uniform(0.0, 1.0)) * length
        return [(before, 0.0), (length, curvature), (total - before - length, 0.0)]
    other = _at_least(-curvature * float(random.uniform(0.5, 1.0)))
    straight = BEFORE_M - length
    return [(straight, 0.0), (length, curvature), (length, other), (AFTER_M - length, 0.0)]


def _at_least(curvature: float) -> float:
    """The curvature, or the smallest of its sign that a bend on both sides of a median can have."""
    return math.copysign(max(abs(curvature), 1.02 / MAX_RADIUS_M), curvature)


def random_carriageway(
    random: np.random.Generator,
    name: str,
    lanes: int,
    speed_kmh: float,
    curve: list[Piece],
    start: dict[str, float],
    event: str,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Roads and flows of one direction, with at most one event near the middle of the view."""

    def road(suffix: str, count: int, pieces: list[Piece], **place: Any) -> dict[str, Any]:
        path, speed = [_piece(p) for p in pieces], speed_kmh
        return {"id": name + suffix, "lanes": count, "speed_kmh": speed, "path": path, **place}

    shares = random.dirichlet(np.full(lanes, 5.0)).tolist()
    per_hour = float(lanes * np.exp(random.uniform(np.log(150.0), np.log(1800.0))))
    flow = {"route": [name], "per_hour": per_hour, "lane_shares": shares}
    if not event:
        return [road("", lanes, curve, start=start)], [flow]
    at = BEFORE_M + float(random.uniform(-60.0, 60.0))
    if event in ("end", "begin"):
        first, second = _cut(curve, at)
        change = 1 if event == "begin" else -1
        # Without drivers who want to be in it, a lane that begins would stay empty.
        parts = [road("_a", lanes, first, start=start)]
        parts.append(road("_b", lanes + change, second, follows=parts[0]["id"]))
        flow["route"] = [part["id"] for part in parts]
        flows = [flow]
        if event == "begin":
            keen = {**flow, "per_hour": 0.4 * per_hour, "arrival_lane": 0}
            flows = [{**flow, "per_hour": 0.6 * per_hour}, keen]
        return parts, flows
    length = float(random.uniform(80.0, 220.0))
    first, rest = _cut(curve, at - length / 2)
    middle, last = _cut(rest, length)
    parts = [road("_a", lanes, first, start=start)]
    parts.append(road("_b", lanes + 1, middle, follows=parts[0]["id"]))
    parts.append(road("_c", lanes, last, follows=parts[1]["id"]))
    flow["route"] = [part["id"] for part in parts]
    away, turn = -1.0 / float(random.uniform(250.0, 900.0)), math.radians(random.uniform(5.0, 14.0))
    along = (middle if event == "join" else last)[0][1]
    bend, beside = (turn / abs(away), along + away), (150.0, along)
    ramp_flow = {"per_hour": float(random.uniform(150.0, 900.0))}
    if event == "join":
        ramp = road("_ramp", 1, [beside, bend], joins={"road": parts[1]["id"], "lane": 0})
        route = {"route": [ramp["id"], parts[1]["id"], parts[2]["id"]]}
    else:
        ramp = road("_ramp", 1, [bend, beside], leaves={"road": parts[1]["id"], "lane": 0})
        right = [0.7, 0.3] + [0.0] * (lanes - 2)
        route = {"route": [parts[0]["id"], parts[1]["id"], ramp["id"]], "lane_shares": right}
    return [*parts, ramp], [flow, {**ramp_flow, **route}]


def opposite_curve(
    curve: list[Piece], start: dict[str, float], median_m: float
) -> tuple[list[Piece], dict[str, float]]:
    """The line `median_m` to the left of a curve in the other direction, and where it starts."""
    at, heading = complex(start["x_m"], start["y_m"]), math.radians(90.0 - start["heading_deg"])
    for length, curvature in curve:
        turn = length * curvature
        chord = length * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        at += chord * np.exp(1j * (heading + turn / 2))
        heading += turn
    at += median_m * np.exp(1j * (heading + math.pi / 2))
    back = [(n * (1.0 - k * median_m), -k / (1.0 - k * median_m)) for n, k in reversed(curve)]
    bearing = (270.0 - math.degrees(heading)) % 360.0
    return back, {"x_m": float(at.real), "y_m": float(at.imag), "heading_deg": bearing}


def _piece(piece: Piece) -> dict[str, float]:
    """As a scene file writes it."""
    length, curvature = piece
    if abs(curvature) <= 1.0 / MAX_RADIUS_M:
        return {"straight_m": length}
    return {"radius_m": 1.0 / abs(curvature), "turn_deg": math.degrees(length * curvature)}


def _cut(curve: list[Piece], at_m: float) -> tuple[list[Piece], list[Piece]]:
    """The curve before and after arc length `at_m`; pieces of less than a metre are left out."""
    before: list[Piece] = []
    after: list[Piece] = []
    for length, curvature in curve:
        share = min(max(at_m, 0.0), length)
        before.append((share, curvature))
        after.append((length - share, curvature))
        at_m -= length
    return [p for p in before if p[0] >= 1.0], [p for p in after if p[0] >= 1.0]


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
