"""What a camera sees of a network: its view as a polygon, and the lanes inside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.network import RoadNetwork

PIXEL_SIGMA = 1.5
"""1-sigma error of a box edge. Chosen: larger makes the view shorter, smaller longer."""
MAX_SIGMA_M = 2.0
"""The view ends where `PIXEL_SIGMA` is more than this on the ground. Chosen: half a lane and a
little along the line of sight; larger adds ground where lanes can't be told apart."""
BORDER_SHARE = 0.01
"""Border of the image that is left out, as a share of its size: boxes that the border cuts are not
used (`calibration.box_projector`)."""
COLUMNS, ROWS = 33, 200
"""Pixels at which the view is tested. Chosen: more make the polygon finer and slower."""
SAMPLE_M = 1.0
"""Between points of a reference lane. Chosen: bends of 30 m radius are drawn to 4 mm."""
MIN_LENGTH_M = 20.0
"""Shorter parts of lanes are left out. Chosen: a detected lane of that length says little about the
next one; smaller adds pieces at the border of the view."""


def view_polygon(
    homography: Homography, image_size: tuple[int, int], max_sigma_m: float = MAX_SIGMA_M
) -> NDArray[np.float64]:
    """(V, 2) corners in the map frame of what the camera sees, counter-clockwise or clockwise.

    Its near side is the lower border of the image, its far side where a pixel error of
    `PIXEL_SIGMA` becomes `max_sigma_m` on the ground.

    Raises:
        RoadNetworkError: No part of the road is seen that well.
    """
    width, height = image_size
    margin_x, margin_y = BORDER_SHARE * width, BORDER_SHARE * height
    rows = np.linspace(height - margin_y, margin_y, ROWS)
    near, far = [], []
    for x in np.linspace(margin_x, width - margin_x, COLUMNS):
        pixel = np.column_stack((np.full(ROWS, x), rows))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            good = homography.visible(pixel) & (
                homography.sigma_m(pixel, PIXEL_SIGMA) <= max_sigma_m
            )
        count = ROWS if good.all() else int(np.argmin(good))
        if count > 1:
            near.append(pixel[0])
            far.append(pixel[count - 1])
    if len(near) < 2:
        found = f"no ground with errors up to {max_sigma_m:g} m in a {width}x{height} image"
        raise RoadNetworkError("camera's view", found, "a camera that looks at the road")
    return np.asarray(homography.to_ground(np.array(near + far[::-1])), dtype=np.float64)


def inside(point_m: NDArray[np.float64], polygon_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie in a polygon (V, 2), by the even-odd rule."""
    x, y = point_m[:, :1], point_m[:, 1:]
    x0, y0 = polygon_m.T
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray(np.count_nonzero(crosses & (x < at), axis=1) % 2 == 1)


def reference_lanes(network: RoadNetwork, view_m: NDArray[np.float64]) -> tuple[Lane, ...]:
    """The lanes that a camera sees, one for each physical lane.

    SUMO ends a lane at every junction; here it continues in the lane straight ahead. A lane that
    leaves a junction beside another begins there. A lane that is in view twice is cut to the
    longer part. Cycle lanes are left out; bus lanes are there, for buses make lanes, too.

    Args:
        network: The network, in the camera's own map frame (`load_network` with its datum).
        view_m: (V, 2) polygon of what the camera sees, in that frame (`view_polygon`).

    Returns:
        Lanes numbered from 1 in the network's order: centre line, borders and width as the
        network has them; their errors are not known (`sigma_m` is NaN).

    Raises:
        RoadNetworkError: No lane of the network is in view.
    """
    found: list[Lane] = []
    for chain in lane_chains(network):
        if not network.for_motors[chain].all():
            continue
        line, width = chain_line(network, chain)
        run = _longest_run(inside(line, view_m))
        if run.stop - run.start < MIN_LENGTH_M / SAMPLE_M:
            continue
        cut, half = line[run], 0.5 * width[run]
        found.append(
            Lane(
                lane_id=len(found) + 1,
                centerline_m=cut,
                left_m=cut + half[:, None] * _left(cut),
                right_m=cut - half[:, None] * _left(cut),
                width_m=float(width[run].mean()),
                width_sigma_m=float("nan"),
                confidence=1.0,
                status="confirmed",
                vehicles=0.0,
            )
        )
    if not found:
        low, high = view_m.min(axis=0), view_m.max(axis=0)
        nearest = float(np.hypot(*(network.point_m - 0.5 * (low + high)).T).min())
        raise RoadNetworkError(
            str(network.path),
            f"no lane in the camera's view, the nearest is {nearest:.0f} m from its middle",
            "a network that covers what the camera sees",
        )
    return tuple(found)


def lane_chains(network: RoadNetwork) -> list[list[int]]:
    """Lanes joined end to end, straight ahead first; each lane is in exactly one chain."""
    begin, end = _directions(network)
    turns = sorted(
        (abs((begin[b] - end[a] + np.pi) % (2 * np.pi) - np.pi), a, b)
        for a in range(len(network))
        for b in network.successors[a]
        if network.for_motors[a] == network.for_motors[b]
    )
    after: dict[int, int] = {}
    before: dict[int, int] = {}
    for _, a, b in turns:  # the straightest pairs first
        if a not in after and b not in before:
            after[a], before[b] = b, a
    chains = []
    seen: set[int] = set()
    for lane in [k for k in range(len(network)) if k not in before] + list(range(len(network))):
        if lane in seen:
            continue  # the second round finds closed chains, which have no beginning
        chain = [lane]
        while chain[-1] in after and after[chain[-1]] not in chain:
            chain.append(after[chain[-1]])
        seen.update(chain)
        # A chain of internal lanes alone is no lane of the road.
        if not all(network.internal[k] for k in chain):
            chains.append(chain)
    return sorted(chains, key=lambda c: min(k for k in c if not network.internal[k]))


def _directions(network: RoadNetwork) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first = network.point_m[network.start[:-1] + 1] - network.point_m[network.start[:-1]]
    last = network.point_m[network.start[1:] - 1] - network.point_m[network.start[1:] - 2]
    return np.arctan2(first[:, 1], first[:, 0]), np.arctan2(last[:, 1], last[:, 0])


def chain_line(
    network: RoadNetwork, chain: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K, 2) points every `SAMPLE_M` along a chain, and (K,) the lane's width at each."""
    line = np.concatenate([network.line(k) for k in chain])
    width = np.concatenate([np.full(len(network.line(k)), network.width_m[k]) for k in chain])
    step = np.hypot(*np.diff(line, axis=0).T)
    kept = np.append(True, step > 1e-6)
    line, width = line[kept], width[kept]
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.append(np.arange(0.0, arc[-1], SAMPLE_M), arc[-1])
    points = np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])
    return points, np.interp(at, arc, width)


def _left(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 2) unit vectors to the left."""
    return np.asarray(offset_line(line, 1.0) - line)


def _longest_run(flag: NDArray[np.bool_]) -> slice:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return slice(0, 0)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return slice(int(start), int(stop))
