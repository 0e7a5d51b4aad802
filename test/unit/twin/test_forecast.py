"""Forecasts: they continue what was seen, and a closed lane costs what it must."""

import json
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from made_twin import DATUM, FakeSimulation

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.road_plan import Road, Start, Straight
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.twin.forecast.files import ForecastStart, write_forecast
from geoorbit_ros.twin.forecast.observed_traffic import Demand, Drivers, ObservedTraffic
from geoorbit_ros.twin.forecast.runs import AS_IT_IS, WITH_CHANGES, Forecast, ForecastRun
from geoorbit_ros.twin.scenario import Scenario, parse_scenario
from geoorbit_ros.twin.sumo_process import SimulationError
from geoorbit_ros.twin.synchronizer import Synchronizer

SPEED_MPS, SEEN_S = 22.0, 120.0
FLOW_PER_H = 3000.0
"""More than one lane carries, less than two do."""


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    """Two lanes east: 400 m, then 300 m more."""
    start = Start(x_m=0, y_m=0, heading_deg=90)
    roads = [
        Road(id="first", lanes=2, path=[Straight(straight_m=400.0)], start=start),
        Road(id="second", lanes=2, path=[Straight(straight_m=300.0)], follows="first"),
    ]
    scene = load_scene("straight_3x3").model_copy(update={"roads": roads})
    net = write_network(place_roads(scene), tmp_path_factory.mktemp("net"), DATUM)
    return load_network(net, DATUM)


class Seen:
    """Traffic of two lanes through a twin without SUMO, seen from 100 m to 600 m."""

    def __init__(self, network: RoadNetwork, broken: bool = False) -> None:
        self.traffic = ObservedTraffic(network, 600.0)
        twin = Synchronizer(network, _OnLanes(network), ["c"], 0.1, 0.0, self.traffic.add)
        random = np.random.default_rng(3)
        # Per lane, and never nearer than a second to the one before.
        gaps = 1.0 + random.exponential(2.0 * 3600.0 / FLOW_PER_H - 1.0, (2, 200))
        times, lanes = np.cumsum(gaps, axis=1).ravel() - 40.0, np.repeat([0, 1], 200)
        y = [float(network.line(network.number[f"first_{k}"])[0, 1]) for k in range(2)]
        for k in range(round(SEEN_S / 0.1)):
            at = 100.0 + (k * 0.1 - times) * SPEED_MPS
            here = np.flatnonzero((at > 100.0) & (at < 600.0))
            rows = np.zeros(len(here), TRACK_DTYPE)
            # A tracker that loses every vehicle half-way gives it another number.
            rows["track_id"] = here + (1000 * (at[here] > 350.0) if broken else 0)
            rows["x"], rows["y"] = at[here], np.array(y)[lanes[here]]
            rows["vx"], rows["length"], rows["width"] = SPEED_MPS, 4.6, 1.8
            rows["sigma"], rows["class_id"] = 0.2, 2
            twin.add("c", 10**9 + k * 10**8, rows)

    @property
    def demand(self) -> Demand:
        found = self.traffic.demand()
        assert found is not None
        return found


class _OnLanes(FakeSimulation):
    """Says for each vehicle the lane that it was put on."""

    def __init__(self, network: RoadNetwork) -> None:
        super().__init__()
        self._network, self._lane = network, dict[str, str]()

    def move(self, moves):  # type: ignore[no-untyped-def]
        super().move(moves)
        for name, edge, lane in zip(moves.name, moves.edge, moves.lane, strict=True):
            self._lane[name] = f"{edge}_{lane}"

    def states(self, names):  # type: ignore[no-untyped-def]
        found = super().states(names)
        return type(found)(found.xy, found.angle_deg, [self._lane[name] for name in names])


@pytest.fixture(scope="module")
def seen(network: RoadNetwork) -> Seen:
    return Seen(network)


def start(seen: Seen, horizon_s: float = 600.0) -> ForecastStart:
    assert seen.traffic.last is not None
    return ForecastStart(seen.traffic.last, seen.demand, horizon_s, seed=1)


@pytest.fixture(scope="module")
def forecasts(network: RoadNetwork, seen: Seen) -> Iterator[list[Forecast]]:
    scenario = parse_scenario(["second_0"], ["first=60"], network, "test")
    run = ForecastRun(network, start(seen), scenario, 60.0)
    yield run.wait()
    run.close()


def flow(forecast: Forecast, edge: str) -> float:
    return sum(lane.flow_per_h for lane in forecast.lanes if lane.lane.startswith(edge))


