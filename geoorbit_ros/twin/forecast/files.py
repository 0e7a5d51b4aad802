"""Writes SUMO's input files of a forecast: network, vehicles, measurements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.roadnet.network_file import parse_xml
from geoorbit_ros.roadnet.routing import MAX_EDGES, RouteFinder
from geoorbit_ros.twin.forecast.observed_traffic import Demand
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.scenario import Scenario
from geoorbit_ros.twin.vehicles import FREE, TYPES, add_free_type, add_type, may_drive

STEP_S = 0.5
"""Length of a step. SUMO's drivers are made for steps up to their reaction time of 1 s (`tau`, SUMO
user documentation). Chosen: half of it; smaller takes longer, larger brakes late."""
HEADWAY_S = 1.5
"""Two vehicles do not arrive in one lane within less: the second takes another lane. Chosen: most
drivers keep 1 to 2 s; larger moves more out of their lanes, smaller leaves them without room."""
QUEUE_PERIOD_S = 10.0
"""Between two measurements of queues. Chosen: shorter makes files larger, longer misses short
queues."""
LANES, QUEUES, CONFIG = "lanes.xml", "queues.xml", "forecast.sumocfg"


@dataclass(frozen=True, slots=True)
class ForecastStart:
    """Where a forecast begins.

    Attributes:
        step: The twin's last step.
        demand: Traffic that will arrive.
        horizon_s: How far ahead.
        seed: Of the arrivals and of SUMO's drivers.
    """

    step: TwinStep
    demand: Demand
    horizon_s: float
    seed: int


def write_forecast(
    folder: Path, network: RoadNetwork, start: ForecastStart, scenario: Scenario
) -> Path:
    """Write all files of one forecast; the path of SUMO's configuration.

    The vehicles of the step go on from where they are, over routes drawn from the turns seen.
    New ones arrive at random times (exponential headways) with the flows seen, the same in every
    scenario.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _write_network(network.path, folder / "forecast.net.xml", scenario)
    additional = Xml.Element("additional")
    for kind in TYPES:
        add_type(additional, kind.name, kind)
        add_free_type(additional, kind)
    # Lanes without vehicles are listed, too.
    measured = {"id": "all", "file": LANES, "excludeEmpty": "false", "withInternal": "0"}
    Xml.SubElement(additional, "laneData", measured | {"begin": "0", "end": f"{start.horizon_s:g}"})
    _save(additional, folder / "forecast.add.xml")
    _save(_routes(network, start, scenario), folder / "forecast.rou.xml")
    root = Xml.Element("configuration")
    for name, value in {
        "net-file": "forecast.net.xml",
        "route-files": "forecast.rou.xml",
        "additional-files": "forecast.add.xml",
        "queue-output": QUEUES,
        "queue-output.period": f"{QUEUE_PERIOD_S:g}",
        "summary-output": "summary.xml",
        "begin": "0",
        "end": f"{start.horizon_s:g}",
        "step-length": f"{STEP_S:g}",
        "seed": str(start.seed),
        "time-to-teleport": "-1",
        "collision.action": "none",
        "ignore-route-errors": "true",
        "no-step-log": "true",
        "no-warnings": "true",
        "max-depart-delay": "-1",
    }.items():
        Xml.SubElement(root, name, value=value)
    _save(root, folder / CONFIG)
    return folder / CONFIG


def _write_network(path: Path, out: Path, scenario: Scenario) -> None:
    tree = parse_xml(path)
    for lane in tree.getroot().iter("lane"):
        name = lane.get("id", "")
        if name in scenario.closed:
            lane.attrib.pop("allow", None)
            lane.set("disallow", "all")
        if name in scenario.limit_mps:
            lane.set("speed", f"{scenario.limit_mps[name]:.3f}")
    tree.write(out, encoding="utf-8", xml_declaration=True)


