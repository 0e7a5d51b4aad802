"""Vehicles that stand on a lane where they should not.

A vehicle that waits stands too. Who waits has somebody before it, or a place at which others waited
before it, or a traffic light: then it goes on within one red. And not all that stands is a vehicle:
signs and poles are detected too, but the traffic drives through them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import hypot

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.traffic.event_records import EventKind, EventLog
from geoorbit_ros.traffic.lane_flow import LaneFlow
from geoorbit_ros.traffic.lane_neighbours import same_way
from geoorbit_ros.traffic.moments import MOVES_MPS, Moment
from geoorbit_ros.traffic.watched_tracks import (
    SHARP_M,
    STAND_M,
    WatchedTrack,
    WatchedTracks,
    along_and_left,
)

NOTED_NS = 3_000_000_000
"""A vehicle at one place for this long is noted. Chosen: longer misses what drives around it."""
WAIT_NS = 15_000_000_000
"""On a fast road with free traffic, a vehicle that stands for longer has stopped. Chosen: nobody
waits there; shorter reports who only slows down far away, where places are poor."""
RED_NS = 120_000_000_000
"""Elsewhere it may wait at a red light, or in a jam. Cycles of traffic lights are to be no longer
than 120 s (RiLSA; FHWA Signal Timing Manual, 5.5)."""
USUAL_WAITS = 3.0
"""Where others waited before, it must wait so many times longer than any of them. Chosen: phases of
traffic lights differ by less."""
FAST_MPS = 17.0
"""Roads with this usual speed are fast. Chosen: 61 km/h; lights are seldom on faster roads."""
IN_LANE = 0.8
"""Share of half the lane's width within which the middle of the vehicle must be. Chosen: a car on
the shoulder is at 1.5 or more; less misses trucks, whose places lie aside."""
AHEAD_M, BESIDE_M = 25.0, 50.0
"""Somebody who waits this near before it makes it one of a queue; who is slow this near in a lane
beside makes it a jam. Chosen: a lorry and its gap; the length of a view."""
PASS_M, LANE_BESIDE_M = 1.2, 6.0
"""Who passes nearer than the first has driven through it, within the second beside it. Chosen: two
cars that are 1.2 m aside touch; a lane and a half."""
CLEAR_M = 5.0
"""Who was seen this far beyond it has driven through it. Chosen: a car's length; an id that is
exchanged with that of who waits behind it gets to it, and no farther."""
THROUGH = 2
"""After so many have driven through it is no vehicle. Chosen: one may be an exchanged id."""
PASSED, PASSED_JAM = 3, 5
"""So many have passed it beside when traffic flows, with slow ones about. Chosen: less is a gap."""
AROUND = 3
"""Of a vehicle that was never seen to drive, so many must have changed lanes before it. Chosen:
fewer may have changed anyway."""
UNSEEN_TICKS = 60
"""It is gone when it was not seen for 30 s of watching. Chosen: in dense traffic others hide it for
20 s; more reports its end late."""
LEFT_TICKS = 20
"""Ten seconds, if its track was seen to go on. Chosen: ids of who passes are exchanged with it."""
USUAL_PLACE_M = 12.0
"""Waits this near to each other are at the same place. Chosen: the first two of a queue."""
Placed = Callable[[float, float], Moment]
"""Gives the moment, in the lanes of now, of something at a place."""


@dataclass(slots=True)
class Stand:
    """Something that stands.

    Attributes:
        track_id: The first track on it.
        x, y, lane, arc, offset, half_width, heading: Its place, in lane coordinates too.
        since_ns: When it came to stand.
        last_ns: When it was last seen.
        came: It was seen to drive there.
        from_start: It was there when watching began.
        holder: The track that is on it now.
        unseen: Moments since it was last seen.
        within: Who drove into it, and was not seen beyond it yet.
        through, beside, around: Who drove through it, beside it, and to the lane beside before it.
        drove_off: Its track went on.
        crowd_ns: When others last waited before or beside it.
    """

    track_id: int
    x: float
    y: float
    lane: int
    arc: float
    offset: float
    half_width: float
    heading: float
    since_ns: int
    last_ns: int
    driven_m: float
    came: bool
    from_start: bool
    holder: WatchedTrack | None
    unseen: int = 0
    within: set[int] = field(default_factory=set)
    through: set[int] = field(default_factory=set)
    beside: set[int] = field(default_factory=set)
    around: set[int] = field(default_factory=set)
    drove_off: bool = False
    crowd_ns: int = 0
    event: NDArray[np.void] | None = None

    @property
    def is_over(self) -> bool:
        """Whether it is gone."""
        return self.unseen > (LEFT_TICKS if self.drove_off else UNSEEN_TICKS)


class StandingWatch:
    """Finds stopped vehicles.

    Args:
        log: Takes the events.
        flow: Knows the usual speed in each lane.
    """

    def __init__(self, log: EventLog, flow: LaneFlow) -> None:
        self._log, self._flow = log, flow
        self._stands: list[Stand] = []
        self._waits: dict[int, list[tuple[float, int]]] = {}

    def use_lanes(self, lanes: Sequence[Lane], placed: Placed) -> None:
        """Look on these lanes from now on.

        Args:
            lanes: The lanes.
            placed: Gives the moment, in the new lanes, of something at a place.
        """
        self._lanes = lanes
        self._same_way = same_way(lanes)
        self._length = [lane.length_m for lane in lanes]
        for stand in self._stands:
            at = placed(stand.x, stand.y)
            stand.lane, stand.arc, stand.offset = at.lane, at.arc, at.offset
            stand.half_width, stand.heading = at.half_width, at.heading

    def take(self, stamp_ns: int, watched: WatchedTracks, placed: Placed) -> None:
        """Take the tracks of a half second.

        Args:
            stamp_ns: Its time.
            watched: The tracks.
            placed: See `use_lanes`.
        """
        held = {id(stand.holder): stand for stand in self._stands if stand.holder is not None}
        for stand in self._stands:
            stand.unseen += 1
        for track in watched.now:
            stand_of = held.get(id(track))
            if track.stands_ns < NOTED_NS or track.last.sigma > SHARP_M:
                if stand_of is not None and track.here < 6:
                    stand_of.holder, stand_of.drove_off = None, True
            elif stand_of is not None:
                self._see(stand_of, track)
            elif track.last.lane >= 0:
                self._note(track, placed)
        self._forget(stamp_ns)
        if self._stands:
            self._passes(watched)
            slow = [t for t in watched.now if t.is_slow and t.is_vehicle and t.last.lane >= 0]
            for stand in self._stands:
                if stand.unseen == 0 and stand.event is None:
                    self._judge(stamp_ns, stand, slow)

    def _see(self, stand: Stand, track: WatchedTrack) -> None:
        stand.unseen, stand.last_ns = 0, track.last.stamp_ns
        stand.drove_off = False
        stand.came = stand.came or track.is_vehicle

    def _note(self, track: WatchedTrack, placed: Placed) -> None:
        """A track that stands is on something that is known, or on something new."""
        x, y = track.anchor
        for stand in self._stands:
            if hypot(stand.x - x, stand.y - y) <= 1.5 * STAND_M:
                if stand.unseen > 1:  # otherwise two ids are on one vehicle
                    stand.holder = track
                    self._see(stand, track)
                return
        at = placed(x, y)  # its id may just have gone over to who passes
        stand = Stand(
            track.last.track_id,
            x,
            y,
            at.lane,
            at.arc,
            at.offset,
            at.half_width,
            at.heading,
            track.since_ns,
            track.last.stamp_ns,
            track.driven_m,
            track.is_vehicle,
            track.from_start,
            track,
        )
        self._stands.append(stand)

    def _forget(self, stamp_ns: int) -> None:
        """Stands that are over; where somebody waited is remembered."""
        for stand in self._stands:
            if not stand.is_over:
                continue
            if stand.event is not None:
                self._log.end(stand.event, stamp_ns, last_ns=stand.last_ns)
            elif stand.came and stand.drove_off and stand.lane >= 0:
                waits = self._waits.setdefault(self._lanes[stand.lane].lane_id, [])
                waits.append((stand.arc, stand.last_ns - stand.since_ns))
                del waits[:-50]
        self._stands = [stand for stand in self._stands if not stand.is_over]

    def _passes(self, watched: WatchedTracks) -> None:
        """Who drove past each stand since the half second before."""
        for track in watched.now:
            if len(track.recent) < 2 or track.last.sigma > SHARP_M:
                continue
            before, now = track.recent[-2], track.last
            if not hypot(now.vx, now.vy) >= MOVES_MPS:
                continue
            moved = abs(now.x - before.x) + abs(now.y - before.y) + LANE_BESIDE_M
            for stand in self._stands:
                if stand.lane < 0 or abs(stand.x - now.x) + abs(stand.y - now.y) > 2.0 * moved:
                    continue
                if stand.holder is not track:
                    _note_pass(stand, track, before, now)

    def _judge(self, stamp_ns: int, stand: Stand, slow: list[WatchedTrack]) -> None:
        """Report a stand once it can't be a wait any more."""
        stands_ns = stand.last_ns - stand.since_ns
        if stands_ns < WAIT_NS or stand.lane < 0 or len(stand.through) >= THROUGH:
            return
        if abs(stand.offset) > IN_LANE * stand.half_width:
            return
        if not stand.came and not (stand.from_start and self._is_avoided(stand)):
            return
        needed_ns = self._needed_ns(stand, slow)
        if needed_ns is None or stands_ns < needed_ns:
            return
        stand.event = self._log.begin(
            EventKind.STOPPED,
            stamp_ns,
            first_ns=stand.since_ns,
            last_ns=stand.last_ns,
            lane_id=self._lanes[stand.lane].lane_id,
            track_id=stand.track_id,
            arc_m=stand.arc,
            x=stand.x,
            y=stand.y,
            vehicles=len(stand.beside),
            length_m=stand.driven_m,
        )

    def _is_avoided(self, stand: Stand) -> bool:
        """Whether vehicles changed lanes before it, in a lane that they need not leave there."""
        return len(stand.around) >= AROUND and self._is_free_ahead(stand)

    def _is_free_ahead(self, stand: Stand) -> bool:
        """Whether its lane is seen to go on beyond it."""
        return self._length[stand.lane] - stand.arc >= AHEAD_M

    def _needed_ns(self, stand: Stand, slow: list[WatchedTrack]) -> float | None:
        """How long a vehicle must stand there to have stopped; None: it waits in a queue."""
        ahead, behind, jam = self._waiting_near(stand, slow)
        if ahead or jam:
            stand.crowd_ns = stand.last_ns
        if ahead:
            return None
        # A jam that dissolves leaves its vehicles one after the other.
        jam = jam or stand.last_ns - stand.crowd_ns < WAIT_NS
        free_ahead = self._is_free_ahead(stand)
        fast = self._flow.usual_mps(stand.lane) >= FAST_MPS
        needed: float = WAIT_NS if fast else RED_NS
        if jam or behind:
            if not free_ahead:
                return None
            flows = len(stand.beside) >= (PASSED_JAM if jam else PASSED)
            if jam and not flows:
                return None
            if jam or not flows:
                needed = RED_NS
        waits = [
            wait_ns
            for arc, wait_ns in self._waits.get(self._lanes[stand.lane].lane_id, ())
            if abs(arc - stand.arc) < USUAL_PLACE_M
        ]
        if len(waits) >= 2:
            needed = max(needed, USUAL_WAITS * max(waits))
        return needed

    def _waiting_near(self, stand: Stand, slow: list[WatchedTrack]) -> tuple[bool, bool, bool]:
        """Whether others wait before it, behind it, and in the lanes beside."""
        ahead = behind = beside = False
        for track in slow:
            if track is stand.holder or not self._same_way[stand.lane, track.last.lane]:
                continue
            along, _ = along_and_left(stand.x, stand.y, stand.heading, track.last)
            if track.last.lane == stand.lane:
                ahead = ahead or STAND_M < along < AHEAD_M
                behind = behind or -AHEAD_M < along < -STAND_M
            else:
                beside = beside or abs(along) < BESIDE_M
        return ahead, behind, beside


