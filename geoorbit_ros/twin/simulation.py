"""The simulation as the twin uses it: vehicles that are put where they are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Moves:
    """Where M vehicles go in the next step, in the network's coordinates.

    Attributes:
        name: SUMO's vehicle ids.
        edge: Edge of each; empty beside the network.
        lane: (M,) lane index in the edge.
        share: (M,) place along the lane, as a share of its length.
        xy: (M, 2) middle of the front bumper.
        angle_deg: (M,) clockwise from north.
        reach_m: (M,) largest distance of the lane.
        within: (M,) whether the vehicle is between the borders and the ends of its lane.
    """

    name: Sequence[str]
    edge: Sequence[str]
    lane: NDArray[np.int64]
    share: NDArray[np.float64]
    xy: NDArray[np.float64]
    angle_deg: NDArray[np.float64]
    reach_m: NDArray[np.float64]
    within: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class States:
    """Where SUMO has M vehicles after a step, in the network's coordinates.

    Attributes:
        xy: (M, 2) middle of the front bumper; NaN for vehicles that SUMO took away.
        angle_deg: (M,) clockwise from north.
        lane: (M,) lane ids, empty beside the network.
    """

    xy: NDArray[np.float64]
    angle_deg: NDArray[np.float64]
    lane: list[str]


class Simulation(Protocol):
    """What the synchroniser needs of a simulation.

    Every method raises SimulationError when the simulation is gone.
    """

    def add(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        """Let a vehicle enter; it appears where the next `move` puts it."""

    def resize(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        """Give a vehicle another type and size."""

    def remove(self, name: str) -> None:
        """Let a vehicle leave."""

    def move(self, moves: Moves) -> None:
        """Set where vehicles are at the end of the next step."""

    def step(self) -> None:
        """Simulate one step."""

    def states(self, names: Sequence[str]) -> States:
        """Where vehicles are."""

    def set_scenario(self, scenario: Scenario) -> None:
        """Close these lanes and set these limits, and undo what was changed before."""

    def close(self) -> None:
        """End the simulation."""
