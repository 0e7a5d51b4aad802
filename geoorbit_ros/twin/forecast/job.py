"""A forecast from what the twin saw, as one piece of work for a thread of its own."""

from __future__ import annotations

from typing import Any

from geoorbit_ros.roadnet.errors import SimulationError
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.forecast.files import ForecastStart
from geoorbit_ros.twin.forecast.observed_traffic import MIN_TIME_S, ObservedTraffic
from geoorbit_ros.twin.forecast.runs import ForecastRun
from geoorbit_ros.twin.scenario import Scenario

SEED = 1


class ForecastJob:
    """Looks at the traffic when it is made; works when it is told to.

    Args:
        network: The roads.
        traffic: What was seen; later steps don't matter.
        scenario: What is changed.
        horizon_s: How far ahead.
        limit_s: Time after which it is given up.
        place: Who asks, for errors.

    Attributes:
        about: What it will be about, for JSON.

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
            "changes": scenario.words(),
            "observed_s": traffic.time_s,
        }

    def work(self) -> dict[str, Any]:
        """What came of it, for JSON.

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
        """End it; `work` finds its processes ended."""
        self._closed = True
        if self._run is not None:
            self._run.close()

    def _too_little(self) -> SimulationError:
        found = "too little traffic to know its flows"
        return SimulationError(self._place, found, f"{MIN_TIME_S:g} s of it")