def test_what_enters_a_junction_leaves_it(tmp_path: Path) -> None:
    """Two roads join, and one of the two is hardly seen: only its last 40 m."""
    scene = load_scene("on_ramp_merge")
    network = load_network(write_network(place_roads(scene), tmp_path, DATUM), DATUM)
    traffic = ObservedTraffic(network, 600.0)
    twin = Synchronizer(network, _OnLanes(network), ["c"], 0.1, 0.0, traffic.add)
    ways = [[f"{edge}_0", "merge_0"] for edge in ("ramp", "main_in")]
    lines = [np.vstack([network.line(network.number[lane]) for lane in way]) for way in ways]
    arcs = [np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))) for line in lines]
    seen_from = [0.0, float(network.length_m[network.number["main_in_0"]]) - 40.0]
    for k in range(900):
        rows = np.zeros(60, TRACK_DTYPE)
        count = 0
        for way, (line, arc) in enumerate(zip(lines, arcs, strict=True)):
            for vehicle in range(30):
                at = 15.0 * (0.1 * k - 3.0 * vehicle - 1.5 * way)
                if not seen_from[way] < at < arc[-1] - 10.0:
                    continue
                here = [np.interp([at, at + 0.5], arc, line[:, axis]) for axis in range(2)]
                (x, x_on), (y, y_on) = here
                rows[count]["x"], rows[count]["y"] = x, y
                heading = np.arctan2(y_on - y, x_on - x)
                rows[count]["vx"], rows[count]["vy"] = 15 * np.cos(heading), 15 * np.sin(heading)
                rows[count]["heading"], rows[count]["track_id"] = heading, 100 * way + vehicle + 1
                count += 1
        rows["length"], rows["width"], rows["sigma"], rows["class_id"] = 4.6, 1.8, 0.2, 2
        twin.add("c", 10**9 + k * 10**8, rows[:count])
    demand = traffic.demand()
    assert demand is not None
    flow = demand.edge_flow_per_h
    assert flow["merge"] == pytest.approx(flow["main_in"] + flow["ramp"])
    assert min(flow["main_in"], flow["ramp"]) > 300.0


def test_flows_and_drivers_are_those_that_were_seen(network: RoadNetwork, seen: Seen) -> None:
    demand = seen.demand
    # Of 90 vehicles in two minutes the number itself varies by a tenth.
    assert demand.flow_per_h == pytest.approx({"first": FLOW_PER_H}, rel=0.12)
    assert demand.edge_flow_per_h["second"] == pytest.approx(demand.flow_per_h["first"])
    assert set(demand.turns) == {"first"}
    assert set(demand.turns["first"]) == {"second"}
    limit = network.speed_mps[network.number["first_0"]]
    assert demand.drivers.factors == pytest.approx(SPEED_MPS / limit, rel=0.01)


def test_the_next_driver_is_one_of_the_same_road_by_the_distance_driven() -> None:
    """A queue in one direction slows nobody in the other, and a false track hardly counts."""
    driven_m = np.array([1500.0, 5.0, 1200.0])
    edge = np.array(["east", "east", "west"], dtype=object)
    number = np.zeros(3, np.int64)
    drivers = Drivers(edge, number, np.array([1.0, 0.3, 0.5]), driven_m, number)
    every, two = np.ones(3, np.bool_), np.array([True, True, False])
    assert drivers.weights("east", every) == pytest.approx([1500 / 1505, 5 / 1505, 0.0])
    assert drivers.weights("west", every) == pytest.approx([0.0, 0.0, 1.0])
    assert drivers.weights("west", two) == pytest.approx([1500 / 1505, 5 / 1505, 0.0])
    assert drivers.weights("north", every) == pytest.approx(driven_m / 2705.0)


def test_vehicles_arrive_in_the_lanes_in_which_they_were_seen(
    network: RoadNetwork, seen: Seen, tmp_path: Path
) -> None:
    """Unless two would arrive in one lane at once, or it is closed."""

    def lanes(closed: list[str]) -> list[str]:
        name = "closed" if closed else "open"
        scenario = parse_scenario(closed, [], network, "test")
        write_forecast(tmp_path / name, network, start(seen), scenario)
        routes = Xml.parse(tmp_path / name / "forecast.rou.xml").getroot()
        new = [v for v in routes.iter("vehicle") if v.attrib["id"].startswith("new")]
        return [v.attrib["departLane"] for v in new]

    seen_in = {str(network.index[lane]) for lane in seen.demand.drivers.lane}
    found = lanes([])
    assert set(found) - {"random"} == seen_in
    assert found.count("random") < 0.5 * len(found)
    assert set(lanes(["first_0"])).isdisjoint({"0"})


