"""Lanes of a map without traffic, where other lanes of the same road have some.

A lane without traffic is extra only where so many vehicles drove beside it that some would have
driven in it. With shares of the traffic drawn at random (Dirichlet, all alike), k lanes and N
vehicles, a real lane stays empty with probability (k - 1) / (k - 1 + N). And only where drivers
have no reason to leave it: a lane that ends is left long before its end, and on a lane that not all
cars may use (a bus lane, the middle of the road) the traffic beside it says nothing.
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
"""Lanes are compared over at least this length. Chosen: shorter pieces say little (two car lengths
and a gap); larger leaves short edges unchecked."""
EMPTY_SHARE = 0.7
"""An extra lane is empty over this share of the length over which its edge is in use. Chosen:
larger misses extra lanes that a vehicle touched, smaller reports lanes that are seldom used."""
CELL_M = 4.0
"""Cells in which use is counted: two samples (`offsets.STEP_M`). Chosen: smaller leaves gaps
between samples."""
EXTRA_CONFIDENCE = 0.9
"""Least probability that an empty lane is extra. With 0.8, lanes with two vehicles a minute were
called extra in random scenes (ADR 0029)."""
LEAVES_S = 5.0
"""Drivers leave a lane that ends at least this long before its end: a change of lane takes 4.6 s on
average (Toledo and Zohar 2007)."""


def find_extra(
    lanes: Sequence[Lane], network: RoadNetwork, number: NDArray[np.int64], partners: Partners
) -> tuple[list[Finding], list[Unseen]]:
    """Empty lanes of edges in use: extra ones, and those about which too little is known.

    One vehicle that drove `MIN_LENGTH_M` in a lane proves it, however empty the rest is: beside
    ramps and before their ends, lanes are left early and entered late.
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
            if not network.for_cars[k]:
                text = f"no traffic seen on {name}, which is for {network.users(k)}"
                unseen.append(Unseen(name, f"{text}: the traffic beside it says nothing about it"))
                continue
            if must_be_left(network, k):
                leaves_m = float(network.length_m[k] - LEAVES_S * network.speed_mps[k])
                if leaves_m - arc.min() < MIN_LENGTH_M:
                    text = f"no traffic seen on {name}, which ends: drivers leave it before its end"
                    unseen.append(Unseen(name, text))
                    continue
                seen_m = min(seen_m, leaves_m - float(arc.min()))
            others = sum(bool(network.for_cars[j]) for j in group) - 1
            confidence = vehicles / (vehicles + max(others, 1))
            line = _stretch(network, k, arc)
            if confidence < EXTRA_CONFIDENCE:
                needed = EXTRA_CONFIDENCE / (1.0 - EXTRA_CONFIDENCE) * max(others, 1) - vehicles
                text = (
                    f"no traffic seen on {name}; {ceil(needed - 1e-6)} more vehicles beside it "
                    "are needed to say that it isn't there"
                )
                unseen.append(Unseen(name, text))
                continue
            text = (
                f"no traffic on {name} over {seen_m:.0f} m, while {vehicles:.0f} vehicles "
                "drove beside it"
            )
            found.append(Finding("extra", name, None, line, 0.0, 1.0, 0.0, "", confidence, text))
    return found, unseen


def must_be_left(network: RoadNetwork, k: int) -> bool:
    """Whether lane k ends while the road goes on with fewer lanes.

    Where the lanes beside it lead to several roads (a junction), each lane leads to one of them: a
    lane without connection there is wrong. So is a lane that can't be entered either, where the
    others can.
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
