"""Errors planted into a network whose lanes are right, to see whether validation finds them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.map_build import write_moved
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.roadnet.plain_network import LaneEdit, PlainNetwork

Error = Literal["missing", "extra", "shifted", "width", "direction", "offset"]
SHIFT_M = 1.0
"""How far a shifted lane or map is off. Chosen: less than a third of a lane, more than a map's
error."""
WIDTH_M = 0.8
"""How much too narrow a lane is. Chosen: as `SHIFT_M`."""


def plant(error: Error, network: RoadNetwork, lane_id: str, out: Path, folder: Path) -> str:
    """Write a network with one error.

    `missing` takes the lane away, `extra` puts one beside it (outside an edge's outermost lane,
    inside any other: of the innermost, or it lies on another lane), `width` makes it
    `WIDTH_M` narrower; `shifted` moves its edge by `SHIFT_M` to the left, `direction` reverses its
    edge, `offset` moves the whole map.

    Args:
        error: Which.
        network: The network, which stays as it is.
        lane_id: The lane.
        out: The new network.
        folder: For netconvert's files; must be empty.

    Returns:
        The lane to be named by the finding: for `extra` the new one, for `missing` its neighbour
        (the edge's id and an underscore, as any neighbour will do), for `offset` none.
    """
    k = network.number[lane_id]
    edge_id, index = network.edge_id[k], int(network.index[k])
    if error == "offset":
        step = network.line(k)[-1] - network.line(k)[0]
        left = SHIFT_M * np.array([-step[1], step[0]]) / np.hypot(*step)
        write_moved(network, lambda xy: xy + left, out)
        return ""
    plain = PlainNetwork(network.path, folder)
    edge = plain.edge(edge_id)
    at = next(i for i, lane in enumerate(edge.lanes) if lane.origin == index)
    lane = edge.lanes[at]
    named = lane_id
    if error == "missing":
        del edge.lanes[at]
        named = f"{edge_id}_"
    elif error == "extra":
        side = -1.0 if (at == 0) != network.left_hand else 1.0
        shape = offset_line(lane.shape_m, side * lane.width_m)
        edge.lanes.insert(
            at if at == 0 else at + 1, LaneEdit(None, shape, lane.width_m, lane.rules)
        )
        named = f"{edge_id}_{0 if at == 0 else at + 1}"
    elif error == "width":
        lane.width_m -= WIDTH_M
    elif error == "shifted":
        for other in edge.lanes:
            other.shape_m = offset_line(other.shape_m, SHIFT_M)
    else:
        edge.reverse()
    plain.write(out)
    return named
