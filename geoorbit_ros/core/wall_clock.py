"""What this computer's clock says about a stamp, and how far that clock itself is believed."""

from __future__ import annotations

import time
from collections.abc import Callable

from geoorbit_ros.core.errors import MessageError

DAY_NS = 86_400_000_000_000
"""Nanoseconds of a day."""
CLOCK_SET_NS = 1_767_225_600 * 10**9
"""2026-01-01. A computer that says it is earlier has not set its clock yet, and so can't judge:
this program is younger."""
MAX_AHEAD_NS = DAY_NS
"""A stamp later than now by more than this is no time of capture. Chosen: a day is more than any
time zone that was mistaken for UTC; larger lets a stamp in that the counts then wait for."""
LEAP_NS = DAY_NS
"""A clock that went forward by more than this against the time that passed has leapt. Chosen: as
`MAX_AHEAD_NS`; smaller takes a computer that slept over night for one that is wrong."""
BELIEVE_NS = DAY_NS
"""So long a leap must last before anything is deleted for it. Chosen: a day is long enough for a
person, or the network's time, to put it right; longer keeps old data longer."""


def refuse_ahead(stamp_ns: int, place: str, now_ns: int | None = None) -> None:
    """Refuse a stamp that lies in the future.

    Stamps of the past are fine: recordings are played again. A computer whose clock is not set
    refuses nothing.

    Args:
        stamp_ns: Of a message.
        place: Its topic, for the error.
        now_ns: This computer's clock; None asks it.

    Raises:
        MessageError: Later than now by more than `MAX_AHEAD_NS`.
    """
    now = time.time_ns() if now_ns is None else now_ns
    if now >= CLOCK_SET_NS and stamp_ns > now + MAX_AHEAD_NS:
        ahead = (stamp_ns - now) / DAY_NS
        raise MessageError(
            place,
            f"stamp {stamp_ns / 1e9:.0f} s, {ahead:.0f} days after this computer's clock",
            "a time of capture: set the clock of the camera, or of this computer",
        )


class RetentionClock:
    """Says what is old enough to be deleted, by this computer's clock alone.

    A clock that leaps forward, or that says at the start that the last data are long past, is
    believed after `BELIEVE_NS` only: until then nothing is deleted for it. One that goes back
    is believed at once, for it deletes less.

    Args:
        days: How long data are kept; 0 keeps all.
        newest_ns: When the last data were stored, by the clock of then; None: nothing is.
        wall_ns: The clock.
        steady_ns: A clock that does not leap.
    """

    def __init__(
        self,
        days: float,
        newest_ns: int | None = None,
        wall_ns: Callable[[], int] = time.time_ns,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._kept_ns = round(days * DAY_NS)
        self._wall_ns, self._steady_ns = wall_ns, steady_ns
        self._offset_ns = (wall_ns() if newest_ns is None else newest_ns) - steady_ns()
        self._leapt: tuple[int, int] | None = None

    @property
    def doubt(self) -> str | None:
        """Why nothing is deleted at present; None: the clock is believed."""
        if self._leapt is None:
            return None
        days = (self._leapt[0] - self._offset_ns) / DAY_NS
        return (
            f"old data are kept for now: this computer's clock went forward by {days:.0f} days; "
            "it is believed after one day"
        )

    def cutoff_ns(self) -> int | None:
        """What was stored before this is old; None: nothing is to be deleted."""
        wall, steady = self._wall_ns(), self._steady_ns()
        if not self._kept_ns or wall < CLOCK_SET_NS:
            return None
        offset = wall - steady
        if offset <= self._offset_ns + LEAP_NS:
            self._offset_ns, self._leapt = offset, None
        elif self._leapt is None or abs(offset - self._leapt[0]) > LEAP_NS:
            self._leapt = offset, steady
        elif steady - self._leapt[1] >= BELIEVE_NS:
            self._offset_ns, self._leapt = offset, None
        return None if self._leapt else wall - self._kept_ns
