"""A road's own coordinates: arc length s along a reference curve, lateral offset d to its left.

Lanes bend and point anywhere, so x = f(y) serves one heading only. Along a curve that runs with the
traffic, lanes are lines of nearly constant d (the s-t coordinates of ASAM OpenDRIVE).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from geoorbit_ros.lanes.passes import wrap_rad

STEP_M = 2.0
TRACE_NODES = 1500
TRACE_ANGLE_RAD = 0.4
ALIGN_ROUNDS = 2
RUN_OUT_M = 20.0
"""Straight extension beyond both ends, so that nodes near the ends have coordinates."""


@dataclass(frozen=True)
class Spine:
    """A reference curve sampled every `STEP_M`.

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
        return np.asarray(gaussian_filter1d(np.gradient(self.heading, STEP_M), 5.0))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.xy)

    def heading_at(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heading at arc lengths `s`, radians."""
        return np.asarray(np.interp(s, self.s, self.heading))

    def to_road(
        self, xy: NDArray[np.float64], near_s: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(s, d) of points (N, 2); d is positive to the left of the direction of travel.

        Args:
            xy: Points.
            near_s: About where they are, (N,); saves the search.
        """
        s = self.s[self._tree.query(xy)[1]] if near_s is None else near_s
        for _ in range(2):
            s = np.clip(s + self._offset(s, xy)[0], 0.0, self.s[-1])
        along, left = self._offset(s, xy)
        return s + along, left

    def to_map(self, s: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) points at (s, d)."""
        x, y = np.interp(s, self.s, self.xy[:, 0]), np.interp(s, self.s, self.xy[:, 1])
        heading = self.heading_at(s)
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
        return np.asarray(1.0 - d * np.interp(s, self.s, self.curvature) > 0.3)

    def _offset(
        self, s: NDArray[np.float64], xy: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        dx = xy[:, 0] - np.interp(s, self.s, self.xy[:, 0])
        dy = xy[:, 1] - np.interp(s, self.s, self.xy[:, 1])
        heading = self.heading_at(s)
        cos, sin = np.cos(heading), np.sin(heading)
        return dx * cos + dy * sin, dy * cos - dx * sin


def spine_from_headings(
    anchor_xy: NDArray[np.float64], anchor: int, heading: NDArray[np.float64]
) -> Spine:
    """Integrate a heading profile; sample number `anchor` lies at `anchor_xy`."""
    mid = 0.5 * (heading[1:] + heading[:-1])
    step = STEP_M * np.column_stack([np.cos(mid), np.sin(mid)])
    xy = np.vstack([np.zeros(2), np.cumsum(step, axis=0)])
    return Spine(xy - xy[anchor] + anchor_xy, heading)


def trace_spine(
    xy: NDArray[np.float64],
    heading: NDArray[np.float64],
    seed: NDArray[np.int64],
    scale_m: float,
) -> Spine:
    """The reference curve of the traffic stream that the seed pass belongs to.

    Starts from the seed's own path, follows the stream beyond both of its ends, then turns the
    curve until it runs parallel to the median traffic at every place: an average position would
    wander from lane to lane as vehicles enter and leave, an average direction does not.

    Args:
        xy: (N, 2) nodes of all passes.
        heading: (N,) their directions of travel.
        seed: Indices of the seed pass's nodes, in travel order.
        scale_m: Length over which the road's direction is averaged.
    """
    # A direction averaged over a road's scale needs no more nodes than this; every n-th node keeps
    # all passes represented.
    stride = max(1, len(xy) // TRACE_NODES)
    some, directions = xy[::stride], heading[::stride]
    tree = cKDTree(some)
    unit = np.column_stack([np.cos(directions), np.sin(directions)])
    middle = seed[len(seed) // 2]
    before = _follow(tree, some, unit, xy[seed[0]], heading[seed[0]], -1.0, scale_m)
    after = _follow(tree, some, unit, xy[seed[-1]], heading[seed[-1]], 1.0, scale_m)
    path = np.vstack([before[::-1], xy[seed], after])
    profile, anchor = _headings(path, len(before) + len(seed) // 2, scale_m)
    spine = spine_from_headings(xy[middle], anchor, profile)
    alike = spine.may_run_along(directions, TRACE_ANGLE_RAD)
    some, directions = some[alike], directions[alike]
    s = None
    for _ in range(ALIGN_ROUNDS):
        s, d = spine.to_road(some, s)
        spine = _align(spine, anchor, s, d, directions, scale_m)
    return spine


def _follow(
    tree: cKDTree,
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
        near = np.asarray(tree.query_ball_point(at, 1.5 * scale_m), dtype=np.int64)
        ahead = ((xy[near] - at) @ direction) * sense
        alike = unit[near] @ direction
        near = near[(ahead > 0.2 * scale_m) & (alike > np.cos(0.4))]
        if len(near) == 0:
            break
        lateral = (xy[near] - at) @ np.array([-direction[1], direction[0]])
        weight = np.exp(-0.5 * (lateral / (0.5 * scale_m)) ** 2)
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
    inner = np.clip(grid, 0.0, arc[-1])
    half = 0.5 * scale_m
    low, high = np.clip(inner - half, 0.0, arc[-1]), np.clip(inner + half, 0.0, arc[-1])
    dx = np.interp(high, arc, path[keep, 0]) - np.interp(low, arc, path[keep, 0])
    dy = np.interp(high, arc, path[keep, 1]) - np.interp(low, arc, path[keep, 1])
    profile = gaussian_filter1d(np.unwrap(np.arctan2(dy, dx)), half / STEP_M, mode="nearest")
    return profile, round((arc_anchor + RUN_OUT_M) / STEP_M)


def _align(
    spine: Spine,
    anchor: int,
    s: NDArray[np.float64],
    d: NDArray[np.float64],
    heading: NDArray[np.float64],
    scale_m: float,
) -> Spine:
    """Turn the curve, place by place, into the robust mean direction of the traffic beside it."""
    off = wrap_rad(heading - spine.heading_at(s))
    use = (np.abs(off) < TRACE_ANGLE_RAD) & (np.abs(d) < 2.0 * scale_m) & spine.regular(s, d)
    use &= (s >= 0.0) & (s <= spine.s[-1])
    if not use.any():
        return spine
    k = np.minimum((s[use] / STEP_M).round().astype(np.int64), len(spine.s) - 1)
    off = off[use]
    centre = np.zeros(len(spine.s))
    blur = 0.5 * scale_m / STEP_M
    for _ in range(3):
        # Cauchy weights: turning and lane-changing vehicles hardly count.
        weight = 1.0 / (1.0 + ((off - centre[k]) / 0.03) ** 2)
        mass = gaussian_filter1d(np.bincount(k, weight, len(centre)), blur)
        pull = gaussian_filter1d(np.bincount(k, weight * off, len(centre)), blur)
        # A lone vehicle that turns weighs next to nothing, but is all there is to go by.
        known = mass > min(1e-3, 0.5 * float(mass.max()))
        where = np.flatnonzero(known)
        centre = np.interp(np.arange(len(centre)), where, pull[known] / mass[known])
    return spine_from_headings(spine.xy[anchor], anchor, spine.heading + centre)
