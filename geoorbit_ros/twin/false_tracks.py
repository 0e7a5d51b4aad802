"""Finds tracks that follow no vehicle, and tracks that just jumped or began beside a vehicle."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.vehicles import Vehicles

MAX_BRAKING_MPS2 = 9.0
"""Hardest braking of a vehicle: tyres on dry asphalt. Trackers smooth speeds, and so show less."""
FAST_MPS, STOPPED_SHARE = 10.0, 0.35
"""A vehicle that could not have braked below the first, and is slower than this share of the speed
that braking allows, is false. Chosen: a lower speed or a larger share takes vehicles in queues for
false tracks, a higher speed or a smaller share leaves false tracks longer."""
BRAKES_S = 0.4
"""It must be so for this long. Chosen: speeds are wrong for a moment where a track changes its
vehicle; larger leaves false tracks longer."""
STANDS_M, STANDS_S = 6.0, 2.0
"""A vehicle that has not moved by more than the first for the second stands. Chosen: boxes of far
vehicles wander by metres; larger takes slow queues for standing, smaller misses false tracks that
wander."""
THROUGH_ALONG_M, THROUGH_ACROSS_M = 1.5, 1.0
"""A moving vehicle whose middle is this near to that of a standing one drives through it. Chosen: a
third of a car's length, half of its width; larger takes vehicles that pass closely for it."""
MIN_OVERLAPPING = 3
"""So many different vehicles that overlap a standing one by more than both errors prove it false:
it lies beside the middle of a lane. Chosen: a single one may be a mistake in its size; more leave
false tracks longer."""
THROUGH_MPS = 4.0
"""Only faster vehicles count as driving through. Chosen: vehicles that close up in a queue are
slower."""
MAX_SIGMA_M = 2.0
"""Vehicles with larger ground errors prove nothing. Chosen: half a lane and a little; larger
compares far vehicles by their noise."""
PASS_M = 2.0
"""A vehicle has passed a standing one when it was this far behind it, and then this far ahead.
Chosen: half a car's length, so that jitter makes no pass."""
LANE_M, OWN_LANE_M = 5.5, 1.0
"""Passes as far across as the first are compared; as near as the second, they are in the standing
vehicle's own place. Chosen: a lane and a half; and half of two cars' widths, less what far boxes
are wrong by: larger takes parked vehicles for false, smaller misses false boxes beside the lane."""
MIN_PASSES, PASS_SHARE = 3, 0.25
"""So many vehicles, and this share of those that passed, drove through a standing vehicle that is
none. Chosen: with errors of 1 m, one pass in ten beside a parked vehicle seems to go through it."""
STAYS_S = 45.0
"""A box that never drove, and stays for so long while `MIN_PASSES` vehicles pass beside it, is no
traffic: a parked vehicle, a sign. Chosen: longer than most red lights; larger keeps such boxes
longer, smaller drops vehicles that stood in a queue when the recording began."""
LEAVES_M = 10.0
"""A false track that moves by more follows a vehicle again. Chosen: larger ignores real vehicles
longer, smaller lets false tracks back that wander."""
SETTLE_S = 0.3
"""A track that has moved as its velocity says for so long follows a vehicle. Chosen: false boxes
come in single frames, three of which in a row are rare; larger lets vehicles enter later."""
JUMP_ALONG_M, JUMP_ACROSS_M = 4.0, 2.0
"""A track that leaves its predicted position by more in one step has jumped. Chosen: a swap of ids
moves a track to the next lane (3 m) or the next vehicle (6 m and more); larger misses swaps,
smaller takes noise for them."""
JUMP_SIGMAS = 3.0
"""Along the road also so many times its 1-sigma errors: 0.3 % by chance (normal distribution)."""


