"""The twin's vehicles in CARLA: spawned, moved and taken away, whatever serves them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.carla.frame import CarlaPose, vehicle_pose


class CarlaServer(Protocol):
    """What the fleet needs of a CARLA server. Every method raises CarlaError when it is gone."""

    def spawn(self, class_id: int, length_m: float, pose: CarlaPose) -> int | None:
        """A vehicle that is moved by hand; None where there is no room for it."""

    def move(self, poses: Mapping[int, CarlaPose]) -> None:
        """Put actors in their places, all at once."""

    def destroy(self, actors: Sequence[int]) -> None:
        """Take actors away."""

    def tick(self) -> None:
        """One frame."""


class CarlaFleet:
    """Keeps one actor per vehicle of the twin.

    Args:
        server: Has the actors.

    Attributes:
        actors: Actor by vehicle id.
        refused: Times that there was no room for a vehicle; it is tried again with every step.
    """

    def __init__(self, server: CarlaServer) -> None:
        self._server = server
        self.actors: dict[int, int] = {}
        self.refused = 0

    def update(self, rows: NDArray[np.void], origin_m: NDArray[np.float64]) -> None:
        """Follow one step of the twin.

        Args:
            rows: `TRACK_DTYPE` of `twin/tracks`.
            origin_m: (2,) origin of their frame in the road's.
        """
        there = set(rows["track_id"].tolist())
        gone = [vehicle for vehicle in self.actors if vehicle not in there]
        if gone:
            self._server.destroy([self.actors.pop(vehicle) for vehicle in gone])
        poses: dict[int, CarlaPose] = {}
        for row in rows:
            x, y = float(row["x"]) + origin_m[0], float(row["y"]) + origin_m[1]
            pose = vehicle_pose(x, y, float(row["heading"]))
            vehicle = int(row["track_id"])
            if vehicle in self.actors:
                poses[self.actors[vehicle]] = pose
                continue
            actor = self._server.spawn(int(row["class_id"]), float(row["length"]), pose)
            if actor is None:
                self.refused += 1
            else:
                self.actors[vehicle] = actor
        self._server.move(poses)
        self._server.tick()

    def close(self) -> None:
        """Take all vehicles away."""
        self._server.destroy(list(self.actors.values()))
        self.actors.clear()
