"""How traffic moved at each place of the image: what to expect of a vehicle that is new.

From one box nobody knows where its vehicle is going; at five frames per second it may be lengths
away in the next frame, where its neighbour was. A camera stands still and traffic follows the road:
vehicles move as those did that were there before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.motion import MEAN, RATE, MotionNoise

Array = NDArray[np.float64]

CAPACITY = 2000
"""Samples that are kept, the latest ones: half a minute of dense traffic, minutes of sparse."""
REACH = 2.0
"""1-sigma of the neighbourhood, sizes of the new box: about a lane."""
WIDE_WEIGHT = 1.0
"""Samples that the wide prior counts for: some vehicle may do what none did before."""


class Flow:
    """Samples of the motion of confirmed tracks.

    Arrays are (4, N): x, y in pixels and the logarithms of width and height, as in `motion`.
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
