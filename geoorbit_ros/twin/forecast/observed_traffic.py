"""Demand for a forecast from what the twin saw in the last minutes.

Flows are counts: each vehicle once, where it crosses the counting station of its lanes
(`traffic.stations`).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.twin.forecast.counted_flows import count_ways
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.vehicles import TYPES

SAMPLE_NS = 500_000_000
"""Time between two samples. Chosen: more often costs memory, more seldom leaves few places of a
vehicle beside a counting station."""
MIN_TIME_S = 10.0
"""A forecast needs this much observed traffic. Chosen: less gives flows of single vehicles, more
makes users wait."""
MOVING_MPS = 2.0
"""Only faster vehicles count for the drivers' speeds. Chosen: slower ones stand or queue."""
FACTOR_BOUNDS = (0.3, 2.0)
"""Of speed over limit. Chosen: slower is a queue, faster a wrong track or a wrong limit."""
ENOUGH_SAMPLES = 40
"""Samples of a lane for its mean speed: 20 s of vehicles. Chosen: fewer are of one or two."""
ENOUGH_M = 1000.0
"""Distance driven on an edge from which on its own drivers are drawn: ten vehicles over 100 m.
Chosen: larger takes drivers of other roads, smaller repeats a few."""
_SAMPLE = np.dtype(
    [
        ("stamp_ns", "<i8"),
        ("vehicle", "<i8"),
        ("lane", "<i8"),
        ("xy", "<f8", 2),
        ("kind", "<i8"),
        ("speed", "<f8"),
    ]
)
"""A vehicle in one sample."""


