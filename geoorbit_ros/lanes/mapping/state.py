"""What an estimator remembers, as plain arrays: for a process that is started again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, Status
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import Passes

State = dict[str, NDArray[Any]]
"""Arrays by name; none of objects."""

_STATUSES: tuple[Status, ...] = ("tentative", "confirmed")
_NUMBERS = ("width_m", "width_sigma_m", "confidence", "vehicles", "sigma_m")


def pack_passes(passes: Passes) -> State:
    """The arrays of `Passes`."""
    return {
        "passes_xy": passes.xy,
        "passes_sigma": passes.sigma,
        "passes_heading": passes.heading,
        "passes_time_s": passes.time_s,
        "passes_offset": passes.offset,
        "passes_large": passes.large,
    }


def unpack_passes(state: Mapping[str, NDArray[Any]]) -> Passes:
    """The inverse of `pack_passes`.

    Raises:
        KeyError, ValueError: Arrays that are missing or don't fit together.
    """
    names = ("xy", "sigma", "heading", "time_s", "offset", "large")
    passes = Passes(*(state[f"passes_{name}"] for name in names))
    nodes = int(passes.offset[-1])
    if passes.xy.shape != (nodes, 2) or len(passes.large) != len(passes):
        raise ValueError(f"{len(passes)} passes, {passes.xy.shape} nodes, offset ends at {nodes}")
    return passes


def pack_lanes(lanes: Iterable[Lane]) -> State:
    """Lanes as arrays, one after the other."""
    lanes = list(lanes)
    lines = [np.stack([k.centerline_m, k.left_m, k.right_m], axis=1) for k in lanes]
    return {
        "lanes_points_m": np.concatenate([np.empty((0, 3, 2)), *lines]),
        "lanes_count": np.array([len(line) for line in lines], np.int64),
        "lanes_id": np.array([lane.lane_id for lane in lanes], np.int64),
        "lanes_status": np.array([_STATUSES.index(lane.status) for lane in lanes], np.int64),
        "lanes_missing": np.array([lane.vehicles_missing for lane in lanes], np.int64),
        "lanes_numbers": np.array(
            [[getattr(lane, name) for name in _NUMBERS] for lane in lanes], np.float64
        ).reshape(-1, len(_NUMBERS)),
    }


def unpack_lanes(state: Mapping[str, NDArray[Any]]) -> list[Lane]:
    """The inverse of `pack_lanes`.

    Raises:
        KeyError, ValueError, IndexError: Arrays that are missing or don't fit together.
    """
    ends = np.cumsum(state["lanes_count"])
    if len(ends) and ends[-1] != len(state["lanes_points_m"]):
        raise ValueError(f"{len(state['lanes_points_m'])} points of lanes, {ends[-1]} wanted")
    lanes = []
    for k, points in enumerate(np.split(state["lanes_points_m"], ends[:-1])[: len(ends)]):
        numbers = dict(zip(_NUMBERS, state["lanes_numbers"][k].tolist(), strict=True))
        lanes.append(
            Lane(
                lane_id=int(state["lanes_id"][k]),
                centerline_m=points[:, 0],
                left_m=points[:, 1],
                right_m=points[:, 2],
                status=_STATUSES[int(state["lanes_status"][k])],
                vehicles_missing=int(state["lanes_missing"][k]),
                **numbers,
            )
        )
    return lanes
