"""Trajectory segments: tracks cleaned of stops, jumps and reversals, condensed to a few nodes each.

A segment is one vehicle's smooth travel through the view. Detections of one vehicle are strongly
correlated, so the frames of a fifth of a second are averaged into one node: thirty times less data
and no information lost about where the lane is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.grouped import changes, lengths
from geoorbit_ros.lanes.estimators.curvilinear.track_rows import TrackRows

MAX_GAP_S = 1.5
"""A track silent for longer is taken for two vehicles: ids are reused after occlusions.
Chosen: longer joins two vehicles, shorter cuts one that passed behind a sign."""
MAX_PIECE_S = 60.0
"""Longer tracks are cut, so that a stopped vehicle can't hold memory without end.
Chosen: longer holds more memory, shorter counts a queueing vehicle twice."""
NODE_PERIOD_S = 0.2
"""Frames within this are averaged into one node. Chosen: longer rounds bends off, shorter takes
more time and memory and says no more: errors of boxes are alike from frame to frame."""
NODE_SPACING_M = 2.0
"""Nodes closer than this are averaged into one. Chosen: wider rounds bends off, closer measures the
headings of slow vehicles from noise."""
MAX_SPEED_MPS = 70.0
"""250 km/h. A faster jump is another vehicle. Chosen: higher joins two vehicles under one id, lower
cuts fast ones."""
MIN_TRAVEL_M = 8.0
"""Less net travel is a parked or jittering box, not traffic. Chosen: more loses vehicles at the
edge of the view, less takes parked ones for traffic."""
MAX_TURN_RAD = np.pi / 3
"""Between neighbouring nodes; a sharper turn is an identity switch, not a vehicle. Chosen: larger
keeps switched ids, smaller cuts vehicles that turn at a junction."""
MAX_LATERAL_MPS2 = 8.0
"""Lateral acceleration on dry asphalt that no everyday driver exceeds. Chosen: larger keeps
switched ids, smaller cuts vehicles in tight ramps."""
MIN_BREAK_RAD = 0.35
"""A turn of less is never taken for a switched id. Chosen: larger keeps switched ids, smaller cuts
lane changes of noisy tracks."""
HEADING_BASE = 2
"""Nodes to either side over which a heading is measured. Chosen: more round bends off, fewer pass
on the noise of single nodes."""


@dataclass(frozen=True)
class TrajectorySegments:
    """P segments with N nodes in all; nodes of segment p are `slice(offset[p], offset[p + 1])`.

    Attributes:
        xy: (N, 2) float64, map frame, metres, in travel order.
        sigma: (N,) 1-sigma ground error of a node.
        heading: (N,) radians, direction of travel.
        time_s: (N,) capture time, seconds since the evidence's epoch.
        offset: (P + 1,) int64.
        large: (P,) bool, a bus or a truck.
    """

    xy: NDArray[np.float64]
    sigma: NDArray[np.float64]
    heading: NDArray[np.float64]
    time_s: NDArray[np.float64]
    offset: NDArray[np.int64]
    large: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.offset) - 1

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """(N,) index of the segment each node belongs to."""
        return np.repeat(np.arange(len(self)), np.diff(self.offset))


def no_segments() -> TrajectorySegments:
    """No traffic yet."""
    none = np.empty(0)
    return TrajectorySegments(
        np.empty((0, 2)), none, none, none, np.zeros(1, np.int64), np.empty(0, bool)
    )


def concatenate(parts: list[TrajectorySegments]) -> TrajectorySegments:
    """Segments of several parts, in order."""
    parts = [p for p in parts if len(p)]
    if not parts:
        return no_segments()
    if len(parts) == 1:
        return parts[0]
    counts = np.concatenate([np.diff(p.offset) for p in parts])
    return TrajectorySegments(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.sigma for p in parts]),
        np.concatenate([p.heading for p in parts]),
        np.concatenate([p.time_s for p in parts]),
        np.append(0, np.cumsum(counts)),
        np.concatenate([p.large for p in parts]),
    )


def newest(segments: TrajectorySegments, count: int) -> TrajectorySegments:
    """The last `count` segments, or all when there are fewer; views."""
    first = max(0, len(segments) - count)
    node = int(segments.offset[first])
    return TrajectorySegments(
        segments.xy[node:],
        segments.sigma[node:],
        segments.heading[node:],
        segments.time_s[node:],
        segments.offset[first:] - node,
        segments.large[first:],
    )


def select(segments: TrajectorySegments, keep: NDArray[np.bool_]) -> TrajectorySegments:
    """The segments for which `keep` (P,) holds."""
    nodes = np.repeat(keep, np.diff(segments.offset))
    counts = np.diff(segments.offset)[keep]
    return TrajectorySegments(
        segments.xy[nodes],
        segments.sigma[nodes],
        segments.heading[nodes],
        segments.time_s[nodes],
        np.append(0, np.cumsum(counts)),
        segments.large[keep],
    )


def condense(rows: TrackRows) -> TrajectorySegments:
    """Segments in `rows`, which must be sorted by (track, time).

    Returns:
        One segment per stretch of smooth travel of at least `MIN_TRAVEL_M`.
    """
    if len(rows) == 0:
        return no_segments()
    new = _new_vehicle(rows)
    first = np.flatnonzero(new)
    begin_s = np.repeat(rows.time_s[first], lengths(first, len(rows)))
    slot = np.floor((rows.time_s - begin_s) / NODE_PERIOD_S)
    new[1:] |= np.diff(np.floor(slot / (MAX_PIECE_S / NODE_PERIOD_S))) > 0
    nodes = _Nodes(
        rows.x, rows.y, rows.sigma, rows.time_s, np.cumsum(new) - 1, rows.large, rows.vehicle
    )
    nodes = nodes.average(slot)
    nodes = nodes.average(np.floor(_travel_m(nodes) / NODE_SPACING_M))
    return _to_segments(_cut_at_turns(nodes))


@dataclass(frozen=True, slots=True)
class _Nodes:
    """Rows on their way to becoming segments; `piece` numbers the vehicles and never decreases."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    sigma: NDArray[np.float64]
    time_s: NDArray[np.float64]
    piece: NDArray[np.int64]
    large: NDArray[np.float64]
    vehicle: NDArray[np.float64]

    def starts(self) -> NDArray[np.bool_]:
        return changes(self.piece)

    def average(self, slot: NDArray[np.float64]) -> _Nodes:
        """One node per run of equal `slot` within a piece, weighted by 1 / sigma^2."""
        first = np.flatnonzero(self.starts() | changes(slot))
        weight = self.sigma**-2
        total = np.add.reduceat(weight, first)

        def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.add.reduceat(values * weight, first) / total)

        # The error of a box is alike from frame to frame: averaging hardly reduces it, so a node
        # keeps the (harmonic mean) error of its rows instead of dividing it by sqrt(n).
        count = lengths(first, len(weight))
        return _Nodes(
            mean(self.x),
            mean(self.y),
            np.sqrt(count / total),
            mean(self.time_s),
            self.piece[first],
            mean(self.large),
            mean(self.vehicle),
        )


