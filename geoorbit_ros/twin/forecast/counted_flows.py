"""Counts the twin's vehicles in the network's lanes, as cameras' vehicles are counted in theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line, project
from geoorbit_ros.core.tables import TRACK_DTYPE, frames_from_rows
from geoorbit_ros.mapcheck.lane_edges import LaneEdges, Stretch
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.roadnet.reference_lanes import chain_line, lane_chains
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.twin.demand.counted_ways import CountedVehicles, find_ways, place_detectors
from geoorbit_ros.twin.vehicles import TYPES

TRIM = 0.01
"""Share of positions at either end of a lane that are left out. Chosen: the outermost are of single
vehicles; larger shortens the stretch that is seen."""
LEAST_M = 20.0
"""Lanes seen over less are not counted in. Chosen: vehicles leave few samples there."""
SIGMA_M = 0.3
"""1-sigma of a vehicle's place (docs/results.md)."""


def count_ways(network: RoadNetwork, samples: NDArray[np.void]) -> CountedVehicles:
    """The ways of vehicles, by counting stations across the network's lanes in view.

    Args:
        network: The roads.
        samples: (N,) with `stamp_ns`, `vehicle`, `lane`, `xy` and `kind`, outside junctions.
    """
    lanes, stretches = _lanes_in_view(network, samples)
    edges = LaneEdges(network, stretches, 0.0)
    if not lanes:
        none = np.empty(0)
        return CountedVehicles((), none.astype(np.int64), none.astype(np.int64), none, none, 0)
    rows = np.zeros(len(samples), TRACK_DTYPE)
    rows["x"], rows["y"] = samples["xy"].T
    rows["track_id"], rows["sigma"], rows["score"] = samples["vehicle"], SIGMA_M, 1.0
    rows["class_id"] = np.array([kind.coco_class for kind in TYPES])[samples["kind"]]
    rows["length"] = np.array([kind.length_m for kind in TYPES])[samples["kind"]]
    counter = TrafficCounter(lanes)
    counter.add(frames_from_rows(samples["stamp_ns"], rows))
    counted = counter.finish()
    detectors = place_detectors(lanes, counter.stations, edges)
    return find_ways(counted.passages, counted.crossings, detectors, edges)


def _lanes_in_view(
    network: RoadNetwork, samples: NDArray[np.void]
) -> tuple[list[Lane], dict[int, tuple[Stretch, ...]]]:
    """The network's lanes, joined where they go straight on, as far as vehicles were seen."""
    lanes, stretches = list[Lane](), dict[int, tuple[Stretch, ...]]()
    used = set(samples["lane"].tolist())
    for chain in lane_chains(network):
        if used.isdisjoint(chain):
            continue
        line, width = chain_line(network, chain)
        there = samples["xy"][np.isin(samples["lane"], chain)]
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        low, high = np.quantile(project(there, line).arc_m, [TRIM, 1.0 - TRIM])
        inside = np.flatnonzero((arc >= low) & (arc <= high))
        if high - low < LEAST_M or len(inside) < 2:
            continue
        seen, half = line[inside], 0.5 * float(width[inside].mean())
        number = len(lanes) + 1
        lanes.append(lane_of_map(number, seen, offset_line(seen, half), offset_line(seen, -half)))
        stretches[number] = _stretches(network, chain, float(arc[inside[0]]), float(high - low))
    return lanes, stretches


def _stretches(
    network: RoadNetwork, chain: list[int], from_m: float, length_m: float
) -> tuple[Stretch, ...]:
    """The lanes of a chain along the part of it that is in view."""
    found, begin = list[Stretch](), -from_m
    for lane in chain:
        end = begin + float(network.length_m[lane])
        if not network.internal[lane] and end > 0.0 and begin < length_m:
            found.append(Stretch(max(begin, 0.0), min(end, length_m), lane, max(-begin, 0.0)))
        begin = end
    return tuple(found)
