"""What the parts of a scene must agree on, checked when a scene is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoorbit_ros.storage.yaml_file import Key, WrongValue

if TYPE_CHECKING:
    from geoorbit_ros.scenes.road_plan import Road, RoadPoint
    from geoorbit_ros.scenes.scene import Flow, Scene


def check_scene(scene: Scene) -> None:
    """Raise `WrongValue` for the first contradiction."""
    roads: dict[str, Road] = {}
    for k, road in enumerate(scene.roads):
        if road.id in roads:
            raise WrongValue(("roads", k, "id"), f"'{road.id}' again", "an id of its own")
        roads[road.id] = road
    for k, road in enumerate(scene.roads):
        _check_anchor(("roads", k), road, roads)
    for k, road in enumerate(scene.roads):
        _check_circle(("roads", k), road, roads)
        _check_bends(("roads", k), road, scene)
    if sum(scene.traffic.mix.values()) <= 0.0:
        raise WrongValue(("traffic", "mix"), "no share above 0", "shares of vehicle types")
    for k, flow in enumerate(scene.traffic.flows):
        _check_flow(("traffic", "flows", k), flow, roads)
    for name in ("pole", "look_at"):
        _check_point(("camera", name), getattr(scene.camera, name), roads)
    if scene.camera.pole == scene.camera.look_at:
        raise WrongValue(("camera", "look_at"), "the place of the pole", "a point beside it")


def road_length_m(road: Road, roads: dict[str, Road]) -> float:
    """Length of a road's left border."""
    source, median = (
        (roads[road.opposite.road], road.opposite.median_m) if road.opposite else (road, 0.0)
    )
    return sum(piece.length_m(median) for piece in source.path)


def _known(key: Key, name: str, roads: dict[str, Road]) -> Road:
    if name not in roads:
        raise WrongValue(key, f"'{name}'", f"one of the roads {', '.join(roads)}")
    return roads[name]


def _check_anchor(key: Key, road: Road, roads: dict[str, Road]) -> None:
    if road.follows:
        _known((*key, "follows"), road.follows, roads)
    if road.opposite:
        other = _known((*key, "opposite", "road"), road.opposite.road, roads)
        if other.opposite:
            raise WrongValue(
                (*key, "opposite", "road"),
                f"'{other.id}', itself an opposite",
                "a road with a path",
            )
    for name in ("leaves", "joins"):
        ref = getattr(road, name)
        if ref is None:
            continue
        lanes = _known((*key, name, "road"), ref.road, roads).lanes
        if ref.lane + road.lanes > lanes:
            wanted = f"lane 0 to {lanes - road.lanes} of '{ref.road}', which has {lanes}"
            beside = "" if road.lanes == 1 else f", with {road.lanes} lanes side by side"
            expected = wanted + beside if road.lanes <= lanes else f"a road of {road.lanes} lanes"
            raise WrongValue((*key, name, "lane"), ref.lane, expected)


def _check_circle(key: Key, road: Road, roads: dict[str, Road]) -> None:
    chain = [road.id]
    while (anchor := roads[chain[-1]].anchor) is not None:
        if anchor in chain:
            circle = " → ".join([*chain[chain.index(anchor) :], anchor])
            raise WrongValue(key, f"roads in a circle: {circle}", "a road with 'start' among them")
        chain.append(anchor)


def _check_bends(key: Key, road: Road, scene: Scene) -> None:
    """No lane folds over: a bend's centre is outside of the road and its other carriageway."""
    default = scene.lane_width_m
    right = road.lanes * (road.lane_width_m or default)
    left = max(
        (
            other.opposite.median_m + other.lanes * (other.lane_width_m or default)
            for other in scene.roads
            if other.opposite and other.opposite.road == road.id
        ),
        default=0.0,
    )
    for k, piece in enumerate(road.path):
        inside = left if piece.turn_deg > 0 else right
        if piece.radius_m <= inside:
            raise WrongValue(
                (*key, "path", k, "radius_m"),
                f"{piece.radius_m:g}",
                f"more than the {inside:g} m of road inside the bend",
            )


def _check_flow(key: Key, flow: Flow, roads: dict[str, Road]) -> None:
    for k, name in enumerate(flow.route):
        road = _known((*key, "route", k), name, roads)
        if k == 0:
            continue
        before = roads[flow.route[k - 1]]
        leaves = road.leaves is not None and road.leaves.road == before.id
        joins = before.joins is not None and before.joins.road == name
        if not (road.follows == before.id or leaves or joins):
            raise WrongValue(
                (*key, "route", k), f"'{name}'", f"a road that begins where '{before.id}' ends"
            )
    first, last = roads[flow.route[0]], roads[flow.route[-1]]
    shares = flow.lane_shares
    if shares is not None and (len(shares) != first.lanes or sum(shares) <= 0.0):
        raise WrongValue(
            (*key, "lane_shares"),
            shares,
            f"{first.lanes} shares, one per lane of '{first.id}', not all 0",
        )
    if flow.arrival_lane is not None and flow.arrival_lane >= last.lanes:
        raise WrongValue(
            (*key, "arrival_lane"), flow.arrival_lane, f"0 to {last.lanes - 1} on '{last.id}'"
        )


def _check_point(key: Key, point: RoadPoint, roads: dict[str, Road]) -> None:
    length = road_length_m(_known((*key, "road"), point.road, roads), roads)
    if point.along_m > length:
        raise WrongValue(
            (*key, "along_m"), f"{point.along_m:g}", f"0 to {length:.1f}, the end of '{point.road}'"
        )
