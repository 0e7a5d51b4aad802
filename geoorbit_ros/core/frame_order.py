"""Order in time of a stream of frames: which are late, which start anew, how many are missing."""

from __future__ import annotations

from collections import deque
from enum import Enum
from statistics import median
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.input_report import InputReport, Treatment

RESTART_NS = 1_000_000_000
"""Where the stamps of a recording go back by more than this, its source has started again; as
`restart_jump_s` of the nodes."""
NO_STAMP_NS = 86_400_000_000_000
"""Where stamps are later than this, one of 0 means none; earlier, a simulation's first frame.
Chosen: a day is longer than simulations run, and far before any clock that was set."""
CONTRADICTION_SHARE = 0.1
"""Where time starts again in more messages than this share, stamps and receipt say different
things. Chosen: a camera that is started again and again still sends ten frames in between."""
Stamps = NDArray[np.int64]

_INTERVALS = 31
"""Intervals behind the usual one: their median is right with up to fifteen gaps among them."""
_MAX_GAP = 1000
"""A longer silence, in frames, is a camera that was off, not frames that were lost. Chosen: a
minute at 15 frames per second; larger counts pauses as losses, smaller misses long ones."""


LEAP_NS = 60_000_000_000
"""A stamp later than the last by more than this is believed once another frame follows it. Chosen:
a minute's pause delays one frame; larger lets a wrong stamp through that ends a sequence."""
_LEAP_INTERVALS = 3
"""Where the usual interval is that long, so many of them are no leap."""


class Arrival(Enum):
    """What a frame's stamp says about it."""

    NEXT = "next"
    LATE = "late"
    RESTART = "restart"
    ODD = "odd"
    """Far before or after its neighbours, and none followed it."""


Frame = TypeVar("Frame")
Arrivals = list[tuple[Arrival, int, Frame]]


