"""Which track goes on in which: trackers lose vehicles and find them again under another id."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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
        first_ns: When it was first seen.
        last_ns: When it was last seen.
        pauses: Whether it was lost for long enough to be another's continuation meanwhile.
        goes_on_ns: Where a long track was cut, when its next part begins.
        key: Names it among all tracks: an id may come back.
    """

    track_id: int
    rows: NDArray[np.void]
    first_ns: int
    last_ns: int
    pauses: bool
    goes_on_ns: int | None = None
    key: Key = field(init=False)

    def __post_init__(self) -> None:
        self.key = self.track_id, self.first_ns


def are_pauses(stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N - 1,) whether a track was lost for long between two of its rows; see `Fragment`."""
    return np.asarray(np.diff(stamp_ns) > LOOK_NS - OVERLAP_NS)


@dataclass(frozen=True, slots=True)
class Motions:
    """Where M vehicles were at one time each, and how fast.

    Attributes:
        stamp_ns: (M,) when.
        xy: (2, M) metres.
        velocity: (2, M) metres per second; NaN where it is not known.
        sigma_m: (M,) 1-sigma of the place.
    """

    stamp_ns: NDArray[np.int64]
    xy: Array
    velocity: Array
    sigma_m: Array

    def take(self, index: NDArray[np.intp]) -> Motions:
        """Some of them."""
        return Motions(
            self.stamp_ns[index], self.xy[:, index], self.velocity[:, index], self.sigma_m[index]
        )


@dataclass(slots=True)
class Links:
    """Joins tracks to vehicles; remembers decisions until their vehicles are gone.

    Attributes:
        joined: Tracks so far that went on from another.
    """

    joined: int = 0
    _next: dict[Key, Key] = field(default_factory=dict)
    _decided: set[Key] = field(default_factory=set)
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
            chain, key = [fragment], self._next.get(fragment.key)
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
                self._begin_ns.pop(part.key, None)
        chains.sort(key=lambda chain: (max(p.last_ns for p in chain), chain[0].track_id))
        return chains, open_fragments

    def _decide(self, fragments: list[Fragment], now_ns: int | None) -> None:
        """Find what each new track continues, in the order in which they begin."""
        ordered = sorted(fragments, key=lambda f: (f.first_ns, f.track_id))
        new = [
            fragment
            for fragment in ordered
            if fragment.key not in self._decided
            and (now_ns is None or fragment.first_ns + LOOK_NS < now_ns)
        ]
        if not new:
            return
        before, after, which, ends = _pairs(ordered, new)
        begins = _motions([_first_second(f.rows) for f in new], 0)
        near = _near(ends, begins, which, after).nonzero()[0]
        before, after = before[near], after[near]
        square = _squares(ends.take(which[near]), begins.take(after))
        possible = square < MAX_SQUARE
        found = zip(
            after[possible].tolist(),
            before[possible].tolist(),
            square[possible].tolist(),
            strict=True,
        )
        continues = dict[int, list[tuple[float, int]]]()
        for k, other, error in found:
            continues.setdefault(k, []).append((error, other))
        self._decided.update(fragment.key for fragment in new)
        for k, others in sorted(continues.items()):
            fragment = new[k]
            for _, other in sorted(others):
                if self._may_go_on(ordered[other], fragment.first_ns):
                    self._next[ordered[other].key] = fragment.key
                    self._begin_ns[fragment.key] = self._began(ordered[other])
                    self.joined += 1
                    break

    def _began(self, fragment: Fragment) -> int:
        """When the vehicle of a track was first seen."""
        return self._begin_ns.get(fragment.key, fragment.first_ns)

    def _may_go_on(self, fragment: Fragment, start_ns: int) -> bool:
        """Whether a track has no continuation yet, nor is cut before one that begins then."""
        if fragment.key in self._next or cut_ns(self._began(fragment)) <= start_ns:
            return False
        return fragment.goes_on_ns is None or fragment.goes_on_ns > start_ns + LOOK_NS


def _pairs(
    ordered: list[Fragment], new: list[Fragment]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Motions]:
    """Which tracks each new one may continue, by their times alone.

    Args:
        ordered: All tracks, in the order in which they begin.
        new: Those of them of which something is to be decided.

    Returns:
        (P,) indices in `ordered`, (P,) in `new` and (P,) in the last: how tracks ended, by what is
        known a second after the other one of the pair began.
    """
    first_ns = np.array([f.first_ns for f in ordered], np.int64)
    last_ns = np.array([f.last_ns for f in ordered], np.int64)
    start_ns = np.array([f.first_ns for f in new], np.int64)
    by_end = np.argsort(last_ns, kind="stable")
    low = np.searchsorted(last_ns[by_end], start_ns - MAX_GAP_NS)
    count = np.searchsorted(last_ns[by_end], start_ns + OVERLAP_NS, side="right") - low
    after = np.repeat(np.arange(len(new)), count)
    rank = np.arange(len(after)) - np.repeat(np.cumsum(count) - count, count)
    before = by_end[np.repeat(low, count) + rank]
    earlier = first_ns[before] < start_ns[after]
    before, after = before[earlier], after[earlier]
    ended, which = np.unique(before, return_inverse=True)
    # One that pauses goes on long after, but may have been another's beginning in the pause.
    parts = [_last_second(ordered[k].rows) for k in ended.tolist()]
    more = list[tuple[int, int, int]]()
    for k in [k for k, fragment in enumerate(ordered) if fragment.pauses]:
        within = (start_ns > first_ns[k]) & (start_ns + LOOK_NS < last_ns[k])
        for j in within.nonzero()[0].tolist():
            known = _known_at(ordered[k].rows, int(start_ns[j]))
            if known is not None:
                more.append((k, j, len(parts)))
                parts.append(_last_second(known))
    pairs = np.array(more, np.intp).reshape(-1, 3)
    before, after = np.append(before, pairs[:, 0]), np.append(after, pairs[:, 1])
    return before, after, np.append(which, pairs[:, 2]), _motions(parts, -1)


def _known_at(rows: NDArray[np.void], start_ns: int) -> NDArray[np.void] | None:
    """A track's rows until a second after another one began; None: it was not lost then."""
    stamps = rows["stamp_ns"]
    known = rows[: np.searchsorted(stamps, start_ns + LOOK_NS, side="right")]
    lost_ns = start_ns - int(known["stamp_ns"][-1])
    return known if -OVERLAP_NS <= lost_ns <= MAX_GAP_NS else None


