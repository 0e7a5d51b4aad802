"""What a tracker learns: how vehicles move at each place, and where predictions are right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.motion_model import MEAN, RATE, MotionNoise

Array = NDArray[np.float64]

CAPACITY = 2000
"""Samples that are kept, the latest ones: half a minute of dense traffic, minutes of sparse.
Chosen: more take time, fewer forget quiet lanes."""
REACH = 2.0
"""1-sigma of the neighbourhood in sizes of the new box: about a lane. Chosen: larger mixes lanes,
smaller finds no samples."""
WIDE_WEIGHT = 1.0
"""Samples that the wide prior counts for, because a vehicle may do what none did before. Chosen:
larger learns later, smaller loses such a vehicle."""


class Flow:
    """Samples of the motion of confirmed tracks.

    Arrays are (4, N): x, y in pixels and the logarithms of width and height, as in `motion_model`.
    """

    def __init__(self) -> None:
        self._place, self._rate = np.empty((2, CAPACITY)), np.empty((4, CAPACITY))
        self._count = 0

    def add(self, state: Array) -> None:
        """Remember states (5, 4, N)."""
        state = state[:, :, -CAPACITY:]
        slot = (self._count + np.arange(state.shape[2])) % CAPACITY
        self._place[:, slot], self._rate[:, slot] = state[MEAN, :2], state[RATE]
        self._count += state.shape[2]

    def expect(self, box: Array, noise: MotionNoise) -> tuple[Array, Array]:
        """Mean (4, M) and variance (4, M) of the rates of vehicles first seen in boxes (4, M).

        They are those of the mixture of the wide prior and the samples nearby, each weighted by its
        distance. Where both directions pass, the mixture is wide again.
        """
        wide = noise.rate_variance(box)
        held = min(self._count, CAPACITY)
        if not held:
            return np.zeros_like(box), wide
        apart = self._place[:, None, :held] - box[:2, :, None]
        squared = (apart * apart).sum(axis=0) / (REACH**2 * box[2] * box[3])[:, None]
        weight = np.exp(-0.5 * squared)
        rate = self._rate[:, :held]
        total = WIDE_WEIGHT + weight.sum(axis=1)
        mean = rate @ weight.T / total
        square = (WIDE_WEIGHT * wide + (rate * rate) @ weight.T) / total
        return mean, square - mean * mean


HIDDEN_SHARE = 0.5
"""A place that one detection covers to this share is hidden; others are in the open. Chosen: most
of the vehicle is then out of sight."""
PRIOR_RIGHT = 5.0
"""Right predictions that a tracker is credited with at its start. Chosen: more show wrong
predictions for longer, fewer show none after one error."""
LEAST_SHARE = 0.75
"""Share of predictions that must have been right for the next ones to be shown (docs/tracking.md).
Chosen: larger hides useful ones, smaller shows wrong ones."""
MEMORY = 2000.0
"""Predictions after which what was before counts 1/e: some minutes of usual traffic. Chosen: more
adapt to another detector later, fewer are noisier."""


class PredictionGate:
    """Counts of predictions that proved right and wrong, in the open and hidden."""

    def __init__(self) -> None:
        self._right, self._wrong = np.full(2, PRIOR_RIGHT), np.zeros(2)

    def trusted(self, hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(N,) whether predictions at places that are `hidden` (N,) or not may be shown."""
        share = self._right / (self._right + self._wrong)
        return np.asarray((share >= LEAST_SHARE)[hidden.astype(np.intp)])

    def learn(self, predicted_frames: Array, right: bool) -> None:
        """Take predictions that proved right or wrong.

        Args:
            predicted_frames: (2, N) how often tracks were predicted in the open and hidden.
            right: Whether they came back, or ended.
        """
        count = predicted_frames.sum(axis=1)
        fade = np.exp(-count.sum() / MEMORY)
        self._right, self._wrong = fade * self._right, fade * self._wrong
        if right:
            self._right += count
        else:
            self._wrong += count


def hidden(box: Array, detections: Array) -> NDArray[np.bool_]:
    """(N,) which boxes (4, N) lie behind detections (4, M); x, y, width, height of both."""
    if not detections.size:
        return np.zeros(box.shape[1], dtype=bool)
    half, other = 0.5 * box[2:, :, None], 0.5 * detections[2:, None, :]
    apart = np.abs(box[:2, :, None] - detections[:2, None, :])
    shared = np.clip(np.minimum(half + other - apart, 2.0 * np.minimum(half, other)), 0.0, None)
    share = shared.prod(axis=0).max(axis=1) / (box[2] * box[3])
    return np.asarray(share >= HIDDEN_SHARE)
