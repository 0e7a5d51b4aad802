"""Whether an unobserved vehicle may be shown where it should be: where that was right so far.

One detector misses vehicles at random, and they are where they are expected. Another, which sees
what moves, loses the track of a piece that joined its vehicle again, and nothing is there. Which
it is shows afterwards: the vehicle comes back, or its track ends.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIDDEN_SHARE = 0.5
"""A place covered by one detection to this share is hidden; others are in the open."""
FAITH = 5.0
"""Right predictions that a tracker takes for granted at its start."""
LEAST_SHARE = 0.75
"""Share of predictions that must have been right for the next ones to be shown."""
MEMORY = 2000.0
"""Predictions after which what was before counts 1/e: some minutes of usual traffic."""


class Foresight:
    """Counts of predictions that proved right and wrong, in the open and hidden."""

    def __init__(self) -> None:
        self._right, self._wrong = np.full(2, FAITH), np.zeros(2)

    def trusted(self, hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(N,) whether predictions at places that are `hidden` (N,) or not may be shown."""
        share = self._right / (self._right + self._wrong)
        return np.asarray((share >= LEAST_SHARE)[hidden.astype(np.intp)])

    def learn(self, foreseen: Array, right: bool) -> None:
        """Take predictions that proved right or wrong.

        Args:
            foreseen: (2, N) how often tracks were predicted in the open and hidden.
            right: Whether they came back, or ended.
        """
        count = foreseen.sum(axis=1)
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