class FalseTrackWatch:
    """Finds vehicles of the twin that can't be real, and remembers the tracks that showed them.

    Args:
        vehicles: The vehicles.
        cameras: How many there are.
    """

    def __init__(self, vehicles: Vehicles, cameras: int) -> None:
        self._vehicles = vehicles
        self._positions: list[dict[int, NDArray[np.float64]]] = [{} for _ in range(cameras)]
        # By the id of a standing vehicle, the ids of moving ones that overlapped it.
        self._overlapped: dict[int, set[int]] = {}
        self._passes = PassWatch(vehicles)

    def forget(self, camera: int) -> None:
        """Forget a camera's tracks, because its tracker started again."""
        self._positions[camera].clear()

    def add(self, camera: int, track: int, xy: NDArray[np.float64]) -> None:
        """This track is false from now on."""
        self._positions[camera][track] = xy.copy()

    def ignored(self, camera: int, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Which rows (R,) are false tracks; those that have moved on are forgotten."""
        positions = self._positions[camera]
        flag = np.zeros(len(rows), dtype=np.bool_)
        if not positions:
            return flag
        tracks = rows["track_id"].tolist()
        for k, track in enumerate(tracks):
            if track in positions:
                if np.hypot(*(rows["xy"][k] - positions[track])) > LEAVES_M:
                    del positions[track]
                else:
                    flag[k] = True
        return flag

    def find(self, now_ns: int, step_s: float) -> NDArray[np.int64]:
        """Slots of vehicles seen in this step that can't be real."""
        table, slots = self._vehicles.table, self._vehicles.slots
        seen = slots[table["observed"][slots]]
        speed = np.hypot(*table["velocity"][seen].T)
        possible = table["possible_mps"][seen] - MAX_BRAKING_MPS2 * step_s
        slow = (possible > FAST_MPS) & (speed < STOPPED_SHARE * possible)
        table["slow_s"][seen] = np.where(slow, table["slow_s"][seen] + step_s, 0.0)
        brakes = (table["slow_s"][seen] > BRAKES_S) & (table["sigma"][seen] < MAX_SIGMA_M)
        table["possible_mps"][seen] = np.maximum(speed, possible)
        away = np.hypot(*(table["xy"][seen] - table["anchor"][seen]).T) > STANDS_M
        fresh = seen[away | (table["anchor_ns"][seen] == 0)]
        new = seen[table["entry_ns"][seen] == 0]
        table["entry"][new], table["entry_ns"][new] = table["xy"][new], now_ns
        table["anchor"][fresh], table["anchor_ns"][fresh] = table["xy"][fresh], now_ns
        stands = now_ns - table["anchor_ns"][seen] > STANDS_S * 1e9
        false = brakes | self._driven_through(seen, speed, stands)
        through, beside = self._passes.find(seen, stands)
        stays = now_ns - table["entry_ns"][seen] > STAYS_S * 1e9
        stays &= np.hypot(*(table["xy"][seen] - table["entry"][seen]).T) < LEAVES_M
        false |= through | (stays & beside)
        return np.asarray(seen[false])

    def false_since_ns(self, slot: int, now_ns: int) -> int:
        """Since when a vehicle that was found false has been none: while it has stood."""
        row = self._vehicles.table[slot]
        if np.hypot(*(row["xy"] - row["entry"])) < LEAVES_M:
            return int(row["entry_ns"])  # it never was anywhere else
        stands = now_ns - int(row["anchor_ns"]) > STANDS_S * 1e9
        return int(row["anchor_ns"]) if stands else now_ns

    def _driven_through(
        self,
        seen: NDArray[np.int64],
        speed: NDArray[np.float64],
        stands: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        table = self._vehicles.table
        flag = np.zeros(len(seen), dtype=np.bool_)
        sharp = (table["sigma"][seen] < MAX_SIGMA_M) & (table["cameras"][seen] == 1)
        still = np.flatnonzero(stands & sharp)
        moving = np.flatnonzero((speed > THROUGH_MPS) & sharp & ~stands)
        if not len(still) or not len(moving):
            return flag
        course = table["course"][seen[moving]]
        gap = table["xy"][seen[still]][:, None] - table["xy"][seen[moving]][None]
        cos, sin = np.cos(course), np.sin(course)
        along = gap[..., 0] * cos + gap[..., 1] * sin
        across = gap[..., 1] * cos - gap[..., 0] * sin
        inside = (np.abs(along) < THROUGH_ALONG_M) & (np.abs(across) < THROUGH_ACROSS_M)
        flag[still] = inside.any(axis=1)
        flag[still] |= self._overlapped_often(seen[still], seen[moving], along, across)
        return flag

    def _overlapped_often(
        self,
        still: NDArray[np.int64],
        moving: NDArray[np.int64],
        along: NDArray[np.float64],
        across: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Which standing vehicles (S,) too many moving ones (M,) overlapped; gaps are (S, M)."""
        table = self._vehicles.table
        error = np.hypot(table["sigma"][still][:, None], table["sigma"][moving])
        side, end = (
            0.5 * (table[size][still][:, None] + table[size][moving]) - error
            for size in ("width", "length")
        )
        for s, m in np.argwhere((np.abs(across) < side) & (np.abs(along) < end)).tolist():
            vehicle = int(table["vehicle_id"][still[s]])
            self._overlapped.setdefault(vehicle, set()).add(int(table["vehicle_id"][moving[m]]))
        standing = table["vehicle_id"][still].tolist()
        self._overlapped = {v: self._overlapped[v] for v in standing if v in self._overlapped}
        return np.array([len(self._overlapped.get(v, ())) >= MIN_OVERLAPPING for v in standing])


class PassWatch:
    """Counts vehicles that drive through a standing one: many do so only if there is none.

    It needs no exact positions: a false box far from the camera is found by those that pass it from
    behind to ahead, in its own lane. Around a vehicle that has broken down, they change lanes.

    Args:
        vehicles: The vehicles.
    """

    def __init__(self, vehicles: Vehicles) -> None:
        self._vehicles = vehicles
        # By the id of a standing vehicle: the ids of those behind it, and how far across each of
        # those that have passed was.
        self._behind: dict[int, set[int]] = {}
        self._across_m: dict[int, list[float]] = {}

    def find(
        self, seen: NDArray[np.int64], stands: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which of the vehicles seen in this step (S,) stand and were driven through, or passed.

        Vehicles that no camera sees just now pass, too: many leave the view there.
        """
        table = self._vehicles.table
        moving = np.setdiff1d(self._vehicles.slots, seen[stands])
        moving = moving[np.hypot(*table["velocity"][moving].T) > THROUGH_MPS]
        number = table["vehicle_id"][seen]
        standing = set(number[stands].tolist())
        self._behind = {v: self._behind.get(v, set()) for v in standing}
        self._across_m = {v: self._across_m.get(v, []) for v in standing}
        through, beside = np.zeros((2, len(seen)), dtype=np.bool_)
        cos, sin = np.cos(table["course"][moving]), np.sin(table["course"][moving])
        for k in np.flatnonzero(stands).tolist():
            vehicle = int(number[k])
            gap = table["xy"][moving] - table["xy"][seen[k]]
            along = gap[:, 0] * cos + gap[:, 1] * sin
            across = np.abs(gap[:, 1] * cos - gap[:, 0] * sin)
            near = across < LANE_M
            behind, passed = self._behind[vehicle], self._across_m[vehicle]
            others = table["vehicle_id"][moving]
            for j in np.flatnonzero(near & (along > PASS_M)).tolist():
                if int(others[j]) in behind:
                    behind.discard(int(others[j]))
                    passed.append(float(across[j]))
            behind.update(others[near & (along < -PASS_M)].tolist())
            hits = sum(x < OWN_LANE_M for x in passed)
            through[k] = hits >= max(MIN_PASSES, PASS_SHARE * len(passed))
            beside[k] = len(passed) >= MIN_PASSES
        return through, beside


def reach_along_m(
    sigma_m: NDArray[np.float64], other_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far two positions of one vehicle may differ along the road, by their 1-sigma errors."""
    return np.maximum(JUMP_ALONG_M, JUMP_SIGMAS * np.hypot(sigma_m, other_m))


@dataclass(slots=True)
class _Path:
    """Where a track should be by its velocities since a time, and its last state."""

    since_ns: int
    now_ns: int
    xy: NDArray[np.float64]
    velocity: NDArray[np.float64]
    sigma_m: float


class JumpWatch:
    """Remembers tracks that jumped, or began beside a vehicle, until they have settled.

    Args:
        cameras: How many there are.
    """

    def __init__(self, cameras: int) -> None:
        self._paths: list[dict[int, _Path | None]] = [{} for _ in range(cameras)]

    def forget(self, camera: int) -> None:
        """Forget a camera's tracks, because its tracker started again."""
        self._paths[camera].clear()

    def add(self, camera: int, track: int) -> None:
        """This track has jumped, maybe again."""
        self._paths[camera][track] = None

    def add_new(self, camera: int, tracks: Iterable[int]) -> None:
        """These tracks have no vehicle and began beside one; known ones continue to settle."""
        for track in tracks:
            self._paths[camera].setdefault(track, None)

    def unsettled(self, camera: int, rows: NDArray[np.void], time_ns: int) -> NDArray[np.bool_]:
        """Which rows (R,) are of tracks that have not settled yet.

        Args:
            camera: Its number.
            rows: All rows of the camera whose track has no vehicle; other tracks are forgotten.
            time_ns: Time of the step.
        """
        paths, flag = self._paths[camera], np.zeros(len(rows), dtype=np.bool_)
        if not paths:
            return flag
        waiting: dict[int, _Path | None] = {}
        for k, track in enumerate(rows["track_id"].tolist()):
            if track not in paths:
                continue
            path = _followed(paths[track], rows[k], time_ns)
            if time_ns - path.since_ns < SETTLE_S * 1e9:
                waiting[track] = path
                flag[k] = True
        self._paths[camera] = waiting
        return flag


def _followed(path: _Path | None, row: NDArray[np.void], time_ns: int) -> _Path:
    """The path after one more step; it begins again where the track has left it."""
    xy, velocity, sigma_m = row["xy"].copy(), row["velocity"].copy(), float(row["sigma"])
    if path is None:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    step_s = (time_ns - path.now_ns) * 1e-9
    expected = path.xy + 0.5 * (path.velocity + velocity) * step_s
    reach_m = reach_along_m(np.array(sigma_m), np.array(path.sigma_m))
    if np.hypot(*(xy - expected)) > reach_m:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    return _Path(path.since_ns, time_ns, expected, velocity, path.sigma_m)