def _routes(network: RoadNetwork, start: ForecastStart, scenario: Scenario) -> Xml.Element:
    root, random = Xml.Element("routes"), np.random.default_rng(start.seed)
    draw, demand = _RouteDraw(network, start.demand, random), start.demand
    step = start.step
    speed = np.hypot(*step.velocity.T)
    there = (step.lane != NO_LANE) & np.isfinite(step.xy[:, 0])
    for k in np.flatnonzero(there & ~network.internal[np.maximum(step.lane, 0)]).tolist():
        lane = int(step.lane[k])
        front = network.place_on(lane, step.xy[k]) + 0.5 * float(step.size_m[k, 0])
        position = min(max(front, 0.1), float(network.length_m[lane]) - 0.1)
        _vehicle(
            root,
            draw.onwards(network.edge_id[lane], int(step.kind[k])),
            id=f"v{step.vehicle_id[k]}",
            type=TYPES[step.kind[k]].name + ("" if draw.may[step.kind[k], lane] else FREE),
            depart="0",
            departLane=str(network.index[lane]),
            departPos=f"{position:.2f}",
            departSpeed=f"{speed[k]:.2f}",
            speedFactor=f"{draw.driver(network.edge_id[lane]).factor:.3f}",
            insertionChecks="none",
        )
    arrivals: list[tuple[float, str]] = []
    for edge, flow in sorted(demand.flow_per_h.items()):
        # More than will arrive, except with a chance of one in millions.
        expected = flow * start.horizon_s / 3600.0
        gaps = random.exponential(1.0, int(expected + 6.0 * np.sqrt(expected) + 10))
        times = np.cumsum(gaps) * 3600.0 / max(flow, 1e-9)
        arrivals += [(time, edge) for time in times.tolist() if time < start.horizon_s]
    last_s: dict[int, float] = {}
    for number, (time, edge) in enumerate(sorted(arrivals)):
        driver = draw.driver(edge)
        depart_lane = "random"
        seen = driver.edge == edge and network.lane_id[driver.lane] not in scenario.closed
        # One that was seen in a lane for others will not drive there: most don't.
        seen = seen and bool(draw.may[driver.kind, driver.lane])
        if seen and time >= last_s.get(driver.lane, -np.inf) + HEADWAY_S:
            depart_lane, last_s[driver.lane] = str(network.index[driver.lane]), time
        _vehicle(
            root,
            draw.onwards(edge, driver.kind),
            id=f"new{number}",
            type=TYPES[driver.kind].name + ("" if draw.may_enter(edge, driver.kind) else FREE),
            depart=f"{time:.2f}",
            # Where it was seen, as fast drivers keep to other lanes than slow ones, or else in any
            # open one; it leaves it in time.
            departLane=depart_lane,
            departSpeed="max",
            speedFactor=f"{driver.factor:.3f}",
        )
    return root


def _vehicle(root: Xml.Element, edges: list[str], **values: str) -> None:
    Xml.SubElement(Xml.SubElement(root, "vehicle", values), "route", edges=" ".join(edges))


class _Driver(NamedTuple):
    """A vehicle that was seen: its type, speed over the limit, edge and lane."""

    kind: int
    factor: float
    edge: str
    lane: int


class _RouteDraw:
    """Draws routes by the turns that were seen, and drivers among those that were seen.

    Attributes:
        may: (T, L) whether vehicles of each type may drive in each lane.
    """

    def __init__(self, network: RoadNetwork, demand: Demand, random: np.random.Generator) -> None:
        self._finder, self._demand, self._random = RouteFinder(network), demand, random
        self.may = may_drive(network)
        self._enter: dict[str, NDArray[np.bool_]] = {
            edge: np.asarray(self.may[:, list(lanes)].any(axis=1))
            for edge, lanes in network.lanes_of.items()
        }

    def may_enter(self, edge: str, kind: int) -> bool:
        """Whether vehicles of a type may drive in some lane of an edge."""
        return bool(self._enter[edge][kind])

    def onwards(self, edge: str, kind: int) -> list[str]:
        """An edge and those after it that are for a type, by the turns that were seen.

        Where no vehicle was seen to go on, traffic parts as the lanes do, up to the network's end.
        """
        route = [edge]
        while len(route) < MAX_EDGES:
            turns = self._demand.turns.get(route[-1]) or self._finder.branches(route[-1])
            targets = [t for t in turns if t not in route and self.may_enter(t, kind)]
            if not targets:
                break
            counts = np.array([turns[target] for target in targets], dtype=np.float64)
            route.append(targets[int(self._random.choice(len(targets), p=counts / counts.sum()))])
        return route

    def driver(self, edge: str) -> _Driver:
        """One of the drivers that were seen and may drive on an edge."""
        drivers = self._demand.drivers
        weights = drivers.weights(edge, self._enter[edge][drivers.kinds])
        k = int(self._random.choice(len(weights), p=weights))
        factor = float(drivers.factors[k])
        return _Driver(int(drivers.kinds[k]), factor, drivers.edge[k], int(drivers.lane[k]))


def _save(root: Xml.Element, path: Path) -> None:
    Xml.indent(root)
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
