"""Fuses the tracks of all cameras: one vehicle, however many cameras see it.

A track stays with its vehicle as long as it moves like a vehicle. A new track, and one that jumped
(trackers swap ids), goes to a vehicle nearby that has no track of this camera; all pairs of a step
are assigned at once (Kuhn 1955, linear assignment). The other tracks enter as new vehicles. Tracks
that jumped to where no vehicle is, or began beside the vehicle of another track, must settle before
(`false_tracks.JumpWatch`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.twin.false_tracks import JUMP_ACROSS_M, FalseTrackWatch, JumpWatch, reach_along_m
from geoorbit_ros.twin.vehicles import Vehicles, type_of_class, usual_size

Slots = NDArray[np.int64]
OnRoad = Callable[[NDArray[np.float64]], NDArray[np.bool_]]

GATE_ACROSS_M = 1.7
"""Half a lane: farther across, it is the vehicle in the next lane."""
GATE_TURN_RAD = np.radians(35.0)
"""Largest difference in heading between a track and its vehicle. Chosen: larger joins crossing
traffic, smaller loses vehicles in bends while no camera sees them."""
GATE_SPEED_MPS = 10.0
"""Largest difference in velocity. Chosen: new tracks have noisy velocities; larger joins oncoming
slow traffic."""
DRIFT_MPS = 2.0
"""For every second unseen, a vehicle may be this much farther from its prediction. Chosen: larger
joins other vehicles, smaller loses those that brake."""
MERGE_ALONG_M, MERGE_ACROSS_M, MERGE_S = 2.5, 1.2, 0.5
"""Two vehicles of different cameras that stay this near, along and across, for this many seconds
are one. Chosen: half a car's length and width; larger joins motorcycles side by side, smaller
leaves doubles where cameras differ."""
MERGE_COS = 0.8
"""Least cosine between their courses, 37 degrees. Chosen: as `GATE_TURN_RAD`."""
LEAST_SIGMA_M = 0.05
"""Added to ground errors where several are weighted. Chosen: an error of 0 would outweigh all
others."""
ENTERS, IGNORED = -1, -2
"""In place of a slot: the row enters as a new vehicle, or is ignored."""


@dataclass(slots=True)
class FusionCounts:
    """Counts of what happened to tracks so far.

    Attributes:
        jumps: Times that a track left its vehicle's position within one step.
        unsettled: Rows ignored because their track had just jumped to where no vehicle was, or had
            just begun beside the vehicle of another track of the same camera.
        handovers: Times that a track was given to an existing vehicle.
        doubled: Rows ignored because they lay within another vehicle of their camera.
        merged: Vehicles that were the same as another one.
        off_road: Rows ignored because they lay beside the network.
        false_tracks: Tracks of something that is no vehicle, ignored until they move on.
    """

    jumps: int = 0
    unsettled: int = 0
    handovers: int = 0
    doubled: int = 0
    merged: int = 0
    off_road: int = 0
    false_tracks: int = 0


class Fusion:
    """Assigns tracks to vehicles, and moves the vehicles with their tracks.

    Args:
        vehicles: The vehicles; changed with every update.
        cameras: How many there are.
        on_road: For points (M, 2), whether a vehicle may enter there.

    Attributes:
        counts: What happened so far.
        false_since_ns: Ids of vehicles found false in the last step, and since when they were none.
    """

    def __init__(self, vehicles: Vehicles, cameras: int, on_road: OnRoad) -> None:
        self.counts = FusionCounts()
        self.false_since_ns: dict[int, int] = {}
        self._vehicles, self._on_road = vehicles, on_road
        self._bound: list[dict[int, int]] = [{} for _ in range(cameras)]
        self._near_s: dict[tuple[int, int], float] = {}
        self._false_tracks = FalseTrackWatch(vehicles, cameras)
        self._jumps = JumpWatch(cameras)

    def release(self, slot: Slots) -> None:
        """Take all tracks from these vehicles, because they leave."""
        gone = set(slot.tolist())
        if gone:
            for bound in self._bound:
                for track in [t for t, s in bound.items() if s in gone]:
                    del bound[track]

    def forget_tracks(self, camera: int) -> None:
        """Forget a camera's tracks, because its tracker started again."""
        self._bound[camera].clear()
        self._false_tracks.forget(camera)
        self._jumps.forget(camera)

    def update(self, time_ns: int, step_s: float, tables: Sequence[NDArray[np.void]]) -> Slots:
        """Move all vehicles to `time_ns`, by their tracks where they have one.

        Args:
            time_ns: Time of the step.
            step_s: Time since the last step, of which the vehicles' states are.
            tables: `OBSERVATION_DTYPE` rows of each camera at `time_ns`.

        Returns:
            (E,) slots of vehicles that entered.
        """
        table = self._vehicles.table
        present = self._vehicles.slots
        table["xy"][present] += table["velocity"][present] * step_s
        table["observed"][present] = False
        table["predicted"][present] = False
        table["cameras"][present] = 0
        entered, slots, rows = [], [], []
        for camera, table_now in enumerate(tables):
            found = table_now[~self._false_tracks.ignored(camera, table_now)]
            slot = self._assign(camera, found, time_ns)
            new = np.flatnonzero(slot == ENTERS)
            able = self._on_road(found["xy"][new])
            self.counts.off_road += int(np.count_nonzero(~able))
            new = new[able]
            if len(new):
                fresh = self._vehicles.enter(len(new))
                slot[new] = fresh
                entered.append(fresh)
                self._bound[camera].update(
                    zip(found["track_id"][new].tolist(), fresh.tolist(), strict=True)
                )
                self._place(fresh, found[new], time_ns)  # the next camera may see them, too
            kept = slot >= 0
            slots.append(slot[kept])
            rows.append(found[kept])
        if slots:
            self._place(np.concatenate(slots), np.concatenate(rows), time_ns)
        self._drop_false_tracks(time_ns, step_s)
        if len(tables) > 1:
            self._merge(step_s)
        return np.concatenate(entered) if entered else np.empty(0, np.int64)

    def _assign(self, camera: int, rows: NDArray[np.void], time_ns: int) -> Slots:
        """The vehicle of each row (R,); `ENTERS` for new vehicles, `IGNORED` for rows to ignore."""
        bound, track = self._bound[camera], rows["track_id"].tolist()
        slot = np.array([bound.get(t, ENTERS) for t in track], dtype=np.int64)
        held = np.flatnonzero(slot >= 0)
        jumped = ~self._may_be(rows[held], slot[held])
        self.counts.jumps += int(np.count_nonzero(jumped))
        slot[held[jumped]] = ENTERS
        for k in held[jumped].tolist():
            del bound[track[k]]
            self._jumps.add(camera, track[k])
        free = np.flatnonzero(slot < 0)
        if len(free):
            taken = slot[slot >= 0]
            slot[free] = self._match_vehicles(rows[free], taken, time_ns)
            self.counts.handovers += int(np.count_nonzero(slot[free] >= 0))
            bound.update((track[k], int(slot[k])) for k in free.tolist() if slot[k] >= 0)
            alone = free[slot[free] < 0]
            within, beside = self._by_vehicles(rows[alone], taken)
            slot[alone[within]] = IGNORED
            self.counts.doubled += int(np.count_nonzero(within))
            self._jumps.add_new(camera, rows["track_id"][alone[beside & ~within]].tolist())
        alone = np.flatnonzero(slot < 0)
        unsettled = self._jumps.unsettled(camera, rows[alone], time_ns)
        self.counts.unsettled += int(np.count_nonzero(unsettled & (slot[alone] == ENTERS)))
        slot[alone[unsettled]] = IGNORED
        return slot

    def _match_vehicles(self, rows: NDArray[np.void], taken: Slots, time_ns: int) -> Slots:
        """Vehicles for rows without one, `ENTERS` where there is none."""
        found = np.full(len(rows), ENTERS, dtype=np.int64)
        table = self._vehicles.table
        able = np.setdiff1d(self._vehicles.slots, taken)
        if not len(able):
            return found
        pair_row = np.repeat(np.arange(len(rows)), len(able))
        pair_slot = np.tile(able, len(rows))
        pairs, vehicles = rows[pair_row], table[pair_slot]
        along, across = self._apart(pairs, pair_slot)
        unseen_s = (time_ns - vehicles["seen_ns"]) * 1e-9
        turn = (pairs["heading"] - vehicles["course"] + np.pi) % (2 * np.pi) - np.pi
        speed = np.hypot(*(pairs["velocity"] - vehicles["velocity"]).T)
        reach = reach_along_m(pairs["sigma"], vehicles["sigma"]) + DRIFT_MPS * unseen_s
        cost = (along / reach) ** 2 + (across / GATE_ACROSS_M) ** 2
        excluded = (np.abs(along) > reach) | (np.abs(across) > GATE_ACROSS_M)
        excluded |= np.abs(np.nan_to_num(turn)) > GATE_TURN_RAD
        # A track that has just begun has no velocity yet.
        excluded |= ~np.isnan(pairs["heading"]) & (speed > GATE_SPEED_MPS)
        matrix = np.where(excluded, 1e3, cost).reshape(len(rows), len(able))
        r, v = scipy.optimize.linear_sum_assignment(matrix)
        good = matrix[r, v] < 1e3
        found[r[good]] = able[v[good]]
        return found

    def _by_vehicles(
        self, rows: NDArray[np.void], taken: Slots
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which rows (R,) lie within a vehicle of another track of this camera, and which near."""
        within, beside = np.zeros((2, len(rows)), dtype=np.bool_)
        if not len(rows) or not len(taken):
            return within, beside
        table = self._vehicles.table
        sigma = rows["sigma"].max(keepdims=True)
        reach_m = reach_along_m(sigma, table["sigma"][taken].max()) + JUMP_ACROSS_M + 0.5 * sigma
        reach_m = np.maximum(reach_m, 0.5 * table["length"][taken].max() + JUMP_ACROSS_M)
        gap = rows["xy"][:, None] - table["xy"][taken][None]
        row, at = np.nonzero((np.abs(gap) < reach_m).all(axis=2))  # few pairs are near
        slot = taken[at]
        along, across = self._apart(rows[row], slot)
        inside = np.abs(along) < 0.5 * table["length"][slot]
        inside &= np.abs(across) < 0.5 * table["width"][slot]
        within[row[inside]] = True
        beside[row[self._may_be(rows[row], slot)]] = True
        return within, beside

    def _may_be(self, rows: NDArray[np.void], slot: Slots) -> NDArray[np.bool_]:
        """Whether rows (M,) are as near to vehicles (M,) as their own tracks may be."""
        along, across = self._apart(rows, slot)
        sigma = rows["sigma"]
        near = np.abs(along) <= reach_along_m(sigma, self._vehicles.table["sigma"][slot])
        return np.asarray(near & (np.abs(across) <= JUMP_ACROSS_M + 0.5 * sigma))

    def _apart(
        self, rows: NDArray[np.void], slot: Slots
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far rows are from vehicles, along and across the vehicle's heading."""
        table = self._vehicles.table
        heading = np.nan_to_num(table["course"][slot])
        dx, dy = (rows["xy"] - table["xy"][slot]).T
        cos, sin = np.cos(heading), np.sin(heading)
        return dx * cos + dy * sin, dy * cos - dx * sin

    def _place(self, slot: Slots, rows: NDArray[np.void], time_ns: int) -> None:
        """Give vehicles the states of their tracks; several are weighted by their variances."""
        table = self._vehicles.table
        self._vehicles.vote(slot, type_of_class(rows["class_id"]))
        place, first, inverse, count = np.unique(
            slot, return_index=True, return_inverse=True, return_counts=True
        )
        mean = rows[first]
        if len(place) < len(slot):
            mean = _weighted_means(rows, inverse, first)
        for name in ("xy", "velocity", "sigma", "predicted"):
            table[name][place] = mean[name]
        known = ~np.isnan(mean["heading"])
        table["heading"][place[known]] = mean["heading"][known]
        fresh = np.isnan(table["course"][place])
        table["course"][place[fresh]] = mean["heading"][fresh]
        length, width = usual_size(table["kind"][place], mean["length"], mean["width"])
        table["length"][place], table["width"][place] = length, width
        table["seen_ns"][place], table["observed"][place] = time_ns, True
        table["cameras"][place] = count

    def _drop_false_tracks(self, time_ns: int, step_s: float) -> None:
        """Take the tracks from vehicles that can't be real; the vehicles leave with this step."""
        table = self._vehicles.table
        self.false_since_ns = {}
        for slot in self._false_tracks.find(time_ns, step_s).tolist():
            since_ns = self._false_tracks.false_since_ns(slot, time_ns)
            self.false_since_ns[int(table["vehicle_id"][slot])] = since_ns
            for camera, bound in enumerate(self._bound):
                for track in [t for t, s in bound.items() if s == slot]:
                    del bound[track]
                    self._false_tracks.add(camera, track, table["xy"][slot])
            table["seen_ns"][slot] = 0
            table["observed"][slot] = False
            self.counts.false_tracks += 1

    def _merge(self, step_s: float) -> None:
        """Join two vehicles that are one: the older one gets all tracks."""
        slots = self._vehicles.slots
        table = self._vehicles.table
        seen = slots[table["observed"][slots] & (table["cameras"][slots] == 1)]
        cameras = [set(b.values()) for b in self._bound]
        near: dict[tuple[int, int], float] = {}
        if len(seen) > 1:
            gap = table["xy"][seen][:, None] - table["xy"][seen][None]
            pairs = np.argwhere(np.triu(np.hypot(gap[..., 0], gap[..., 1]) < MERGE_ALONG_M, 1))
            for a, b in seen[pairs].tolist():
                turn = table["course"][a] - table["course"][b]
                cos, sin = np.cos(table["course"][a]), np.sin(table["course"][a])
                dx, dy = table["xy"][a] - table["xy"][b]
                if abs(dy * cos - dx * sin) > MERGE_ACROSS_M or np.cos(turn) < MERGE_COS:
                    continue
                if not any(a in bound and b in bound for bound in cameras):
                    near[a, b] = self._near_s.get((a, b), 0.0) + step_s
        self._near_s = near
        for (a, b), time_s in near.items():
            if time_s >= MERGE_S:
                stays, goes = sorted((a, b), key=lambda s: int(table["vehicle_id"][s]))
                for bound in self._bound:
                    bound.update({t: stays for t, s in bound.items() if s == goes})
                table["seen_ns"][goes] = 0  # it leaves with this step
                table["observed"][goes] = False
                self.counts.merged += 1


def _weighted_means(
    rows: NDArray[np.void], group: NDArray[np.int64], first: NDArray[np.int64]
) -> NDArray[np.void]:
    """One row per group: means weighted by the inverse of the squared ground error."""
    weight = 1.0 / (rows["sigma"] ** 2 + LEAST_SIGMA_M**2)
    total = np.bincount(group, weight)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.bincount(group, weight * values) / total)

    out = rows[first].copy()
    for name in ("xy", "velocity"):
        out[name] = np.column_stack([mean(rows[name][:, k]) for k in range(2)])
    known = ~np.isnan(rows["heading"])
    angle = np.where(known, rows["heading"], 0.0)
    cos, sin = mean(known * np.cos(angle)), mean(known * np.sin(angle))
    out["heading"] = np.where(np.hypot(cos, sin) > 1e-6, np.arctan2(sin, cos), np.nan)
    out["sigma"] = 1.0 / np.sqrt(total)
    out["predicted"] = np.bincount(group, ~rows["predicted"]) == 0
    return out
