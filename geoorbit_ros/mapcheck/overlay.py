"""Detected lanes laid over a network: how far every point of the ones is from every other lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.roadnet.errors import RoadNetworkError
from geoorbit_ros.roadnet.network import RoadNetwork

STEP_M = 2.0
NEAR_M = 12.0
"""Network lanes farther from every detected lane say nothing about them."""
END_SLACK_M = 3.0
"""A detected lane may reach this far over the end of a network lane."""
PARALLEL = float(np.cos(np.radians(25.0)))


@dataclass(frozen=True, slots=True)
class LaneSamples:
    """Points every `STEP_M` along lanes.

    Attributes:
        lane: (N,) which of the lanes.
        xy: (N, 2) points.
        tangent: (N, 2) direction of travel there.
        step_m: (N,) length that each point stands for.
    """

    lane: NDArray[np.int64]
    xy: NDArray[np.float64]
    tangent: NDArray[np.float64]
    step_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Offsets:
    """N points against L lines.

    Attributes:
        offset_m: (N, L) distance to the left of the line, `inf` where the point isn't beside it or
            the line isn't parallel to the point's lane.
        normal: (N, L, 2) unit vector to the left of the line.
        along: (N, L) cosine between the directions: 1 same, -1 opposite.
        arc_m: (N, L) place along the line.
    """

    offset_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    along: NDArray[np.float64]
    arc_m: NDArray[np.float64]


def sample_lines(lines: Sequence[NDArray[np.float64]]) -> LaneSamples:
    """Points along polylines (K, 2)."""
    parts = [sample(line, STEP_M) for line in lines]
    return LaneSamples(
        np.repeat(np.arange(len(parts)), [len(p.point_m) for p in parts]),
        np.concatenate([np.empty((0, 2)), *(p.point_m for p in parts)]),
        np.concatenate([np.empty((0, 2)), *(p.tangent for p in parts)]),
        np.concatenate([np.empty(0), *(np.full(len(p.point_m), p.piece_m) for p in parts)]),
    )


def offsets(points: LaneSamples, lines: Sequence[NDArray[np.float64]]) -> Offsets:
    """How every point lies to every polyline (K, 2)."""
    shape = (len(points.xy), len(lines))
    found = Offsets(np.full(shape, np.inf), np.zeros((*shape, 2)), np.zeros(shape), np.zeros(shape))
    for k, line in enumerate(lines):
        # Most lines of a large network are far away.
        low, high = line.min(axis=0) - NEAR_M, line.max(axis=0) + NEAR_M
        at = np.flatnonzero(np.all((points.xy >= low) & (points.xy <= high), axis=1))
        if not len(at):
            continue
        foot = project(points.xy[at], line, END_SLACK_M)
        along = np.sum(points.tangent[at] * foot.tangent, axis=1)
        good = foot.inside & (np.abs(along) >= PARALLEL)
        found.offset_m[at, k] = np.where(good, foot.offset_m, np.inf)
        found.normal[at, k] = np.column_stack((-foot.tangent[:, 1], foot.tangent[:, 0]))
        found.along[at, k], found.arc_m[at, k] = along, foot.arc_m
    return found


def lanes_near(network: RoadNetwork, lanes: Sequence[Lane]) -> NDArray[np.int64]:
    """Numbers of the network's lanes near detected ones, internal ones included.

    Raises:
        RoadNetworkError: There is none: the network lies elsewhere.
    """
    points = np.concatenate([lane.centerline_m for lane in lanes])
    low, high = points.min(axis=0) - NEAR_M, points.max(axis=0) + NEAR_M
    near = []
    for k in range(len(network)):
        line = network.line(k)
        if np.all(line.max(axis=0) >= low) and np.all(line.min(axis=0) <= high):
            near.append(k)
    if not near:
        middle = 0.5 * (low + high)
        away = float(np.hypot(*(network.point_m - middle).T).min())
        raise RoadNetworkError(
            str(network.path),
            f"no lane near the detected ones, the nearest is {away:.0f} m away",
            "a network that covers what the camera sees",
        )
    return np.array(near, dtype=np.int64)
