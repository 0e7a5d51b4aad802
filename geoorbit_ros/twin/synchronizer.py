"""Keeps a simulation in step with the tracks of all cameras.

Time is that of the tracks: a step is simulated as soon as every camera has a frame that is not
older, or is `MAX_WAIT_S` behind the others. The same frames give the same twin at any speed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.roadnet.routing import position_ahead
from geoorbit_ros.twin.camera_tracks import CameraTracks
from geoorbit_ros.twin.fusion import Fusion
from geoorbit_ros.twin.health import ReservedLanes
from geoorbit_ros.twin.lane_changes import MAX_ACROSS_MPS
from geoorbit_ros.twin.matching import LaneMatcher
from geoorbit_ros.twin.placement import Placement, TwinStep
from geoorbit_ros.twin.simulation import Simulation
from geoorbit_ros.twin.vehicles import Vehicles

MAX_WAIT_S = 0.2
"""A camera that is farther behind the newest one is not waited for. Chosen: two frames at 10 Hz;
larger delays the twin, smaller guesses positions of slow cameras."""
MIN_SPEED_MPS = 0.2
"""Slower vehicles that no camera sees keep their position. Chosen: below, the velocity is noise;
larger stops vehicles that creep."""
LANE_TURN_RAD = np.radians(4.0)
"""A vehicle's heading may differ from its lane's by this more. Chosen: lanes are drawn in straight
pieces; larger turns fronts into the next lane."""
MAX_GAP_S = 30.0
"""After a longer pause of all cameras, time jumps instead of being simulated step by step. Chosen:
by then all vehicles have left."""


class Synchronizer:
    """Frames in, simulation steps out.

    Args:
        network: The roads.
        simulation: What is moved.
        cameras: Their names.
        step_s: Length of a step.
        hold_s: How long a vehicle that no camera sees keeps driving before it leaves.
        on_step: Called after every step.

    Attributes:
        vehicles: The vehicles.
        fusion: Assigns tracks to vehicles.
        placement: Puts SUMO's vehicles where the tracks say.
        steps: Simulated so far.
        reserved: Vehicles in lanes that the map keeps for others.
    """

    def __init__(
        self,
        network: RoadNetwork,
        simulation: Simulation,
        cameras: Sequence[str],
        step_s: float,
        hold_s: float,
        on_step: Callable[[TwinStep], None],
    ) -> None:
        self._network, self._on_step = network, on_step
        self._step_ns, self._hold_ns = round(step_s * 1e9), round(hold_s * 1e9)
        self._cameras = {c: CameraTracks(c, hold_s, network.datum) for c in cameras}
        self._order = {c: k for k, c in enumerate(cameras)}
        self._matcher = LaneMatcher(network, step_s)
        self._now_ns: int | None = None
        self.vehicles = Vehicles()
        self.placement = Placement(network, self.vehicles, simulation)
        self.fusion = Fusion(self.vehicles, len(cameras), self._matcher.on_road)
        self.reserved = ReservedLanes(network)
        self.steps = 0

    def set_datum(self, camera: str, datum: Datum) -> None:
        """Set the origin of a camera's map frame; without it, that of the network is used."""
        self._cameras[camera].set_datum(datum)

    def set_alignment(self, camera: str, alignment: Alignment) -> None:
        """Lay a camera's tracks on the network from the next frame on."""
        self._cameras[camera].alignment = alignment

    def follow(self, driven: DrivenNetwork) -> None:
        """Use the lanes where they are driven, from the next step on."""
        self._network = driven.network
        self._matcher.follow(driven)
        self.placement.follow(driven)

    def replace_simulation(self, simulation: Simulation) -> None:
        """Go on with another simulation, into which all vehicles enter with the next step."""
        self.placement.replace(simulation)

    def restart(self, camera: str) -> None:
        """A camera's stream starts again, at an earlier time."""
        self._cameras[camera].reset()
        self.fusion.forget_tracks(self._order[camera])
        if all(c.newest_ns is None for c in self._cameras.values()):
            self._now_ns = None
            self._let_leave(self.vehicles.slots)

    def add(self, camera: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take a frame of `TRACK_DTYPE` rows and simulate what can be.

        Raises:
            SimulationError: The simulation is gone; continue after `replace_simulation`.
        """
        self._cameras[camera].add(stamp_ns, rows)
        if self._now_ns is None:
            # Steps lie on whole multiples, so that the first frame does not shift them.
            self._now_ns = -(-stamp_ns // self._step_ns) * self._step_ns - self._step_ns
        self._advance()

    def finish(self) -> None:
        """Simulate the rest: no more frames will come."""
        self._advance(wait=False)

    def _advance(self, wait: bool = True) -> None:
        newest = [c.newest_ns for c in self._cameras.values() if c.newest_ns is not None]
        if not newest or self._now_ns is None:
            return
        late = max(newest) - round(MAX_WAIT_S * 1e9) if wait else max(newest)
        until = max(min(newest), late)
        if until - self._now_ns > MAX_GAP_S * 1e9:
            self._let_leave(self.vehicles.slots)
            self._now_ns = (until // self._step_ns - 1) * self._step_ns
        while self._now_ns + self._step_ns <= until:
            self._now_ns += self._step_ns
            self._simulate(self._now_ns)

    def _simulate(self, now_ns: int) -> None:
        start = time.perf_counter()
        vehicles, step_s = self.vehicles, self._step_ns * 1e-9
        tables = [camera.at(now_ns) for camera in self._cameras.values()]
        self._matcher.forget(self.fusion.update(now_ns, step_s, tables))
        table, slots = vehicles.table, vehicles.slots
        unseen = slots[~table["observed"][slots]]
        self._let_leave(unseen[table["seen_ns"][unseen] < now_ns - self._hold_ns])
        self._coast(unseen[table["active"][unseen]], step_s)
        slots = vehicles.slots
        found = self._matcher.update(
            slots, *(table[name][slots] for name in ("xy", "heading", "sigma", "observed", "kind"))
        )
        table["lane"][slots], table["arc"][slots] = found.lane, found.arc_m
        table["offset"][slots], table["within"][slots] = found.offset_m, found.within
        # Until a vehicle has moved, it points along its lane.
        blind = np.isnan(table["heading"][slots])
        table["heading"][slots[blind]] = np.nan_to_num(found.heading_rad[blind])
        table["course"][slots] = plausible_course(
            table["heading"][slots], np.hypot(*table["velocity"][slots].T), found.heading_rad
        )
        step = self.placement.step(now_ns, slots, start)
        if self.fusion.false_since_ns:
            step = replace(step, false_since_ns=self.fusion.false_since_ns)
        self.steps += 1
        self.reserved.add(step)
        self._on_step(step)

    def _let_leave(self, slot: NDArray[np.int64]) -> None:
        self.placement.leave(slot)
        self.fusion.release(slot)
        self.vehicles.leave(slot)

    def _coast(self, slot: NDArray[np.int64], step_s: float) -> None:
        """Vehicles that no camera sees go on along their lanes."""
        table = self.vehicles.table
        for k in slot.tolist():
            row = table[k]
            speed = float(np.hypot(*row["velocity"]))
            if row["lane"] == NO_LANE or speed < MIN_SPEED_MPS:
                continue  # straight on, as the fusion has it
            arc_m = float(row["arc"]) + speed * step_s
            place = position_ahead(self._network, int(row["lane"]), arc_m, float(row["offset"]))
            if place.ended:
                self._let_leave(np.array([k]))
                continue
            table["xy"][k], table["heading"][k] = place.xy, place.heading_rad
            table["velocity"][k] = speed * np.array(
                [np.cos(place.heading_rad), np.sin(place.heading_rad)]
            )


def plausible_course(
    heading_rad: NDArray[np.float64],
    speed_mps: NDArray[np.float64],
    lane_heading_rad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Headings (M,), limited to what a vehicle can drive at its speed in its lane.

    The heading of a new track is noise. The front of a fast vehicle that is turned by it would
    reach into the next lane, and SUMO would count the vehicle there. Vehicles move across lanes no
    faster than `MAX_ACROSS_MPS`, which limits the angle to the lane; beside the network (NaN) there
    is no limit.
    """
    share = MAX_ACROSS_MPS / np.maximum(speed_mps, MAX_ACROSS_MPS)
    bound = np.where(share < 1.0, np.arcsin(share) + LANE_TURN_RAD, np.pi)
    turn = (heading_rad - lane_heading_rad + np.pi) % (2 * np.pi) - np.pi
    bounded = lane_heading_rad + np.clip(turn, -bound, bound)
    return np.where(np.isnan(turn) | (np.abs(turn) <= bound), heading_rad, bounded)
