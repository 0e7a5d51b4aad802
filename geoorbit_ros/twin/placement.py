"""Puts the twin's vehicles into the simulation and reads back where it has them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_PREDICTED, TRACK_DTYPE
from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.roadnet.lane_index import RADIUS_M
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.roadnet.routing import position_ahead
from geoorbit_ros.twin.simulation import Moves, Simulation, States
from geoorbit_ros.twin.vehicles import TYPES, Vehicles

RESIZE_M = 0.5
"""A vehicle gets another length when its track's differs by this. Chosen: smaller resizes vehicles
with every noisy box, larger shows wrong lengths."""
REACH_M = 1.0
"""SUMO looks for the lane this much farther than the vehicle's offset and half its length. Chosen:
larger looks at more lanes and costs time, smaller can miss the lane in a bend."""


@dataclass(frozen=True, slots=True)
class TwinStep:
    """The twin after one step: M vehicles, in the map frame.

    Attributes:
        stamp_ns: Time of the step.
        vehicle_id: (M,) never used again.
        xy: (M, 2) middle of the footprint as SUMO has it; NaN for a vehicle that SUMO took away.
        heading_rad: (M,) counter-clockwise from east, as SUMO has it.
        velocity: (M, 2) m/s.
        size_m: (M, 2) length and width.
        sigma_m: (M,) 1-sigma ground error of the tracks.
        kind: (M,) number in `vehicles.TYPES`.
        lane: (M,) lane number that SUMO has it in, by its front; `NO_LANE` beside the network, and
            where SUMO counts a vehicle that leaves the network to the turnaround at its end.
        wanted_lane: (M,) lane number that it was put on; `NO_LANE` beside every lane, where SUMO
            may count it to the nearest lane or to none.
        observed: (M,) whether a camera saw it; otherwise it goes on along its lane.
        cameras: (M,) how many did.
        wanted_xy: (M, 2) where the tracks say it is.
        wanted_heading_rad: (M,) as tracked.
        cost_s: Time that the step took.
        false_since_ns: Ids of vehicles that were found to be none, and since when: a box that
            stands where others drive. They are not in this step; what earlier steps said is void.
    """

    stamp_ns: int
    vehicle_id: NDArray[np.int64]
    xy: NDArray[np.float64]
    heading_rad: NDArray[np.float64]
    velocity: NDArray[np.float64]
    size_m: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    kind: NDArray[np.int64]
    lane: NDArray[np.int64]
    wanted_lane: NDArray[np.int64]
    observed: NDArray[np.bool_]
    cameras: NDArray[np.int64]
    wanted_xy: NDArray[np.float64]
    wanted_heading_rad: NDArray[np.float64]
    cost_s: float
    false_since_ns: Mapping[int, int] = field(default_factory=dict)


class Placement:
    """Keeps SUMO's vehicles where the twin's are.

    SUMO's vehicle is at the middle of its front bumper, the twin's at the middle of its
    footprint: half a length lies between them along the heading.

    Args:
        network: The roads.
        vehicles: The vehicles.
        simulation: What is moved.

    Attributes:
        lost: Vehicles that SUMO took away so far; they are put back with the next step.
    """

    def __init__(self, network: RoadNetwork, vehicles: Vehicles, simulation: Simulation) -> None:
        self._network, self._vehicles, self._simulation = network, vehicles, simulation
        self._leaving: list[str] = []
        self._moved_m = 0.0
        self.lost = 0

    def follow(self, driven: DrivenNetwork) -> None:
        """Use from now on the lanes where they are driven; those in SUMO stay."""
        self._network, self._moved_m = driven.network, driven.largest_m

    def replace(self, simulation: Simulation) -> None:
        """Go on with another simulation; all vehicles enter it with the next step."""
        self._simulation = simulation
        self._leaving = []
        self._vehicles.table["entered"] = False

    def leave(self, slot: NDArray[np.int64]) -> None:
        """Let these vehicles leave with the next step."""
        rows = self._vehicles.table[slot]
        self._leaving += _names(rows["vehicle_id"][rows["entered"]])

    def step(self, now_ns: int, slots: NDArray[np.int64], start_s: float) -> TwinStep:
        """Simulate one step that ends with the vehicles where the twin has them.

        Args:
            now_ns: Time of its end.
            slots: (M,) all vehicles.
            start_s: `time.perf_counter` when work on this step began.

        Raises:
            SimulationError: The simulation is gone.
        """
        table = self._vehicles.table
        names = _names(table["vehicle_id"][slots])
        self._enter_and_resize(slots, names)
        rows = table[slots]
        front = rows["xy"] + _bumper(rows["course"], rows["sim_length"])
        lane, arc_m = self._front_lanes(rows, front)
        plane, network = self._network.plane, self._network
        turn = plane.to_network.turn_rad(front)
        safe = np.maximum(lane, 0)
        moves = Moves(
            names,
            [network.edge_id[k] if k != NO_LANE else "" for k in lane.tolist()],
            np.where(lane == NO_LANE, 0, network.index[safe]),
            arc_m / network.length_m[safe],
            plane.to_network.points(front),
            np.degrees(0.5 * np.pi - rows["course"] - turn) % 360.0,
            self._reach_m(rows),
            rows["within"] & (lane == rows["lane"]),
        )
        self._simulation.move(moves)
        self._simulation.step()
        states = self._simulation.states(names)
        return self._read(now_ns, slots, rows, lane, states, start_s)

    def _reach_m(self, rows: NDArray[np.void]) -> NDArray[np.float64]:
        """(M,) how far from the front bumper the simulation's lane may be."""
        away_m = np.where(rows["within"], np.abs(rows["offset"]), RADIUS_M)
        return np.asarray(away_m + 0.5 * rows["sim_length"] + self._moved_m + REACH_M)

    def _enter_and_resize(self, slots: NDArray[np.int64], names: list[str]) -> None:
        table = self._vehicles.table
        while self._leaving:
            self._simulation.remove(self._leaving.pop())
        # Field by field: whole rows of all vehicles are a quarter of a megabyte to copy.
        other = table["kind"][slots] != table["sim_kind"][slots]
        other |= np.abs(table["length"][slots] - table["sim_length"][slots]) > RESIZE_M
        for k in np.flatnonzero(other | ~table["entered"][slots]).tolist():
            slot = slots[k]
            row = table[slot].copy()
            change = self._simulation.resize if row["entered"] else self._simulation.add
            change(names[k], TYPES[row["kind"]].name, float(row["length"]), float(row["width"]))
            table["entered"][slot] = True
            for name in ("kind", "length", "width"):
                table[f"sim_{name}"][slot] = row[name]

    def _front_lanes(
        self, rows: NDArray[np.void], front: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Lanes of the front bumpers, and metres along them (M,).

        The next lane where the front is over an end, `NO_LANE` where none comes next.
        """
        lane = rows["lane"].copy()
        ahead = rows["arc"] + 0.5 * rows["sim_length"]
        over = (lane != NO_LANE) & (ahead > self._network.length_m[np.maximum(lane, 0)])
        for k in np.flatnonzero(over).tolist():
            place = position_ahead(self._network, int(lane[k]), float(ahead[k]), 0.0, front[k])
            lane[k], ahead[k] = (NO_LANE if place.ended else place.lane), place.arc_m
        return np.asarray(lane, dtype=np.int64), ahead

    def _read(
        self,
        now_ns: int,
        slots: NDArray[np.int64],
        rows: NDArray[np.void],
        lane: NDArray[np.int64],
        states: States,
        start_s: float,
    ) -> TwinStep:
        gone = np.isnan(states.angle_deg)
        if gone.any():
            self.lost += int(np.count_nonzero(gone))
            self._vehicles.table["entered"][slots[gone]] = False
        plane, number = self._network.plane, self._network.number
        front = plane.to_map.points(states.xy)
        heading = 0.5 * np.pi - np.radians(states.angle_deg) + plane.to_map.turn_rad(states.xy)
        heading = (heading + np.pi) % (2 * np.pi) - np.pi
        seen_in = np.array([number.get(name, NO_LANE) for name in states.lane], dtype=np.int64)
        leaves = self._network.turns_round[seen_in] & (seen_in != NO_LANE) & (lane != seen_in)
        return TwinStep(
            stamp_ns=now_ns,
            vehicle_id=rows["vehicle_id"],
            xy=front - _bumper(heading, rows["sim_length"]),
            heading_rad=heading,
            velocity=rows["velocity"],
            size_m=np.column_stack((rows["sim_length"], rows["sim_width"])),
            sigma_m=rows["sigma"],
            kind=rows["sim_kind"],
            lane=np.where(leaves, NO_LANE, seen_in),
            wanted_lane=np.where(rows["within"], lane, NO_LANE),
            observed=rows["observed"],
            cameras=rows["cameras"],
            wanted_xy=rows["xy"],
            wanted_heading_rad=rows["heading"],
            cost_s=time.perf_counter() - start_s,
        )


def _names(vehicle_id: NDArray[np.int64]) -> list[str]:
    return [f"v{k}" for k in vehicle_id.tolist()]


def _bumper(heading_rad: NDArray[np.float64], length_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 2) from the middle of the footprint to that of the front bumper."""
    unit = np.column_stack((np.cos(heading_rad), np.sin(heading_rad)))
    return np.asarray(0.5 * length_m[:, None] * unit)


def track_rows(step: TwinStep) -> NDArray[np.void]:
    """(M,) `TRACK_DTYPE`; `track_id` is the vehicle's id, `FLAG_PREDICTED` where it is not seen."""
    kept = np.isfinite(step.xy[:, 0])
    rows = np.zeros(int(np.count_nonzero(kept)), TRACK_DTYPE)
    rows["x"], rows["y"] = step.xy[kept].T
    rows["vx"], rows["vy"] = step.velocity[kept].T
    rows["heading"], rows["sigma"] = step.heading_rad[kept], step.sigma_m[kept]
    rows["length"], rows["width"] = step.size_m[kept].T
    rows["score"] = 1.0
    rows["class_id"] = np.array([kind.coco_class for kind in TYPES])[step.kind[kept]]
    rows["track_id"] = step.vehicle_id[kept]
    rows["flags"] = np.where(step.observed[kept], 0, FLAG_PREDICTED)
    return rows
