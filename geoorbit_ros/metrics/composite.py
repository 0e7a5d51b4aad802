"""The paper's composite objective (section IV-B) and what goes into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.metrics.lane_number import lane_number_loss
from geoorbit_ros.metrics.lane_pairs import pair_lanes
from geoorbit_ros.metrics.triplet import LaneEmbedding, center_loss
from geoorbit_ros.metrics.width_loss import width_loss

TERMS = ("consistency", "geometry", "center", "lane_num", "total")


@dataclass(frozen=True, slots=True)
class LossWeights:
    """lambda_1 to lambda_4. The paper prints none; every term counts once here.

    Raises:
        ParameterError: A weight that is negative or not finite.
    """

    consistency: float = 1.0
    geometry: float = 1.0
    center: float = 1.0
    lane_num: float = 1.0

    def __post_init__(self) -> None:
        for name, value in zip(TERMS, astuple(self), strict=False):
            if not 0.0 <= value < np.inf:
                raise ParameterError(f"loss weight '{name}'", value, "0 or more")


@dataclass(frozen=True, slots=True)
class LaneLosses:
    """The paper's losses of one camera.

    Attributes:
        consistency: Mean Fréchet distance of the lanes, metres.
        geometry: Sum of squared width differences, square metres.
        center: Sum of triplet losses, squared lane spacings.
        lane_num: Difference in the number of lanes.
        total: Their weighted sum.
        detected: Lanes in the map, for those who must not take an empty one for a good one.
    """

    consistency: float
    geometry: float
    center: float
    lane_num: float
    total: float
    detected: int


def lane_losses(
    detected: Sequence[Lane],
    reference: Sequence[Lane],
    embedding: LaneEmbedding,
    weights: LossWeights | None = None,
    tolerated: int = 0,
) -> LaneLosses:
    """L_total = l1 L_consistency + l2 L_geometry + l3 L_center + l4 L_lane_num.

    Args:
        detected: Lanes of the map, in the frame of the reference.
        reference: Lanes that must be there, cut to what the camera sees.
        embedding: f of L_center.
        weights: Lambdas; the same for every model that is compared.
        tolerated: Further reference lanes that may be in the map or not (`lane_number`).

    Raises:
        TableError: No reference lane, or a detected lane that is not finite.
    """
    pairs = pair_lanes(detected, reference)
    chosen = weights or LossWeights()
    terms = (
        float(np.mean(pairs.frechet_m)),
        width_loss(pairs),
        center_loss(pairs, embedding),
        lane_number_loss(len(detected), len(reference), tolerated),
    )
    return LaneLosses(*terms, float(np.dot(terms, astuple(chosen))), len(detected))
