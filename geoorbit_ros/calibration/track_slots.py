"""Gives every tracked id a row in state arrays, for as long as it is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FORGET_NS = 10_000_000_000
"""An id unseen for 10 s of data time is a new vehicle when it comes back."""
SWEEP_NS = 1_000_000_000
NO_IDENTITY = -(2**40)
"""Keys from here downwards stand for detections without identity; no int32 id gets there."""


class TrackSlots:
    """Maps track ids to slots of a growing table; slots of forgotten ids are used again.

    The answer depends on stamps and ids alone, never on when old slots are swept.
    """

    def __init__(self, capacity: int = 64) -> None:
        self._slot: dict[int, int] = {}
        self._free = list(range(capacity - 1, -1, -1))
        self._last_ns = np.zeros(capacity, dtype=np.int64)
        self._sweep_ns: int | None = None
        self._anonymous = NO_IDENTITY

    @property
    def capacity(self) -> int:
        """Rows that the state arrays need."""
        return len(self._last_ns)

    def __len__(self) -> int:
        return len(self._slot)

    def enter(
        self, stamp_ns: int, track_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Slots of the ids in one frame.

        Args:
            stamp_ns: Capture time, not earlier than in the last call.
            track_id: (M,); negative ids are detections without identity, new every time.

        Returns:
            slot (M,) and whether the id is new (M,), so that the caller starts its state afresh.
        """
        self._sweep(stamp_ns)
        ids = track_id.tolist()
        known = [self._slot.get(identity, -1) for identity in ids]
        fresh = np.zeros(len(ids), dtype=bool)
        if -1 in known:
            for k, identity in enumerate(ids):
                if identity < 0 or identity not in self._slot:
                    known[k] = self._new(identity)
                    self._last_ns[known[k]] = stamp_ns
                    fresh[k] = True
                else:
                    known[k] = self._slot[identity]
        slot = np.array(known, dtype=np.intp)
        fresh |= stamp_ns - self._last_ns[slot] > FORGET_NS
        self._last_ns[slot] = stamp_ns
        return slot, fresh

    def _new(self, track_id: int) -> int:
        if track_id < 0:
            self._anonymous -= 1
            track_id = self._anonymous
        if not self._free:
            size = self.capacity
            self._last_ns = np.append(self._last_ns, np.zeros(size, dtype=np.int64))
            self._free = list(range(2 * size - 1, size - 1, -1))
        slot = self._free.pop()
        self._slot[track_id] = slot
        return slot

    def _sweep(self, stamp_ns: int) -> None:
        """Once per second of data time, take back the slots of ids that are gone.

        Detections without identity carry negative keys and go at the first sweep.
        """
        if self._sweep_ns is not None and stamp_ns - self._sweep_ns < SWEEP_NS:
            return
        self._sweep_ns = stamp_ns
        gone = [
            key
            for key, slot in self._slot.items()
            if key < 0 or stamp_ns - self._last_ns[slot] > FORGET_NS
        ]
        self._free.extend(self._slot.pop(key) for key in gone)
