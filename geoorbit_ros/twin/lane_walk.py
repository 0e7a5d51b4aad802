"""Along lanes: from a place in one to the place some metres ahead, over junctions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.network import RoadNetwork


@dataclass(frozen=True, slots=True)
class LanePlace:
    """A place in the network: lane number, metres along it, point and direction there."""

    lane: int
    arc_m: float
    xy: NDArray[np.float64]
    heading_rad: float
    ended: bool


def walk(
    network: RoadNetwork,
    lane: int,
    arc_m: float,
    offset_m: float,
    towards: NDArray[np.float64] | None = None,
) -> LanePlace:
    """The place at `arc_m` of a lane, which may lie beyond its end.

    Where lanes part, the way is the one that ends nearest to `towards`; without it, the first.

    Args:
        network: The network.
        lane: Where the way begins.
        arc_m: Metres from the lane's beginning.
        offset_m: Metres to the left of the middle.
        towards: (2,) point that the place should be near.

    Returns:
        The place; `ended` where the network ends before it, which then is beyond its end.
    """
    while arc_m > network.length_m[lane] and network.successors[lane]:
        arc_m -= float(network.length_m[lane])
        choice = network.successors[lane]
        if towards is None or len(choice) == 1:
            lane = choice[0]
        else:
            ends = [walk(network, c, arc_m, 0.0, towards).xy for c in choice]
            lane = choice[int(np.argmin([np.hypot(*(end - towards)) for end in ends]))]
    line, arc = network.line(lane), network.arc(lane)
    k = min(max(int(np.searchsorted(arc, arc_m, side="right")) - 1, 0), len(line) - 2)
    step = line[k + 1] - line[k]
    unit = step / max(float(np.hypot(*step)), 1e-9)
    xy = line[k] + (arc_m - arc[k]) * unit + offset_m * np.array([-unit[1], unit[0]])
    heading = float(np.arctan2(unit[1], unit[0]))
    return LanePlace(lane, arc_m, xy, heading, bool(arc_m > network.length_m[lane]))
