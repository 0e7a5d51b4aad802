"""SUMO traffic on a scene's network.

libsumo holds one simulation per process, so this file is also the child process's program.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.roadnet.netconvert import last_line
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import PlacedRoad
from geoorbit_ros.scenes.scene import VEHICLE_TYPES, Scene, Traffic

STEP_S = 0.1
"""SUMO's time step; positions in between are interpolated. Chosen: longer changes lanes in jumps,
shorter takes more time."""
WARM_UP_S = 45.0
"""Traffic flows this long before time 0. Chosen: at 100 km/h vehicles are 1.2 km down the road by
then."""
LANE_CHANGE_S = 4.0
"""Duration of a lane change. Chosen: longer keeps vehicles between lanes, shorter turns them too
sharply."""
SLOW = ("truck", "trailer", "bus")
"""SUMO's classes of vehicles that keep to the outer lane."""
MOST_LORRIES = 0.8
"""Largest share of them in a lane. Chosen: more leaves no car between them."""
BRAKING_MPS2 = 3.0
"""Who is to stop brakes no harder. Chosen: less than the 4.5 m/s² that SUMO's drivers can."""
ROOM_M = 30.0
"""Nearer to the beginning of its road than this, nobody brakes on it. Chosen: from 50 km/h."""
TIME_LIMIT_S = 900.0
"""SUMO is ended after this. Chosen: longer hides for longer that it hangs, shorter ends long
scenes."""
_LEAKED = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
"""Variables that the ROS wheels set for their own process; no other interpreter may see them."""


class TrafficError(GeoOrbitError):
    """SUMO could not simulate the scene's traffic."""


@dataclass(frozen=True, slots=True)
class TrafficRecord:
    """States of all vehicles at every simulation step, ordered by time.

    Attributes:
        step: (N,) int, time is `step * STEP_S`.
        vehicle: (N,) int, index into the lists below.
        xy: (N, 2) middle of the vehicle's footprint, map frame, metres.
        heading: (N,) radians counter-clockwise from east.
        speed: (N,) m/s.
        lane: (N,) int, index into `lane_names`; -1 inside a junction.
        lane_names: (road, lane) of each.
        vehicle_types: Name of each vehicle's type.
        vehicle_sizes: (V, 3) length, width, height.
    """

    step: NDArray[np.int64]
    vehicle: NDArray[np.int64]
    xy: NDArray[np.float64]
    heading: NDArray[np.float64]
    speed: NDArray[np.float64]
    lane: NDArray[np.int64]
    lane_names: list[tuple[str, int]]
    vehicle_types: list[str]
    vehicle_sizes: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Halt:
    """A vehicle that is to stop on its lane.

    Attributes:
        x_m, y_m: Where, map frame.
        road: The road there.
        lane: Its lane, 0 the rightmost.
        time_s: The next vehicle that can is to stop from then on.
        duration_s: How long it stands.
    """

    x_m: float
    y_m: float
    road: str
    lane: int
    time_s: float
    duration_s: float


def simulate_traffic(
    scene: Scene,
    placed: dict[str, PlacedRoad],
    duration_s: float,
    seed: int,
    halts: Sequence[Halt] = (),
) -> TrafficRecord:
    """Run SUMO in a process of its own; traffic flows already at time 0.

    Args:
        scene: The scene.
        placed: Its roads.
        duration_s: How long traffic is recorded.
        seed: The same one gives the same traffic.
        halts: Vehicles that stop.

    Raises:
        TrafficError: SUMO stops with an error or does not end.
        RoadNetworkError: The roads make no network.
    """
    with tempfile.TemporaryDirectory(prefix="geoorbit_scene_") as name:
        folder = Path(name)
        write_network(placed, folder)
        vehicles = _departures(scene, duration_s, seed)
        _write_routes(scene, vehicles, folder / "scene.rou.xml")
        job = {
            "folder": name,
            "steps": round((WARM_UP_S + duration_s) / STEP_S),
            "seed": seed,
            "halts": [asdict(halt) for halt in halts],
        }
        command = [sys.executable, "-m", __name__, json.dumps(job)]
        env = {k: v for k, v in os.environ.items() if k not in _LEAKED}
        env["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=TIME_LIMIT_S
            )
        except subprocess.TimeoutExpired as error:
            raise TrafficError("sumo", f"no end after {TIME_LIMIT_S} s", "an end") from error
        if done.returncode != 0:
            raise TrafficError("sumo", last_line(done.stderr), "a simulation")
        return _read(folder, vehicles)


