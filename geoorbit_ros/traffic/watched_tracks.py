"""What is remembered of the tracks in view: how far they drove, whether they stand, and where."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import cos, hypot, isfinite, sin

from geoorbit_ros.traffic.moments import TICK_NS, Moment

FORGET_NS = 4_000_000_000
"""A track that was not seen for this long is gone (`track_links.MAX_GAP_NS`)."""
SHARP_M = 2.5
"""Places with a larger 1-sigma error show no event. Chosen: they can be in any of three lanes; more
takes false events from far away, less gives up the far end of the view."""
STAND_M, STAND_SIGMAS = 2.0, 2.5
"""A vehicle stands while it is this near to one place. Chosen: half a car's length, and what the
errors of places make; more takes creeping for standing, less loses who stands in a bad place."""
SLOW_MPS = 2.8
"""A vehicle that waits or creeps is slower (10 km/h). Chosen: between the 5 mph of queues in the
HCM and the pace of a lane that dissolves."""
PACE_TICKS = 4
"""The pace is taken over two seconds. Chosen: shorter is noise, longer is late."""
DRIVEN_M, DRIVEN_SIGMAS = 8.0, 5.0
"""Who was seen to get this far from where its track began is a vehicle, and no sign or pole.
Chosen: two lengths of a car, and more than errors of places make; less believes jitter."""
LINK_M, LINK_ACROSS_M = 3.0, 2.0
"""A track that begins this near, along and across, to the way on which one just ended goes on from
it. Chosen: a car's place moves so far when its box is cut by another."""
STOOD_NS = 30_000_000_000
"""Where a vehicle waited or crept that long ago, what is seen to wait is a vehicle. Chosen: in a
queue others hide it for 20 s (`standing.UNSEEN_TICKS`), and its track begins anew."""
LINK_MPS = 12.0
"""What was faster when its track ended can't stand at once: braking with 8 m/s² it gets `DRIVEN_M`
far in its new track, and needs nothing from the old one."""


@dataclass(slots=True)
class WatchedTrack:
    """One track in view.

    Attributes:
        first: Its first moment.
        last: Its newest one.
        recent: The newest few, for the pace.
        driven_m: How far it got from where it began, that of tracks it goes on from included.
        from_start: It was there when watching began.
        anchor: Place at which it has been since `since_ns`.
        since_ns: Time of the first moment there.
        here: Moments there.
        away: Moments in a row that were not there.
        lanes: Lanes that it drove in, and where along them it was last.
    """

    first: Moment
    last: Moment
    from_start: bool
    recent: deque[Moment] = field(default_factory=lambda: deque(maxlen=PACE_TICKS + 1))
    driven_m: float = 0.0
    inherited_m: float = 0.0
    anchor: tuple[float, float] = (0.0, 0.0)
    since_ns: int = 0
    here: int = 0
    away: int = 0
    pace_mps: float = float("nan")
    lanes: dict[int, float] = field(default_factory=dict)

    @property
    def is_vehicle(self) -> bool:
        """Whether it was seen to drive."""
        return self.driven_m >= max(DRIVEN_M, DRIVEN_SIGMAS * min(self.last.sigma, SHARP_M))

    @property
    def is_slow(self) -> bool:
        """Whether it waits or creeps."""
        return self.pace_mps < SLOW_MPS

    @property
    def stands_ns(self) -> int:
        """How long it has been at one place."""
        return self.last.stamp_ns - self.since_ns

    def take(self, moment: Moment) -> None:
        """The track's next moment."""
        if not self.recent:
            self._stand_at(moment)
        self.last = moment
        self.recent.append(moment)
        far = hypot(moment.x - self.first.x, moment.y - self.first.y)
        self.driven_m = max(self.driven_m, self.inherited_m + far)
        if moment.lane >= 0 and moment.way == 1:
            self.lanes[moment.lane] = moment.arc
        oldest = self.recent[0]
        time_s = (moment.stamp_ns - oldest.stamp_ns) * 1e-9
        if len(self.recent) > 2 and time_s < 2.0 * (PACE_TICKS + 1):
            self.pace_mps = hypot(moment.x - oldest.x, moment.y - oldest.y) / time_s
        else:
            self.pace_mps = float("nan")
        x, y = self.anchor
        if hypot(moment.x - x, moment.y - y) <= _reach_m(moment):
            self.here, self.away = self.here + 1, 0
            share = 1.0 / min(self.here, 8)
            if self.here <= 8:
                self.anchor = x + share * (moment.x - x), y + share * (moment.y - y)
        else:
            self.away += 1
            if self.away >= 2:
                self._stand_at(moment)

    def _stand_at(self, moment: Moment) -> None:
        self.anchor, self.since_ns = (moment.x, moment.y), moment.stamp_ns
        self.here, self.away = 1, 0


