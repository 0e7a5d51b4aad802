"""Lanes that are used no more, or driven more slowly than before."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp, hypot, isfinite, log, sqrt
from statistics import median

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.traffic.event_records import EventKind, EventLog
from geoorbit_ros.traffic.moments import TICK_NS
from geoorbit_ros.traffic.stations import place_stations
from geoorbit_ros.traffic.watched_tracks import SHARP_M, WatchedTrack

HALF_LIFE_S = 1800.0
"""Half-life of what is known of a lane's share of the traffic. Chosen: shares change over hours;
shorter forgets them before they are known at night, longer lags behind the rush hour."""
LEAST_VEHICLES = 10.0
"""So many vehicles in a lane are needed to know its share. Chosen: 1-sigma is a third of it."""
IN_LANE = 0.7
"""Share of half the lane's width within which a vehicle must be to use it. Chosen: on the line
there is no lane; one in fifty of a full lane is placed on it, which looks like traffic in an empty
one beside it."""
UNUSED_SHARE = 0.1
"""A lane with a tenth of its usual share is unused: the few are errors of the lane. Chosen: more
takes a lane for unused that has become less popular, less is ended by two wrong places."""
LEAST_SHARE = 0.03
"""Nothing is said of a lane that fewer vehicles use. Chosen: its share changes by more than that
from hour to hour."""
CLUMPING = 1.5
"""Variance of counts over that of independent vehicles: drivers keep to lanes in platoons. Chosen:
larger reports later, 1 takes platoons for evidence."""
BY_CHANCE_S = 10.0 * 365.25 * 86400.0
"""Chance alone would leave a lane so empty once in ten years. Chosen: of a thousand cameras, two in
a week would err; shorter reports earlier."""
SAME_FLOW = 0.5
"""While the lanes beside carry less than this share of their usual flow, a lane's usual share says
nothing: in sparse traffic everybody keeps to one lane."""
BACK = 3
"""So many vehicles in the lane end it. Chosen: one or two may be in a wrong lane."""

NOW_VEHICLES = 8
"""Vehicles whose median is the speed now. Chosen: fewer may all be lorries, more are late."""
NOW_SLOW = 6
"""So many of them are to be slow. Chosen: a wave of braking slows three or four in a row."""
NOW_NS = 300_000_000_000
"""They came within this time. Chosen: five minutes; who came before says nothing of now."""
USUAL_VEHICLES = (20, 200)
"""The usual speed is the median of the last 200 vehicles before these, and not known from fewer
than 20. Chosen: an hour's traffic of a quiet lane; less follows the slow ones, more the day."""
DROP_SHARE, DROP_MPS = 0.6, 5.0
"""A drop is to less than this share of the usual speed, and by so much. Chosen: lorries drive at
0.7 of the speed of cars; less waits for a jam."""
RECOVERED_SHARE = 0.8
"""Again faster than this share, the drop is over. Chosen: between the drop and the usual."""


@dataclass(slots=True)
class _Lane:
    """What is known of one lane.

    Attributes:
        own, others: Decayed numbers of vehicles in it, and in those beside.
        watched_s: Decayed time over which they came.
        held_own, held_others, held_s: The same since the lane may have been unused.
        sum: Evidence that it is unused (Page 1954), in log odds.
        last_ns, last_track: The last vehicle before that.
    """

    own: float = 0.0
    others: float = 0.0
    watched_s: float = 0.0
    held_own: float = 0.0
    held_others: float = 0.0
    held_s: float = 0.0
    sum: float = 0.0
    last_ns: int = 0
    last_track: int = 0
    unused: NDArray[np.void] | None = None
    back: int = 0
    back_ns: int = 0
    others_since_back: int = 0
    speeds: deque[tuple[int, int, float]] = field(default_factory=lambda: deque())
    usual: deque[float] = field(default_factory=lambda: deque(maxlen=USUAL_VEHICLES[1]))
    drop: NDArray[np.void] | None = None

    def hold_nothing(self) -> None:
        """What was held back belongs to the usual traffic after all."""
        self.own += self.held_own
        self.others += self.held_others
        self.watched_s += self.held_s
        self.held_own = self.held_others = self.held_s = self.sum = 0.0


