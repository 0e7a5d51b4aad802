"""A synchroniser whose simulation is started again when it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.scenario import Scenario
from geoorbit_ros.twin.simulation import Simulation
from geoorbit_ros.twin.sumo_process import SimulationError
from geoorbit_ros.twin.synchronizer import Synchronizer

RETRY_S = 5.0
"""A simulation that does not start is tried again after this long. Chosen: shorter costs the live
node time, longer leaves it without SUMO."""


class TwinRunner:
    """Runs a synchroniser; when the simulation ends unexpectedly, a new one takes its place.

    The vehicles are kept here, not in SUMO: with the next step all of them enter the new
    simulation where they are by then.

    Args:
        network: The roads.
        start: Starts a simulation of them.
        cameras: Names.
        step_s: Length of a step.
        hold_s: How long a vehicle that no camera sees keeps driving.
        on_step: Called after every step.
        clock_s: Monotonic time, for the pause between attempts.

    Attributes:
        twin: The synchroniser.
        restarts: How often the simulation was started again.

    Raises:
        SimulationError: The simulation does not start at all.
    """

    def __init__(
        self,
        network: RoadNetwork,
        start: Callable[[], Simulation],
        cameras: Sequence[str],
        step_s: float,
        hold_s: float,
        on_step: Callable[[TwinStep], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._start, self._clock_s = start, clock_s
        self._simulation: Simulation | None = start()
        self._failed_s = -RETRY_S
        self.restarts = 0
        self._scenario = Scenario()
        self.twin = Synchronizer(network, self._simulation, cameras, step_s, hold_s, on_step)

    @property
    def simulation(self) -> Simulation | None:
        """The running simulation; None while none can be started."""
        return self._simulation

    def set_datum(self, camera: str, datum: Datum) -> None:
        """Set the origin of a camera's map frame."""
        self.twin.set_datum(camera, datum)

    def set_alignment(self, camera: str, alignment: Alignment) -> None:
        """Lay a camera's tracks on the network."""
        self.twin.set_alignment(camera, alignment)

    def follow(self, driven: DrivenNetwork) -> None:
        """Use from now on the lanes where they are driven."""
        self.twin.follow(driven)

    def set_scenario(self, scenario: Scenario) -> None:
        """Close lanes and set limits, now and in every simulation that takes this one's place."""
        self._scenario = scenario
        if self._simulation is not None:
            self._simulation.set_scenario(scenario)

    def restart(self, camera: str) -> None:
        """A camera's stream starts again."""
        self.twin.restart(camera)

    def add(self, camera: str, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take a frame; see `Synchronizer.add`.

        Raises:
            SimulationError: The simulation ended during this frame. A new one has been started, or
                will be, and continues with the next frames.
        """
        if self._simulation is None:
            self._start_again()
        try:
            self.twin.add(camera, stamp_ns, rows)
        except SimulationError:
            if self._simulation is not None:
                self._simulation.close()
                self._simulation = None
            self._start_again()
            raise

    def diagnostic_values(self) -> dict[str, object]:
        """Size of the twin, and what happened to tracks and to the simulation."""
        twin = self.twin
        return {
            "vehicles": len(twin.vehicles.slots),
            "steps": twin.steps,
            "vehicles_lost": twin.placement.lost,
            "simulation_restarts": self.restarts,
            "vehicles_in_reserved_lanes": twin.reserved.vehicles.total(),
            **asdict(twin.fusion.counts),
        }

    def close(self) -> None:
        """End the simulation."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _start_again(self) -> None:
        now_s = self._clock_s()
        if now_s - self._failed_s < RETRY_S:
            found = "a simulation that did not start again"
            raise SimulationError("SUMO", found, f"one; next attempt in {RETRY_S:g} s at most")
        try:
            self._simulation = self._start()
        except SimulationError:
            self._failed_s = now_s
            raise
        self._simulation.set_scenario(self._scenario)
        self.restarts += 1
        self.twin.replace_simulation(self._simulation)
