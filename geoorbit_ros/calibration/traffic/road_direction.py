"""The road's direction where vehicles were seen, from all who drove there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.traffic.paths import Headings

Array = NDArray[np.float64]
Index = NDArray[np.intp]

REACH_M, REACH_NOISE = (12.0, 40.0), 60.0
"""Places so far before and behind are used: the noise of a position across the way times the last,
between the first two. Chosen: longer smooths the beginning of bends, shorter follows the noise."""
WIDER = 1.5
"""Speeds are taken from places so much further before and behind: chosen by their noisy places,
those at the ends would turn the road as well."""
ASIDE_M = 6.0
"""Places so far to the side are used: those of the lane and of its neighbours."""
TURNED_RAD = 0.35
"""Vehicles that head so differently are on another road."""
WANDER_RAD = np.radians(0.6)
"""1-sigma of the angle between a vehicle and its lane: habits, and changes of lane. Chosen: larger
lets each box's noise turn its vehicle, smaller turns those who change lanes."""
BEND, BEND_CHANGE, SPREAD = 1 / 60, 1e-3, 6e-3
"""1-sigma of what is fitted beside the direction: curvature in 1/m, how it changes in 1/m², and by
how much lanes part per metre to the side. Wide: a road that turns off within a junction is within
them. They keep the fit from bending where there are few places."""
CHANGES_LANE = 2.0
"""Sigma beyond which a vehicle counts less."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where vehicles were, densely.

    Attributes:
        xy: (2, M) metres, ordered by vehicle and time.
        vehicle: (M,) whose they are.
        time_s: (M,) when.
        angle: (M,) roughly where they head.
        noise: (M,) 1-sigma of a position across the way, so that neighbouring ones are independent.
    """

    xy: Array
    vehicle: Index
    time_s: Array
    angle: Array
    noise: Array


def road_headings(
    places: Places, xy: Array, vehicle: Index, angle: Array, noise: Array
) -> tuple[Headings, Headings]:
    """Directions of the road at some places, and of the vehicles there.

    A local regression: across the direction, every vehicle's way is a constant of its own and a
    slope, a bend and a change of bend that all share, the slope changing to the side. How far along
    a vehicle is follows from the time, at a steady speed: its place is uncertain along the line of
    sight, and with the noisy place itself every way would turn towards the camera (two-stage least
    squares, e.g. Wooldridge (2010), chapter 5).

    Args:
        places: Of all vehicles.
        xy: (2, N) metres where directions are wanted.
        vehicle: (N,) whose places they are.
        angle: (N,) roughly the directions.
        noise: (N,) 1-sigma of a position across the way.

    Returns:
        Of the road, and of each vehicle: the road's and what the vehicle's own way says.
    """
    known = np.isfinite(places.xy).all(axis=0)
    places = Places(
        places.xy[:, known],
        places.vehicle[known],
        places.time_s[known],
        places.angle[known],
        places.noise[known],
    )
    reach = np.clip(REACH_NOISE * np.nan_to_num(noise, nan=1.0), *REACH_M)
    centre = np.nan_to_num(xy, nan=1e6, posinf=1e6, neginf=1e6)
    tree = scipy.spatial.cKDTree(places.xy.T)
    near = tree.query_ball_point(centre.T, np.hypot(WIDER * reach, ASIDE_M))
    road, own = np.array(angle), np.array(angle)
    variance, bend = np.full(len(angle), TURNED_RAD**2), np.zeros(len(angle))
    unsure = np.zeros(len(angle))
    for k, found in enumerate(near):
        chosen = np.array(found, dtype=np.intp)
        fitted = _local(places, chosen, xy[:, k], angle[k], reach[k], int(vehicle[k]))
        if fitted is not None:
            turn, variance[k], bend[k], wander, unsure[k] = fitted
            road[k] += turn
            own[k] = road[k] + wander
    return Headings(road, variance, bend), Headings(own, variance + unsure, bend)


