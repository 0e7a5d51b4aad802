"""The paper's losses (section IV-A) and its composite objective (section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.metrics.lane_pairs import LanePairs, pair_lanes


def lane_number_loss(detected: int, reference: int, tolerated: int = 0) -> float:
    """L_lane_num = |N_det - N_ref|, in lanes.

    Args:
        detected: N_det, lanes in the map.
        reference: N_ref, lanes that must be there.
        tolerated: Reference lanes beyond those that may be there or not, since hardly anybody
            drove on them: N_ref is then only known to lie in [reference, reference + tolerated],
            and the loss is the distance from that interval. 0 is the paper's equation.
    """
    return float(max(reference - detected, detected - reference - tolerated, 0))


def width_loss(pairs: LanePairs) -> float:
    """L_geometry = sum over M of |s_w - c_w|^2, in square metres.

    M are the reference lanes, s_w the width of the detected counterpart, c_w the reference width.
    """
    return float(np.sum((pairs.detected_width_m - pairs.reference_width_m) ** 2))


Array = NDArray[np.float64]


class LaneEmbedding(Protocol):
    """f(.), a learned feature mapping of centrelines."""

    def embed(self, line_m: Array) -> Array:
        """(B, E) features of (B, S, 2) centrelines of one camera, metres in its road frame."""
        ...


def center_loss(pairs: LanePairs, embedding: LaneEmbedding) -> float:
    """L_center = sum over E of max(|f(c) - f(s)|^2 - |f(c) - f(c')|^2, 0).

    E are the triplets (c, s, c'): each reference lane c, its detected counterpart s, and as the
    negative c' the hardest real one, the other reference lane whose embedding is nearest to that of
    c. A camera with one reference lane only has no other: the lane's own copy one lane width to its
    left stands for it.
    """
    axes = _road_frame(pairs.reference)
    reference = axes(pairs.reference)
    detected = axes(pairs.detected)
    truth, found = embedding.embed(reference), embedding.embed(detected)
    if len(reference) > 1:
        between = np.sum((truth[:, None, :] - truth[None, :, :]) ** 2, axis=2)
        np.fill_diagonal(between, np.inf)
        negative = np.min(between, axis=1)
    else:
        aside = reference + np.array([0.0, pairs.reference_width_m[0]])
        negative = np.sum((truth - embedding.embed(aside)) ** 2, axis=1)
    positive = np.sum((truth - found) ** 2, axis=1)
    return float(np.sum(np.maximum(positive - negative, 0.0)))


class _road_frame:  # noqa: N801 - used as a function
    """Coordinates with the reference's middle as origin and its main axis as x."""

    def __init__(self, reference: Array) -> None:
        points = reference.reshape(-1, 2)
        self._middle = points.mean(axis=0)
        _, _, axes = np.linalg.svd(points - self._middle, full_matrices=False)
        # A rotation, not a reflection; which of the two ends is positive doesn't matter to f.
        self._axes = axes if np.linalg.det(axes) > 0.0 else axes * np.array([[1.0], [-1.0]])

    def __call__(self, line_m: Array) -> Array:
        return np.asarray((line_m - self._middle) @ self._axes.T)


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
