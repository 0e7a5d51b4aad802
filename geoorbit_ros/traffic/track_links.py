"""Which track goes on in which: trackers lose vehicles and find them again under another id."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Key = tuple[int, int]

LOOK_NS = 1_000_000_000
"""How much of a new track decides what it continues, and of the old one where it was heading.
Chosen: in a second a vehicle shows its velocity; longer delays the decision."""
MAX_GAP_NS = 4_000_000_000
"""A vehicle that is found again later is another one. Chosen: behind a lorry or in merged boxes
vehicles are lost for one to three seconds; longer joins followers."""
OVERLAP_NS = 300_000_000
"""A new track may begin this long before the old one ends. Chosen: trackers keep two ids on one
vehicle for a few images; longer joins vehicles that drive side by side."""
ENDED_NS = 10_000_000_000
"""A track that was not seen for this long has ended (`vehicle_paths.SPLIT_NS`)."""
LONGEST_NS = 600_000_000_000
"""Paths are cut at multiples of this time once they are half as long. Without it, a parked vehicle
keeps the intervals of its stay open for ever. Chosen: vehicles cross a view of 200 m in a jam at
3 km/h within four minutes and are never cut; longer delays intervals. The multiples are those of
the clock, so that a counter which was started again cuts at the same times."""
ACCELERATION_MPS2 = 1.5
"""1-sigma of a driver's acceleration. Chosen: usual braking; harder braking is joined if short."""
ACROSS_MPS = 0.5
"""1-sigma of movement across the road. Chosen: that of a slow lane change."""
PLACE_M = (1.0, 0.5)
"""1-sigma along and across that boxes move by when a vehicle is partly hidden. Chosen: a quarter of
a car's length and width."""
MAX_SQUARE = 9.2
"""Squared error up to which two tracks are one vehicle: chi-square, 2 degrees of freedom, 99 %."""
SLOW_MPS = 2.0
"""Slower vehicles have no direction to be held against. Chosen: the noise of a velocity."""
SPEED_SHARE = 0.25
"""Error of a velocity from one second of places, as a share of it. Chosen: far away a pixel is
metres."""
TURN_COS = 0.7
"""Least cosine between the two directions of motion. Chosen: 45 degrees, a bend's worth."""


