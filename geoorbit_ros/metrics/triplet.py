"""The paper's centreline embedding loss (section IV-A)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.metrics.lane_pairs import LanePairs

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