def test_a_closed_road_lets_nobody_through(network: RoadNetwork, seen: Seen) -> None:
    """Those who can't enter wait; they are not counted as arrived."""
    everything = ["first_0", "first_1", "second_0", "second_1"]
    scenario = parse_scenario(everything, [], network, "test")
    run = ForecastRun(network, start(seen, 120.0), scenario, 60.0)
    open_road, closed = run.wait()
    run.close()
    assert open_road.left_per_h > 0.5 * FLOW_PER_H
    assert closed.left_per_h < 0.1 * open_road.left_per_h
    assert closed.waiting > 0.8 * FLOW_PER_H * 120.0 / 3600.0
    assert open_road.waiting < 5


def test_the_speeds_that_were_seen_stand_beside(forecasts: list[Forecast]) -> None:
    for lane in forecasts[0].lanes:
        assert lane.seen_kmh == pytest.approx(3.6 * SPEED_MPS, rel=0.02)


def test_broken_tracks_add_no_traffic(network: RoadNetwork, seen: Seen) -> None:
    broken = Seen(network, broken=True).demand
    assert broken.flow_per_h["first"] == pytest.approx(seen.demand.flow_per_h["first"], rel=0.03)


def test_without_changes_the_traffic_goes_on_as_seen(forecasts: list[Forecast]) -> None:
    as_it_is = forecasts[0]
    assert as_it_is.scenario == AS_IT_IS
    assert flow(as_it_is, "second") == pytest.approx(FLOW_PER_H, rel=0.12)
    assert as_it_is.left_per_h == pytest.approx(FLOW_PER_H, rel=0.12)
    assert as_it_is.waiting == 0
    assert max(lane.queue_m_max for lane in as_it_is.lanes) < 30.0
    for lane in as_it_is.lanes:
        assert lane.speed_kmh is not None
        assert 0.8 * 3.6 * SPEED_MPS < lane.speed_kmh < 1.1 * 3.6 * SPEED_MPS
        length_m = 400.0 if lane.lane.startswith("first") else 300.0
        assert lane.travel_time_s == pytest.approx(3.6 * length_m / lane.speed_kmh, rel=0.05)


def test_one_of_two_lanes_closed_carries_less_and_queues(forecasts: list[Forecast]) -> None:
    as_it_is, changed = forecasts
    assert changed.scenario == WITH_CHANGES
    assert changed.changes == "second_0 closed; first_0 60 km/h; first_1 60 km/h"
    assert changed.left_per_h < 0.85 * as_it_is.left_per_h
    by_lane = {lane.lane: lane for lane in changed.lanes}
    assert by_lane["second_0"].flow_per_h == 0.0
    assert by_lane["second_0"].speed_kmh is None
    assert changed.waiting + sum(lane.queue_vehicles for lane in changed.lanes) > 10
    assert by_lane["first_0"].queue_m_max > 100.0 + as_it_is.lanes[0].queue_m_max
    assert max(by_lane["first_0"].speed_kmh or 0, by_lane["first_1"].speed_kmh or 0) < 61.0


def test_results_are_json_without_nan(forecasts: list[Forecast]) -> None:
    text = json.dumps([forecast.values() for forecast in forecasts], allow_nan=False)
    assert {lane["lane"] for lane in json.loads(text)[0]["lanes"]} == {
        "first_0",
        "first_1",
        "second_0",
        "second_1",
    }


def test_the_same_start_gives_the_same_forecast(network: RoadNetwork, seen: Seen) -> None:
    lanes = []
    for _ in range(2):
        run = ForecastRun(network, start(seen, 60.0), Scenario(), 60.0)
        lanes.append([forecast.lanes for forecast in run.wait()])
        run.close()
    assert lanes[0] == lanes[1]
    assert len(lanes[0]) == 1  # nothing is changed: one scenario


def test_a_forecast_that_takes_too_long_is_given_up(network: RoadNetwork, seen: Seen) -> None:
    now_s = iter(range(0, 1000, 100))
    run = ForecastRun(network, start(seen), Scenario(), 50.0, lambda: float(next(now_s)))
    with pytest.raises(SimulationError, match="no result in 50 s"):
        run.wait()
    run.close()


@pytest.mark.parametrize(
    ("closed", "limits", "said"),
    [
        (["nowhere_0"], [], "'nowhere_0'.*first_0, first_1"),
        ([], ["first"], "'first'.*<km/h"),
        ([], ["first=fast"], "'first=fast'"),
        ([], ["first=900"], "from 1 to 250"),
        ([], ["none=50"], "'none'"),
    ],
)
def test_a_scenario_that_the_network_has_not_is_one_sentence(
    network: RoadNetwork, closed: list[str], limits: list[str], said: str
) -> None:
    with pytest.raises(ParameterError, match=said) as error:
        parse_scenario(closed, limits, network, "test")
    assert "\n" not in str(error.value)


def test_nothing_seen_is_no_demand(network: RoadNetwork) -> None:
    assert ObservedTraffic(network, 600.0).demand() is None
