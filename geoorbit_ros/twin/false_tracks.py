"""Tracks that stand for no vehicle: they left theirs, just jumped, or began beside another one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.vehicles import Vehicles

MAX_BRAKING_MPS2 = 9.0
"""Dry asphalt; trackers smooth speeds, and so show less."""
FAST_MPS, STOPPED_SHARE = 10.0, 0.35
"""Below this share of the speed that is possible by braking, a vehicle that was fast is none."""
BRAKES_S = 0.4
"""For so long, as speeds of tracks that change their vehicle are wrong for a moment."""
STANDS_M, STANDS_S = 6.0, 2.0
"""What has not moved by more for so long stands."""
THROUGH_ALONG_M, THROUGH_ACROSS_M = 1.5, 1.0
GRAZES = 3
"""So many different vehicles that overlap a standing one by more than both errors drive through it:
a false box beside the middle of a lane. One alone may be a mistake in its size."""
THROUGH_MPS = 4.0
"""Who drives through another one is faster than vehicles that close up in a queue."""
MAX_SIGMA_M = 2.0
LEAVES_M = 10.0
"""A ghost that moves by more has become a vehicle's track again."""


class FalseTrackWatch:
    """Finds vehicles that are none, and remembers which tracks show them.

    Args:
        vehicles: The vehicles.
        cameras: How many there are.
    """

    def __init__(self, vehicles: Vehicles, cameras: int) -> None:
        self._vehicles = vehicles
        self._places: list[dict[int, NDArray[np.float64]]] = [{} for _ in range(cameras)]
        self._grazed: dict[int, set[int]] = {}  # by standing vehicle: who drove over its side

    def forget(self, camera: int) -> None:
        """A camera's tracker started again."""
        self._places[camera].clear()

    def add(self, camera: int, track: int, xy: NDArray[np.float64]) -> None:
        """From now on this track is a ghost's."""
        self._places[camera][track] = xy.copy()

    def ignored(self, camera: int, rows: NDArray[np.void]) -> NDArray[np.bool_]:
        """Which rows (R,) are ghosts'; those that have moved on are none any more."""
        places = self._places[camera]
        flag = np.zeros(len(rows), dtype=np.bool_)
        if not places:
            return flag
        tracks = rows["track_id"].tolist()
        for k, track in enumerate(tracks):
            if track in places:
                if np.hypot(*(rows["xy"][k] - places[track])) > LEAVES_M:
                    del places[track]
                else:
                    flag[k] = True
        return flag

    def find(self, now_ns: int, step_s: float) -> NDArray[np.int64]:
        """Slots of vehicles seen in this step that can't be vehicles."""
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
        table["anchor"][fresh], table["anchor_ns"][fresh] = table["xy"][fresh], now_ns
        stands = now_ns - table["anchor_ns"][seen] > STANDS_S * 1e9
        return np.asarray(seen[brakes | self._driven_through(seen, speed, stands)])

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
        flag[still] = inside.any(axis=1) | self._grazes(seen[still], seen[moving], along, across)
        return flag

    def _grazes(
        self,
        still: NDArray[np.int64],
        moving: NDArray[np.int64],
        along: NDArray[np.float64],
        across: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Which standing vehicles (S,) too many of moving ones (M,) overlap; gaps are (S, M)."""
        table = self._vehicles.table
        error = np.hypot(table["sigma"][still][:, None], table["sigma"][moving])
        side, end = (
            0.5 * (table[size][still][:, None] + table[size][moving]) - error
            for size in ("width", "length")
        )
        for s, m in np.argwhere((np.abs(across) < side) & (np.abs(along) < end)).tolist():
            vehicle = int(table["vehicle_id"][still[s]])
            self._grazed.setdefault(vehicle, set()).add(int(table["vehicle_id"][moving[m]]))
        standing = table["vehicle_id"][still].tolist()
        self._grazed = {v: self._grazed[v] for v in standing if v in self._grazed}
        return np.array([len(self._grazed.get(v, ())) >= GRAZES for v in standing])


SETTLE_S = 0.3
"""A track that has moved as it says for so long follows something: false boxes come in single
frames, three of which in a row are rare."""
JUMP_ALONG_M, JUMP_ACROSS_M = 4.0, 2.0
"""From one step to the next no vehicle leaves its predicted place by more, but for its errors: a
swap of ids moves a track to the next lane (3 m) or the next vehicle (6 m and more)."""
JUMP_SIGMAS = 3.0


def reach_along_m(
    sigma_m: NDArray[np.float64], other_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far two places of one vehicle may lie apart along its way, by their 1-sigma errors."""
    return np.maximum(JUMP_ALONG_M, JUMP_SIGMAS * np.hypot(sigma_m, other_m))


@dataclass(slots=True)
class _Path:
    """Where a track should be by its velocities since a time, and where it was last."""

    since_ns: int
    now_ns: int
    xy: NDArray[np.float64]
    velocity: NDArray[np.float64]
    sigma_m: float


class JumpWatch:
    """Remembers which tracks have jumped, or begun beside a vehicle, and not settled yet.

    Args:
        cameras: How many there are.
    """

    def __init__(self, cameras: int) -> None:
        self._paths: list[dict[int, _Path | None]] = [{} for _ in range(cameras)]

    def forget(self, camera: int) -> None:
        """A camera's tracker started again."""
        self._paths[camera].clear()

    def add(self, camera: int, track: int) -> None:
        """A track has jumped, or jumped again."""
        self._paths[camera][track] = None

    def add_new(self, camera: int, tracks: Iterable[int]) -> None:
        """Tracks without a vehicle are where one may be; those remembered go on settling."""
        for track in tracks:
            self._paths[camera].setdefault(track, None)

    def unsettled(self, camera: int, rows: NDArray[np.void], time_ns: int) -> NDArray[np.bool_]:
        """Which rows (R,), all that no vehicle has, are of tracks that have not settled yet.

        Tracks that are not among them are forgotten: they have a vehicle, or are gone.
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
    """A path with one more step; it begins anew where the track is not on it."""
    xy, velocity, sigma_m = row["xy"].copy(), row["velocity"].copy(), float(row["sigma"])
    if path is None:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    step_s = (time_ns - path.now_ns) * 1e-9
    expected = path.xy + 0.5 * (path.velocity + velocity) * step_s
    reach_m = reach_along_m(np.array(sigma_m), np.array(path.sigma_m))
    if np.hypot(*(xy - expected)) > reach_m:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    return _Path(path.since_ns, time_ns, expected, velocity, path.sigma_m)