class WatchedTracks:
    """All tracks in view, moment by moment.

    Attributes:
        tracks: By id.
        now: The tracks that were seen in the newest half second, by id.
    """

    def __init__(self) -> None:
        self.tracks: dict[int, WatchedTrack] = {}
        self.now: list[WatchedTrack] = []
        self._start_tick: int | None = None
        self._stood: list[WatchedTrack] = []

    def take(self, tick: int, moments: list[Moment]) -> None:
        """Take a half second."""
        if self._start_tick is None:
            self._start_tick = tick
        now_ns = tick * TICK_NS
        for key, track in list(self.tracks.items()):
            if track.last.stamp_ns < now_ns - FORGET_NS:
                del self.tracks[key]
                if track.is_slow and track.is_vehicle:
                    self._stood.append(track)
        self._stood = [t for t in self._stood if t.last.stamp_ns >= now_ns - STOOD_NS]
        self.now = []
        new = list[WatchedTrack]()
        for moment in moments:
            found = self.tracks.get(moment.track_id)
            if found is None:
                found = WatchedTrack(moment, moment, tick <= self._start_tick + 2)
                self.tracks[moment.track_id] = found
                new.append(found)
            self.now.append(found)
        if new:
            seen = {moment.track_id for moment in moments}
            ended = [
                (t, speed)
                for k, t in self.tracks.items()
                if k not in seen and t.is_vehicle and isfinite(speed := hypot(t.last.vx, t.last.vy))
            ]
            for track in new:
                _go_on(track, ended)
                for stood in self._stood:
                    _stand_in(track, stood)
        for track, moment in zip(self.now, moments, strict=True):
            track.take(moment)

    def forget_lanes(self) -> None:
        """The map has other lanes from now on."""
        for track in self.tracks.values():
            track.lanes.clear()


def _reach_m(moment: Moment) -> float:
    """How near to a place a moment is still there."""
    return max(STAND_M, STAND_SIGMAS * min(moment.sigma, SHARP_M))


def _go_on(track: WatchedTrack, ended: list[tuple[WatchedTrack, float]]) -> None:
    """Let a new track inherit from those that ended where it may have come from.

    Args:
        track: The new one.
        ended: Tracks with the speeds at which they ended.
    """
    x, y, start_ns = track.first.x, track.first.y, track.first.stamp_ns
    for other, speed in ended:
        last = other.last
        dx, dy = x - last.x, y - last.y
        way_m = speed * (start_ns - last.stamp_ns) * 1e-9
        reach_m = way_m + 2.0 * LINK_M  # more than both limits below
        if reach_m < 0.0 or dx * dx + dy * dy > reach_m * reach_m:
            continue
        if speed > SLOW_MPS:
            along = (dx * last.vx + dy * last.vy) / speed
            across = abs(dy * last.vx - dx * last.vy) / speed
            follows = across <= LINK_ACROSS_M and -LINK_M <= along <= way_m + LINK_M
        else:
            follows = hypot(dx, dy) <= _reach_m(track.first)
        if follows:
            if speed <= LINK_MPS:
                track.inherited_m = max(track.inherited_m, other.driven_m)
            for lane, arc in other.lanes.items():
                track.lanes.setdefault(lane, arc)


def _stand_in(track: WatchedTrack, stood: WatchedTrack) -> None:
    """Let a new track that begins where a vehicle stood be that vehicle, or the next of a queue."""
    x, y = track.first.x - stood.last.x, track.first.y - stood.last.y
    if hypot(x, y) <= _reach_m(track.first):
        track.inherited_m = max(track.inherited_m, stood.driven_m)
        for lane, arc in stood.lanes.items():
            track.lanes.setdefault(lane, arc)


def along_and_left(x: float, y: float, heading: float, moment: Moment) -> tuple[float, float]:
    """Metres ahead and to the left of a place, seen along `heading`."""
    c, s = cos(heading), sin(heading)
    dx, dy = moment.x - x, moment.y - y
    return dx * c + dy * s, dy * c - dx * s
