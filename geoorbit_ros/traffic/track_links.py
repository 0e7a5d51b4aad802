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
TURN_COS = 0.7
"""Least cosine between the two directions of motion. Chosen: 45 degrees, a bend's worth."""


@dataclass(frozen=True, slots=True)
class Fragment:
    """One track.

    Attributes:
        track_id: Its id.
        rows: `vehicle_paths.PATH_DTYPE`, in time order, at least one.
    """

    track_id: int
    rows: NDArray[np.void]

    @property
    def key(self) -> Key:
        """Names it among all tracks: an id may come back."""
        return self.track_id, self.first_ns

    @property
    def first_ns(self) -> int:
        """When it was first seen."""
        return int(self.rows["stamp_ns"][0])

    @property
    def last_ns(self) -> int:
        """When it was last seen."""
        return int(self.rows["stamp_ns"][-1])


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a vehicle was at one time, and how fast.

    Attributes:
        stamp_ns: When.
        place_m: (2,) metres.
        velocity_mps: (2,), None where it is not known.
        sigma_m: 1-sigma of the place.
    """

    stamp_ns: int
    place_m: Array
    velocity_mps: Array | None
    sigma_m: float


@dataclass(slots=True)
class Links:
    """Joins tracks to vehicles; remembers decisions until their vehicles are gone.

    Attributes:
        joined: Tracks so far that went on from another.
    """

    joined: int = 0
    _next: dict[Key, Key] = field(default_factory=dict)
    _decided: set[Key] = field(default_factory=set)

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
                self.joined += 1

    def _before(self, after: Fragment, near: list[Fragment]) -> Fragment | None:
        """The track that `after` continues, among those that began earlier."""
        start_ns = after.first_ns
        begin: Motion | None = None
        best, least = None, MAX_SQUARE
        for fragment in near:
            if fragment.key in self._next:
                continue
            stamps = fragment.rows["stamp_ns"]
            if stamps[-1] > start_ns + OVERLAP_NS:
                known = fragment.rows[: np.searchsorted(stamps, start_ns + LOOK_NS, side="right")]
            else:
                known = fragment.rows
            gap_ns = start_ns - int(known["stamp_ns"][-1])
            if not -OVERLAP_NS <= gap_ns <= MAX_GAP_NS:
                continue
            if begin is None:
                begin = _motion(after.rows, begins=True)
            square = _square(_motion(known, begins=False), begin)
            if square < least:
                best, least = fragment, square
        return best


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
    place = np.column_stack((part["x"], part["y"]))
    sigma_m = float(part["sigma"].min())
    if len(part) < 3 or np.ptp(time_s) < 0.3 * LOOK_NS * 1e-9:
        return Motion(at_ns, place[0 if begins else -1], None, sigma_m)
    weight = 1.0 / np.maximum(part["sigma"].astype(np.float64), 0.05) ** 2
    mean_s = float((weight * time_s).sum() / weight.sum())
    mean_m = (weight[:, None] * place).sum(axis=0) / weight.sum()
    spread = (weight * (time_s - mean_s) ** 2).sum()
    velocity = (weight[:, None] * (time_s - mean_s)[:, None] * (place - mean_m)).sum(axis=0)
    velocity = velocity / spread
    return Motion(at_ns, mean_m - mean_s * velocity, velocity, sigma_m)


def _square(before: Motion, after: Motion) -> float:
    """Squared error, in its own sigma, of one vehicle having both motions; infinite if it can't."""
    gap_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    known = [m.velocity_mps for m in (before, after) if m.velocity_mps is not None]
    velocity = np.mean(known, axis=0) if known else np.zeros(2)
    moved = after.place_m - before.place_m
    error = moved - velocity * gap_s
    if len(known) == 2:
        speeds = [float(np.hypot(*v)) for v in known]
        cosine = float(known[0] @ known[1]) / max(speeds[0] * speeds[1], 1e-9)
        if min(speeds) > SLOW_MPS and cosine < TURN_COS:
            return float("inf")
        allowed = 3.0 * ACCELERATION_MPS2 * max(abs(gap_s), 1.0) + 0.25 * max(speeds)
        if abs(speeds[0] - speeds[1]) > allowed:
            return float("inf")
    speed = float(np.hypot(*velocity))
    if speed > SLOW_MPS:
        along = velocity / speed
    else:
        length = float(np.hypot(*error))
        along = error / length if length > 0.0 else np.array([1.0, 0.0])
    noise = before.sigma_m**2 + after.sigma_m**2
    # A vehicle of which one velocity is unknown may have any usual acceleration over the gap.
    along_sigma = np.sqrt(noise + PLACE_M[0] ** 2 + (0.5 * ACCELERATION_MPS2 * gap_s**2) ** 2)
    across_sigma = np.sqrt(noise + PLACE_M[1] ** 2 + (ACROSS_MPS * gap_s) ** 2)
    along_m = float(error @ along)
    across_m = float(error @ np.array([-along[1], along[0]]))
    return (along_m / float(along_sigma)) ** 2 + (across_m / float(across_sigma)) ** 2
