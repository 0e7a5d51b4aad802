"""How fast a vehicle can cross the road: a box that jumps to the next lane takes none with it.

Boxes far away, or partly hidden, can be off by a lane for half a second. Positions are what the
tracks say; but the lane is judged by where the vehicle can be by then. The limit is that of a lane
change, so that a real one is never behind.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ACROSS_MPS = 2.5
"""A lane change in two seconds reaches 2.5 m/s half-way, three times the usual."""
BEGINS_S = 1.0
"""So long the place of a track that has just begun is no better known than what follows."""


class CrossingLimit:
    """Remembers where across the road each vehicle, in its slot, can be.

    Args:
        capacity: Slots at first; `reserve` makes more.
    """

    def __init__(self, capacity: int) -> None:
        self._xy = np.full((capacity, 2), np.nan)
        self._age_s = np.zeros(capacity)
        self._unseen = np.zeros(capacity, dtype=np.bool_)

    def reserve(self, capacity: int) -> None:
        """Room for so many slots."""
        more = capacity - len(self._age_s)
        if more > 0:
            self._xy = np.concatenate([self._xy, np.full((more, 2), np.nan)])
            self._age_s = np.append(self._age_s, np.zeros(more))
            self._unseen = np.append(self._unseen, np.zeros(more, dtype=np.bool_))

    def forget(self, slot: NDArray[np.int64]) -> None:
        """Vehicles in these slots are new ones."""
        self._xy[slot], self._age_s[slot], self._unseen[slot] = np.nan, 0.0, False

    def excess(
        self,
        slot: NDArray[np.int64],
        xy: Array,
        heading_rad: Array,
        observed: NDArray[np.bool_],
        step_s: float,
    ) -> Array:
        """(M, C) how much farther to the left vehicles seem to be than they can be.

        Args:
            slot: (M,) which vehicles.
            xy: (M, 2) where their tracks are.
            heading_rad: (M, C) directions of the lanes that they may be in.
            observed: (M,) whether a camera sees them; where they are seen again, they are.
            step_s: Time since the last step.
        """
        gap = xy - self._xy[slot]
        gap[(self._age_s[slot] < BEGINS_S) | self._unseen[slot] | np.isnan(gap[:, 0])] = 0.0
        self._age_s[slot] += step_s
        self._unseen[slot] = ~observed
        left = gap[:, 1:] * np.cos(heading_rad) - gap[:, :1] * np.sin(heading_rad)
        reach_m = MAX_ACROSS_MPS * step_s
        return np.asarray(left - np.clip(left, -reach_m, reach_m))

    def keep(self, slot: NDArray[np.int64], xy: Array, heading_rad: Array, excess_m: Array) -> None:
        """Vehicles at `xy` (M, 2) are in lanes of these directions (M,), with this excess (M,)."""
        aside = np.column_stack((np.sin(heading_rad), -np.cos(heading_rad)))
        self._xy[slot] = xy + excess_m[:, None] * aside
