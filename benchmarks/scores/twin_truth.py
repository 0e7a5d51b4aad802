"""The twin against traffic that is known exactly: which vehicles are in their true lane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.scenes.simulate import START_NS
from geoorbit_ros.scenes.traffic import STEP_S, TrafficRecord
from geoorbit_ros.twin.placement import TwinStep

CROSSING_S = 1.0
"""This long before and after a lane change a body of 1.8 m stands on the line between two lanes:
SUMO's change of `traffic.LANE_CHANGE_S` moves it by a lane's width in four seconds."""
ALONG_M = 6.0
"""Within this distance along the road, a vehicle of the twin belongs to a true one; farther off it
is a false track. Chosen: about a car and its error."""
ACROSS_M = 1.7
"""The same across the road. Chosen: half a lane."""
PASSES_MPS = 10.0
"""A vehicle of the twin whose velocity differs by this from that of the true vehicle beside it is
not its double: it stands where the true one drives by, and is false. Its positions decide, not its
track, whose speed may be wrong at first. Chosen: more than the errors of speed, less than that of
traffic."""


@dataclass(slots=True)
class LaneCount:
    """Vehicle steps by their lane.

    Attributes:
        right, wrong: In the true lane, in another one; away from true changes of lane.
        crossing_right, crossing_wrong: Within `CROSSING_S` of one.
    """

    right: int = 0
    wrong: int = 0
    crossing_right: int = 0
    crossing_wrong: int = 0

    @property
    def share(self) -> float:
        """Right ones of the vehicles that don't cross a line."""
        return self.right / max(self.right + self.wrong, 1)

    @property
    def share_with_crossings(self) -> float:
        """Right ones of all vehicles, also of those that stand on the line between two lanes."""
        right = self.right + self.crossing_right
        return right / max(right + self.wrong + self.crossing_wrong, 1)


@dataclass(slots=True)
class LaneScore(LaneCount):
    """Vehicle steps, counted.

    Attributes:
        false_tracks: Of vehicles that belong to no true one.
        doubled: Of vehicles beyond the first that are the same true one's, and move as it does.
    """

    false_tracks: int = 0
    doubled: int = 0


class LaneTruth:
    """Counts steps of a twin of a scene's traffic.

    Args:
        record: The scene's traffic.
        network: The scene's own network.
    """

    def __init__(self, record: TrafficRecord, network: RoadNetwork) -> None:
        self.score = LaneScore()
        self._record, self._network = record, network
        names = [f"{road}_{lane}" for road, lane in record.lane_names]
        self._lane = np.array([network.number[name] for name in names] + [NO_LANE])
        self._crossing = self._find_crossings()
        self._before: tuple[int, dict[int, NDArray[np.float64]]] = (0, {})

    def count(self, step: TwinStep) -> None:
        """Count one step's vehicles that a camera sees; those inside junctions are left out."""
        record = self._record
        number = round((step.stamp_ns - START_NS) * 1e-9 / STEP_S)
        now = slice(*np.searchsorted(record.step, [number, number + 1]))
        heading = record.heading[now]
        seen = np.flatnonzero(step.observed & np.isfinite(step.xy[:, 0]))
        if not len(heading):
            self.score.false_tracks += len(seen)
            return
        gap = step.xy[seen][:, None] - record.xy[now][None]
        along = gap[..., 0] * np.cos(heading) + gap[..., 1] * np.sin(heading)
        across = gap[..., 1] * np.cos(heading) - gap[..., 0] * np.sin(heading)
        distance = np.hypot(along / ALONG_M, across / ACROSS_M)
        nearest = np.argmin(distance, axis=1)
        known = distance[np.arange(len(seen)), nearest] < 1.0
        self.score.false_tracks += int(np.count_nonzero(~known))
        way = np.column_stack((np.cos(heading), np.sin(heading)))
        velocity = (record.speed[now][:, None] * way)[nearest]
        otherwise = np.hypot(*(self._velocity(step)[seen] - velocity).T)
        along_with = known & ~(otherwise >= PASSES_MPS)
        self.score.doubled += int(along_with.sum()) - len(np.unique(nearest[along_with]))
        true_lane = self._lane[record.lane[now]][nearest[known]]
        lane = step.lane[seen[known]]
        inside = (lane != NO_LANE) & self._network.internal[np.maximum(lane, 0)]
        counted = (true_lane != NO_LANE) & ~inside
        right = lane == true_lane
        crossing = self._crossing[now][nearest[known]]
        self.score.right += int(np.count_nonzero(counted & right & ~crossing))
        self.score.wrong += int(np.count_nonzero(counted & ~right & ~crossing))
        self.score.crossing_right += int(np.count_nonzero(counted & right & crossing))
        self.score.crossing_wrong += int(np.count_nonzero(counted & ~right & crossing))

    def _velocity(self, step: TwinStep) -> NDArray[np.float64]:
        """(M, 2) from the places of this step and the one before; NaN for a vehicle that is new."""
        stamp_ns, places = self._before
        ids, nowhere = step.vehicle_id.tolist(), np.full(2, np.nan)
        before = np.array([places.get(v, nowhere) for v in ids]).reshape(-1, 2)
        self._before = step.stamp_ns, dict(zip(ids, step.xy, strict=True))
        return np.asarray((step.xy - before) / (1e-9 * (step.stamp_ns - stamp_ns)))

    def _find_crossings(self) -> NDArray[np.bool_]:
        """(N,) whether a row of the record is near a change of lane within a road."""
        record = self._record
        road = np.array([0, *(1 + k for k in self._road_numbers())])[record.lane + 1]
        flag = np.zeros(len(record.step), dtype=np.bool_)
        order = np.lexsort((record.step, record.vehicle))
        vehicle, lane, step = record.vehicle[order], record.lane[order], record.step[order]
        same = (vehicle[1:] == vehicle[:-1]) & (road[order][1:] == road[order][:-1])
        changes = np.flatnonzero(same & (lane[1:] != lane[:-1]) & (lane[1:] >= 0)) + 1
        reach = round(CROSSING_S / STEP_S)
        for k in changes.tolist():
            near = (vehicle == vehicle[k]) & (np.abs(step - step[k]) <= reach)
            flag[order[near]] = True
        return flag

    def _road_numbers(self) -> list[int]:
        roads = sorted({road for road, _ in self._record.lane_names})
        return [roads.index(road) for road, _ in self._record.lane_names]
