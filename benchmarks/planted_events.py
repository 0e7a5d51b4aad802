"""Events planted in the traffic of scenes, and what the camera's tracks show of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.scenes.roads import PlacedRoad, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import START_NS, SceneRun, scene_camera, simulate
from geoorbit_ros.scenes.traffic import STEP_S, Halt, TrafficRecord, simulate_traffic
from geoorbit_ros.scenes.truth import VisibleLane, visible_lanes

Array = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)

WHERE = 0.5
"""Vehicles halt at this share of the lane in view."""
SEEN_M = 45.0
"""Events are planted in lanes that are seen over this length."""
SLOW_MPS = 2.8
"""Who waits or creeps is slower."""


@dataclass(frozen=True, slots=True)
class Planted:
    """One scene run with an event in it.

    Attributes:
        run: The run.
        tracks: Ground tracks, as the camera's boxes give them.
        lane_ids: The lanes in which the event is; empty: it did not come about.
        place_m: Where it is, NaN for all along the lane.
        begin_s, end_s: When.
        record: The traffic.
    """

    run: SceneRun
    tracks: Frames
    lane_ids: tuple[int, ...]
    place_m: tuple[float, float]
    begin_s: float
    end_s: float
    record: TrafficRecord


def ground_tracks(run: SceneRun) -> Frames:
    """The run's boxes on the road, by a calibration with the surveyor's errors."""
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    return projector.project_block(run.frames)


def at_rate(scene: Scene, fps: float) -> Scene:
    """The scene with at most so many frames per second."""
    camera = scene.camera.model_copy(update={"fps": min(fps, scene.camera.fps)})
    return scene.model_copy(update={"camera": camera})


def lanes_in_view(scene: Scene) -> tuple[dict[str, PlacedRoad], list[VisibleLane]]:
    """The roads, and the lanes on which an event can be planted."""
    placed = place_roads(scene)
    lanes = visible_lanes(placed, scene_camera(scene, placed))
    return placed, lanes


def long_enough(lanes: list[VisibleLane]) -> list[int]:
    """Numbers of those that are seen over `SEEN_M`, or else of the longest."""
    found = [k for k, lane in enumerate(lanes) if lane.lane.length_m >= SEEN_M]
    return found or [int(np.argmax([lane.lane.length_m for lane in lanes]))]


def halt_at(
    placed: dict[str, PlacedRoad], seen: VisibleLane, point: Array, time_s: float, lasts_s: float
) -> Halt:
    """A vehicle that stops at a point of a lane."""
    near = [
        float(np.abs(_nearest(placed[road].centerline(lane), point))) for road, lane in seen.chain
    ]
    road, lane = seen.chain[int(np.argmin(near))]
    return Halt(float(point[0]), float(point[1]), road, lane, time_s, lasts_s)


def _nearest(line: Array, point: Array) -> float:
    at = project(point[None], line)
    return float(np.abs(at.offset_m[0])) + (0.0 if at.inside[0] else 1.0)


def point_of(lane: Lane, share: float) -> Array:
    """The point at a share of a lane."""
    step = np.hypot(*np.diff(lane.centerline_m, axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    return np.array([np.interp(share * arc[-1], arc, lane.centerline_m[:, k]) for k in (0, 1)])


def finish(
    scene: Scene,
    record: TrafficRecord,
    duration_s: float,
    seed: int,
    lane_ids: Sequence[int],
    place_m: tuple[float, float],
    span_s: tuple[float, float],
) -> Planted:
    """Film the traffic."""
    run = simulate(scene, duration_s, seed, traffic_record=record)
    return Planted(run, ground_tracks(run), tuple(lane_ids), place_m, *span_s, record)


def standing(record: TrafficRecord, point: Array, reach_m: float) -> tuple[float, float] | None:
    """When the vehicle that stands longest near a point stands there."""
    near = (np.hypot(*(record.xy - point).T) < reach_m) & (record.speed < 0.1)
    vehicles, count = np.unique(record.vehicle[near], return_counts=True)
    if not len(vehicles):
        return None
    steps = record.step[near & (record.vehicle == vehicles[count.argmax()])]
    return float(steps.min() * STEP_S), float(steps.max() * STEP_S)


def stopped_car(scene: Scene, seed: int) -> Planted:
    """A vehicle stops in a lane for four minutes; the others change lanes, or wait behind it."""
    random = np.random.default_rng([seed, 21])
    placed, lanes = lanes_in_view(scene)
    k = int(random.choice(long_enough(lanes)))
    point = point_of(lanes[k].lane, WHERE)
    duration_s = 330.0
    halt = halt_at(placed, lanes[k], point, 80.0, 220.0)
    record = simulate_traffic(scene, placed, duration_s, seed, [halt])
    span = standing(record, point, 12.0)
    ids = [lanes[k].lane.lane_id] if span and span[1] - span[0] > 150.0 else []
    place = (float(point[0]), float(point[1]))
    return finish(scene, record, duration_s, seed, ids, place, span or (0.0, 0.0))


def queue(scene: Scene, seed: int) -> Planted:
    """All lanes of a direction are stopped for two minutes, as by a red light."""
    random = np.random.default_rng([seed, 22])
    placed, lanes = lanes_in_view(scene)
    k = int(random.choice(long_enough(lanes)))
    heading = lanes[k].lane.middle[2]
    duration_s = 240.0
    halts = []
    for seen in lanes:
        if np.cos(seen.lane.middle[2] - heading) > 0.5:
            point = point_of(seen.lane, 0.75)
            halts.append(halt_at(placed, seen, point, 80.0, 100.0))
    record = simulate_traffic(scene, placed, duration_s, seed, halts)
    planted = finish(scene, record, duration_s, seed, [], (np.nan, np.nan), (60.0, 230.0))
    return replace(planted, lane_ids=queued_lanes(planted.run))


HIDDEN_S = 4.0
"""A queue is the same one if the detector sees fewer than three for that long (`queues`)."""


def queued_lanes(run: SceneRun) -> tuple[int, ...]:
    """Lanes in which the detector sees one queue for 15 s, without the times that it is hidden."""
    return tuple(lane.lane_id for lane in run.truth if true_queue(run, lane)[1] >= 15.0)


def true_queue(run: SceneRun, lane: Lane) -> tuple[dict[float, float], float]:
    """Tail along the lane by time, while the detector sees three who wait; for how long at most."""
    rows = run.clean.rows
    place = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    at = project(place, lane.centerline_m)
    waits = at.inside & (np.abs(at.offset_m) < 1.2) & (np.hypot(rows["vx"], rows["vy"]) < SLOW_MPS)
    order = np.flatnonzero(waits)
    stamps = run.clean.row_stamp_ns()[order]
    bounds = np.flatnonzero(np.diff(stamps, prepend=-1, append=-1))
    tails: dict[float, float] = {}
    for a, b in pairwise(bounds.tolist()):
        half, arc = 0.5 * rows["length"][order[a:b]], at.arc_m[order[a:b]]
        by_place = np.argsort(-arc)
        rear, front = (arc - half)[by_place], (arc + half)[by_place]
        joined = np.append(True, rear[:-1] - front[1:] < 12.0)
        count = len(arc) if joined.all() else int(np.argmin(joined))
        if count >= 3:
            tails[float(stamps[a] - START_NS) * 1e-9] = float(rear[count - 1])
    begin = np.flatnonzero(np.diff(list(tails), prepend=-np.inf) > HIDDEN_S)
    frames = np.diff(np.append(begin, len(tails)))
    return tails, int(frames.max(initial=0)) / run.scene.camera.fps


RIGHT_WAY = 5
"""So many vehicles drove in the lane, or beside it, before one drives backwards: from fewer nobody
knows which way a lane leads (`wrong_way.WITH_VEHICLES`)."""


def wrong_way(scene: Scene, seed: int) -> Planted:
    """A vehicle drives the path of another one backwards."""
    random = np.random.default_rng([seed, 23])
    placed, lanes = lanes_in_view(scene)
    duration_s = 150.0
    record = simulate_traffic(scene, placed, duration_s, seed)
    candidates = long_enough(lanes)
    early = (record.step >= 0) & (record.step < 900)
    for k in random.permutation(candidates).tolist():
        lane = lanes[k].lane
        if sum(_passing(record, lanes, k, early)) < RIGHT_WAY:
            continue
        at = project(record.xy, lane.centerline_m)
        inside = at.inside & (np.abs(at.offset_m) < 1.0)
        inside &= (record.step > 900) & (record.step < 1400)
        vehicles = np.unique(record.vehicle[inside])
        moved = [np.ptp(at.arc_m[inside & (record.vehicle == v)]) for v in vehicles.tolist()]
        good = np.flatnonzero(np.array(moved) > 0.9 * lane.length_m)
        if not len(good):
            continue
        chosen = int(vehicles[random.choice(good)])
        seen = record.step[inside & (record.vehicle == chosen)]
        edited = backwards(record, chosen, int((seen.min() + seen.max()) // 2))
        span = float(seen.min() * STEP_S) - 2.0, float(seen.max() * STEP_S) + 8.0
        return finish(scene, edited, duration_s, seed, [lane.lane_id], (np.nan, np.nan), span)
    return finish(scene, record, duration_s, seed, [], (np.nan, np.nan), (0.0, 0.0))


def backwards(record: TrafficRecord, vehicle: int, middle: int) -> TrafficRecord:
    """The record with one vehicle's path driven from its end to its beginning, about a step.

    Somebody else drives it, and the first one isn't there: they would meet.
    """
    rows = np.flatnonzero(record.vehicle == vehicle)
    back = 2 * middle - record.step[rows]
    rows, back = rows[back >= 0], back[back >= 0]
    order = np.argsort(np.concatenate((record.step, back)), kind="stable")

    def with_it(old: NDArray[Scalar], more: NDArray[Scalar]) -> NDArray[Scalar]:
        return np.concatenate((old, more))[order]

    other_way = (record.heading[rows] + 2 * np.pi) % (2 * np.pi) - np.pi
    edited = replace(
        record,
        step=with_it(record.step, back),
        vehicle=with_it(record.vehicle, np.full(len(rows), len(record.vehicle_types))),
        xy=with_it(record.xy, record.xy[rows]),
        heading=with_it(record.heading, other_way),
        speed=with_it(record.speed, record.speed[rows]),
        lane=with_it(record.lane, np.full(len(rows), -1)),
        vehicle_types=[*record.vehicle_types, record.vehicle_types[vehicle]],
        vehicle_sizes=np.concatenate((record.vehicle_sizes, record.vehicle_sizes[vehicle][None])),
    )
    return without(edited, edited.vehicle == vehicle)


def without(record: TrafficRecord, rows: NDArray[np.bool_]) -> TrafficRecord:
    """The record without some rows."""
    kept = {
        name: getattr(record, name)[~rows]
        for name in ("step", "vehicle", "xy", "heading", "speed", "lane")
    }
    return replace(record, **kept)


ENOUGH = 36
"""A lane is closed if so many drove in it in the first four minutes: its share is known by them."""
STAY_AWAY = 80
"""And if so many stay away then, by its share before, while as many drive beside it. Who sees every
vehicle needs 52 to be sure to what chance does once in ten years (`lane_flow.BY_CHANCE_S`)."""
FLOWS = 0.7
"""The lanes beside carry at least this share of their flow before. Who used the closed lane is
taken out of the traffic; where that were most of it, a road would be closed and no lane."""
OPEN_S, CLOSED_S = 240.0, 840.0


def closed_lane(scene: Scene, seed: int) -> Planted:
    """From 240 s on nobody drives in a lane that has others beside it."""
    random = np.random.default_rng([seed, 24])
    placed, lanes = lanes_in_view(scene)
    duration_s = OPEN_S + CLOSED_S
    record = simulate_traffic(scene, placed, duration_s, seed)
    begin = round(OPEN_S / STEP_S)
    options = [k for k in long_enough(lanes) if _beside(lanes, k)]
    for k in random.permutation(options).tolist():
        own, beside = _passing(record, lanes, k, record.step < begin)
        if own < ENOUGH or not beside:
            continue
        at = project(record.xy, lanes[k].lane.centerline_m)
        inside = at.inside & (np.abs(at.offset_m) < 0.5 * lanes[k].lane.width_m)
        gone = np.unique(record.vehicle[inside & (record.step >= begin)])
        rows = np.isin(record.vehicle, gone) & (record.step >= begin)
        early = np.unique(record.vehicle[rows & inside & (record.step < begin + 50)])
        edited = without(record, rows & ~np.isin(record.vehicle, early))
        _, then = _passing(edited, lanes, k, edited.step >= begin)
        if then / CLOSED_S < FLOWS * beside / OPEN_S:
            continue
        if min(own * then / beside, then) < STAY_AWAY:
            continue
        ids, span = [lanes[k].lane.lane_id], (OPEN_S, duration_s)
        return finish(scene, edited, duration_s, seed, ids, (np.nan, np.nan), span)
    return finish(scene, record, duration_s, seed, [], (np.nan, np.nan), (0.0, 0.0))


def _passing(
    record: TrafficRecord, lanes: list[VisibleLane], k: int, when: NDArray[np.bool_]
) -> tuple[int, int]:
    """How many pass the middle of a lane in it, and in those beside it."""
    middle = point_of(lanes[k].lane, 0.5)
    near = when & (np.hypot(*(record.xy - middle).T) < 10.0)
    place, vehicle = record.xy[near], record.vehicle[near]

    def within(j: int) -> NDArray[np.int64]:
        at = project(place, lanes[j].lane.centerline_m)
        return np.asarray(
            vehicle[at.inside & (np.abs(at.offset_m) < 0.5 * lanes[j].lane.width_m)], dtype=np.int64
        )

    own = np.unique(within(k))
    beside = np.unique(np.concatenate([own[:0], *(within(j) for j in _beside(lanes, k))]))
    return len(own), len(np.setdiff1d(beside, own))


def _beside(lanes: list[VisibleLane], k: int) -> list[int]:
    """Lanes next to one, the same way."""
    lane = lanes[k].lane
    return [
        j
        for j, other in enumerate(lanes)
        if j != k
        and np.cos(other.lane.middle[2] - lane.middle[2]) > 0.8
        and np.abs(_nearest(other.lane.centerline_m, point_of(lane, 0.5))) < 6.0
    ]


PLANTS = {
    "stopped": stopped_car,
    "wrong_way": wrong_way,
    "queue": queue,
    "lane_unused": closed_lane,
}
