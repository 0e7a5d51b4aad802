"""The twin's speed: libsumo beside the same work through TraCI, and real time beside both.

A made motorway of twice four lanes, 5 km with bends, carries vehicles 37 m apart, seen at 10 Hz.
Each backend runs in a process of its own (libsumo holds one simulation per process).
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.road_plan import Bend, Opposite, Road, Start, Straight
from geoorbit_ros.scenes.roads import PlacedRoad, place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.twin.sumo_simulation import SumoSimulation, backend_of
from geoorbit_ros.twin.synchronizer import Synchronizer

STEP_S = 0.1
DATUM = Datum(43.0, -89.3)
STEPS = {1000: {"libsumo": 100, "traci": 20}, 100: {"libsumo": 400, "traci": 100}}
WARM_UP = 5
LANES, APART_M = 8, 37.0
REAL_TIME_FACTOR, LATENCY_S = 5.0, 0.02


def made_roads() -> dict[str, PlacedRoad]:
    """Two carriageways, 5 km, radii as motorways have them."""
    scene = load_scene("motorway_4x4")
    path = [
        Straight(straight_m=1500.0),
        Bend(radius_m=900.0, turn_deg=40.0),
        Straight(straight_m=1200.0),
        Bend(radius_m=1200.0, turn_deg=-35.0),
        Straight(straight_m=1000.0),
    ]
    roads = [
        Road(id="east", lanes=4, path=path, start=Start(x_m=0.0, y_m=0.0, heading_deg=80.0)),
        Road(id="west", lanes=4, opposite=Opposite(road="east", median_m=6.0)),
    ]
    return place_roads(scene.model_copy(update={"roads": roads}))


class MadeTraffic:
    """Vehicles that drive along the lanes, each at its own speed and place in the lane."""

    def __init__(self, network: RoadNetwork, count: int) -> None:
        random = np.random.default_rng(1)
        self._line = [network.line(k) for k in range(len(network))]
        self._arc = [
            np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))) for line in self._line
        ]
        self._lane = np.arange(count) % LANES
        self._start = 100.0 + APART_M * (np.arange(count) // LANES)
        self._speed = 25.0 + random.uniform(-1.0, 1.0, count)
        self._side = random.normal(0.0, 0.2, count)

    def rows(self, time_s: float) -> NDArray[np.void]:
        """`TRACK_DTYPE` at a time."""
        rows = np.zeros(len(self._lane), TRACK_DTYPE)
        rows["track_id"] = np.arange(len(rows)) + 1
        rows["length"], rows["width"], rows["sigma"], rows["class_id"] = 4.6, 1.8, 0.3, 2
        for lane, (line, arc) in enumerate(zip(self._line, self._arc, strict=True)):
            mine = self._lane == lane
            at = self._start[mine] + self._speed[mine] * time_s
            x, y = (np.interp(at, arc, line[:, k]) for k in range(2))
            ahead = [np.interp(at + 1.0, arc, line[:, k]) for k in range(2)]
            heading = np.arctan2(ahead[1] - y, ahead[0] - x)
            rows["x"][mine] = x - self._side[mine] * np.sin(heading)
            rows["y"][mine] = y + self._side[mine] * np.cos(heading)
            rows["heading"][mine] = heading
            rows["vx"][mine] = self._speed[mine] * np.cos(heading)
            rows["vy"][mine] = self._speed[mine] * np.sin(heading)
        return rows


@dataclass(frozen=True)
class Cost:
    """What frames cost.

    Attributes:
        cpu_s: Processor time of each on average, SUMO's own program included.
        took_s: Time that each took, which also measures what else the machine does.
    """

    cpu_s: float
    took_s: list[float]


def measure(net: Path, backend: str, count: int) -> Cost:
    """Run made traffic through the twin."""
    network = load_network(net, DATUM)
    traffic = MadeTraffic(network, count)
    simulation = SumoSimulation(net, STEP_S, backend=backend_of(backend, gui=False))
    twin = Synchronizer(network, simulation, ["c"], STEP_S, 1.5, lambda _: None)
    took, cpu_s, before_s = list[float](), 0.0, 0.0
    gc.collect()
    gc.freeze()  # as the node does (nodes/support/process.py)
    for k in range(WARM_UP + STEPS[count][backend]):
        rows = traffic.rows(k * STEP_S)
        if k == WARM_UP:
            took, cpu_s, before_s = [], 0.0, program_cpu_s(simulation.pid)
        start, start_cpu = time.perf_counter(), time.process_time()
        twin.add("c", 10**9 + round(k * STEP_S * 1e9), rows)
        took.append(time.perf_counter() - start)
        cpu_s += time.process_time() - start_cpu
    cpu_s += program_cpu_s(simulation.pid) - before_s
    assert len(twin.vehicles.slots) == count, "every vehicle is in the twin"
    simulation.close()
    return Cost(cpu_s / len(took), took)


def program_cpu_s(pid: int | None) -> float:
    """Processor time of another process so far (proc(5), fields 14 and 15 of stat)."""
    if pid is None:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def in_process_of_its_own(net: Path, backend: str, count: int) -> Cost:
    """`measure` in a child process."""
    command = [sys.executable, __file__, str(net), backend, str(count)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=600)
    return Cost(**json.loads(done.stdout.splitlines()[-1]))


def report(name: str, ratio: float, limit: float | None, note: str) -> None:
    print(json.dumps({"name": name, "ratio": round(ratio, 4), "limit": limit}))
    print(f"{name}: {note}", file=sys.stderr)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        net = write_network(made_roads(), Path(name), DATUM)
        for count in STEPS:
            own = in_process_of_its_own(net, "libsumo", count)
            peer = in_process_of_its_own(net, "traci", count)
            report(
                f"{count} vehicles at 10 Hz, libsumo / TraCI, processor time",
                own.cpu_s / peer.cpu_s,
                0.5,
                f"{1e3 * own.cpu_s:.1f} ms a step, TraCI {1e3 * peer.cpu_s:.1f} ms",
            )
            if count == 1000:
                report(
                    "1000 vehicles at 10 Hz, processor time / a fifth of real time",
                    own.cpu_s / (STEP_S / REAL_TIME_FACTOR),
                    1.0,
                    f"{STEP_S / own.cpu_s:.1f} times real time, {1.0 / own.cpu_s:.0f} steps/s; on "
                    f"this machine now {STEP_S / np.mean(own.took_s):.1f} times",
                )
            else:
                p99_s = float(np.quantile(own.took_s, 0.99))
                report(
                    f"{count} vehicles at 10 Hz, 99 % of the steps / 20 ms",
                    p99_s / LATENCY_S,
                    1.0,
                    f"99 % within {1e3 * p99_s:.1f} ms, half within "
                    f"{1e3 * np.median(own.took_s):.1f} ms",
                )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(asdict(measure(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])))))
    else:
        main()
