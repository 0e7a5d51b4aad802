"""The paper's losses (section IV-A) and its composite objective (section IV-B).

First each reference lane is paired with a detected one, by Fréchet distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError, TableError
from geoorbit_ros.core.lanes import Lane

Array = NDArray[np.float64]


def resample(line_m: Array, points: int) -> Array:
    """(points, 2) positions evenly spaced by arc length along a (K, 2) polyline, ends included.

    A line without length gives the same point `points` times.
    """
    line = np.asarray(line_m, dtype=np.float64)
    step = np.hypot(*np.diff(line, axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    at = np.linspace(0.0, arc[-1], points)
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])


def discrete_frechet(p_m: Array, q_m: Array) -> float:
    """Discrete Fréchet distance of two curves, in metres.

    Args:
        p_m: (N, 2) samples of one curve, in order.
        q_m: (M, 2) samples of the other.

    Raises:
        TableError: A curve without samples, or one that is not finite.
    """
    return float(frechet_matrix([p_m], [q_m])[0, 0])


def frechet_matrix(p_m: list[Array], q_m: list[Array]) -> Array:
    """Discrete Fréchet distance of every pair, all pairs at once.

    The table c(i, j) = max(d(i, j), min(c(i-1, j), c(i-1, j-1), c(i, j-1))) is filled along its
    anti-diagonals: entries of one anti-diagonal don't depend on each other.

    Args:
        p_m: A curves of one common number N of samples, each (N, 2).
        q_m: B curves of one common number M of samples, each (M, 2).

    Returns:
        (A, B) distances in metres; empty where a list is.

    Raises:
        TableError: Curves of a list differ in shape, have no sample, or are not finite.
    """
    if not p_m or not q_m:
        return np.empty((len(p_m), len(q_m)))
    p, q = _stack(p_m), _stack(q_m)
    gap = p[:, None, :, None, :] - q[None, :, None, :, :]
    distance = np.hypot(gap[..., 0], gap[..., 1])
    n, m = distance.shape[2:]
    # One cell of infinity before the first row: `leash[..., i + 1]` belongs to row i.
    shape = (*distance.shape[:2], n + 1)
    before, last = np.full(shape, np.inf), np.full(shape, np.inf)
    for diagonal in range(n + m - 1):
        low, high = max(0, diagonal - m + 1), min(diagonal, n - 1)
        i = np.arange(low, high + 1)
        leash = np.full(shape, np.inf)
        shortest = np.minimum(last[..., i], last[..., i + 1])
        shortest = np.minimum(shortest, before[..., i])
        if diagonal == 0:
            shortest[:] = 0.0
        leash[..., i + 1] = np.maximum(distance[:, :, i, diagonal - i], shortest)
        before, last = last, leash
    return np.asarray(last[..., n])


def _stack(lines: list[Array]) -> Array:
    shapes = {np.shape(line) for line in lines}
    if len(shapes) > 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        found = ", ".join(str(s) for s in sorted(shapes))
        raise TableError("Fréchet distance", f"curves of shape {found}", "one shape (N, 2), N > 0")
    stacked = np.asarray(lines, dtype=np.float64)
    if not np.isfinite(stacked).all():
        raise TableError("Fréchet distance", "a curve with NaN or infinity", "finite metres")
    return stacked


SAMPLES = 64
"""Points per centreline: one every two to three metres of what a roadside camera sees. Chosen: more
cost time, fewer miss bends."""


@dataclass(frozen=True, slots=True)
class LanePairs:
    """Every reference lane beside its detected counterpart.

    Attributes:
        reference: (R, `SAMPLES`, 2) reference centrelines c, metres in the map frame.
        reference_width_m: (R,) their widths.
        detected: (R, `SAMPLES`, 2) counterparts s.
        detected_width_m: (R,) their widths.
        frechet_m: (R,) Fréchet distance of each pair, metres.
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
    rows, columns = scipy.optimize.linear_sum_assignment(distance)
    partner[rows] = columns
    return LanePairs(
        np.array(lines),
        reference_width,
        np.array(found)[partner],
        width[partner],
        distance[np.arange(len(lines)), partner],
    )


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