def cut_ns(begin_ns: int) -> int:
    """When the path of a vehicle that was first seen at `begin_ns` is cut, if it is still there."""
    return -((begin_ns + LONGEST_NS // 2) // -LONGEST_NS) * LONGEST_NS


def _first_second(rows: NDArray[np.void]) -> NDArray[np.void]:
    stamps = rows["stamp_ns"]
    return rows[: stamps.searchsorted(stamps[0] + LOOK_NS, side="right")]


def _last_second(rows: NDArray[np.void]) -> NDArray[np.void]:
    stamps = rows["stamp_ns"]
    return rows[stamps.searchsorted(stamps[-1] - LOOK_NS) :]


def _motions(parts: list[NDArray[np.void]], at: int) -> Motions:
    """A straight line in time through the places of each part of a track, at one of its rows.

    Args:
        parts: Rows of `vehicle_paths.PATH_DTYPE`, at least one in each.
        at: 0 for where each begins, -1 for where it ends.
    """
    if not parts:
        return Motions(np.empty(0, np.int64), np.empty((2, 0)), np.empty((2, 0)), np.empty(0))
    rows = np.concatenate(parts, dtype=parts[0].dtype)
    count = np.array([len(part) for part in parts])
    begin = np.cumsum(count) - count
    part, row = np.repeat(np.arange(len(parts)), count), begin if at == 0 else begin + count - 1
    stamp_ns = rows["stamp_ns"][row]
    time_s = (rows["stamp_ns"] - stamp_ns[part]) * 1e-9
    place = np.stack((rows["x"], rows["y"]))

    def sums(value: Array) -> Array:
        # Row by row: no part changes another's bits.
        return np.bincount(part, value, len(parts)).astype(np.float64)

    weight = 1.0 / np.maximum(rows["sigma"], 0.05) ** 2
    weight = weight / sums(weight)[part]
    mean_s = sums(weight * time_s)
    lever = weight * (time_s - mean_s[part])
    spread = sums(lever * (time_s - mean_s[part]))
    span_s = np.abs(time_s[begin] - time_s[begin + count - 1])
    known = (count >= 3) & (span_s >= 0.3 * LOOK_NS * 1e-9)
    spread = np.where(known, spread, 1.0)
    velocity = np.stack([np.where(known, sums(lever * axis) / spread, np.nan) for axis in place])
    middle = np.stack([sums(weight * axis) for axis in place])
    xy = np.where(known, middle - mean_s * velocity, place[:, row])
    return Motions(stamp_ns, xy, velocity, np.minimum.reduceat(rows["sigma"], begin))


def _near(
    ends: Motions, begins: Motions, which: NDArray[np.intp], after: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """(P,) whether the square of a pair can be below `MAX_SQUARE`, by its distance alone."""
    gap_s = np.abs(begins.stamp_ns[after] - ends.stamp_ns[which]) * 1e-9
    speeds = [np.nan_to_num(np.hypot(*m.velocity), nan=0.0) for m in (ends, begins)]
    speed = np.maximum(speeds[0][which], speeds[1][after])
    apart = [begins.xy[axis][after] - ends.xy[axis][which] for axis in (0, 1)]
    noise = sum(float(m.sigma_m.max(initial=0.0)) ** 2 for m in (ends, begins))
    reach_m = speed * gap_s + np.sqrt(MAX_SQUARE * np.maximum(*_variances(noise, gap_s)))
    # A little more, for the rounding of all this.
    return np.asarray(apart[0] ** 2 + apart[1] ** 2 <= 1.001 * reach_m**2)


def _variances(noise: Array | float, gap_s: Array) -> tuple[Array, Array]:
    """(M,) variances of places along and across the way, after a gap."""
    along = noise + PLACE_M[0] ** 2 + (0.5 * ACCELERATION_MPS2 * gap_s**2) ** 2
    return along, noise + PLACE_M[1] ** 2 + (ACROSS_MPS * gap_s) ** 2


def _squares(before: Motions, after: Motions) -> Array:
    """(M,) squared error, in its own sigma, of one vehicle having both motions of a pair.

    Infinite if it can't.
    """
    gap_s = np.asarray(after.stamp_ns - before.stamp_ns, np.float64) * 1e-9
    unknown = np.isnan(before.velocity[0]), np.isnan(after.velocity[0])
    total = np.nan_to_num(before.velocity, nan=0.0) + np.nan_to_num(after.velocity, nan=0.0)
    velocity = total / np.maximum(2 - unknown[0] - unknown[1].astype(np.int64), 1)
    error = after.xy - before.xy - velocity * gap_s
    speed, length = np.hypot(*velocity), np.hypot(*error)
    moves, apart = speed > SLOW_MPS, length > 0.0
    along = np.where(moves, velocity, np.where(apart, error, [[1.0], [0.0]]))
    along = along / np.where(moves, speed, np.where(apart, length, 1.0))
    along_m = error[0] * along[0] + error[1] * along[1]
    across_m = error[1] * along[0] - error[0] * along[1]
    variances = _variances(before.sigma_m**2 + after.sigma_m**2, gap_s)
    square = along_m**2 / variances[0] + across_m**2 / variances[1]
    possible = unknown[0] | unknown[1] | _may_be_one(before.velocity, after.velocity, gap_s)
    return np.where(possible, square, np.inf)


def _may_be_one(before: Array, after: Array, gap_s: Array) -> NDArray[np.bool_]:
    """(M,) whether a vehicle can change from one velocity to the other in the time."""
    speeds = np.hypot(*before), np.hypot(*after)
    slower, faster = np.minimum(*speeds), np.maximum(*speeds)
    along = before[0] * after[0] + before[1] * after[1]
    turns = (slower > SLOW_MPS) & (along < TURN_COS * slower * faster)
    allowed = 3.0 * ACCELERATION_MPS2 * np.maximum(np.abs(gap_s), 1.0) + SPEED_SHARE * faster
    return np.asarray(~turns & (faster - slower <= allowed))