@dataclass(frozen=True, slots=True)
class _Departure:
    time_s: float
    type_name: str
    size: tuple[float, float, float]
    route: tuple[str, ...]
    lane: int
    speed_factor: float
    early_lane_change: float
    arrival_lane: int | None


def _departures(scene: Scene, duration_s: float, seed: int) -> list[_Departure]:
    """Poisson arrivals with a minimum headway, per flow and lane."""
    random = np.random.default_rng([seed, 1])
    lanes_of = {road.id: road.lanes for road in scene.roads}
    names = list(scene.traffic.mix)
    found = []
    for flow in scene.traffic.flows:
        lanes = lanes_of[flow.route[0]]
        lane_shares = flow.lane_shares or [1.0 / lanes] * lanes
        for lane, share in enumerate(lane_shares[:lanes]):
            rate = flow.per_hour * share / sum(lane_shares) / 3600.0
            shares = _mix(scene.traffic, lane, share / sum(lane_shares), lanes)
            time_s = 0.0
            while rate > 0.0:
                # Shifted exponential headways (Cowan 1975, M3): the least headway is 1.5 s.
                shift = min(1.5, 0.6 / rate)
                time_s += shift + random.exponential(1.0 / rate - shift)
                if time_s > WARM_UP_S + duration_s:
                    break
                kind = names[int(random.choice(len(names), p=shares / shares.sum()))]
                spec = VEHICLE_TYPES[kind]
                scale = 1.0 + spec.spread * random.standard_normal(3)
                size = np.clip(scale, 0.85, 1.15) * (spec.length_m, spec.width_m, spec.height_m)
                factor = spec.speed_factor * (
                    1.0 + scene.traffic.speed_factor_sigma * random.standard_normal()
                )
                found.append(
                    _Departure(
                        time_s,
                        kind,
                        (float(size[0]), float(size[1]), float(size[2])),
                        tuple(flow.route),
                        lane,
                        float(np.clip(factor, 0.6, 1.4)),
                        # Drivers differ widely in how late they leave an ending lane.
                        float(scene.traffic.early_lane_change * np.exp(0.6 * random.normal())),
                        flow.arrival_lane,
                    )
                )
    return sorted(found, key=lambda d: d.time_s)


def _mix(traffic: Traffic, lane: int, lane_share: float, lanes: int) -> NDArray[np.float64]:
    """How often each vehicle type enters in a lane that has a share of the flow."""
    shares = np.array(list(traffic.mix.values()), dtype=np.float64)
    if traffic.lorries_outside is None or lanes == 1 or not 0.0 < lane_share < 1.0:
        return shares
    shares /= shares.sum()
    slow = np.array([VEHICLE_TYPES[name].vclass in SLOW for name in traffic.mix])
    outer = traffic.lorries_outside / lane_share
    inner = (1.0 - traffic.lorries_outside) / (1.0 - lane_share)
    wanted = shares[slow] * (outer if lane == 0 else inner)
    shares[slow] = wanted * min(1.0, MOST_LORRIES / max(float(wanted.sum()), 1e-9))
    shares[~slow] *= (1.0 - shares[slow].sum()) / max(float(shares[~slow].sum()), 1e-9)
    return shares


def _write_routes(scene: Scene, vehicles: list[_Departure], path: Path) -> None:
    lines = ["<routes>"]
    for k, v in enumerate(vehicles):
        spec = VEHICLE_TYPES[v.type_name]
        arrival = "" if v.arrival_lane is None else f' arrivalLane="{v.arrival_lane}"'
        lines.append(
            f'<vType id="t{k}" vClass="{spec.vclass}" length="{v.size[0]:.3f}" '
            f'width="{v.size[1]:.3f}" height="{v.size[2]:.3f}" speedFactor="{v.speed_factor:.4f}" '
            f'speedDev="0" maxSpeed="55" lcKeepRight="{scene.traffic.keep_right}" '
            f'lcStrategic="{v.early_lane_change:.3f}"/>'
            f'<vehicle id="{k}" type="t{k}" depart="{v.time_s:.2f}" departLane="{v.lane}" '
            f'departSpeed="desired" departPos="base"{arrival}>'
            f'<route edges="{" ".join(v.route)}"/></vehicle>'
        )
    path.write_text("\n".join([*lines, "</routes>"]), encoding="utf-8")