def _new_vehicle(rows: TrackRows) -> NDArray[np.bool_]:
    """Where a vehicle begins: another id, a long silence, or a jump that no vehicle can make."""
    dt = np.diff(rows.time_s)
    jump_squared = np.diff(rows.x) ** 2 + np.diff(rows.y) ** 2
    reach = MAX_SPEED_MPS * dt + 4.0 * (rows.sigma[1:] + rows.sigma[:-1]) + 0.5
    new: NDArray[np.bool_] = changes(rows.track)
    new[1:] |= (dt > MAX_GAP_S) | (jump_squared > reach * reach)
    return new


def step_m(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N - 1,) lengths of the steps between points; numpy's hypot takes ten times as long."""
    return np.asarray(np.sqrt(np.diff(x) ** 2 + np.diff(y) ** 2))


def _travel_m(nodes: _Nodes) -> NDArray[np.float64]:
    """Distance travelled since the piece began.

    Steps inside the noise don't count: a standing vehicle would crawl away on its own jitter.
    """
    step = step_m(nodes.x, nodes.y)
    step[step < 0.5 * (nodes.sigma[1:] + nodes.sigma[:-1])] = 0.0
    begin = nodes.starts()
    step[begin[1:]] = 0.0
    travel = np.append(0.0, np.cumsum(step))
    return np.asarray(travel - travel[begin][np.cumsum(begin) - 1])


def _cut_at_turns(nodes: _Nodes) -> _Nodes:
    """Cut where the direction of travel breaks: there an id went from one vehicle to another.

    A vehicle at speed v turns by at most a / v per second, a being its largest lateral
    acceleration; the turn that the nodes' errors alone can make is allowed on top.
    """
    inside = np.diff(nodes.piece) == 0
    turn = np.abs(wrap_rad(np.diff(np.arctan2(np.diff(nodes.y), np.diff(nodes.x)))))
    length = np.maximum(step_m(nodes.x, nodes.y), 1e-3)
    dt = np.maximum(np.diff(nodes.time_s), 1e-3)
    error = np.maximum(nodes.sigma[1:], nodes.sigma[:-1])
    speed = 0.5 * (length[1:] / dt[1:] + length[:-1] / dt[:-1])
    from_errors = error / length
    from_errors = 3.0 * np.sqrt(from_errors[1:] ** 2 + from_errors[:-1] ** 2)
    possible = MAX_LATERAL_MPS2 * 0.5 * (dt[1:] + dt[:-1]) / np.maximum(speed, 0.1)
    real = inside & (length > 2.0 * error)
    impossible = (turn > possible + from_errors) & (turn > MIN_BREAK_RAD) & inside[1:] & inside[:-1]
    new = nodes.starts()
    new[1:-1] |= ((turn > MAX_TURN_RAD) & real[1:] & real[:-1]) | impossible
    return replace(nodes, piece=np.cumsum(new) - 1)


def _to_segments(nodes: _Nodes) -> TrajectorySegments:
    """Drop what is no traffic, measure headings."""
    first = np.flatnonzero(nodes.starts())
    counts = lengths(first, len(nodes.piece))
    last = first + counts - 1
    noise = nodes.sigma[first] + nodes.sigma[last]
    chord = np.hypot(nodes.x[last] - nodes.x[first], nodes.y[last] - nodes.y[first])
    keep = (chord >= np.maximum(MIN_TRAVEL_M, 2.0 * noise)) & (counts >= 3)
    # By majority: a detector takes a van for a train now and then.
    keep &= np.add.reduceat(nodes.vehicle, first) / counts > 0.5
    large = np.add.reduceat(nodes.large, first) / counts > 0.5

    at = np.arange(len(nodes.piece))
    low = np.maximum(at - HEADING_BASE, np.repeat(first, counts))
    high = np.minimum(at + HEADING_BASE, np.repeat(last, counts))
    heading = np.arctan2(nodes.y[high] - nodes.y[low], nodes.x[high] - nodes.x[low])
    xy = np.column_stack([nodes.x, nodes.y])
    offset = np.append(0, np.cumsum(counts))
    return select(TrajectorySegments(xy, nodes.sigma, heading, nodes.time_s, offset, large), keep)


def wrap_rad(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle in [-pi, pi]."""
    return np.asarray(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))
