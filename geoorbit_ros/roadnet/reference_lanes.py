"""The network's lanes inside a camera's view: what the lane detector is held against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.camera_view import inside
from geoorbit_ros.roadnet.errors import RoadNetworkError
from geoorbit_ros.roadnet.network import RoadNetwork

SAMPLE_M = 1.0
MIN_LENGTH_M = 20.0
"""Of less, a camera can't tell a lane."""
REACH_M = 1000.0
"""A lane is followed this far over the ends of its edges."""


def reference_lanes(network: RoadNetwork, view_m: NDArray[np.float64]) -> tuple[Lane, ...]:
    """The lanes that a camera sees, one for each physical lane.

    SUMO cuts a lane at every junction; here it goes on to the lane straight ahead. A lane that
    leaves a junction beside another begins there. A lane that is in view twice is cut to the
    longer part.

    Args:
        network: The network, in the camera's own map frame (`load_network` with its datum).
        view_m: (V, 2) polygon of what the camera sees, in that frame (`view.view_polygon`).

    Returns:
        Lanes numbered from 1 in the network's order: centre line, borders and width as the
        network has them, which says nothing about their true errors (`sigma_m` is NaN).

    Raises:
        RoadNetworkError: No lane of the network is in view.
    """
    found: list[Lane] = []
    for chain in lane_chains(network):
        line, width = _joined(network, chain)
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
            continue  # the second round finds circles, which begin nowhere
        chain = [lane]
        while chain[-1] in after and after[chain[-1]] not in chain:
            chain.append(after[chain[-1]])
        seen.update(chain)
        # A piece of a junction by itself is no lane.
        if not all(network.internal[k] for k in chain):
            chains.append(chain)
    return sorted(chains, key=lambda c: min(k for k in c if not network.internal[k]))


def _directions(network: RoadNetwork) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first = network.point_m[network.start[:-1] + 1] - network.point_m[network.start[:-1]]
    last = network.point_m[network.start[1:] - 1] - network.point_m[network.start[1:] - 2]
    return np.arctan2(first[:, 1], first[:, 0]), np.arctan2(last[:, 1], last[:, 0])


def _joined(
    network: RoadNetwork, chain: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points every `SAMPLE_M` along a chain, and the lane's width at each."""
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
