"""Replays recorded tracks through the twin, as fast as it can, without ROS; writes its states."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.twin.fusion import FusionCounts
from geoorbit_ros.twin.health import HealthReport, HealthWindow, ReservedLanes
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.simulation import Simulation
from geoorbit_ros.twin.synchronizer import Synchronizer
from geoorbit_ros.twin.vehicles import TYPES

STEP_S, HOLD_S = 0.1, 1.5
"""The defaults of the node sumo_bridge (params/sumo_bridge.yaml)."""
COLUMNS = "time_s,vehicle,type,latitude,longitude,heading_deg,speed_mps,length_m,lane,observed"
"""Of vehicles.csv, see `StateWriter`."""


@dataclass(frozen=True, slots=True)
class TrackStream:
    """One camera's tracks.

    Attributes:
        camera: Its name.
        frames: Stamp and `TRACK_DTYPE` rows in time order.
        datum: Origin of the frame that the rows are in.
        alignment: Lays the tracks on the network; None: they are used as they are.
        projector: What puts the boxes on the road, and says what speaks against them; None where
            the tracks are already there.
    """

    camera: str
    frames: Iterable[tuple[int, NDArray[np.void]]]
    datum: Datum
    alignment: Alignment | None = None
    projector: BoxProjector | None = None


@dataclass(frozen=True, slots=True)
class ReplayScore:
    """How the twin followed a recording.

    Attributes:
        health: Errors and cost over all steps.
        events: What happened to tracks.
        vehicles: How many vehicles there were.
        tracks: How many tracks, over all cameras.
        reserved: Vehicles in lanes that the map keeps for others.
    """

    health: HealthReport
    events: FusionCounts
    vehicles: int
    tracks: int
    reserved: ReservedLanes

    def values(self) -> dict[str, Any]:
        """All figures by name; NaN, which JSON lacks, is left out."""
        found: dict[str, float | int] = {"vehicles_total": self.vehicles, "tracks": self.tracks}
        found |= self.health.values() | asdict(self.events)
        known = {name: value for name, value in found.items() if not math.isnan(value)}
        return known | {"in_reserved_lanes": self.reserved.values()}


def replay_tracks(
    network: RoadNetwork,
    simulation: Simulation,
    streams: list[TrackStream],
    on_step: Callable[[TwinStep], None],
    step_s: float = STEP_S,
    hold_s: float = HOLD_S,
    driven: DrivenNetwork | None = None,
) -> ReplayScore:
    """Run recorded tracks of one or more cameras through a simulation.

    Args:
        network: The roads.
        simulation: An empty simulation of them, with steps of `step_s`.
        streams: One per camera.
        on_step: Called with each step.
        step_s: Length of a step.
        hold_s: How long a vehicle that no camera sees keeps driving.
        driven: The network with its lanes where they are driven; None: the network itself is used.

    Raises:
        SimulationError: SUMO is gone.
    """
    window = HealthWindow()
    first_ns: dict[int, int] = {}

    def take(step: TwinStep) -> None:
        window.add(step)
        for vehicle in step.vehicle_id.tolist():
            first_ns.setdefault(vehicle, step.stamp_ns)
        for vehicle, since_ns in step.false_since_ns.items():
            if since_ns <= first_ns.get(vehicle, since_ns):
                first_ns.pop(vehicle, None)  # it never was a vehicle
        on_step(step)

    names = [stream.camera for stream in streams]
    twin = Synchronizer(network, simulation, names, step_s, hold_s, take)
    if driven is not None:
        twin.follow(driven)
    for stream in streams:
        twin.set_datum(stream.camera, stream.datum)
        if stream.alignment is not None:
            twin.set_alignment(stream.camera, stream.alignment)
    tracks: set[tuple[str, int]] = set()
    for stamp_ns, camera, rows in heapq.merge(
        *(_named(stream) for stream in streams), key=lambda frame: frame[0]
    ):
        twin.add(camera, stamp_ns, rows)
        tracks.update((camera, track) for track in rows["track_id"].tolist())
    twin.finish()
    return ReplayScore(
        window.report(), twin.fusion.counts, len(first_ns), len(tracks), twin.reserved
    )


def _named(stream: TrackStream) -> Iterator[tuple[int, str, NDArray[np.void]]]:
    for stamp_ns, rows in stream.frames:
        yield stamp_ns, stream.camera, rows


class StateWriter:
    """Writes the vehicles of every step as CSV with `COLUMNS`; a context manager.

    A vehicle that is found to be none (`TwinStep.false_since_ns`) is left out again. Time is the
    tracks' own; positions are the middle of the footprint; headings are clockwise
    from north; `lane` is SUMO's id, empty beside the network; `observed` is 0 where no camera saw
    the vehicle and it went on along its lane.

    Args:
        path: The file.
        network: Its lanes and datum.
    """

    def __init__(self, path: Path, network: RoadNetwork) -> None:
        self._path, self._network = path, network
        self._file: IO[str] | None = None
        self._false_since_ns: dict[int, int] = {}

    def __enter__(self) -> StateWriter:
        self._file = self._path.open("w", encoding="utf-8")
        self._file.write(COLUMNS + "\n")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._file.close()
        if self._false_since_ns and error is None:
            self._leave_out()

    def _leave_out(self) -> None:
        """Write the file once more, without the vehicles that were none."""
        whole = self._path.with_suffix(".all.csv")
        self._path.replace(whole)
        with whole.open(encoding="utf-8") as lines, self._path.open("w", encoding="utf-8") as out:
            out.write(next(lines))
            for line in lines:
                time_s, vehicle, _ = line.split(",", 2)
                since_ns = self._false_since_ns.get(int(vehicle))
                if since_ns is None or float(time_s) < since_ns / 1e9 - 0.0005:
                    out.write(line)
        whole.unlink()

    def write(self, step: TwinStep) -> None:
        """Write the vehicles of one step."""
        assert self._file is not None, "use it in a with statement"
        self._false_since_ns.update(step.false_since_ns)
        kept = np.isfinite(step.xy[:, 0])
        geodetic = self._network.datum.to_geodetic(step.xy[kept])
        heading = np.degrees(0.5 * np.pi - step.heading_rad[kept]) % 360.0
        speed = np.hypot(*step.velocity[kept].T)
        for vehicle, kind, (lat, lon), course, mps, length, lane, seen in zip(
            step.vehicle_id[kept].tolist(),
            step.kind[kept].tolist(),
            geodetic.tolist(),
            heading.tolist(),
            speed.tolist(),
            step.size_m[kept, 0].tolist(),
            step.lane[kept].tolist(),
            step.observed[kept].tolist(),
            strict=True,
        ):
            name = self._network.lane_id[lane] if lane != NO_LANE else ""
            self._file.write(
                f"{step.stamp_ns / 1e9:.3f},{vehicle},{TYPES[kind].name},{lat:.8f},{lon:.8f},"
                f"{course:.2f},{mps:.2f},{length:.1f},{name},{int(seen)}\n"
            )