def _local(
    places: Places, chosen: Index, xy: Array, angle: float, reach: float, vehicle: int
) -> tuple[float, float, float, float, float] | None:
    """Turn from `angle`, its variance, the curvature, the vehicle's own turn, its variance.

    None where there are no places.
    """
    chosen = np.sort(chosen)
    off = places.xy[:, chosen] - xy[:, None]
    cos, sin = np.cos(angle), np.sin(angle)
    along, aside = off[0] * cos + off[1] * sin, off[1] * cos - off[0] * sin
    turn = (places.angle[chosen] - angle + np.pi) % (2.0 * np.pi) - np.pi
    use = (np.abs(along) < WIDER * reach) & (np.abs(aside) < ASIDE_M)
    use &= np.abs(turn) < TURNED_RAD
    if use.sum() < 2:
        return None
    chosen, along, aside = chosen[use], along[use], aside[use]
    along = _steady(places.vehicle[chosen], places.time_s[chosen], along)
    use = np.abs(along) < reach
    if use.sum() < 2:
        return None
    chosen, along, aside = chosen[use], along[use], aside[use]
    first = np.diff(places.vehicle[chosen], prepend=-1) != 0
    whose, of = places.vehicle[chosen][first], np.cumsum(first) - 1
    weight = (1.0 - np.abs(along / reach) ** 3) ** 3 * (1.0 - (aside / ASIDE_M) ** 2)
    weight = weight / places.noise[chosen] ** 2

    total = np.bincount(of, weight)

    def centred(values: Array) -> Array:
        return np.asarray(values - (np.bincount(of, weight * values) / total)[of])

    middle = (np.bincount(of, weight * aside) / total)[of]
    terms = np.stack([centred(t) for t in (along, along**2 / 2.0, along**3 / 6.0, middle * along)])
    target = centred(aside)
    information = np.bincount(of, weight * terms[0] ** 2)
    share = 1.0 / (1.0 + information * WANDER_RAD**2)
    # Some 10 degrees: it is not singular where every vehicle is seen once.
    prior = np.array([1.0 / 0.2, 1.0 / BEND, 1.0 / BEND_CHANGE, 1.0 / SPREAD]) ** 2
    trust = np.ones(len(whose))
    for _ in range(2):
        each = weight * (share * trust)[of]
        normal = (terms * each) @ terms.T + np.diag(prior)
        solution = np.linalg.solve(normal, (terms * each) @ target)
        rest = target - solution @ terms
        slope = np.bincount(of, weight * terms[0] * rest) / np.maximum(information, 1e-9)
        sigma = np.sqrt(1.0 / np.maximum(information, 1e-9) + WANDER_RAD**2)
        trust = 1.0 / (1.0 + (slope / sigma / CHANGES_LANE) ** 2)
    variance = float(np.linalg.inv(normal)[0, 0])
    mine = np.flatnonzero(whose == vehicle)
    wander, unsure = 0.0, WANDER_RAD**2
    if len(mine):
        known = float(information[mine[0]]) * WANDER_RAD**2
        wander = float(slope[mine[0]]) * known / (1.0 + known)
        unsure /= 1.0 + known
    tilt = float(np.arctan(solution[0]))
    return tilt, variance, float(solution[1]) * np.cos(tilt) ** 3, wander, unsure


def _steady(vehicle: Index, time_s: Array, along: Array) -> Array:
    """How far along vehicles are at a steady speed each; by vehicle."""
    first = np.diff(vehicle, prepend=-1) != 0
    of = np.cumsum(first) - 1
    count = np.bincount(of)
    middle_s, middle = np.bincount(of, time_s) / count, np.bincount(of, along) / count
    time = time_s - middle_s[of]
    speed = np.bincount(of, time * along) / np.maximum(np.bincount(of, time**2), 1e-9)
    return np.asarray(middle[of] + speed[of] * time)
