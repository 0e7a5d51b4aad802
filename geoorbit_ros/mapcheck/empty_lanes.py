"""Lanes of a map that carry nothing, where others of the same road do.

A lane that carries no traffic is extra only where lanes beside it have carried so much that it
would have had some: with shares of the traffic drawn at random (Dirichlet, all alike), k lanes and
N vehicles, a lane that is there stays empty with probability (k - 1) / (k - 1 + N). And only where
drivers have no reason to be in another one: a lane that ends is left long before it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.mapcheck.findings import Finding, Unseen
from geoorbit_ros.mapcheck.offsets import Partners
from geoorbit_ros.roadnet.network import RoadNetwork

MIN_LENGTH_M = 20.0
"""Of less, neither side says much."""
EMPTY_SHARE = 0.7
"""An extra lane is empty over this share of the length over which its edge is seen in use."""
CELL_M = 4.0
EXTRA_CONFIDENCE = 0.9
"""With 0.8, lanes with two vehicles a minute were called extra (random scenes)."""
LEAVES_S = 5.0
"""A change of lane takes so long (Toledo and Zohar 2007, 4.6 s on average): nearer to a lane's end
nobody is in it who left it in time."""


def find_extra(
    lanes: Sequence[Lane], network: RoadNetwork, number: NDArray[np.int64], partners: Partners
) -> tuple[list[Finding], list[Unseen]]:
    """Lanes of edges in use that carry nothing, and those of which that says too little.

    A lane in which somebody drove over `MIN_LENGTH_M`, be it once, is there, however much of it is
    empty: beside ramps and before their ends lanes are left early and entered late.
    """
    found: list[Finding] = []
    unseen: list[Unseen] = []
    normal = [int(k) for k in number if not network.internal[k]]
    for edge in dict.fromkeys(network.edge_id[k] for k in normal):
        group = [k for k in normal if network.edge_id[k] == edge]
        used = np.isin(partners.lane, group)
        users = sorted(set(partners.detected[used].tolist()))
        if not users:
            continue
        vehicles = float(np.nansum([lanes[d].vehicles for d in users]))
        for k in group:
            foot = project(partners.xy[used], network.line(k), 1.0)
            arc = foot.arc_m[foot.inside]
            own = partners.arc_m[partners.lane == k]
            seen_m = float(np.ptp(arc)) if len(arc) else 0.0
            used_m = _covered_m(own)
            is_used = used_m >= MIN_LENGTH_M or used_m > (1.0 - EMPTY_SHARE) * _covered_m(arc)
            if seen_m < MIN_LENGTH_M or is_used:
                continue
            name = network.lane_id[k]
            if must_be_left(network, k):
                leaves_m = float(network.length_m[k] - LEAVES_S * network.speed_mps[k])
                if leaves_m - arc.min() < MIN_LENGTH_M:
                    text = f"no traffic seen on {name}, which ends: drivers leave it before"
                    unseen.append(Unseen(name, text))
                    continue
                seen_m = min(seen_m, leaves_m - float(arc.min()))
            others = len(group) - 1
            sure = vehicles / (vehicles + max(others, 1))
            line = _stretch(network, k, arc)
            if sure < EXTRA_CONFIDENCE:
                needed = EXTRA_CONFIDENCE / (1.0 - EXTRA_CONFIDENCE) * max(others, 1) - vehicles
                text = (
                    f"no traffic seen on {name}; {ceil(needed - 1e-6)} more vehicles beside it "
                    "would say that it isn't there"
                )
                unseen.append(Unseen(name, text))
                continue
            text = (
                f"no lane seen on {name} over {seen_m:.0f} m, while {vehicles:.0f} drove beside it"
            )
            found.append(Finding("extra", name, None, line, 0.0, 1.0, 0.0, "", sure, text))
    return found, unseen


def must_be_left(network: RoadNetwork, k: int) -> bool:
    """Whether lane k ends while the road goes on with fewer lanes.

    At a junction, where the lanes beside it lead to several roads, each lane leads somewhere: one
    that leads nowhere is not left, but wrong. One that cannot be entered either, where others can,
    leads from nowhere to nowhere: no driver has ever been in it to leave it.
    """
    group = [j for j, edge in enumerate(network.edge_id) if edge == network.edge_id[k]]
    narrows = len(set().union(*(_onward(network, j) for j in group))) == 1
    begins = not network.predecessors[k] and any(network.predecessors[j] for j in group)
    return narrows and not network.successors[k] and not begins


def _onward(network: RoadNetwork, k: int) -> set[str]:
    """Edges that lane k leads to, across the junction at its end."""
    found, waiting = set[str](), list(network.successors[k])
    while waiting:
        j = waiting.pop()
        if network.internal[j]:
            waiting += network.successors[j]
        else:
            found.add(network.edge_id[j])
    return found


def _stretch(network: RoadNetwork, k: int, arc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of a lane between the least and the greatest arc."""
    at = np.linspace(arc.min(), arc.max(), 20)
    line, along = network.line(k), network.arc(k)
    return np.column_stack([np.interp(at, along, line[:, j]) for j in range(2)])


def _covered_m(arc: NDArray[np.float64]) -> float:
    """Metres along a lane at which there are samples, in cells of `CELL_M`."""
    return CELL_M * len(np.unique(np.round(arc / CELL_M)))
