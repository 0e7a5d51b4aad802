"""How well lanes fit a place on a network, and the place nearby where they fit best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import sample
from geoorbit_ros.mapcheck.offsets import LaneSamples, sample_lines
from geoorbit_ros.roadnet.network import RoadNetwork

Array = NDArray[np.float64]

SAMPLES = 240
"""Points of the lanes that are compared, at most. Chosen: more cost time and say the same."""
BLOCK_M = 25.0
"""Over this length the errors of lanes and map are the same: one observation. Chosen: larger makes
chance significant, smaller makes noise significant."""
SHAPE_M = (0.1, 1.0)
"""1-sigma of the shapes of lanes and map, at least and at most; between them it is what the best
fit leaves. Drawn maps give each lane a usual width, and bends few points."""
ODDS_M = 3.0
"""Residuals beyond so many of their own 1-sigma are taken for something that the map lacks."""
UNUSED = 1.0
"""What a network lane in view that nobody drives along speaks against a place, per `BLOCK_M`, in
units of the log-likelihood. Chosen: larger forbids lanes that are closed or seldom used, smaller
lays two lanes on any two of five."""
UNUSED_MAX = 3.0
"""The same for a whole lane. Chosen: a long unused lane is still one lane."""
TURN_PER_M = 8.0
"""Metres that a radian of direction counts for in the search for the nearest lane: 0.3 rad weigh
as much as most of a lane's width. Chosen: larger loses bends, smaller takes crossing lanes."""
END_SLACK_M = 3.0
"""A lane may reach this far over the end of the network's lane."""
SEARCH_SIGMAS = 2.5
"""Places beyond so many 1-sigma of the given one are not looked at."""
MAX_SEARCH_M = 400.0
"""Nor beyond this. Chosen: the rasters grow with its square."""


@dataclass(frozen=True, slots=True)
class RoughPlace:
    """What is known of a camera's place before its lanes are compared with the network.

    Attributes:
        near_m: (2,) where `camera_m` is, roughly, in the network's frame.
        camera_m: (2,) a point of the lanes' frame, usually below the camera.
        near_sigma_m: 1-sigma of `near_m`. Default: a place read off a map.
        scale_sigma: Relative 1-sigma of the lanes' scale. Default: a calibration from a minute of
            traffic.
        turn_rad: Rotation of the lanes' frame into the network's, counter-clockwise, roughly: where
            the camera looks. A motorway looks the same from its other end. None: not known.
        turn_sigma_rad: 1-sigma of it. Default: a direction such as north-east.
    """

    near_m: Array
    camera_m: Array
    near_sigma_m: float = 50.0
    scale_sigma: float = 0.03
    turn_rad: float | None = None
    turn_sigma_rad: float = float(np.radians(30.0))

    @property
    def reach_m(self) -> float:
        """How far from `near_m` is searched."""
        return min(SEARCH_SIGMAS * self.near_sigma_m, MAX_SEARCH_M)


@dataclass(frozen=True)
class Search:
    """Lanes and network, prepared; a move is (x, y, turn, scale) of the lanes' middle.

    Attributes:
        xy: (N, 2) points of the lanes from their middle.
        heading: (N,) direction of travel there.
        sigma_m: (N,) 1-sigma of the lanes across.
        weight: (N,) observations that each point stands for.
        centre: (2,) their middle.
        camera: (2,) `RoughPlace.camera_m` from their middle.
        rough: What is known beforehand.
        net: Samples along the network's lanes.
        tree: Of them by place and direction.
        seen: (K, 2) polygon that the camera sees, from the middle.
    """

    xy: Array
    heading: Array
    sigma_m: Array
    weight: Array
    centre: Array
    camera: Array
    rough: RoughPlace
    net: LaneSamples
    tree: KDTree
    seen: Array

    @cached_property
    def net_heading(self) -> Array:
        """(M,) directions of the network's samples."""
        return np.asarray(np.arctan2(self.net.tangent[:, 1], self.net.tangent[:, 0]))

    @cached_property
    def own_tree(self) -> KDTree:
        """Of the lanes' points by place and direction."""
        return KDTree(_with_direction(self.xy, self.heading))


