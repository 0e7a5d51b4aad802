"""Which detected lane each reference lane is compared with, for the paper's losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.metrics.frechet import frechet_matrix, resample

SAMPLES = 64
"""Points per centreline: one every two to three metres of what a roadside camera sees."""


@dataclass(frozen=True, slots=True)
class LanePairs:
    """Every reference lane beside its detected counterpart.

    Attributes:
        reference: (R, `SAMPLES`, 2) reference centrelines c, metres in the map frame.
        reference_width_m: (R,) their widths.
        detected: (R, `SAMPLES`, 2) counterparts s.
        detected_width_m: (R,) their widths.
        frechet_m: (R,) Fréchet distance of each pair, metres.
        detected_count: Lanes in the map.
    """

    reference: NDArray[np.float64]
    reference_width_m: NDArray[np.float64]
    detected: NDArray[np.float64]
    detected_width_m: NDArray[np.float64]
    frechet_m: NDArray[np.float64]


def pair_lanes(detected: Sequence[Lane], reference: Sequence[Lane]) -> LanePairs:
    """Match lanes one to one with the smallest sum of Fréchet distances (Hungarian method).

    Reference lanes that are left over are compared with the detected lane nearest to them: a map
    gains nothing by leaving out a lane that it would draw badly. Detected lanes that are left over
    count in the lane number loss. Where the map is empty, the counterpart has neither length nor
    width: the point half-way along the reference. Curves are directed: a lane that points the wrong
    way is as far from its reference as the reference is long.

    Raises:
        TableError: No reference lane, or a detected lane that is not finite.
    """
    if not reference:
        raise TableError("reference lanes", "none", "at least one")
    lines = [resample(lane.centerline_m, SAMPLES) for lane in reference]
    found = [resample(lane.centerline_m, SAMPLES) for lane in detected]
    width = np.array([lane.width_m for lane in detected])
    if not np.isfinite(width).all():
        raise TableError("detected lanes", "a width that is not finite", "metres")
    reference_width = np.array([lane.width_m for lane in reference])
    if not found:
        middle = [np.repeat(line[SAMPLES // 2][None, :], SAMPLES, axis=0) for line in lines]
        reach = np.array(
            [frechet_matrix([a], [b])[0, 0] for a, b in zip(lines, middle, strict=True)]
        )
        return LanePairs(
            np.array(lines), reference_width, np.array(middle), np.zeros(len(lines)), reach
        )
    distance = frechet_matrix(lines, found)
    partner = np.argmin(distance, axis=1)
    rows, columns = linear_sum_assignment(distance)
    partner[rows] = columns
    return LanePairs(
        np.array(lines),
        reference_width,
        np.array(found)[partner],
        width[partner],
        distance[np.arange(len(lines)), partner],
    )