@dataclass(slots=True)
class Fragment:
    """One track.

    Attributes:
        track_id: Its id.
        rows: `vehicle_paths.PATH_DTYPE`, in time order, at least one.
        goes_on_ns: Where a long track was cut, when its next part begins.
        first_ns: When it was first seen.
        last_ns: When it was last seen.
        key: Names it among all tracks: an id may come back.
        pauses: Whether it was lost for long enough to be another's continuation meanwhile.
    """

    track_id: int
    rows: NDArray[np.void]
    goes_on_ns: int | None = None
    first_ns: int = field(init=False)
    last_ns: int = field(init=False)
    key: Key = field(init=False)
    pauses: bool = field(init=False)

    def __post_init__(self) -> None:
        stamps = self.rows["stamp_ns"]
        self.first_ns, self.last_ns = int(stamps[0]), int(stamps[-1])
        self.key = self.track_id, self.first_ns
        longest_ns = int(np.diff(stamps).max(initial=0))
        self.pauses = longest_ns > LOOK_NS - OVERLAP_NS


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a vehicle was at one time, and how fast, in plain numbers: pairs are many.

    Attributes:
        stamp_ns: When.
        x: Metres.
        y: Metres.
        vx: Metres per second; NaN where it is not known.
        vy: The same.
        sigma_m: 1-sigma of the place.
    """

    stamp_ns: int
    x: float
    y: float
    vx: float
    vy: float
    sigma_m: float

    @property
    def speed(self) -> float:
        """Metres per second; NaN where it is not known."""
        return math.hypot(self.vx, self.vy)


@dataclass(slots=True)
class Links:
    """Joins tracks to vehicles; remembers decisions until their vehicles are gone.

    Attributes:
        joined: Tracks so far that went on from another.
    """

    joined: int = 0
    _next: dict[Key, Key] = field(default_factory=dict)
    _decided: set[Key] = field(default_factory=set)
    _ends: dict[Key, Motion] = field(default_factory=dict)
    _begin_ns: dict[Key, int] = field(default_factory=dict)

    def join(
        self, fragments: list[Fragment], now_ns: int | None
    ) -> tuple[list[list[Fragment]], list[Fragment]]:
        """Chains of tracks of one vehicle each, for vehicles that are gone, and all other tracks.

        Args:
            fragments: All tracks that were not part of an earlier chain.
            now_ns: Time of the newest frame; None when no more will come.
        """
        by_key = {fragment.key: fragment for fragment in fragments}
        self._decide(fragments, now_ns)
        chains, open_fragments = list[list[Fragment]](), list[Fragment]()
        continued = set(self._next.values())
        for fragment in fragments:
            if fragment.key in continued:
                continue
            chain, key = list[Fragment](), self._next.get(fragment.key)
            chain.append(fragment)
            while key is not None:
                chain.append(by_key[key])
                key = self._next.get(key)
            last_ns = max(part.last_ns for part in chain)
            if now_ns is None or last_ns + ENDED_NS < now_ns:
                chains.append(chain)
            else:
                open_fragments.extend(chain)
        for chain in chains:
            for part in chain:
                self._next.pop(part.key, None)
                self._decided.discard(part.key)
                self._ends.pop(part.key, None)
                self._begin_ns.pop(part.key, None)
        chains.sort(key=lambda chain: (max(p.last_ns for p in chain), chain[0].track_id))
        return chains, open_fragments

    def _decide(self, fragments: list[Fragment], now_ns: int | None) -> None:
        """Find what each new track continues, in the order in which they begin."""
        new = [
            fragment
            for fragment in fragments
            if fragment.key not in self._decided
            and (now_ns is None or fragment.first_ns + LOOK_NS < now_ns)
        ]
        if not new:
            return
        waiting = sorted(fragments, key=lambda f: (f.first_ns, f.track_id), reverse=True)
        near = list[Fragment]()  # those seen within the longest gap before the new track
        for fragment in sorted(new, key=lambda f: (f.first_ns, f.track_id)):
            while waiting and waiting[-1].first_ns < fragment.first_ns:
                near.append(waiting.pop())
            near = [f for f in near if f.last_ns >= fragment.first_ns - MAX_GAP_NS]
            self._decided.add(fragment.key)
            best = self._before(fragment, near)
            if best is not None:
                self._next[best.key] = fragment.key
                self._begin_ns[fragment.key] = self._began(best)
                self.joined += 1

    def _began(self, fragment: Fragment) -> int:
        """When the vehicle of a track was first seen."""
        return self._begin_ns.get(fragment.key, fragment.first_ns)

    def _before(self, after: Fragment, near: list[Fragment]) -> Fragment | None:
        """The track that `after` continues, among those that began earlier."""
        start_ns = after.first_ns
        begin: Motion | None = None
        best, least = None, MAX_SQUARE
        for fragment in near:
            if fragment.last_ns > start_ns + OVERLAP_NS and not fragment.pauses:
                continue  # it is still there
            if fragment.key in self._next or cut_ns(self._began(fragment)) <= start_ns:
                continue
            if fragment.goes_on_ns is not None and fragment.goes_on_ns <= start_ns + LOOK_NS:
                continue
            end = self._end_of(fragment, start_ns)
            if end is None or not -OVERLAP_NS <= start_ns - end.stamp_ns <= MAX_GAP_NS:
                continue
            if begin is None:
                begin = _motion(after.rows, begins=True)
            square = _square(end, begin)
            if square < least:
                best, least = fragment, square
        return best

    def _end_of(self, fragment: Fragment, start_ns: int) -> Motion | None:
        """How the track ended, by what is known a second after `start_ns`; None: it goes on."""
        stamps = fragment.rows["stamp_ns"]
        if fragment.last_ns <= start_ns + LOOK_NS:
            if fragment.last_ns > start_ns + OVERLAP_NS:
                return None
            found = self._ends.get(fragment.key)
            if found is None or found.stamp_ns != fragment.last_ns:
                found = self._ends[fragment.key] = _motion(fragment.rows, begins=False)
            return found
        known = int(np.searchsorted(stamps, start_ns + LOOK_NS, side="right"))
        if int(stamps[known - 1]) > start_ns + OVERLAP_NS:
            return None
        return _motion(fragment.rows[:known], begins=False)


def cut_ns(begin_ns: int) -> int:
    """When the path of a vehicle that was first seen at `begin_ns` is cut, if it is still there."""
    return -((begin_ns + LONGEST_NS // 2) // -LONGEST_NS) * LONGEST_NS


def _motion(rows: NDArray[np.void], *, begins: bool) -> Motion:
    """The first or last second of a track: a straight line in time through its places."""
    stamps = rows["stamp_ns"]
    if begins:
        part = rows[: np.searchsorted(stamps, stamps[0] + LOOK_NS, side="right")]
        at_ns = int(stamps[0])
    else:
        part = rows[np.searchsorted(stamps, stamps[-1] - LOOK_NS) :]
        at_ns = int(stamps[-1])
    time_s = (part["stamp_ns"] - at_ns) * 1e-9
    x, y = part["x"], part["y"]
    sigma_m = float(part["sigma"].min())
    if len(part) < 3 or np.ptp(time_s) < 0.3 * LOOK_NS * 1e-9:
        k = 0 if begins else -1
        return Motion(at_ns, float(x[k]), float(y[k]), math.nan, math.nan, sigma_m)
    weight = 1.0 / np.maximum(part["sigma"], 0.05) ** 2
    weight = weight / weight.sum()
    mean_s, mean_x, mean_y = ((weight * value).sum() for value in (time_s, x, y))
    lever = weight * (time_s - mean_s)
    spread = (lever * (time_s - mean_s)).sum()
    vx, vy = float((lever * x).sum() / spread), float((lever * y).sum() / spread)
    return Motion(at_ns, float(mean_x - mean_s * vx), float(mean_y - mean_s * vy), vx, vy, sigma_m)


def _square(before: Motion, after: Motion) -> float:
    """Squared error, in its own sigma, of one vehicle having both motions; infinite if it can't."""
    gap_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    known = [m for m in (before, after) if not math.isnan(m.vx)]
    if len(known) == 2 and not _may_be_one(before, after, gap_s):
        return math.inf
    count = max(len(known), 1)
    vx, vy = sum(m.vx for m in known) / count, sum(m.vy for m in known) / count
    error_x = after.x - before.x - vx * gap_s
    error_y = after.y - before.y - vy * gap_s
    speed = math.hypot(vx, vy)
    if speed > SLOW_MPS:
        ux, uy = vx / speed, vy / speed
    else:
        length = math.hypot(error_x, error_y)
        ux, uy = (error_x / length, error_y / length) if length > 0.0 else (1.0, 0.0)
    noise = before.sigma_m**2 + after.sigma_m**2
    along = noise + PLACE_M[0] ** 2 + (0.5 * ACCELERATION_MPS2 * gap_s**2) ** 2
    across = noise + PLACE_M[1] ** 2 + (ACROSS_MPS * gap_s) ** 2
    along_m, across_m = error_x * ux + error_y * uy, error_y * ux - error_x * uy
    return along_m**2 / along + across_m**2 / across


def _may_be_one(before: Motion, after: Motion, gap_s: float) -> bool:
    """Whether a vehicle can change from one velocity to the other in the time."""
    slower, faster = sorted((before.speed, after.speed))
    along = before.vx * after.vx + before.vy * after.vy
    if slower > SLOW_MPS and along < TURN_COS * slower * faster:
        return False
    return faster - slower <= 3.0 * ACCELERATION_MPS2 * max(abs(gap_s), 1.0) + SPEED_SHARE * faster