def prepare(
    lanes: Sequence[Lane], network: RoadNetwork, rough: RoughPlace, seen: Array | None
) -> Search:
    """Sample lanes and network.

    Args:
        lanes: In a frame of their own; all are used.
        network: In its map frame.
        rough: What is known beforehand.
        seen: (K, 2) polygon in which other lanes would have been seen; None: the convex hull of the
            lanes.

    Raises:
        RoadNetworkError: The network has no lane near the given place.
    """
    points = sample_lines([lane.centerline_m for lane in lanes])
    thin = slice(None, None, max(1, -(-len(points.xy) // SAMPLES)))
    xy, tangent = points.xy[thin], points.tangent[thin]
    share = len(points.xy) / len(xy)
    sigma = np.array([lane.sigma_m for lane in lanes])
    sigma = np.where(np.isfinite(sigma), sigma, SHAPE_M[0])[points.lane[thin]]
    centre = xy.mean(axis=0)
    reach = rough.reach_m + float(np.hypot(*(xy - rough.camera_m).T).max())
    net = _near_samples(network, rough.near_m, reach)
    hull = xy[scipy.spatial.ConvexHull(xy).vertices] if len(xy) > 2 else xy
    seen = hull if seen is None or len(seen) < 3 else np.asarray(seen)
    heading = np.arctan2(net.tangent[:, 1], net.tangent[:, 0])
    return Search(
        xy - centre,
        np.arctan2(tangent[:, 1], tangent[:, 0]),
        sigma,
        points.step_m[thin] * share / BLOCK_M,
        centre,
        rough.camera_m - centre,
        rough,
        net,
        KDTree(_with_direction(net.xy, heading)),
        seen - centre,
    )


def _near_samples(network: RoadNetwork, near: Array, reach_m: float) -> LaneSamples:
    """Samples along the lanes for cars within reach."""
    lines = []
    for k in np.flatnonzero(network.for_motors & ~network.turns_round).tolist():
        line = network.line(k)
        low, high = line.min(axis=0), line.max(axis=0)
        if np.all(low <= near + reach_m) and np.all(high >= near - reach_m):
            lines.append(line)
    parts = [sample(line, 1.0) for line in lines]
    if not parts:
        away = float(np.hypot(*(network.point_m - near).T).min())
        raise RoadNetworkError(
            str(network.path),
            f"no lane near the given place, the nearest is {away:.0f} m away",
            "a network around the place that --near names",
        )
    lane = np.repeat(np.arange(len(parts)), [len(p.point_m) for p in parts])
    xy = np.concatenate([p.point_m for p in parts])
    tangent = np.concatenate([p.tangent for p in parts])
    step = np.concatenate([np.full(len(p.point_m), p.piece_m) for p in parts])
    inside = np.hypot(*(xy - near).T) <= reach_m
    return LaneSamples(lane[inside], xy[inside], tangent[inside], step[inside])


def refined(search: Search, start: Array, shape_m: float) -> Array:
    """Iteratively reweighted least squares from a start."""
    move = start.copy()
    sigma = np.hypot(search.sigma_m, shape_m)
    for _ in range(20):
        change, _ = step(search, move, sigma)
        move = move + change
        if np.abs(change).max() < 1e-4:
            break
    return move


def step(search: Search, move: Array, sigma: Array) -> tuple[Array, Array]:
    """Change (4,) of one step of least squares, and the covariance (4, 4)."""
    offset, normal, _ = residuals(search, move)
    share = np.minimum(np.abs(offset) / (ODDS_M * sigma), 1.0)
    weight = search.weight * (1.0 - share**2) ** 2 / sigma**2
    arm = turned(search.xy, move[2])
    across = np.column_stack((-arm[:, 1], arm[:, 0])) * move[3]
    rows = np.column_stack((normal, (normal * across).sum(axis=1), (normal * arm).sum(axis=1)))
    offset = np.where(np.isfinite(offset), offset, 0.0)
    matrix = rows.T @ (weight[:, None] * rows)
    vector = -(rows.T @ (weight * offset))
    # The camera is near the given place, the scale near 1.
    arm = turned(search.camera[None], move[2])[0]
    place = np.array([[1.0, 0.0, -arm[1] * move[3], arm[0]], [0.0, 1.0, arm[0] * move[3], arm[1]]])
    off = move[:2] + move[3] * arm - search.rough.near_m
    matrix += place.T @ place / search.rough.near_sigma_m**2
    vector -= place.T @ off / search.rough.near_sigma_m**2
    matrix[3, 3] += search.rough.scale_sigma**-2
    vector[3] -= (move[3] - 1.0) / search.rough.scale_sigma**2
    matrix[2, 2] += 1e-6
    return np.linalg.solve(matrix, vector), np.asarray(np.linalg.inv(matrix))


def residuals(search: Search, move: Array) -> tuple[Array, Array, Array]:
    """Of each point the offset (N,) from the nearest network lane, its normal (N, 2), the point.

    The offset is infinite where no lane of that direction is near.
    """
    xy = move[:2] + move[3] * turned(search.xy, move[2])
    _, at = search.tree.query(_with_direction(xy, search.heading + move[2]))
    tangent = search.net.tangent[at]
    away = xy - search.net.xy[at]
    along = (away * tangent).sum(axis=1)
    normal = np.column_stack((-tangent[:, 1], tangent[:, 0]))
    offset = (away * normal).sum(axis=1)
    alike = np.cos(search.heading + move[2] - search.net_heading[at])
    far = (np.abs(along) > END_SLACK_M) | (alike < np.cos(np.radians(30.0)))
    return np.where(far, np.inf, offset), normal, xy


def shape_left_m(search: Search, move: Array) -> float:
    """1-sigma of the shapes: what a fit leaves of the points that lie beside lanes."""
    offset = np.abs(residuals(search, move)[0])
    near = offset < ODDS_M * SHAPE_M[1]
    if not near.any():
        return SHAPE_M[1]
    return float(np.clip(1.4826 * np.median(offset[near]), *SHAPE_M))


def score_of(search: Search, move: Array, shape_m: float) -> float:
    """Log-likelihood of a place."""
    offset, _, _ = residuals(search, move)
    square = np.minimum((offset / np.hypot(search.sigma_m, shape_m)) ** 2, ODDS_M**2)
    score = -0.5 * float(search.weight @ square)
    camera = move[:2] + move[3] * turned(search.camera[None], move[2])[0]
    score -= 0.5 * float(((camera - search.rough.near_m) ** 2).sum()) / search.rough.near_sigma_m**2
    score -= 0.5 * ((move[3] - 1.0) / search.rough.scale_sigma) ** 2
    if search.rough.turn_rad is not None:
        apart = wrapped(move[2] - search.rough.turn_rad)
        score -= 0.5 * (apart / search.rough.turn_sigma_rad) ** 2
    return float(score - _unused(search, move))


def _unused(search: Search, move: Array) -> float:
    """What network lanes in view that nobody drove along speak against a place."""
    back = turned(search.net.xy - move[:2], -move[2]) / move[3]
    low, high = search.seen.min(axis=0), search.seen.max(axis=0)
    near = np.flatnonzero(np.all((back >= low) & (back <= high), axis=1))
    near = near[_inside(back[near], search.seen)]
    if not len(near):
        return 0.0
    heading = search.net_heading[near] - move[2]
    _, at = search.own_tree.query(_with_direction(back[near], heading))
    tangent = np.column_stack((np.cos(search.heading[at]), np.sin(search.heading[at])))
    away = back[near] - search.xy[at]
    across = tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0]
    along = (away * tangent).sum(axis=1)
    alone = (np.abs(across) > 2.0) | (np.abs(along) > 2.0 * BLOCK_M)
    length = np.bincount(search.net.lane[near][alone], search.net.step_m[near][alone])
    return float(np.minimum(UNUSED * length / BLOCK_M, UNUSED_MAX).sum())


def _inside(xy: Array, polygon: Array) -> NDArray[np.bool_]:
    """(N,) whether points lie in a polygon (K, 2): the crossing rule."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    over = (a[None, :, 1] > xy[:, None, 1]) != (b[None, :, 1] > xy[:, None, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = a[None, :, 0] + (xy[:, None, 1] - a[None, :, 1]) * (
            (b - a)[None, :, 0] / (b - a)[None, :, 1]
        )
    return np.asarray((over & (xy[:, None, 0] < cross)).sum(axis=1) % 2 == 1)


def _with_direction(xy: Array, heading: Array) -> Array:
    """(N, 4) places with directions, so that the nearest point has both alike."""
    return np.column_stack((xy, TURN_PER_M * np.cos(heading), TURN_PER_M * np.sin(heading)))


def wrapped(angle_rad: float) -> float:
    """The same angle from -pi to pi."""
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def turned(vector: Array, angle_rad: float) -> Array:
    """Vectors (N, 2) turned counter-clockwise."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(vector @ np.array([[cos, sin], [-sin, cos]]))
