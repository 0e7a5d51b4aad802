"""SUMO's vehicle types with the speeds that were measured, per class and lane."""

from __future__ import annotations

from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.mapcheck.lane_edges import LaneEdges
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.demand.counted_ways import CountedVehicles, Way
from geoorbit_ros.twin.routes import SPEED_FACTOR_BOUNDS
from geoorbit_ros.twin.vehicles import FREE, TYPES, add_type, may_drive

ENOUGH = 5
"""Vehicles of a class in a lane from which on they have speeds of their own. Chosen: fewer say
little of the spread; with more, few lorries take the speeds of lorries in other lanes."""
DRIVERS = {"lcKeepRight": "0", "lcSpeedGain": "0.2"}
"""Vehicles stay in the lanes in which they were seen: SUMO's usual drivers move to the right of an
empty road, and change lanes for speed several times as often as those that were seen (in 80 m of
off_ramp_diverge: a fifth of lane counts with GEH over 5, none with these). Chosen: 0 keeps fast
vehicles behind slow ones."""


def speed_factors(vehicles: CountedVehicles) -> NDArray[np.float64]:
    """(V,) measured speed of each vehicle over the limit."""
    return np.asarray(np.clip(vehicles.speed_mps / vehicles.limit_mps, *SPEED_FACTOR_BOUNDS))


def type_names(network: RoadNetwork, vehicles: CountedVehicles) -> list[str]:
    """(W,) name of the type of each way's vehicles: its class, and the lane where they begin."""
    may, lanes_of, names = may_drive(network), network.lanes_of, []
    for way in vehicles.ways:
        able = may[way.kind]
        inside = able[way.lane] and all(able[list(lanes_of[edge])].any() for edge in way.edges)
        name = TYPES[way.kind].name + ("" if inside else FREE)
        names.append(f"{name}.{network.lane_id[way.lane]}")
    return names


def departure(edges: LaneEdges, way: Way) -> dict[str, str]:
    """Attributes of a vehicle that departs in its lane where the camera begins to see it.

    From the edge's own beginning, SUMO's drivers would have changed lanes before they come into
    view.
    """
    lane, network = way.lane, edges.network
    most = max(float(network.length_m[lane]) - 0.1, 0.0)
    place = min(edges.first_seen_m.get(lane, 0.0), most)
    return {
        "departLane": str(network.index[lane]),
        "departPos": f"{place:.1f}",
        "departSpeed": "max",
    }


def add_types(root: Xml.Element, network: RoadNetwork, vehicles: CountedVehicles) -> None:
    """Add a `vType` for each class and lane, with the distribution of its speed factors."""
    factor, kind = speed_factors(vehicles), np.array([w.kind for w in vehicles.ways], np.int64)
    lane = np.array([w.lane for w in vehicles.ways], np.int64)
    names = type_names(network, vehicles)
    for name in sorted(set(names)):
        k = names.index(name)
        alike = (kind == kind[k])[vehicles.way]
        own = alike & (lane == lane[k])[vehicles.way]
        used = factor[own if own.sum() >= ENOUGH else alike]
        values = (used.mean(), used.std(), used.min(), used.max())
        text = "normc({:.3f},{:.3f},{:.3f},{:.3f})".format(*(float(v) for v in values))
        free = {"vClass": "ignoring"} if name.split(".")[0].endswith(FREE) else {}
        add_type(root, name, TYPES[int(kind[k])], speedFactor=text, **DRIVERS, **free)