@dataclass(frozen=True, slots=True)
class Drivers:
    """Vehicles as they were seen driving, one row per vehicle and lane.

    Attributes:
        edge: (K,) the lane's edge.
        kinds: (K,) their types, numbers in `TYPES`.
        factors: (K,) their mean speed over the mean limit, on all edges together.
        driven_m: (K,) how far they were seen to drive there.
        lane: (K,) in which lane, numbers of the network.
    """

    edge: NDArray[np.object_]
    kinds: NDArray[np.int64]
    factors: NDArray[np.float64]
    driven_m: NDArray[np.float64]
    lane: NDArray[np.int64]

    def weights(self, edge: str, able: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(K,) chance of each to be the next driver on an edge.

        The distance that it was seen to drive: a track in parts counts once, and a part of a
        second, whose speed is noise, counts little. Drivers of this edge, if enough were seen, or
        else of all: one direction may queue while the other is free.

        Args:
            edge: Where the next driver enters.
            able: (K,) which ones may drive there.
        """
        able = able if able.any() else np.ones(len(able), np.bool_)
        here = able & (self.edge == edge)
        chosen = here if self.driven_m[here].sum() >= ENOUGH_M else able
        weight = np.where(chosen, self.driven_m, 0.0)
        return np.asarray(weight / weight.sum())


@dataclass(frozen=True, slots=True)
class Demand:
    """Traffic as it was seen.

    Attributes:
        time_s: How long it was observed.
        flow_per_h: Vehicles per hour that enter each edge from outside the view.
        turns: For each edge, how many vehicles went on to which edge.
        drivers: Those who were seen.
        lane_kmh: Mean speed in each lane in which enough was seen, by SUMO's id.
        edge_flow_per_h: Flow on every edge that was seen. What enters a junction leaves it.
    """

    time_s: float
    flow_per_h: dict[str, float]
    turns: Mapping[str, Mapping[str, int]]
    drivers: Drivers
    lane_kmh: Mapping[str, float]
    edge_flow_per_h: dict[str, float]


class ObservedTraffic:
    """Samples the twin twice a second and keeps a window of it.

    Args:
        network: The roads.
        window_s: How far back.

    Attributes:
        last: The last step.
    """

    def __init__(self, network: RoadNetwork, window_s: float) -> None:
        self._network, self._window_ns = network, round(window_s * 1e9)
        self._samples: deque[tuple[int, NDArray[np.void]]] = deque()
        self.last: TwinStep | None = None

    def add(self, step: TwinStep) -> None:
        """Take one step."""
        if self.last is not None and step.stamp_ns < self.last.stamp_ns:
            self._samples.clear()  # the source started again
        self.last = step
        for vehicle, since_ns in step.false_since_ns.items():
            self._forget(vehicle, since_ns)
        if self._samples and step.stamp_ns < self._samples[-1][0] + SAMPLE_NS:
            return
        kept = step.observed & (step.lane != NO_LANE) & np.isfinite(step.xy[:, 0])
        rows = np.empty(int(np.count_nonzero(kept)), _SAMPLE)
        rows["stamp_ns"] = step.stamp_ns
        rows["vehicle"], rows["lane"] = step.vehicle_id[kept], step.lane[kept]
        rows["xy"], rows["kind"] = step.xy[kept], step.kind[kept]
        rows["speed"] = np.hypot(*step.velocity[kept].T)
        self._samples.append((step.stamp_ns, rows))
        while self._samples[0][0] < step.stamp_ns - self._window_ns:
            self._samples.popleft()

    def _forget(self, vehicle: int, since_ns: int) -> None:
        """Take back what was sampled of a vehicle that was none."""
        for k, (stamp_ns, rows) in enumerate(self._samples):
            if stamp_ns >= since_ns and (rows["vehicle"] == vehicle).any():
                self._samples[k] = stamp_ns, rows[rows["vehicle"] != vehicle]

    @property
    def time_s(self) -> float:
        """How long the window is by now."""
        return (self._samples[-1][0] - self._samples[0][0]) * 1e-9 if self._samples else 0.0

    def snapshot(self) -> ObservedTraffic:
        """A copy for another thread."""
        other = ObservedTraffic(self._network, self._window_ns * 1e-9)
        other._samples, other.last = deque(self._samples), self.last
        return other

    def demand(self) -> Demand | None:
        """The demand; None where too little was seen."""
        if not self._samples:
            return None
        time_s = self.time_s
        rows = np.concatenate([rows for _, rows in self._samples])
        rows = rows[~self._network.internal[rows["lane"]]]
        if time_s < MIN_TIME_S or not len(rows):
            return None
        ways = count_ways(self._network, rows)
        if not len(ways):
            return None
        enter, turns, flow = Counter[str](), dict[str, Counter[str]](), Counter[str]()
        for number, count in Counter(ways.way.tolist()).items():
            route = ways.ways[number].edges
            enter[route[0]] += count
            flow.update(dict.fromkeys(route, count))
            for here, there in pairwise(route):
                turns.setdefault(here, Counter())[there] += count
        per_h = 3600.0 / time_s
        drivers = self._drivers(rows)
        speeds = self._lane_kmh(rows)
        entering = {edge: per_h * count for edge, count in sorted(enter.items())}
        carried = {edge: per_h * count for edge, count in sorted(flow.items())}
        return Demand(time_s, entering, turns, drivers, speeds, carried)

    def _lane_kmh(self, rows: NDArray[np.void]) -> dict[str, float]:
        """Space mean speeds: of all samples in a lane, in which slow vehicles have more."""
        count = np.bincount(rows["lane"], minlength=len(self._network))
        total = np.bincount(rows["lane"], rows["speed"], minlength=len(self._network))
        lanes = np.flatnonzero(count >= ENOUGH_SAMPLES).tolist()
        return {self._network.lane_id[k]: round(3.6 * float(total[k] / count[k]), 1) for k in lanes}

    def _drivers(self, rows: NDArray[np.void]) -> Drivers:
        """Everyone who was seen driving."""
        rows = rows[rows["speed"] > MOVING_MPS]
        if not len(rows):
            none, one = np.zeros(1, np.int64), np.ones(1)
            return Drivers(np.array([""], dtype=object), none, one, one, none + NO_LANE)
        _, first, vehicle = np.unique(rows["vehicle"], return_index=True, return_inverse=True)
        limit = np.bincount(vehicle, self._network.speed_mps[rows["lane"]])
        factor = np.clip(np.bincount(vehicle, rows["speed"]) / limit, *FACTOR_BOUNDS)
        kind = np.clip(rows["kind"][first], 0, len(TYPES) - 1)
        by_lane, at = np.unique(
            np.column_stack((vehicle, rows["lane"])), axis=0, return_inverse=True
        )
        travelled = np.bincount(at.ravel(), rows["speed"]) * SAMPLE_NS * 1e-9
        driven_m = np.asarray(travelled, dtype=np.float64)
        edge = np.array(self._network.edge_id, dtype=object)[by_lane[:, 1]]
        who, lane = by_lane.T
        return Drivers(edge, kind[who], factor[who], driven_m, lane)
