"""Which lanes of a map run side by side, the same way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lane_order import SAME_COS
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.traffic.stations import BESIDE_M


def same_way(lanes: Sequence[Lane]) -> NDArray[np.bool_]:
    """(L, L) whether two lanes run side by side the same way somewhere; a lane does with itself."""
    out = np.eye(len(lanes), dtype=np.bool_)
    for i, lane in enumerate(lanes):
        points = sample(lane.centerline_m, 2.0)
        for j, other in enumerate(lanes):
            if i != j:
                at = project(points.point_m, other.centerline_m)
                along = (points.tangent * at.tangent).sum(axis=1)
                near = at.inside & (np.abs(at.offset_m) < BESIDE_M)
                out[i, j] = bool((near & (along > SAME_COS)).any())
    return out | out.T