def _read(folder: Path, vehicles: list[_Departure]) -> TrafficRecord:
    data = np.load(folder / "states.npz")
    lane_names = []
    for name in json.loads((folder / "lanes.json").read_text()):
        road, _, lane = name.rpartition("_")
        lane_names.append((road, int(lane)))
    sizes = np.array([v.size for v in vehicles]).reshape(-1, 3)
    heading = np.radians(90.0 - data["angle"])
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    # SUMO's position is the middle of the front bumper.
    xy = data["xy"] - 0.5 * sizes[data["vehicle"], :1] * direction
    shift = round(WARM_UP_S / STEP_S)
    return TrafficRecord(
        data["step"] - shift,
        data["vehicle"],
        xy,
        heading,
        data["speed"],
        data["lane"],
        lane_names,
        [v.type_name for v in vehicles],
        sizes,
    )


def _stop_next(halt: Halt) -> bool:
    """Tell the nearest vehicle that can still brake to stop; False while there is none."""
    import libsumo

    _, at_m, _ = libsumo.simulation.convertRoad(halt.x_m, halt.y_m)
    if at_m < ROOM_M:  # who can still brake is on the road before
        vehicles = libsumo.vehicle.getIDList()
    else:
        vehicles = libsumo.lane.getLastStepVehicleIDs(f"{halt.road}_{halt.lane}")
    best, best_m = "", 1000.0
    for vehicle in vehicles:
        if halt.road not in libsumo.vehicle.getRoute(vehicle):
            continue
        far_m = libsumo.vehicle.getDrivingDistance(vehicle, halt.road, at_m, halt.lane)
        braking_m = libsumo.vehicle.getSpeed(vehicle) ** 2 / (2.0 * BRAKING_MPS2) + 5.0
        if braking_m <= far_m < best_m:
            best, best_m = vehicle, far_m
    if not best:
        return False
    libsumo.vehicle.setStop(best, halt.road, at_m, halt.lane, halt.duration_s)
    return True


def _child(job: dict[str, Any]) -> None:
    """Run SUMO and store every state from the end of the warm-up on."""
    import libsumo

    folder = Path(job["folder"])
    libsumo.start(
        [
            "sumo",
            f"--net-file={folder / 'scene.net.xml'}",
            f"--route-files={folder / 'scene.rou.xml'}",
            f"--step-length={STEP_S}",
            f"--seed={job['seed']}",
            f"--lanechange.duration={LANE_CHANGE_S}",
            "--no-step-log=true",
            "--no-warnings=true",
            "--time-to-teleport=-1",
            "--collision.action=none",
        ]
    )
    first = round(WARM_UP_S / STEP_S)
    columns: list[tuple[int, int, float, float, float, float, int]] = []
    lanes: dict[str, int] = {}
    halts = [Halt(**halt) for halt in job["halts"]]
    for step in range(int(job["steps"]) + 2):
        libsumo.simulationStep()
        time_s = (step - first) * STEP_S
        halts = [halt for halt in halts if time_s < halt.time_s or not _stop_next(halt)]
        if step < first:
            continue
        for vehicle in libsumo.vehicle.getIDList():
            x, y = libsumo.vehicle.getPosition(vehicle)
            name = libsumo.vehicle.getLaneID(vehicle)
            lane = -1 if name.startswith(":") else lanes.setdefault(name, len(lanes))
            angle, speed = libsumo.vehicle.getAngle(vehicle), libsumo.vehicle.getSpeed(vehicle)
            columns.append((step, int(vehicle), x, y, angle, speed, lane))
    libsumo.close()
    table = np.array(columns, dtype=np.float64).reshape(-1, 7)
    np.savez(
        folder / "states.npz",
        step=table[:, 0].astype(np.int64),
        vehicle=table[:, 1].astype(np.int64),
        xy=table[:, 2:4],
        angle=table[:, 4],
        speed=table[:, 5],
        lane=table[:, 6].astype(np.int64),
    )
    (folder / "lanes.json").write_text(json.dumps(list(lanes)))


if __name__ == "__main__":
    _child(json.loads(sys.argv[1]))
