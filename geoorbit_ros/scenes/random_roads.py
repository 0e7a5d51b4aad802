"""Roads drawn at random for random scenes: their curves, lanes, ramps and traffic flows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

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
