"""Order in time of a stream of frames: which are late, which start anew, how many are missing."""

from __future__ import annotations

from collections import deque
from enum import Enum
from statistics import median

_INTERVALS = 31
"""Intervals behind the usual one: their median is right with up to fifteen gaps among them."""
_MAX_GAP = 1000
"""A longer silence, in frames, is a camera that was off, not frames that were lost. Chosen: a
minute at 15 frames per second; larger counts pauses as losses, smaller misses long ones."""


class Arrival(Enum):
    """What a frame's stamp says about it."""

    NEXT = "next"
    LATE = "late"
    RESTART = "restart"


class FrameOrder:
    """Checks stamps one by one.

    Args:
        restart_jump_s: A stamp earlier than the last by more than this begins a new sequence.

    Attributes:
        last_ns: Stamp of the last frame in order; None before the first.
        missing: Frames missing so far, by the median interval of the last 31.
    """

    def __init__(self, restart_jump_s: float) -> None:
        self.last_ns: int | None = None
        self.missing = 0
        self._jump_ns = round(restart_jump_s * 1e9)
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)

    def check(self, stamp_ns: int) -> Arrival:
        """Whether a frame with this stamp comes next, too late (or twice), or begins anew."""
        last = self.last_ns
        if last is None:
            self.last_ns = stamp_ns
            return Arrival.NEXT
        interval = stamp_ns - last
        if -self._jump_ns <= interval <= 0:
            return Arrival.LATE
        self.last_ns = stamp_ns
        if interval < 0:
            self._intervals.clear()
            return Arrival.RESTART
        if len(self._intervals) == _INTERVALS:
            gap = round(interval / median(self._intervals)) - 1
            self.missing += gap if gap <= _MAX_GAP else 0
        self._intervals.append(interval)
        return Arrival.NEXT