def _note_pass(stand: Stand, track: WatchedTrack, before: Moment, now: Moment) -> None:
    """Whether a vehicle drove past a stand between two moments, and where."""
    a = along_and_left(stand.x, stand.y, stand.heading, before)
    b = along_and_left(stand.x, stand.y, stand.heading, now)
    if now.track_id in stand.within and (b[0] >= CLEAR_M or not _drives(now)):
        stand.within.discard(now.track_id)
        if b[0] >= CLEAR_M:
            stand.through.add(now.track_id)
    if not a[0] < 0.0 <= b[0]:
        return
    left = abs(a[1] + (b[1] - a[1]) * -a[0] / (b[0] - a[0]))
    if left < PASS_M:
        if _drives(before) and _drives(now):
            (stand.through if b[0] >= CLEAR_M else stand.within).add(now.track_id)
    elif left < LANE_BESIDE_M and now.lane != stand.lane:
        stand.beside.add(now.track_id)
        if stand.lane in track.lanes and track.lanes[stand.lane] < stand.arc:
            stand.around.add(now.track_id)


def _drives(moment: Moment) -> bool:
    """Whether a vehicle drives; an id that jumps along a queue stands between its jumps."""
    stands = hypot(moment.within_x, moment.within_y) < 0.5 * MOVES_MPS
    return hypot(moment.vx, moment.vy) >= MOVES_MPS and not stands
