"""Intervals that end on the clock of the camera's time zone, and how much of each was watched."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.frame_spool import AnyFrames
from geoorbit_ros.core.tables import distinct

DAY_S = 86_400
CLOCK_SINCE_NS = 631_152_000_000_000_000
"""1990 as nanoseconds since 1970: earlier stamps are times since the recording began."""
NS = 1_000_000_000
AT_ONCE = 250_000
"""Rows whose ids are looked at together. Chosen: more take memory."""
GAP_S = 2.0
"""Frames farther apart than this were not watched between. Chosen: cameras send an image a second
or more often; longer takes short outages for empty roads."""
GAP_BY_CHANCE = 21.0
"""Files that list vehicles only don't say when the camera watched an empty road. A pause is an
outage when it is so many times as long as the mean time between vehicles: chance makes it once in a
million, e^-14, and traffic comes in platoons, which makes pauses longer by half."""
LEAST_QUIET_S = 30.0
"""A shorter pause of such a file is never an outage. Chosen: half the red time of a traffic light;
longer hides outages."""


@dataclass(frozen=True, slots=True)
class IntervalClock:
    """Cuts time into intervals.

    On a clock, intervals begin at local midnight and at each `length_s` of wall-clock time after
    it; where summer time begins or ends, those of over an hour are an hour shorter or longer, and
    those of an hour and less are there once less or once more. Recordings whose times count from
    their own beginning have intervals from 0.

    Attributes:
        length_s: A whole number of seconds that divides a day.
        zone: IANA name of the time zone.
    """

    length_s: int
    zone: str = "UTC"

    def __post_init__(self) -> None:
        if self.length_s < 1 or DAY_S % self.length_s:
            raise ParameterError(
                "interval", f"{self.length_s} s", "1 s to 1 day, a length that divides a day"
            )

    def start_of(self, stamp_ns: int) -> int:
        """Stamp at which the interval of a stamp begins."""
        if stamp_ns < CLOCK_SINCE_NS:
            return stamp_ns - stamp_ns % (self.length_s * NS)
        zone = ZoneInfo(self.zone)
        local = datetime.fromtimestamp(stamp_ns // NS, zone)
        since_midnight = local.hour * 3600 + local.minute * 60 + local.second
        wall = datetime(local.year, local.month, local.day, tzinfo=zone)
        wall += timedelta(seconds=since_midnight - since_midnight % self.length_s)
        # An hour that comes twice has its intervals twice; longer ones span both.
        return _stamp(wall.replace(fold=local.fold if self.length_s <= 3600 else 0))

    def end_of(self, start_ns: int) -> int:
        """Stamp at which the interval that begins at `start_ns` ends."""
        if start_ns < CLOCK_SINCE_NS:
            return start_ns + self.length_s * NS
        if self.length_s > 3600:
            wall = datetime.fromtimestamp(start_ns // NS, ZoneInfo(self.zone))
            since_midnight = wall.hour * 3600 + wall.minute * 60 + wall.second
            short = since_midnight % self.length_s  # it began when an hour was left out
            return _stamp((wall + timedelta(seconds=self.length_s - short)).replace(fold=0))
        end_ns = start_ns + self.length_s * NS
        while (found_ns := self.start_of(end_ns)) == start_ns:
            end_ns += self.length_s * NS  # summer time ended by less than an interval
        return found_ns if found_ns > start_ns else end_ns

    def edges(self, first_ns: int, last_ns: int) -> NDArray[np.int64]:
        """Stamps (K + 1,) between which the K intervals lie that hold the time from first to last.

        Raises:
            ParameterError: More than ten million intervals.
        """
        if (last_ns - first_ns) // (self.length_s * NS) > 10_000_000:
            raise ParameterError(
                "interval",
                f"{self.length_s} s over {(last_ns - first_ns) / NS:.0f} s",
                "a longer one",
            )
        edges = [self.start_of(first_ns)]
        while edges[-1] <= last_ns:
            edges.append(self.end_of(edges[-1]))
        return np.array(edges, np.int64)

    def text(self, stamp_ns: int) -> str:
        """A stamp as people write it: local time with its offset, or seconds."""
        if stamp_ns < CLOCK_SINCE_NS:
            return f"{stamp_ns / NS:.10g}"
        return datetime.fromtimestamp(stamp_ns // NS, ZoneInfo(self.zone)).isoformat()


def checked_zone(name: str, place: str) -> str:
    """The IANA name, if there is such a time zone; `place` is who names it, for errors.

    Raises:
        ParameterError: There is none.
    """
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ParameterError(place, f"'{name}'", "a name such as Europe/Berlin") from None
    return name


def _stamp(wall: datetime) -> int:
    return int(wall.astimezone(UTC).timestamp()) * NS


@dataclass(slots=True)
class ObservedTime:
    """Stretches of time in which the camera watched.

    Attributes:
        max_gap_s: Frames farther apart than this were not watched between.
        spans_ns: (first, last) stamp of each stretch.
    """

    max_gap_s: float = GAP_S
    spans_ns: list[tuple[int, int]] = field(default_factory=list)

    def add(self, stamp_ns: NDArray[np.int64]) -> None:
        """Take the stamps of frames, increasing, later than those before."""
        if not len(stamp_ns):
            return
        cut = np.flatnonzero(np.diff(stamp_ns) > self.max_gap_s * NS)
        first = stamp_ns[np.append(0, cut + 1)].tolist()
        last = stamp_ns[np.append(cut, len(stamp_ns) - 1)].tolist()
        if self.spans_ns and first[0] - self.spans_ns[-1][1] <= self.max_gap_s * NS:
            first[0] = self.spans_ns.pop()[0]
        self.spans_ns.extend(zip(first, last, strict=True))

    def seconds(self, edges_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K,) seconds watched in each interval between consecutive edges."""
        total = np.zeros(len(edges_ns) - 1)
        for first, last in self.spans_ns:
            a = max(int(np.searchsorted(edges_ns, first, side="right")) - 1, 0)
            b = min(int(np.searchsorted(edges_ns, last, side="right")), len(total))
            begin = np.maximum(edges_ns[a:b], first)
            end = np.minimum(edges_ns[a + 1 : b + 1], last)
            total[a:b] += np.maximum(end - begin, 0) / NS
        return total

    def watched(self, first_ns: NDArray[np.int64], last_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) whether all of each time from first to last was watched."""
        starts = np.array([a for a, _ in self.spans_ns], np.int64)
        ends = np.array([b for _, b in self.spans_ns], np.int64)
        if not len(starts):
            return np.zeros(len(first_ns), np.bool_)
        k = np.maximum(np.searchsorted(starts, first_ns, side="right") - 1, 0)
        return np.asarray((first_ns >= starts[k]) & (last_ns <= ends[k]))


def usual_gap_s(frames: AnyFrames) -> float:
    """How long a pause between a recording's frames may be without being an outage, in seconds.

    Recordings that have frames without vehicles have a frame for every image. Others don't say when
    the road was empty: their pauses are held against the traffic, as it is without those pauses
    that are too long for it.
    """
    if len(frames) < 3 or bool((np.diff(frames.offset) == 0).any()):
        return GAP_S
    pause_s = np.diff(frames.stamp_ns) / NS
    least = max(LEAST_QUIET_S, 5.0 * float(np.median(pause_s)))
    vehicles, limit = _track_count(frames), float("inf")
    while True:
        watched_s = float(pause_s[pause_s <= limit].sum())
        shorter = max(least, GAP_BY_CHANCE * watched_s / vehicles)
        if shorter >= limit:
            return limit
        limit = shorter


def _track_count(frames: AnyFrames) -> int:
    """How many ids there are."""
    ids = [distinct(block.rows["track_id"]) for block in frames.blocks(AT_ONCE)]
    return len(np.unique(np.concatenate(ids)))
