"""Runs forecasts in SUMO processes of their own, and reads their results.

`ForecastRun` is for the command line; `ForecastJob` is the same as work for a thread of the node.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.forecast.files import LANES, QUEUES, ForecastStart, write_forecast
from geoorbit_ros.twin.forecast.observed_traffic import MIN_TIME_S, ObservedTraffic
from geoorbit_ros.twin.scenario import Scenario
from geoorbit_ros.twin.sumo_process import (
    SimulationError,
    exit_text,
    program_environment,
    program_path,
)

AS_IT_IS, WITH_CHANGES = "as it is", "with changes"
POLL_S = 0.05
"""Between two looks at the processes. Chosen: far below the seconds that a forecast takes."""
SEED = 1
"""Of the arrivals and of SUMO's drivers in the node. Chosen: any; the same gives the same
forecast."""


@dataclass(frozen=True, slots=True)
class LaneForecast:
    """A lane over the whole forecast; None where no vehicle drove.

    Attributes:
        lane: SUMO's id.
        speed_kmh: Mean speed of the vehicles in it.
        density_per_km: Vehicles per kilometre.
        flow_per_h: Density times speed: vehicles per hour through its middle.
        travel_time_s: Time to drive it at that speed.
        queue_m_mean, queue_m_max: From its end to the last vehicle slower than 5 km/h.
        queue_vehicles: Standing vehicles, on average.
        seen_kmh: Mean speed that was seen in it; None where too little was.
    """

    lane: str
    speed_kmh: float | None
    density_per_km: float
    flow_per_h: float
    travel_time_s: float | None
    queue_m_mean: float
    queue_m_max: float
    queue_vehicles: float
    seen_kmh: float | None = None


@dataclass(frozen=True, slots=True)
class Forecast:
    """What one scenario leads to.

    Attributes:
        scenario: Its name.
        changes: What is changed, in one line.
        lanes: Every lane outside junctions, in the order of the network.
        vehicles: How many were in the network at all.
        left_per_h: Vehicles that reached the end of their routes, per hour.
        waiting: Vehicles that could not enter by the end: for want of room, or because all that
            they may use is closed.
        took_s: Time that the computer needed.
    """

    scenario: str
    changes: str
    lanes: tuple[LaneForecast, ...]
    vehicles: int
    left_per_h: float
    waiting: int
    took_s: float

    def values(self) -> dict[str, Any]:
        """All values, for JSON."""
        return asdict(self)


class ForecastRun:
    """A forecast that is being computed: one process, or two where something is changed.

    It reads the twin only before it returns, and does not wait for SUMO.

    Args:
        network: The roads.
        start: Where it begins.
        scenario: What is changed; without changes only the unchanged road is simulated.
        limit_s: Time after which it is given up.
        clock_s: Monotonic time.

    Raises:
        SimulationError: There is no SUMO.
    """

    def __init__(
        self,
        network: RoadNetwork,
        start: ForecastStart,
        scenario: Scenario,
        limit_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._network, self._start, self._clock_s = network, start, clock_s
        self._limit_s, self._begin_s = limit_s, clock_s()
        self._folder = Path(tempfile.mkdtemp(prefix="geoorbit_forecast_"))
        self._scenarios = {AS_IT_IS: Scenario()}
        if scenario:
            self._scenarios[WITH_CHANGES] = scenario
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        try:
            program = program_path("sumo")
            for name, changed in self._scenarios.items():
                folder = self._folder / name.replace(" ", "_")
                config = write_forecast(folder, network, start, changed)
                with (folder / "sumo.log").open("wb") as log:
                    self._processes[name] = subprocess.Popen(
                        # At low priority: the live twin must keep its pace.
                        ["nice", "-n", "10", program, "-c", str(config)],
                        env=program_environment(),
                        stdout=log,
                        stderr=subprocess.STDOUT,
                    )
        except BaseException:
            self.close()
            raise

    def poll(self) -> list[Forecast] | None:
        """The forecasts, once all are computed; None before.

        Raises:
            SimulationError: SUMO failed, or the time is up.
        """
        codes = {name: process.poll() for name, process in self._processes.items()}
        took_s = self._clock_s() - self._begin_s
        for name, code in codes.items():
            if code:
                raise SimulationError(f"forecast '{name}'", self._reason(name, code), "a forecast")
        if None not in codes.values():
            return [self._read(name, took_s) for name in self._scenarios]
        if took_s > self._limit_s:
            found = f"no result in {self._limit_s:g} s"
            raise SimulationError("forecast", found, "a shorter horizon or a longer limit")
        return None

    def wait(self) -> list[Forecast]:
        """Wait for the forecasts.

        Raises:
            SimulationError: As `poll`.
        """
        while (found := self.poll()) is None:
            time.sleep(POLL_S)
        return found

    def close(self) -> None:
        """End running processes and remove their files."""
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _reason(self, name: str, code: int) -> str:
        text = (self._folder / name.replace(" ", "_") / "sumo.log").read_text(errors="replace")
        errors = [line for line in text.splitlines() if line.startswith("Error")]
        return errors[0][:300] if errors else f"SUMO's end with {exit_text(code)}"

    def _read(self, name: str, took_s: float) -> Forecast:
        folder, changed = self._folder / name.replace(" ", "_"), self._scenarios[name]
        horizon_s = self._start.horizon_s
        queues = _queues(folder / QUEUES)
        found: dict[str, LaneForecast] = {}
        for lane in Xml.parse(folder / LANES).getroot().iter("lane"):
            queue = queues.lengths.get(lane.get("id", ""), [])
            values = {key: float(value) for key, value in lane.items() if key != "id"}
            speed, density = values.get("speed"), values.get("density", 0.0)
            found[lane.attrib["id"]] = LaneForecast(
                lane=lane.attrib["id"],
                speed_kmh=None if speed is None else 3.6 * speed,
                density_per_km=density,
                flow_per_h=3.6 * density * (speed or 0.0),
                travel_time_s=values.get("traveltime") if speed is not None else None,
                queue_m_mean=sum(queue) / max(queues.samples, 1),
                queue_m_max=max(queue, default=0.0),
                queue_vehicles=values.get("waitingTime", 0.0) / horizon_s,
                seen_kmh=self._start.demand.lane_kmh.get(lane.attrib["id"]),
            )
        summary = list(Xml.parse(folder / "summary.xml").getroot().iter("step"))
        last = {key: float(value) for key, value in (summary[-1].items() if summary else ())}
        empty = LaneForecast("", None, 0.0, 0.0, None, 0.0, 0.0, 0.0)
        known = (
            _named(found.get(lane, empty), lane)
            for lane, internal in zip(
                self._network.lane_id, self._network.internal.tolist(), strict=True
            )
            if not internal
        )
        return Forecast(
            scenario=name,
            changes=changed.describe(),
            lanes=tuple(known),
            vehicles=int(last.get("inserted", 0.0)),
            # Not "ended" and "waiting": SUMO ends vehicles without a route, and forgets them.
            left_per_h=last.get("arrived", 0.0) * 3600.0 / horizon_s,
            waiting=int(last.get("loaded", 0.0) - last.get("inserted", 0.0)),
            took_s=round(took_s, 3),
        )


def _named(found: LaneForecast, lane: str) -> LaneForecast:
    return LaneForecast(**(asdict(found) | {"lane": lane}))


@dataclass(frozen=True, slots=True)
class _Queues:
    samples: int
    lengths: dict[str, list[float]]


def _queues(path: Path) -> _Queues:
    """Lengths of the queues of each lane, one per time with a queue."""
    lengths: dict[str, list[float]] = {}
    samples = 0
    for data in Xml.parse(path).getroot().iter("data"):
        samples += 1
        for lane in data.iter("lane"):
            length = float(lane.get("queueing_length", "0"))
            if math.isfinite(length):
                lengths.setdefault(lane.get("id", ""), []).append(length)
    return _Queues(samples, lengths)


class ForecastJob:
    """A forecast for a thread: copies the traffic when made, computes when `work` is called.

    Args:
        network: The roads.
        traffic: What was seen; later steps don't matter.
        scenario: What is changed.
        horizon_s: How far ahead.
        limit_s: Time after which it is given up.
        place: Names the caller in errors.

    Attributes:
        about: Begin, horizon, vehicles and changes, for JSON.

    Raises:
        SimulationError: Too little was seen.
    """

    def __init__(
        self,
        network: RoadNetwork,
        traffic: ObservedTraffic,
        scenario: Scenario,
        horizon_s: float,
        limit_s: float,
        place: str,
    ) -> None:
        self._network, self._traffic, self._scenario = network, traffic.snapshot(), scenario
        self._horizon_s, self._limit_s, self._place = horizon_s, limit_s, place
        self._run: ForecastRun | None = None
        self._closed = False
        if traffic.last is None or traffic.time_s < MIN_TIME_S:
            raise self._too_little()
        self.about: dict[str, Any] = {
            "begins_s": traffic.last.stamp_ns / 1e9,
            "horizon_s": horizon_s,
            "vehicles": len(traffic.last.vehicle_id),
            "changes": scenario.describe(),
            "observed_s": traffic.time_s,
        }

    def work(self) -> dict[str, Any]:
        """Compute the forecast; its values for JSON.

        Raises:
            SimulationError: Too little was seen, SUMO failed, or the time is up.
        """
        demand, last = self._traffic.demand(), self._traffic.last
        if demand is None or last is None:
            raise self._too_little()
        start = ForecastStart(last, demand, self._horizon_s, SEED)
        self._run = ForecastRun(self._network, start, self._scenario, self._limit_s)
        try:
            if self._closed:
                raise SimulationError(self._place, "the node's end", "time for a forecast")
            found = self._run.wait()
        finally:
            self._run.close()
        return {
            "observed_flow_per_h": demand.edge_flow_per_h,
            "forecasts": [forecast.values() for forecast in found],
        }

    def close(self) -> None:
        """End the processes; `work` then raises."""
        self._closed = True
        if self._run is not None:
            self._run.close()

    def _too_little(self) -> SimulationError:
        found = "too little traffic to know its flows"
        return SimulationError(self._place, found, f"{MIN_TIME_S:g} s of it")
