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
        habit[record.vehicle] + scene.traffic.wander_sigma_m * drift[record.step, record.vehicle]
    )
    normal = np.column_stack([-np.sin(record.heading), np.cos(record.heading)])
    return np.asarray(record.xy + offset[:, None] * normal)
