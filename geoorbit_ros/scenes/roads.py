"""Road geometry of a scene: left borders from pieces, lanes as offsets, lanes end to end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.road_plan import Bend, LaneRef, Road
from geoorbit_ros.scenes.scene import Scene

STEP_M = 2.0
"""Spacing of border points; at 12 m radius the chord is 4 cm off the arc."""

LaneKey = tuple[str, int]
"""Road id and lane index, 0 the rightmost."""


@dataclass(frozen=True, slots=True)
class PlacedRoad:
    """A road in the map frame.

    Attributes:
        road: Its description.
        width_m: Width of each lane.
        border_m: (K, 2) left border in travel order.
        heading_rad: (K,) at each point, counter-clockwise from east.
    """

    road: Road
    width_m: float
    border_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]

    def offset(self, right_m: float) -> NDArray[np.float64]:
        """(K, 2) line `right_m` to the right of the left border."""
        normal = np.column_stack([np.sin(self.heading_rad), -np.cos(self.heading_rad)])
        return np.asarray(self.border_m + right_m * normal)

    def centerline(self, lane: int) -> NDArray[np.float64]:
        """(K, 2) middle of a lane; 0 is the rightmost."""
        return self.offset((self.road.lanes - lane - 0.5) * self.width_m)

    def point(self, along_m: float, right_m: float) -> NDArray[np.float64]:
        """(2,) point `along_m` down the road, `right_m` to the right of its left border."""
        step = np.hypot(*np.diff(self.border_m, axis=0).T)
        arc = np.append(0.0, np.cumsum(step))
        line = self.offset(right_m)
        return np.array([np.interp(along_m, arc, line[:, k]) for k in range(2)])


def place_roads(scene: Scene) -> dict[str, PlacedRoad]:
    """All roads of a scene in map coordinates."""
    placed: dict[str, PlacedRoad] = {}
    waiting = list(scene.roads)
    while waiting:  # ends: a scene's roads form no circle (scene_rules)
        ready = [road for road in waiting if road.anchor in (None, *placed)]
        for road in ready:
            placed[road.id] = _place(road, placed, road.lane_width_m or scene.lane_width_m)
        waiting = [road for road in waiting if road.id not in placed]
    return placed


def successors(placed: dict[str, PlacedRoad]) -> dict[LaneKey, list[LaneKey]]:
    """Lanes that each lane leads into, the straight continuation first."""
    after: dict[LaneKey, list[LaneKey]] = {
        (name, lane): [] for name, p in placed.items() for lane in range(p.road.lanes)
    }
    for name, place in placed.items():
        road = place.road
        if road.follows:
            before = placed[road.follows].road.lanes
            for lane in range(road.lanes):
                source = before - road.lanes + lane
                if source >= 0:
                    after[road.follows, source].insert(0, (name, lane))
        for lane in range(road.lanes):
            if road.leaves:
                after[road.leaves.road, road.leaves.lane + lane].append((name, lane))
            if road.joins:
                after[name, lane].append((road.joins.road, road.joins.lane + lane))
    return after


def lane_chains(placed: dict[str, PlacedRoad]) -> list[list[LaneKey]]:
    """Lanes joined end to end: a lane continues straight on; a branch begins where it leaves."""
    after = successors(placed)
    first_choice = {lane: nexts[0] for lane, nexts in after.items() if nexts}
    continued: dict[LaneKey, LaneKey] = {}
    for lane, follower in first_choice.items():
        # Two lanes into one: the road itself continues, the ramp ends. A ramp comes later in
        # `placed`, because it is placed at the road that it joins.
        if follower not in continued.values():
            continued[lane] = follower
    begins = [lane for lane in after if lane not in continued.values()]
    chains = []
    for begin in begins:
        chain = [begin]
        while chain[-1] in continued:
            chain.append(continued[chain[-1]])
        chains.append(chain)
    return chains


def _place(road: Road, placed: dict[str, PlacedRoad], width_m: float) -> PlacedRoad:
    if road.opposite:
        other = placed[road.opposite.road]
        border = other.offset(-road.opposite.median_m)[::-1]
        return PlacedRoad(road, width_m, border, other.heading_rad[::-1] + np.pi)
    border, heading = _trace(road)
    if road.start:
        at = np.array([road.start.x_m, road.start.y_m])
        direction, pivot = np.radians(90.0 - road.start.heading_deg), 0
    elif road.follows:
        before = placed[road.follows]
        at, direction, pivot = before.border_m[-1], before.heading_rad[-1], 0
    else:
        ref, end = (road.leaves, -1) if road.leaves else (road.joins, 0)
        assert ref is not None  # the scene's validation saw to it
        other = placed[ref.road]
        at = other.offset(_left_offset_m(road, ref, other))[end]
        direction, pivot = other.heading_rad[end], 0 if road.leaves else -1
    turn = direction - heading[pivot]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return PlacedRoad(road, width_m, (border - border[pivot]) @ rotation.T + at, heading + turn)


def _left_offset_m(road: Road, ref: LaneRef, other: PlacedRoad) -> float:
    """How far right of the left border of `other` that of `road` is, at the lane `ref`."""
    leftmost = ref.lane + road.lanes - 1
    return (other.road.lanes - 1 - leftmost) * other.width_m


def _trace(road: Road) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Border from the origin towards east, and headings."""
    heading, steps = [0.0], []
    for piece in road.path:
        if isinstance(piece, Bend):
            turn = np.radians(piece.turn_deg)
            length = piece.radius_m * abs(turn)
        else:
            turn, length = 0.0, piece.straight_m
        count = max(1, int(np.ceil(length / STEP_M)))
        for _ in range(count):
            heading.append(heading[-1] + turn / count)
            # The chord of an arc points along its mean heading and is a little shorter.
            half = 0.5 * abs(turn) / count
            chord = length / count * (np.sin(half) / half if half > 0 else 1.0)
            middle = 0.5 * (heading[-1] + heading[-2])
            steps.append([chord * np.cos(middle), chord * np.sin(middle)])
    border = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return border, np.array(heading)