class LaneFlow:
    """Counts vehicles where they cross the stations, and tells when a lane's traffic has changed.

    Args:
        log: Takes the events.
    """

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._known: dict[int, _Lane] = {}
        self._newest_ns = 0

    def use_lanes(self, lanes: Sequence[Lane]) -> None:
        """Count in these lanes; what is known of a lane goes on under its id."""
        self._lanes = lanes
        before = self._known
        self._known = {k.lane_id: before.get(k.lane_id, _Lane()) for k in lanes}
        for lane_id, state in before.items():
            for event in (state.unused, state.drop):
                if lane_id not in self._known and event is not None:
                    self._log.end(event, self._newest_ns)
        self._state = [self._known[k.lane_id] for k in lanes]
        self._line = [0.0] * len(lanes)
        self._beside: list[list[int]] = [[] for _ in lanes]
        self._place = np.zeros((len(lanes), 2))
        for station in place_stations(lanes):
            for k, arc in zip(station.lanes, station.arc_m, strict=True):
                self._line[k] = float(arc)
                self._beside[k] = [j for j in station.lanes if j != k]
                step = np.hypot(*np.diff(lanes[k].centerline_m, axis=0).T)
                at = np.append(0.0, np.cumsum(step))
                self._place[k] = [np.interp(arc, at, lanes[k].centerline_m[:, i]) for i in (0, 1)]

    def usual_mps(self, lane: int) -> float:
        """Median speed of the last vehicles in a lane; NaN before five have come."""
        state = self._state[lane]
        speeds = [*state.usual, *(speed for _, _, speed in state.speeds)]
        return median(speeds) if len(speeds) >= 5 else float("nan")

    def take(self, stamp_ns: int, tracks: list[WatchedTrack]) -> None:
        """Take the tracks of a half second, with their newest moments."""
        self._newest_ns = stamp_ns
        step_s = TICK_NS * 1e-9
        fade = exp(-log(2.0) * step_s / HALF_LIFE_S)
        for state in self._state:
            if state.unused is None:
                state.own, state.others = fade * state.own, fade * state.others
                state.watched_s *= fade
                state.held_s += step_s
                if state.sum == 0.0:
                    state.hold_nothing()
        for track in tracks:
            lane = self._crossed(track)
            if lane is not None:
                moment = track.last
                self._count(lane, stamp_ns, moment.track_id)
                self._speed(lane, stamp_ns, moment.track_id, hypot(moment.vx, moment.vy))

    def _crossed(self, track: WatchedTrack) -> int | None:
        """The lane whose station a vehicle crossed since its moment before."""
        moment = track.last
        if moment.lane < 0 or moment.way != 1 or moment.sigma > SHARP_M or len(track.recent) < 2:
            return None
        if abs(moment.offset) > IN_LANE * moment.half_width:
            return None
        beyond = moment.arc - self._line[moment.lane]
        before = track.recent[-2]
        moved = hypot(moment.x - before.x, moment.y - before.y)
        return moment.lane if 0.0 <= beyond < moved else None

    def _count(self, lane: int, stamp_ns: int, track_id: int) -> None:
        state = self._state[lane]
        if state.unused is None:
            state.held_own += 1.0
            share, _ = _share(state)
            if share > LEAST_SHARE:
                state.sum += log(UNUSED_SHARE) / CLUMPING
            if state.sum <= 0.0:
                state.hold_nothing()
                state.last_ns, state.last_track = stamp_ns, track_id
        else:
            self._came_back(lane, state, stamp_ns, track_id)
        for other in self._beside[lane]:
            self._count_beside(other, stamp_ns)

    def _count_beside(self, lane: int, stamp_ns: int) -> None:
        state = self._state[lane]
        state.held_others += 1.0
        if state.unused is not None:
            state.others_since_back += 1
            return
        share, flow = _share(state)
        if share <= LEAST_SHARE or not state.last_ns:
            return
        state.sum += log((1.0 - UNUSED_SHARE * share) / (1.0 - share)) / CLUMPING
        by_chance_s = exp(min(state.sum, 600.0)) / flow
        if by_chance_s < BY_CHANCE_S:
            return
        if state.held_others / state.held_s < SAME_FLOW * state.others / state.watched_s:
            return
        x, y = self._place[lane].tolist()
        state.unused = self._log.begin(
            EventKind.LANE_UNUSED,
            stamp_ns,
            first_ns=state.last_ns,
            last_ns=stamp_ns,
            lane_id=self._lanes[lane].lane_id,
            track_id=state.last_track,
            arc_m=self._line[lane],
            x=x,
            y=y,
            vehicles=state.held_others,
            by_chance_s=by_chance_s,
        )
        state.back = state.others_since_back = 0

    def _came_back(self, lane: int, state: _Lane, stamp_ns: int, track_id: int) -> None:
        share, _ = _share(state)
        if state.back and state.others_since_back > 2.0 * BACK / share:
            state.back = 0
        if not state.back:
            state.back_ns, state.others_since_back = stamp_ns, 0
        state.back += 1
        if state.back < BACK or state.unused is None:
            return
        self._log.end(
            state.unused,
            stamp_ns,
            last_ns=state.back_ns,
            vehicles=state.held_others,
        )
        state.unused = None
        state.held_own = state.held_others = state.held_s = state.sum = 0.0
        state.last_ns, state.last_track = stamp_ns, track_id

    def _speed(self, lane: int, stamp_ns: int, track_id: int, speed_mps: float) -> None:
        state = self._state[lane]
        if not isfinite(speed_mps):
            return
        state.speeds.append((stamp_ns, track_id, speed_mps))
        while len(state.speeds) > NOW_VEHICLES:
            oldest = state.speeds.popleft()
            if state.drop is None:
                state.usual.append(oldest[2])
        if len(state.speeds) < NOW_VEHICLES or len(state.usual) < USUAL_VEHICLES[0]:
            return
        if state.speeds[0][0] < stamp_ns - NOW_NS:
            return
        now, usual = median(speed for _, _, speed in state.speeds), median(state.usual)
        slow = min(DROP_SHARE * usual, usual - DROP_MPS)
        slow_ones = sum(speed < slow for _, _, speed in state.speeds)
        if state.drop is None and slow_ones >= NOW_SLOW:
            x, y = self._place[lane].tolist()
            state.drop = self._log.begin(
                EventKind.SPEED_DROP,
                stamp_ns,
                first_ns=state.speeds[0][0],
                last_ns=stamp_ns,
                lane_id=self._lanes[lane].lane_id,
                track_id=track_id,
                arc_m=self._line[lane],
                x=x,
                y=y,
                vehicles=NOW_VEHICLES,
                speed_mps=now,
                usual_mps=usual,
            )
        elif state.drop is not None and now > RECOVERED_SHARE * usual:
            self._log.end(state.drop, stamp_ns, last_ns=stamp_ns, speed_mps=now, usual_mps=usual)
            state.drop = None


def _share(state: _Lane) -> tuple[float, float]:
    """The least share of vehicles that the lane has, by two sigma, and all vehicles per second.

    (0, 0) where it is not known.
    """
    total = state.own + state.others
    if state.own < LEAST_VEHICLES or not state.others:
        return 0.0, 0.0
    share = state.own / total
    return share - 2.0 * sqrt(CLUMPING * share * (1.0 - share) / total), total / state.watched_s
