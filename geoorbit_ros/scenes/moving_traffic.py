"""Where every vehicle is at any time: SUMO's steps joined, and each driver's wander in the lane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.scene import VEHICLE_TYPES, Scene
from geoorbit_ros.scenes.traffic import STEP_S, TrafficRecord

WANDER_TIME_S = 4.0
"""Correlation time of a driver's wander in the lane. Chosen: shorter looks like noise of the boxes,
longer like another habitual place."""

SHIFT_TIME_S = 1.5
"""Time constant with which a driver takes to another lane's place. Chosen: a lane change takes 4 s;
shorter moves vehicles sideways in jumps."""


class MovingTraffic:
    """The traffic of one run of a scene.

    Args:
        record: SUMO's states.
        scene: Says how far drivers keep from the lane's middle.
        seed: Of the run: the same one gives every driver the same habit and wander.
    """

    def __init__(self, record: TrafficRecord, scene: Scene, seed: int) -> None:
        self._record = record
        self._xy = _wander(record, scene, seed)
        self._classes = np.array(
            [VEHICLE_TYPES[name].coco_class for name in record.vehicle_types], dtype=np.int64
        )

    def at(self, time_s: float) -> tuple[View, NDArray[np.int64], NDArray[np.float64]]:
        """Vehicles at `time_s`, between two steps; lane number (N,) and velocity (N, 2) of each."""
        record, xy = self._record, self._xy
        at = time_s / STEP_S
        before = int(np.floor(at))
        a = slice(*np.searchsorted(record.step, [before, before + 1]))
        b = slice(*np.searchsorted(record.step, [before + 1, before + 2]))
        common, ia, ib = np.intersect1d(record.vehicle[a], record.vehicle[b], return_indices=True)
        share = at - before
        start, end = xy[a][ia], xy[b][ib]
        turn = record.heading[b][ib] - record.heading[a][ia]
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        view = View(
            common,
            start + share * (end - start),
            record.heading[a][ia] + share * turn,
            record.vehicle_sizes[common],
            self._classes[common],
        )
        return view, record.lane[a][ia], (end - start) / STEP_S


def _wander(record: TrafficRecord, scene: Scene, seed: int) -> NDArray[np.float64]:
    """(N, 2) positions with each driver's habit and slow wander across the lane."""
    random = np.random.default_rng([seed, 4])
    count = len(record.vehicle_types)
    habit = scene.traffic.driver_offset_sigma_m * np.clip(random.standard_normal(count), -2.0, 2.0)
    steps = int(record.step.max(initial=0)) + 1
    fade = np.exp(-STEP_S / WANDER_TIME_S)
    noise = random.standard_normal((steps, count))
    drift = np.empty_like(noise)
    drift[0] = noise[0]
    for k in range(1, steps):
        drift[k] = fade * drift[k - 1] + np.sqrt(1.0 - fade**2) * noise[k]
    offset = (
        habit[record.vehicle]
        + scene.traffic.wander_sigma_m * drift[record.step, record.vehicle]
        + _edge_shift(record, scene, seed)
    )
    normal = np.column_stack([-np.sin(record.heading), np.cos(record.heading)])
    return np.asarray(record.xy + offset[:, None] * normal)


def _edge_shift(record: TrafficRecord, scene: Scene, seed: int) -> NDArray[np.float64]:
    """(N,) how far left of the lane's middle the lane itself makes drivers keep.

    From the edge of the road towards the lane beside; they move over slowly when they change lanes.
    """
    traffic = scene.traffic
    if not (traffic.edge_shift_m or traffic.edge_shift_sigma_m):
        return np.zeros(len(record.step))
    lanes_of = {road.id: road.lanes for road in scene.roads}
    of_lane = []
    for road, lane in record.lane_names:
        # Each lane by its name: the same shift whatever else the scene has.
        own = np.random.default_rng([seed, 5, *road.encode(), lane])
        shift = traffic.edge_shift_m + traffic.edge_shift_sigma_m * own.standard_normal()
        edges = (lane == 0) - (lane == lanes_of[road] - 1)  # 0 for a single lane
        of_lane.append(edges * shift)
    wanted = np.where(record.lane >= 0, np.append(of_lane, 0.0)[record.lane], np.nan)
    found = np.zeros(len(wanted))
    share = 1.0 - np.exp(-STEP_S / SHIFT_TIME_S)
    rows_of = np.argsort(record.vehicle, kind="stable")
    for rows in np.split(rows_of, np.flatnonzero(np.diff(record.vehicle[rows_of])) + 1):
        known = wanted[rows][np.isfinite(wanted[rows])]
        now = known[0] if len(known) else 0.0
        for row in rows:
            if np.isfinite(wanted[row]):  # not within a junction
                now += share * (wanted[row] - now)
            found[row] = now
    return found
