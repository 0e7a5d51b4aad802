"""What if, on the running twin: scenarios by parameters, forecasts by a standard service."""

from __future__ import annotations

import json
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.base import GeoOrbitNode
from geoorbit_ros.nodes.latched import LATCHED
from geoorbit_ros.twin.forecast import ForecastRun
from geoorbit_ros.twin.forecast_files import ForecastStart
from geoorbit_ros.twin.network import RoadNetwork
from geoorbit_ros.twin.observed_traffic import ObservedTraffic
from geoorbit_ros.twin.scenario import Scenario, parse_scenario

POLL_S = 0.2
SEED = 1


class ScenarioParameters(Protocol):
    """Parameters that change the road."""

    @property
    def closed_lanes(self) -> str:
        """Lanes or edges, separated by spaces."""

    @property
    def speed_limits(self) -> str:
        """`LANE=KMH` or `EDGE=KMH`, separated by spaces."""


class Forecaster:
    """Service `~/forecast` (std_srvs/Trigger); topics `twin/forecast`, `twin/scenario` (latched).

    A forecast runs in processes of its own. The service answers at once; the result comes on the
    topic, and so nothing ever waits for it.

    Args:
        node: Offers the service and publishes.
        network: The roads.
        window_s: How far back the traffic is looked at.

    Attributes:
        traffic: Takes the twin's steps.
        done: Forecasts that were published.
    """

    def __init__(self, node: GeoOrbitNode[Any], network: RoadNetwork, window_s: float) -> None:
        self._node, self._network = node, network
        self.traffic = ObservedTraffic(network, window_s)
        self.scenario, self.done = Scenario(), 0
        self._run: ForecastRun | None = None
        self._about: dict[str, Any] = {}
        self._result = node.create_publisher(String, "twin/forecast", LATCHED)
        self._changes = node.create_publisher(String, "twin/scenario", LATCHED)
        node.create_service(Trigger, "~/forecast", self._on_request)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(POLL_S, self._poll, clock=steady)

    def diagnostic_values(self) -> dict[str, object]:
        """For diagnostics."""
        return {"scenario": self.scenario.words(), "forecasts": self.done}

    def changed(self, p: ScenarioParameters) -> Scenario:
        """What parameters say, published, and what the next forecasts compare the road with.

        Raises:
            ParameterError: A lane that the network has not, or no speed.
        """
        place = f"node '{self._node.get_fully_qualified_name()}', closed_lanes, speed_limits"
        closed, limits_kmh = p.closed_lanes.split(), p.speed_limits.split()
        scenario = parse_scenario(closed, limits_kmh, self._network, place)
        self.scenario = scenario
        limits = {lane: 3.6 * v for lane, v in sorted(scenario.limit_mps.items())}
        values = {"closed_lanes": sorted(scenario.closed), "speed_limits_kmh": limits}
        self._changes.publish(String(data=json.dumps(values)))
        return scenario

    def close(self) -> None:
        """Give up what is running."""
        if self._run is not None:
            self._run.close()
            self._run = None

    def _on_request(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        try:
            self._about = self._start()
        except GeoOrbitError as error:
            answer.success, answer.message = False, str(error)
            return answer
        answer.success, answer.message = True, json.dumps(self._about)
        return answer

    def _start(self) -> dict[str, Any]:
        place = self._node.resolve_service_name("~/forecast")
        if self._run is not None:
            raise GeoOrbitError(place, "a forecast that is running", "one at a time")
        demand, last = self.traffic.demand(), self.traffic.last
        if demand is None or last is None:
            raise GeoOrbitError(place, "too little traffic to know its flows", "ten seconds of it")
        p = self._node.p
        start = ForecastStart(last, demand, 60.0 * p.forecast_minutes, SEED)
        self._run = ForecastRun(self._network, start, self.scenario, p.forecast_limit_s)
        return {
            "result": self._result.topic_name,
            "begins_s": last.stamp_ns / 1e9,
            "horizon_s": start.horizon_s,
            "vehicles": len(last.vehicle_id),
            "changes": self.scenario.words(),
            "observed_s": demand.time_s,
            "observed_flow_per_h": demand.edge_flow_per_h,
        }

    def _poll(self) -> None:
        if self._run is None:
            return
        try:
            found = self._run.poll()
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)
            self._result.publish(String(data=json.dumps({**self._about, "error": str(error)})))
            self.close()
            return
        if found is not None:
            self.done += 1
            values = {**self._about, "forecasts": [forecast.values() for forecast in found]}
            self._result.publish(String(data=json.dumps(values, allow_nan=False)))
            self.close()
