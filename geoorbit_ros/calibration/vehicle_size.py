"""Length, width and height of every track, from its class and the size of its boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import solve, total

Array = NDArray[np.float64]

CAR, MOTORCYCLE, BUS, TRUCK = range(4)
"""Groups of vehicles whose sizes are alike."""
GROUP = np.full(256, CAR)
"""COCO class to size group; every other class is taken for a car."""
GROUP[[1, 3, 5, 7]] = MOTORCYCLE, MOTORCYCLE, BUS, TRUCK

MEAN_M = np.array(
    [
        [4.70, 1.85, 1.60],
        [2.20, 0.80, 1.50],
        [12.0, 2.55, 3.20],
        [8.50, 2.35, 3.00],
    ]
)
"""Length, width, height per group. Cars between SUMO's `passenger` (5.0 x 1.8 x 1.5) and today's
SUVs; motorcycles SUMO's `motorcycle` with a rider; buses and trucks after AASHTO (2018), A Policy
on Geometric Design, table 2-4 (CITY-BUS 12.2 x 2.6 x 3.2, SU-9 9.1 x 2.4 x 3.4 to 4.1, WB-20
22.4 x 2.6 x 4.1) and pickups, which detectors also call trucks (5.8 x 2.0 x 1.9)."""

SIGMA_M = np.array(
    [
        [0.55, 0.10, 0.18],
        [0.25, 0.12, 0.15],
        [1.50, 0.08, 0.25],
        [5.00, 0.25, 0.90],
    ]
)
"""1-sigma within each group."""

CORRELATION = np.array(
    [
        [[1.0, 0.4, 0.2], [0.4, 1.0, 0.4], [0.2, 0.4, 1.0]],
        [[1.0, 0.3, 0.2], [0.3, 1.0, 0.2], [0.2, 0.2, 1.0]],
        [[1.0, 0.2, 0.2], [0.2, 1.0, 0.2], [0.2, 0.2, 1.0]],
        [[1.0, 0.7, 0.8], [0.7, 1.0, 0.8], [0.8, 0.8, 1.0]],
    ]
)
"""Between length, width and height of a group. Chosen: a long truck is wide and tall, a pickup is
neither. Larger values learn more from one side, and wrongly where a vehicle is unusual."""

COVARIANCE = CORRELATION * SIGMA_M[:, :, None] * SIGMA_M[:, None, :]
PRECISION = np.linalg.inv(COVARIANCE)
LARGEST_M = np.array([25.0, 2.8, 4.6])
"""No vehicle on a public road is longer, wider or higher without a permit, mirrors included."""
LOWEST_M = np.maximum(MEAN_M - 3 * SIGMA_M, 0.4)
"""Least size per group. Chosen: a lower one lets cut-off boxes shrink a vehicle, a higher one blows
up small cars."""
HIGHEST_M = np.minimum(MEAN_M + 5 * SIGMA_M, LARGEST_M)
"""Largest size per group. Chosen: a higher one lets joined boxes of two vehicles be one, a lower
one cuts long lorries."""

BOX_SIGMA_PX = 1.5
"""1-sigma of a box's side: frame-to-frame noise, as measured at two cameras for `EDGE_SIGMA_PX`."""
BOX_SIGMA_RATIO = 0.05
"""The same as a share of the side, because a vehicle isn't a box and a detector doesn't draw where
its outline ends. Chosen: larger learns sizes more slowly, smaller learns the detector's habits."""
CORRELATION_S = 0.5
"""Seconds within which the error of a box's side stays the same, so that 30 boxes per second don't
count as 30 measurements. Chosen: longer learns sizes more slowly, shorter believes one view too
much."""
HUBER = 2.5
"""Sigma beyond which a side counts less. Chosen: larger lets cut-off boxes shrink a vehicle,
smaller ignores good sides."""

DIM, COV, CLASS, INFO, VECTOR = (
    slice(0, 3),
    slice(3, 12),
    slice(12, 16),
    slice(16, 25),
    slice(25, 28),
)
"""Rows of the filter's state: size, its covariance, votes by class, information, its vector."""
TIME, ROWS = 28, 29
"""Rows of the filter's state, and their number."""
PRIOR_VECTOR = (PRECISION * MEAN_M[:, None]).sum(axis=2)
"""What a group's typical size adds to the vector."""


def start_sizes(
    state: Array, track: NDArray[np.intp], time_s: Array, group: NDArray[np.int64]
) -> None:
    """Begin with the typical size of the group for new vehicles.

    Args:
        state: (`ROWS`, M), changed in place.
        track: (K,) columns of the new vehicles.
        time_s: (K,) when they were first seen.
        group: (K,) size group.
    """
    state[:, track] = 0.0
    state[DIM, track] = MEAN_M[group].T
    state[COV, track] = COVARIANCE[group].reshape(-1, 9).T
    state[TIME, track] = time_s


def learn_sizes(
    state: Array,
    time_s: Array,
    group: NDArray[np.int64],
    score: Array,
    side_px: Array,
    predicted_px: Array,
    slope: Array,
    usable: NDArray[np.bool_],
) -> None:
    """Recursive least squares on (length, width, height), one 3x3 system per vehicle.

    The sides of the box are linear in the three dimensions for a given position and heading
    (`vehicle_fit.edge_slopes`). The class's typical size is the prior; the class is the one
    with the largest sum of scores so far.

    Args:
        state: (`ROWS`, M), one column per vehicle, changed in place.
        time_s: (M,) time of each box, from any epoch.
        group: (M,) size group that the detector says.
        score: (M,) how sure it is.
        side_px: (2, M) width and height of the observed box.
        predicted_px: (2, M) the same for the vehicle of the size so far.
        slope: (2, 3, M) d(side) / d(length, width, height), pixels per metre.
        usable: (M,) False where the box says nothing about the size.
    """
    state[CLASS.start + group, np.arange(len(group))] += np.maximum(score, 1e-3)
    elapsed = time_s - state[TIME]
    state[TIME] = time_s

    variance = BOX_SIGMA_PX**2 + (BOX_SIGMA_RATIO * side_px) ** 2
    residual = side_px - predicted_px
    surprise = np.sqrt(residual**2 / variance)
    weight = np.where(usable, np.minimum(1.0, elapsed / CORRELATION_S), 0.0)
    weight = weight * np.minimum(1.0, HUBER / np.maximum(surprise, 1e-9)) / variance
    weighted = slope * weight[:, None]
    state[INFO] += total(slope[:, :, None] * weighted[:, None]).reshape(9, -1)
    target = residual + total(slope.transpose(1, 0, 2) * state[DIM, None])
    state[VECTOR] += total(target[:, None] * weighted)

    prior = state[CLASS].argmax(axis=0)
    precision = state[INFO].reshape(3, 3, -1) + PRECISION.transpose(1, 2, 0)[:, :, prior]
    covariance = solve(precision, np.eye(3)[:, :, None])
    vector = state[VECTOR] + PRIOR_VECTOR[prior].T
    size = total(covariance * vector[:, None])
    state[DIM] = np.clip(size, LOWEST_M[prior].T, HIGHEST_M[prior].T)
    state[COV] = covariance.reshape(9, -1)
