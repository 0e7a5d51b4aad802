"""When each frame of a recording is due, and which frames of a stream are wanted at all.

Neither knows a clock: both are told the time.
"""

from __future__ import annotations

_MAX_LATE_S = 1.0
"""After a longer hold-up (a suspended process), time goes on from there without a burst."""
_MAX_WAIT_S = 5.0
"""Longer silences in a recording are cut to this."""
_EARLY_RATIO = 0.25
"""Share of the period by which a frame may come early, so that jitter drops none at full rate."""


class Pace:
    """Lets the stamps of a recording pass at a multiple of real time.

    Args:
        rate: Speed relative to the recording; 0 makes every frame due at once.

    Attributes:
        anchors: How often time began anew: at the first frame, and after hold-ups and silences;
            once, and before that frame, when all are due at once.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.anchors = int(rate == 0.0)
        self._anchor: tuple[int, float] | None = None

    def wait_s(self, stamp_ns: int, wall_s: float) -> float:
        """Time from `wall_s` (of any steady clock) until the frame is due; 0 when it is.

        The first frame is due when it is asked about.
        """
        if self._rate == 0.0:
            return 0.0
        if self._anchor is None:
            self._anchor = stamp_ns, wall_s
            self.anchors += 1
        first_ns, start_s = self._anchor
        wait_s = start_s + (stamp_ns - first_ns) / 1e9 / self._rate - wall_s
        if not -_MAX_LATE_S <= wait_s <= _MAX_WAIT_S:
            wait_s = min(max(wait_s, 0.0), _MAX_WAIT_S)
            self._anchor = stamp_ns, wall_s + wait_s
            self.anchors += 1
        return max(wait_s, 0.0)


class Thinning:
    """Keeps at most so many frames per second of their own time, evenly.

    Attributes:
        max_fps: Frames per second; 0 keeps all. May be changed at any time.
        left_out: Frames not kept so far.
    """

    def __init__(self, max_fps: float) -> None:
        self.max_fps = max_fps
        self.left_out = 0
        self._due_ns: float | None = None

    def keep(self, stamp_ns: int) -> bool:
        """Whether to use the frame; call it once for each."""
        if self.max_fps == 0.0:
            return True
        period_ns = 1e9 / self.max_fps
        due_ns = self._due_ns
        if due_ns is None or not stamp_ns - period_ns < due_ns < stamp_ns + 2 * period_ns:
            due_ns = float(stamp_ns)  # the first one, after a gap, or after a step of the clock
        if stamp_ns < due_ns - _EARLY_RATIO * period_ns:
            self.left_out += 1
            return False
        self._due_ns = due_ns + period_ns
        return True
