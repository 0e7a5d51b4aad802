"""What if, on the running twin: scenarios by parameters, forecasts by a standard service."""

from __future__ import annotations

import json
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

from rclpy.clock import Clock, ClockType
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.forecast.observed_traffic import ObservedTraffic
from geoorbit_ros.twin.forecast.runs import ForecastJob
from geoorbit_ros.twin.scenario import Scenario, parse_scenario

POLL_S = 0.2
"""Between two looks for a result. Chosen: short beside a forecast, which takes seconds."""


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

    A forecast is prepared in a thread and runs in processes of its own. The service answers at
    once; the result comes on the topic, and so nothing ever waits for it.

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
        self._job: ForecastJob | None = None
        self._worker = ThreadPoolExecutor(1, "forecast")
        self._work: Future[dict[str, Any]] | None = None
        self._result = node.create_publisher(String, "twin/forecast", LATCHED)
        self._changes = node.create_publisher(String, "twin/scenario", LATCHED)
        node.create_service(Trigger, "~/forecast", self._on_request)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(POLL_S, self._poll, clock=steady)

    def diagnostic_values(self) -> dict[str, object]:
        """For diagnostics."""
        return {"scenario": self.scenario.describe(), "forecasts": self.done}

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
        if self._job is not None:
            self._job.close()
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _on_request(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        place, p = self._node.resolve_service_name("~/forecast"), self._node.p
        try:
            if self._work is not None:
                raise GeoOrbitError(place, "a forecast that is running", "one at a time")
            horizon_s, limit_s = 60.0 * p.forecast_minutes, p.forecast_limit_s
            self._job = ForecastJob(
                self._network, self.traffic, self.scenario, horizon_s, limit_s, place
            )
        except GeoOrbitError as error:
            answer.success, answer.message = False, str(error)
            return answer
        self._work = self._worker.submit(self._job.work)
        about = {"result": self._result.topic_name, **self._job.about}
        answer.success, answer.message = True, json.dumps(about)
        return answer

    def _poll(self) -> None:
        if self._job is None or self._work is None or not self._work.done():
            return
        work, about = self._work, self._job.about
        self._work = self._job = None
        try:
            values = work.result()
            self.done += 1
        except GeoOrbitError as error:
            self._node.diagnostics.refuse(error)
            values = {"error": str(error)}
        self._result.publish(String(data=json.dumps({**about, **values}, allow_nan=False)))
