"""A road's own coordinates: arc length s along a reference line, lateral offset d to its left.

Lanes bend and point anywhere, so x = f(y) serves one heading only. Along a curve that runs with the
traffic, lanes are lines of nearly constant d (the s-t coordinates of ASAM OpenDRIVE).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import wrap_rad

STEP_M = 2.0
"""Distance between samples. Chosen: shorter costs time, longer leaves corners: on a radius of 50 m
the middle of a step is 1 cm off the curve."""
COARSE = 2
"""A point's place along a line is first searched among every second sample. Chosen: fewer samples
can lead to the wrong arm of a tight bend, more cost time."""
TRACE_NODES = 800
"""Nodes from which a line is traced, at most. Chosen: more cost time, fewer leave out rare vehicles
at the ends of the view."""
TRACE_ANGLE_RAD = 0.4
"""Vehicles that drive at more than this to the line do not turn it. Chosen: larger lets turning
vehicles bend the line, smaller leaves out traffic where the first line was wrong."""
ALIGN_ROUNDS = 2
"""How often the line is turned to its traffic. Chosen: more cost time, fewer leave it askew."""
ALIGNED_RAD = 0.02
"""A line that turned less than this has its traffic where it was: it needs no second turn. Chosen:
larger leaves the line askew, smaller costs a round."""
RUN_OUT_M = 20.0
"""Straight extension beyond both ends, so that nodes near the ends have coordinates. Chosen: longer
goes on straight where the road may bend, shorter leaves nodes out."""


@dataclass(frozen=True)
class ReferenceLine:
    """A reference line sampled every `STEP_M`.

    Attributes:
        xy: (K, 2) map frame, metres.
        heading: (K,) radians, unwrapped, direction of travel.
    """

    xy: NDArray[np.float64]
    heading: NDArray[np.float64]

    @cached_property
    def s(self) -> NDArray[np.float64]:
        """(K,) arc length."""
        return np.arange(len(self.xy), dtype=np.float64) * STEP_M

    @cached_property
    def curvature(self) -> NDArray[np.float64]:
        """(K,) 1/m, positive to the left, smoothed over 10 m."""
        bend = (self.heading[1:] - self.heading[:-1]) / STEP_M
        return smooth(np.append(bend, bend[-1]), 5.0) / smooth(np.ones(len(self.xy)), 5.0)

    def heading_at(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heading at arc lengths `s`, radians."""
        return self._at(s, self.heading)[0]

    def to_road(
        self, xy: NDArray[np.float64], near_s: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(s, d) of points (N, 2); d is positive to the left of the direction of travel.

        Args:
            xy: Points.
            near_s: About where they are, (N,); saves the search.
        """
        x, y = np.ascontiguousarray(xy.T)
        s = self._nearest(xy) if near_s is None else near_s
        s = np.minimum(np.maximum(s + self._offset(s, x, y)[0], 0.0), self.s[-1])
        along, left = self._offset(s, x, y)
        return s + along, left

    def to_map(self, s: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) points at (s, d)."""
        x, y, heading = self._at(s, self.xy[:, 0], self.xy[:, 1], self.heading)
        return np.column_stack([x - d * np.sin(heading), y + d * np.cos(heading)])

    def may_run_along(
        self, heading: NDArray[np.float64], tolerance_rad: float
    ) -> NDArray[np.bool_]:
        """Whether a heading is within `tolerance_rad` of any that the curve has; a quick test."""
        low, high = self.heading.min(), self.heading.max()
        off = np.abs(wrap_rad(heading - 0.5 * (low + high)))
        return np.asarray(off <= 0.5 * (high - low) + tolerance_rad)

    def regular(self, s: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether (s, d) is one to one there: well on this side of the centre of curvature."""
        return np.asarray(1.0 - d * self._at(s, self.curvature)[0] > 0.3)

    def _nearest(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) arc length of the sample nearest to each point, of every `COARSE`-th."""
        sample = self.xy[::COARSE]
        middle = sample.mean(axis=0)
        sample = sample - middle
        # |p - q|^2 without |p|^2, which is alike for all samples q; single precision will do.
        point = np.column_stack([xy - middle, np.ones(len(xy))]).astype(np.float32)
        factor = np.column_stack([-2.0 * sample, (sample**2).sum(axis=1)]).astype(np.float32)
        return np.asarray((point @ factor.T).argmin(axis=1) * (COARSE * STEP_M))

    def _at(
        self, s: NDArray[np.float64], *values: NDArray[np.float64]
    ) -> list[NDArray[np.float64]]:
        """Each of the (K,) values between the samples, at arc lengths `s`."""
        place = np.minimum(np.maximum(s / STEP_M, 0.0), len(self.xy) - 1.0)
        k = np.minimum(place.astype(np.int64), len(self.xy) - 2)
        part = place - k
        return [value[k] * (1.0 - part) + value[k + 1] * part for value in values]

    def _offset(
        self, s: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        x0, y0, heading = self._at(s, self.xy[:, 0], self.xy[:, 1], self.heading)
        dx, dy, cos, sin = x - x0, y - y0, np.cos(heading), np.sin(heading)
        return dx * cos + dy * sin, dy * cos - dx * sin


def smooth(value: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """(K,) convolved with a Gaussian of `sigma` samples, nothing beyond the ends."""
    reach = min(int(4.0 * sigma) + 1, len(value) - 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(value, kernel / kernel.sum())[reach : reach + len(value)]


def line_from_headings(
    anchor_xy: NDArray[np.float64], anchor: int, heading: NDArray[np.float64]
) -> ReferenceLine:
    """Integrate a heading profile; sample number `anchor` lies at `anchor_xy`."""
    mid = 0.5 * (heading[1:] + heading[:-1])
    step = STEP_M * np.column_stack([np.cos(mid), np.sin(mid)])
    xy = np.vstack([np.zeros(2), np.cumsum(step, axis=0)])
    return ReferenceLine(xy - xy[anchor] + anchor_xy, heading)


def trace_reference_line(
    xy: NDArray[np.float64],
    heading: NDArray[np.float64],
    stream: NDArray[np.int64],
    seed: NDArray[np.int64],
    scale_m: float,
) -> ReferenceLine:
    """The reference line of the traffic stream that the seed segment belongs to.

    Starts from the seed's own path, follows the stream beyond both of its ends, then turns the
    curve until it runs parallel to the median traffic at every place: an average position would
    wander from lane to lane as vehicles enter and leave, an average direction does not. Oncoming
    traffic counts too: where one lane becomes two, half of the vehicles may be on their way across,
    and the other carriageway shows which half keeps to the road.

    Args:
        xy: (N, 2) nodes of all segments.
        heading: (N,) their directions of travel.
        stream: Indices of the nodes that the stream may be made of.
        seed: Indices of the seed segment's nodes, in travel order.
        scale_m: Length over which the road's direction is averaged.
    """
    # A direction averaged over a road's scale needs no more nodes than this; every n-th node keeps
    # all segments represented.
    few = stream[:: max(1, len(stream) // TRACE_NODES)]
    some, directions = xy[few], heading[few]
    unit = np.column_stack([np.cos(directions), np.sin(directions)])
    middle = seed[len(seed) // 2]
    before = _follow(some, unit, xy[seed[0]], heading[seed[0]], -1.0, scale_m)
    after = _follow(some, unit, xy[seed[-1]], heading[seed[-1]], 1.0, scale_m)
    path = np.vstack([before[::-1], xy[seed], after])
    profile, anchor = _headings(path, len(before) + len(seed) // 2, scale_m)
    line = line_from_headings(xy[middle], anchor, profile)
    stride = max(1, len(xy) // TRACE_NODES)
    some, directions = xy[::stride], heading[::stride]
    forth = line.may_run_along(directions, TRACE_ANGLE_RAD)
    back = line.may_run_along(directions + np.pi, TRACE_ANGLE_RAD) & ~forth
    some = np.concatenate([some[forth], some[back]])
    directions = np.concatenate([directions[forth], directions[back] + np.pi])
    s = None
    for _ in range(ALIGN_ROUNDS):
        s, d = line.to_road(some, s)
        turn = _turn(line, s, d, directions, scale_m)
        line = line_from_headings(line.xy[anchor], anchor, line.heading + turn)
        if np.abs(turn).max() < ALIGNED_RAD:
            break
    return line


def _follow(
    xy: NDArray[np.float64],
    unit: NDArray[np.float64],
    start: NDArray[np.float64],
    heading: float,
    sense: float,
    scale_m: float,
) -> NDArray[np.float64]:
    """Points along the stream, forwards (`sense` 1) or backwards (-1), until the traffic ends."""
    at, direction = start, np.array([np.cos(heading), np.sin(heading)])
    points = []
    for _ in range(400):
        away = xy - at
        ahead = (away @ direction) * sense
        lateral = away @ np.array([-direction[1], direction[0]])
        near = ahead**2 + lateral**2 < (1.5 * scale_m) ** 2
        near &= (ahead > 0.2 * scale_m) & (unit @ direction > np.cos(0.4))
        if not near.any():
            break
        weight = np.exp(-0.5 * (lateral[near] / (0.5 * scale_m)) ** 2)
        mean = weight @ unit[near] + 0.5 * direction
        direction = mean / np.hypot(*mean)
        at = at + sense * 0.5 * scale_m * direction
        points.append(at)
    return np.array(points).reshape(-1, 2)


def _headings(
    path: NDArray[np.float64], anchor: int, scale_m: float
) -> tuple[NDArray[np.float64], int]:
    """Smooth heading profile of a rough path, every `STEP_M`, with run-outs; the anchor's index."""
    step = np.hypot(*np.diff(path, axis=0).T)
    keep = np.append(True, step > 0.2)
    keep[anchor] = True
    arc = np.append(0.0, np.cumsum(step))[keep]
    arc_anchor = arc[int(keep[: anchor + 1].sum()) - 1]
    grid = np.arange(-RUN_OUT_M, arc[-1] + RUN_OUT_M + STEP_M, STEP_M)
    half = 0.5 * scale_m
    # np.interp keeps to the path's ends beyond them.
    low, high = np.minimum(grid, arc[-1]) - half, np.maximum(grid, 0.0) + half
    dx = np.interp(high, arc, path[keep, 0]) - np.interp(low, arc, path[keep, 0])
    dy = np.interp(high, arc, path[keep, 1]) - np.interp(low, arc, path[keep, 1])
    rough = np.arctan2(dy, dx)
    rough = rough[0] + np.append(0.0, np.cumsum(wrap_rad(rough[1:] - rough[:-1])))
    blur = half / STEP_M
    profile = smooth(rough, blur) / smooth(np.ones(len(rough)), blur)
    return profile, round((arc_anchor + RUN_OUT_M) / STEP_M)


def _turn(
    line: ReferenceLine,
    s: NDArray[np.float64],
    d: NDArray[np.float64],
    heading: NDArray[np.float64],
    scale_m: float,
) -> NDArray[np.float64]:
    """(K,) angle, place by place, to the robust mean direction of the traffic beside the curve."""
    off = wrap_rad(heading - line.heading_at(s))
    use = (np.abs(off) < TRACE_ANGLE_RAD) & (np.abs(d) < 2.0 * scale_m) & line.regular(s, d)
    use &= (s >= 0.0) & (s <= line.s[-1])
    centre = np.zeros(len(line.s))
    if not use.any():
        return centre
    k = np.minimum((s[use] / STEP_M).round().astype(np.int64), len(line.s) - 1)
    off = off[use]
    blur = 0.5 * scale_m / STEP_M
    for _ in range(3):
        # Cauchy weights: turning and lane-changing vehicles hardly count.
        weight = 1.0 / (1.0 + ((off - centre[k]) / 0.03) ** 2)
        mass, pull = (
            smooth(np.bincount(k, w, len(centre)).astype(np.float64), blur)
            for w in (weight, weight * off)
        )
        # A lone vehicle that turns weighs next to nothing, but is all there is to go by.
        known = mass > min(1e-3, 0.5 * float(mass.max()))
        where = np.flatnonzero(known)
        centre = np.interp(np.arange(len(centre)), where, pull[known] / mass[known])
    return centre
