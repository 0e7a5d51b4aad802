"""A SUMO simulation whose vehicles are put where they are seen (`moveToXY`).

SUMO runs in this process (libsumo, one simulation per process) or as a program of its own (TraCI,
with a window if wanted). Both have the same Python interface, which one class uses.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.twin.running_network import write_running_network
from geoorbit_ros.twin.scenario import Scenario
from geoorbit_ros.twin.simulation import Moves, States
from geoorbit_ros.twin.sumo_process import (
    CLOSE_TIMEOUT_S,
    SimulationError,
    exit_text,
    first_line,
    start_program,
)
from geoorbit_ros.twin.vehicles import write_types

Backend = Literal["libsumo", "traci"]
_BESIDE_ROAD = 6
"""`keepRoute` of moveToXY (SUMO's TraCI documentation, sum of flags): the vehicle may leave route
and road (2), also to lanes closed to its class (4)."""
_NAMED_LANE = 4
"""On the road: the named lane counts up to 2 m beside its middle; with (2) it would count only half
its width to either side."""
_SAME_EDGE = 5
"""The same on the route (1), the edge that the vehicle was last put on. SUMO looks at that edge
alone, which takes half the time, and the named lane counts however far it is."""
_ARRIVED = 2
"""Reason of removal: the vehicle reached its destination (traci.constants.REMOVE_ARRIVED)."""

_running_in_process = False


def backend_of(name: str, gui: bool) -> Backend:
    """The backend that parameters name.

    Raises:
        ParameterError: Another name, or a window for a simulation that can't have one.
    """
    if name == "traci":
        return "traci"
    if name != "libsumo" or gui:
        found = f"backend {name} with a window" if gui else f"'{name}'"
        raise ParameterError("SUMO's backend", found, "traci, or libsumo without a window")
    return "libsumo"


class _Calls(NamedTuple):
    """Functions that are called once for every vehicle in every step."""

    move: Callable[..., object]
    position: Callable[[str], tuple[float, float]]
    angle: Callable[[str], float]
    lane: Callable[[str], str]


def _direct_calls(vehicle: Any, *, in_process: bool) -> _Calls:
    """In process, without libsumo's Python wrappers, which take a tenth of a step's time."""
    if not in_process:
        return _Calls(vehicle.moveToXY, vehicle.getPosition, vehicle.getAngle, vehicle.getLaneID)
    from libsumo import _libsumo as direct

    return _Calls(
        direct.vehicle_moveToXY,
        direct.vehicle_getPosition,
        direct.vehicle_getAngle,
        direct.vehicle_getLaneID,
    )


class SumoSimulation:
    """A SUMO simulation of a network without any other traffic.

    Args:
        network: The network file.
        step_s: Length of a step.
        backend: `libsumo` in this process, `traci` as a program of its own.
        gui: Show a window (`sumo-gui`; TraCI only).
        options: More of SUMO's options.

    Attributes:
        pid: Process id of the program; None in process.
        running: Names of the simulated network's edges.

    Raises:
        SimulationError: SUMO is missing, refuses the network, or runs in this process already.
        RoadNetworkError: The network file can't be read.
    """

    def __init__(
        self,
        network: Path,
        step_s: float,
        *,
        backend: Backend = "libsumo",
        gui: bool = False,
        options: Sequence[str] = (),
    ) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="geoorbit_twin_"))
        self._process: subprocess.Popen[bytes] | None = None
        self._in_process = backend == "libsumo"
        self._changed: set[str] = set()  # lanes of the file that a scenario changed
        self._original: dict[str, tuple[float, Sequence[str]]] = {}  # limit, closed classes
        self._inside: set[str] = set()  # vehicles that entered and were not removed
        self._piece_of: dict[str, str] = {}  # edge that SUMO had each vehicle on
        self._sumo: Any = None  # set by the start, unset by the end
        self._fatal: tuple[type[Exception], ...] = ()
        try:
            net, types = self._folder / "twin.net.xml", self._folder / "twin.add.xml"
            self.running = write_running_network(network, net)
            write_types(types)
            arguments = [f"--net-file={net}", f"--additional-files={types}", *_OPTIONS]
            arguments += [f"--step-length={step_s:g}", *options]
            if self._in_process:
                self._start_in_process(arguments)
            else:
                self._start_program("sumo-gui" if gui else "sumo", arguments)
        except BaseException:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise
        self._vehicle: Any = self.sumo.vehicle
        self._direct = _direct_calls(self._vehicle, in_process=self._in_process)

    @property
    def pid(self) -> int | None:
        """Process id of SUMO as a program of its own."""
        return self._process.pid if self._process else None

    @property
    def sumo(self) -> Any:
        """SUMO's own Python interface (libsumo, or a TraCI connection), for everything else."""
        return self._sumo

    def add(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        """Let a vehicle enter; it appears where the next `move` puts it."""
        with self._watched():
            # Without route: SUMO makes one of the edge that the vehicle is put on.
            self._vehicle.add(name, "", type_name, depart="now")
            self._vehicle.setSpeedMode(name, 0)
            self._vehicle.setLaneChangeMode(name, 0)
            self._vehicle.setLength(name, length_m)
            self._vehicle.setWidth(name, width_m)
        self._inside.add(name)

    def resize(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        """Give a vehicle another type and size."""
        with self._watched():
            self._vehicle.setType(name, type_name)
            self._vehicle.setLength(name, length_m)
            self._vehicle.setWidth(name, width_m)

    def remove(self, name: str) -> None:
        """Let a vehicle leave."""
        with self._watched():
            self._vehicle.remove(name, _ARRIVED)
        self._inside.discard(name)

    def move(self, moves: Moves) -> None:
        """Set where vehicles are at the end of the next step."""
        pieces = list(map(self.running.piece, moves.edge, moves.share.tolist()))
        self._begin_routes(moves, pieces)
        stays = [
            _BESIDE_ROAD
            if not piece
            else (_SAME_EDGE if within and before == piece else _NAMED_LANE)
            for within, before, piece in zip(
                moves.within.tolist(), map(self._piece_of.get, moves.name), pieces, strict=True
            )
        ]
        calls = map(
            self._direct.move,
            moves.name,
            pieces,
            moves.lane.tolist(),
            *moves.xy.T.tolist(),
            moves.angle_deg.tolist(),
            stays,
            moves.reach_m.tolist(),
        )
        with self._watched():
            deque(calls, maxlen=0)  # one call after the other, with nothing kept

    def _begin_routes(self, moves: Moves, pieces: list[str]) -> None:
        """Give entering vehicles their edge as route: the named lane counts (`_SAME_EDGE`)."""
        for k, name in enumerate(moves.name):
            if name not in self._piece_of and moves.within[k] and pieces[k][:1] not in ("", ":"):
                with self._watched():
                    self._vehicle.setRoute(name, [pieces[k]])
                self._piece_of[name] = pieces[k]

    def step(self) -> None:
        """Simulate one step."""
        with self._watched():
            self._sumo.simulationStep()

    def states(self, names: Sequence[str]) -> States:
        """Where vehicles are."""
        v = self._vehicle
        with self._watched():
            known = names
            # Where the count is right, all vehicles that entered are still there.
            if v.getIDCount() != len(self._inside) or not self._inside.issuperset(names):
                there = set(v.getIDList())
                known = [name for name in names if name in there]
            xy = list(map(self._direct.position, known))
            angle = list(map(self._direct.angle, known))
            on = list(map(self.running.of_lane.__getitem__, map(self._direct.lane, known)))
        lane, piece = map(list, zip(*on, strict=True)) if on else ([], [])
        self._piece_of = dict(zip(known, piece, strict=True))
        if len(known) == len(names):
            return States(np.array(xy).reshape(-1, 2), np.array(angle, dtype=np.float64), lane)
        found = States(np.full((len(names), 2), np.nan), np.full(len(names), np.nan), [])
        at = np.flatnonzero([name in self._piece_of for name in names])
        found.xy[at], found.angle_deg[at] = np.array(xy).reshape(-1, 2), angle
        lanes = dict(zip(known, lane, strict=True))
        return States(found.xy, found.angle_deg, [lanes.get(name, "") for name in names])

    def set_scenario(self, scenario: Scenario) -> None:
        """Close these lanes and set these limits, and undo what was changed before.

        Tracked vehicles stay where they are seen, also on closed lanes.
        """
        lanes: Any = self.sumo.lane
        with self._watched():
            for lane in {*scenario.closed, *scenario.limit_mps, *self._changed}:
                edge, _, index = lane.rpartition("_")
                for piece in (f"{name}_{index}" for name in self.running.pieces(edge)):
                    if piece not in self._original:
                        self._original[piece] = (
                            lanes.getMaxSpeed(piece),
                            lanes.getDisallowed(piece),
                        )
                    speed, disallowed = self._original[piece]
                    lanes.setMaxSpeed(piece, scenario.limit_mps.get(lane, speed))
                    lanes.setDisallowed(piece, ["all"] if lane in scenario.closed else disallowed)
        self._changed = {*scenario.closed, *scenario.limit_mps}

    def close(self) -> None:
        """End the simulation; a program that does not end is killed."""
        global _running_in_process
        if self._sumo is not None:
            with suppress(Exception):  # it may have ended already
                self._sumo.close(*(() if self._in_process else (False,)))
            self._sumo = None
            if self._in_process:
                _running_in_process = False
        if self._process is not None:
            try:
                self._process.wait(CLOSE_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _start_in_process(self, arguments: list[str]) -> None:
        global _running_in_process
        import libsumo

        if _running_in_process:
            raise SimulationError("SUMO", "a second simulation in one process", "one (libsumo)")
        self._fatal = (libsumo.TraCIException, libsumo.FatalTraCIError)
        try:
            libsumo.start(["sumo", *arguments])
        except (*self._fatal, RuntimeError) as error:
            # libsumo writes the reason on standard error; its exception has none.
            found = first_line(error).replace("Process Error", "a network it refuses (see above)")
            raise SimulationError("SUMO", found, "a simulation") from error
        _running_in_process = True
        self._sumo = libsumo

    def _start_program(self, program: str, arguments: list[str]) -> None:
        import traci

        self._fatal = (traci.TraCIException, traci.FatalTraCIError, OSError)
        self._process, self._sumo = start_program(program, arguments, self._folder)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Turns what SUMO's interface raises into one sentence."""
        if self._sumo is None:
            raise SimulationError("SUMO", "a simulation that was closed", "a running one")
        try:
            yield
        except self._fatal as error:
            if self._process is not None:
                self._explain_end(self._process, error)
            raise SimulationError("SUMO", first_line(error), "a running simulation") from error

    def _explain_end(self, process: subprocess.Popen[bytes], error: Exception) -> None:
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.5)
        if process.returncode is not None:
            found = f"its process ended with {exit_text(process.returncode)}"
            raise SimulationError("SUMO", found, "a running simulation") from error
        if not isinstance(error, self._fatal[0]):
            # The connection failed, the program did not: it did not answer in time.
            process.kill()
            process.wait()
            raise SimulationError("SUMO", "no answer: it hung and was ended", "one") from error


_OPTIONS = (
    "--no-step-log=true",
    "--no-warnings=true",
    # Vehicles are where they are seen, even if they overlap or stand still for long.
    "--time-to-teleport=-1",
    "--collision.action=none",
    "--collision.check-junctions=false",
    "--ignore-route-errors=true",
    "--max-depart-delay=-1",
    # Vehicles are where they are put, not in the middle of their lanes.
    "--lateral-resolution=0",
    # SUMO's drivers decide nothing, as vehicles are put in every step: half the cost.
    "--default.action-step-length=10",
)
