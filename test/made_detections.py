"""Lanes as a camera would have found them, made from those of a network."""

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.roadnet.network import RoadNetwork

FAR_M = 240.0


def detected(
    network: RoadNetwork, vehicles: float = 20.0, seed: int = 1, noise_m: float = 0.08
) -> list[Lane]:
    """The lanes of `made_twin.made_network` within 240 m of its middle.

    Centre lines are off by `noise_m`, slowly changing along the lane.
    """
    random = np.random.default_rng(seed)
    found = []
    chains = [[f"east_{k}", f"bend_{k}"] for k in range(3)] + [["west_0"], ["west_1"], ["ramp_0"]]
    for number, names in enumerate(chains, 1):
        line = np.concatenate([network.line(network.number[name]) for name in names])
        line = _even(line)
        line = line[np.hypot(*(line - [300.0, 0.0]).T) < FAR_M]
        knots = np.arange(0, len(line) + 40, 40)
        wave = np.interp(np.arange(len(line)), knots, random.normal(0.0, noise_m, len(knots)))
        found.append(lane(number, line + wave[:, None] * (offset_line(line, 1.0) - line), vehicles))
    return found


def lane(
    number: int, line: NDArray[np.float64], vehicles: float = 20.0, width_m: float = 3.5
) -> Lane:
    """A confirmed lane along a line."""
    return Lane(
        lane_id=number,
        centerline_m=line,
        left_m=offset_line(line, 0.5 * width_m),
        right_m=offset_line(line, -0.5 * width_m),
        width_m=width_m,
        width_sigma_m=0.1,
        confidence=0.99,
        status="confirmed",
        vehicles=vehicles,
        sigma_m=0.1,
    )


def _even(line: NDArray[np.float64]) -> NDArray[np.float64]:
    step = np.hypot(*np.diff(line, axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    arc, kept = np.unique(arc, return_index=True)
    at = np.arange(0.0, arc[-1], 2.0)
    return np.column_stack([np.interp(at, arc, line[kept][:, k]) for k in range(2)])
