"""Distances between polylines, sampled evenly by arc length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError


@dataclass(frozen=True, slots=True)
class Samples:
    """Points at the middle of N equal pieces of a polyline.

    Attributes:
        point_m: (N, 2) positions.
        tangent: (N, 2) unit vectors in the polyline's direction.
        piece_m: Length that each sample stands for.
    """

    point_m: NDArray[np.float64]
    tangent: NDArray[np.float64]
    piece_m: float


@dataclass(frozen=True, slots=True)
class Projection:
    """Where N points fall on a polyline.

    Attributes:
        offset_m: (N,) signed distance, positive to the left of the polyline's direction.
        arc_m: (N,) arc length of the nearest point.
        tangent: (N, 2) unit direction of the nearest segment.
        inside: (N,) False where the point lies before the first or after the last vertex, so that
            its distance says nothing about lateral error.
    """

    offset_m: NDArray[np.float64]
    arc_m: NDArray[np.float64]
    tangent: NDArray[np.float64]
    inside: NDArray[np.bool_]


def sample(line_m: NDArray[np.float64], step_m: float = 1.0) -> Samples:
    """Sample a (K, 2) polyline at most every `step_m` metres; each sample weighs the same."""
    start, step, length, arc = _segments(line_m)
    count = max(int(np.ceil(arc[-1] / step_m - 1e-9)), 1)
    piece = arc[-1] / count
    at = (np.arange(count) + 0.5) * piece
    k = np.clip(np.searchsorted(arc, at, side="right") - 1, 0, len(step) - 1)
    tangent = step[k] / length[k, None]
    return Samples(start[k] + (at - arc[k])[:, None] * tangent, tangent, float(piece))


def project(
    point_m: NDArray[np.float64], line_m: NDArray[np.float64], end_tolerance_m: float = 1e-6
) -> Projection:
    """Nearest point of a (K, 2) polyline for each of (N, 2) points.

    Args:
        point_m: (N, 2) points.
        line_m: (K, 2) polyline, K >= 2.
        end_tolerance_m: A point this far beyond an end still counts as inside.
    """
    start, step, length, arc = _segments(line_m)
    tangent = step / length[:, None]
    relative = point_m[:, None, :] - start[None, :, :]
    along = np.einsum("nsk,sk->ns", relative, tangent)
    clamped = np.clip(along, 0.0, length)
    squared = np.sum((relative - clamped[..., None] * tangent) ** 2, axis=2)
    k = np.argmin(squared, axis=1)
    n = np.arange(len(point_m))
    cross = tangent[k, 0] * relative[n, k, 1] - tangent[k, 1] * relative[n, k, 0]
    offset = np.copysign(np.sqrt(squared[n, k]), cross)
    before = (k == 0) & (along[n, k] < -end_tolerance_m)
    after = (k == len(step) - 1) & (along[n, k] > length[k] + end_tolerance_m)
    return Projection(offset, arc[k] + clamped[n, k], tangent[k], ~(before | after))


def offset_line(line_m: NDArray[np.float64], offset_m: float) -> NDArray[np.float64]:
    """The (K, 2) polyline moved sideways, point by point; positive `offset_m` is to the left."""
    tangent = np.gradient(line_m, axis=0)
    tangent = tangent / np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-12)[:, None]
    normal = np.column_stack((-tangent[:, 1], tangent[:, 0]))
    return np.asarray(line_m + offset_m * normal, dtype=np.float64)


def _segments(
    line_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Start (S, 2), vector (S, 2), length (S,) of the segments, arc (S + 1,) of the vertices."""
    line = np.asarray(line_m, dtype=np.float64)
    step = np.diff(line, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    keep = length > 1e-9  # a repeated vertex has no direction
    if not keep.any():
        raise TableError("polyline", f"{len(line)} points, all the same", "two different points")
    start, step, length = line[:-1][keep], step[keep], length[keep]
    return start, step, length, np.append(0.0, np.cumsum(length))