class FrameOrder(Generic[Frame]):
    """Puts frames in order by their stamps, one by one.

    A stamp that leaps, forward or back, may be a pause, a source that starts again, or one wrong
    stamp. Its frame waits for the next one, which says what it was: so one wrong stamp does not
    end a sequence.

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
        self._held: tuple[int, Frame] | None = None

    def take(self, stamp_ns: int, frame: Frame) -> Arrivals[Frame]:
        """Take a frame.

        Returns:
            The frames of which it is decided now, in order: this one, the one before that waited,
            both or none.
        """
        decided: Arrivals[Frame] = []
        last, held, self._held = self.last_ns, self._held, None
        if held is not None and last is not None:
            follows = held[0] < stamp_ns and stamp_ns - held[0] < abs(stamp_ns - last)
            decided.append((self._accept(held[0]) if follows else Arrival.ODD, *held))
        if self._leaps(stamp_ns):
            self._held = stamp_ns, frame
        else:
            decided.append((self._accept(stamp_ns), stamp_ns, frame))
        return decided

    def _leaps(self, stamp_ns: int) -> bool:
        if self.last_ns is None:
            return False
        interval = stamp_ns - self.last_ns
        usual = median(self._intervals) if self._intervals else 0
        return interval < -self._jump_ns or interval > max(LEAP_NS, _LEAP_INTERVALS * usual)

    def _accept(self, stamp_ns: int) -> Arrival:
        """Whether a frame comes next, too late (or twice), or begins anew."""
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


def order_fault(
    arrival: Arrival, stamp_ns: int, last_ns: int | None, place: str
) -> MessageError | None:
    """What is wrong with a frame that is not used; None for one that is."""
    last_s = (stamp_ns if last_ns is None else last_ns) / 1e9
    if arrival is Arrival.LATE:
        found = f"stamp {stamp_ns / 1e9:.9f} s after {last_s:.9f} s"
        return MessageError(place, found, "stamps that increase")
    if arrival is Arrival.ODD:
        found = f"one stamp {stamp_ns / 1e9:.3f} s among others near {last_s:.3f} s"
        return MessageError(place, found, "stamps that go on from the last")
    return None


def capture_times(
    stamp_ns: Stamps, received_ns: Stamps, report: InputReport
) -> tuple[Stamps, Stamps]:
    """When each frame was taken, from its stamp or, where that says nothing, its receipt.

    Args:
        stamp_ns: (M,) of the messages, 0 for none; in the order of receipt.
        received_ns: (M,) when the recorder took them.
        report: Takes what was found.

    Returns:
        (M,) times, and (M,) how often the source has started again before.
    """
    run = np.zeros(len(stamp_ns), np.int64)
    known = stamp_ns > 0
    if not known.any():
        if len(stamp_ns) > 1:
            text = "messages have no time of capture (stamp 0); their times of receipt are used"
            report.note(Treatment.REPAIRED, text)
        return received_ns.copy(), run
    usual = np.median(stamp_ns[known])
    absent = (stamp_ns < 0) | (~known & (usual > NO_STAMP_NS))
    times = stamp_ns.copy()
    if absent.any():
        offset = np.median(stamp_ns[known] - received_ns[known]).astype(np.int64)
        times[absent] = received_ns[absent] + offset
        text = (
            f"{absent.sum()} of {len(times)} messages have no time of capture; received times count"
        )
        report.note(Treatment.REPAIRED, text, f"message {np.argmax(absent) + 1}")
    times = _without_odd(times, received_ns, report)
    run = _runs(times)
    if run[-1] > CONTRADICTION_SHARE * len(run):
        text = "stamps and times of receipt contradict each other; times of receipt count"
        report.note(Treatment.DOUBTFUL, text)
        return received_ns.copy(), np.zeros_like(run)
    late = (np.diff(times) < 0) & (np.diff(run) == 0)
    if late.any():
        text = f"{late.sum()} of {len(times)} messages came after others of a later time; sorted"
        report.note(Treatment.REPAIRED, text, f"message {np.argmax(late) + 2}")
    return _one_after_the_other(times, run, received_ns, report), run


def _without_odd(times: Stamps, received_ns: Stamps, report: InputReport) -> Stamps:
    """Times in which one far from both its neighbours, which lie together, is repaired."""
    before, here, after = times[:-2], times[1:-1], times[2:]
    near = np.abs(after - before) <= LEAP_NS
    odd = 1 + np.flatnonzero(
        near & (np.abs(here - before) > LEAP_NS) & (np.abs(here - after) > LEAP_NS)
    )
    if not len(odd):
        return times
    text = f"{len(odd)} of {len(times)} messages have a time far from those around them; repaired"
    report.note(Treatment.REPAIRED, text, f"message {odd[0] + 1}")
    times = times.copy()
    times[odd] = times[odd - 1] + np.maximum(received_ns[odd] - received_ns[odd - 1], 1)
    return times


def _one_after_the_other(
    times: Stamps, run: Stamps, received_ns: Stamps, report: InputReport
) -> Stamps:
    """Times in which each run of a source begins as long after the last as it was received."""
    for k in np.flatnonzero(np.diff(run)) + 1:
        before, here = slice(None, k), run == run[k]
        back_s = (times[before].max() - times[k]) / 1e9
        expected = times[k - 1] + max(int(received_ns[k] - received_ns[k - 1]), 1)
        times[here] += max(expected, times[before].max() + 1) - times[here].min()
        text = (
            f"time goes back by {back_s:.1f} s: the source started again; put after what was before"
        )
        report.note(Treatment.REPAIRED, text, f"message {k + 1}")
    return times


def _runs(times: Stamps) -> Stamps:
    """(M,) how often time has gone back by more than `RESTART_NS` before each message, to stay.

    A single message from before is one that came late.
    """
    run = np.zeros(len(times), np.int64)
    latest = int(times[0])
    following = [*times[1:].tolist(), latest + RESTART_NS]
    for k, (time_ns, next_ns) in enumerate(zip(times.tolist(), following, strict=True)):
        run[k] = run[k - 1] if k else 0
        if max(time_ns, next_ns) < latest - RESTART_NS:
            run[k] += 1
            latest = time_ns
        latest = max(latest, time_ns)
    return run
