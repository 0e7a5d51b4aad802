"""Demand from counted vehicles: all of them, once, where they drove, and nothing from the dark."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
import sumo
from made_lane_traffic import Stream, straight, traffic
from made_twin import DATUM, made_network

from geoorbit_ros.core.lanes import Lane, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import Frames, frames_from_rows
from geoorbit_ros.mapcheck.lane_edges import match_edges
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import Recorded, all_measures, record
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.twin.demand.count_files import write_counts
from geoorbit_ros.twin.demand.day_scenario import write_scenario
from geoorbit_ros.twin.demand.measured_demand import MeasuredDemand, measure_demand

CLOCK = IntervalClock(20)
SEEN_M = (120.0, 260.0)
TOOLS = Path(sumo.SUMO_HOME) / "tools"
SCHEMAS = Path(sumo.SUMO_HOME) / "data" / "xsd"
INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"
LANE_Y = {1: -8.75, 2: -5.25, 3: -1.75}
"""The lanes of `east`, from the outer edge of the road."""


def lane(lane_id: int, y: float) -> Lane:
    line = np.column_stack((np.arange(*SEEN_M, 2.0), np.full(70, y)))
    return lane_of_map(lane_id, line, offset_line(line, 1.75), offset_line(line, -1.75))


LANES = [lane(*item) for item in LANE_Y.items()]


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")), DATUM)


def seen(lanes: dict[int, float] = LANE_Y) -> Frames:
    """Two minutes of vehicles, more of them in lanes with higher numbers."""
    streams = [
        Stream(straight(offset_m=y), 12 + 12 * number, *SEEN_M) for number, y in lanes.items()
    ]
    return traffic(streams, duration_s=120.0)


def without(frames: Frames, from_s: float, to_s: float) -> list[Frames]:
    """What a camera has that stopped for a while."""
    stamp_ns, rows = frames.row_stamp_ns(), frames.rows
    before, after = stamp_ns < from_s * 1e9, stamp_ns >= to_s * 1e9
    return [frames_from_rows(stamp_ns[at], rows[at]) for at in (before, after)]


def counted(parts: list[Frames], lanes: list[Lane] = LANES) -> Recorded:
    return record(TrafficCounter(lanes), parts, 2.0)


@pytest.fixture(scope="module")
def demand(network: RoadNetwork) -> MeasuredDemand:
    return measure_demand(counted([seen()]), network, CLOCK)


def written(demand: MeasuredDemand, folder: Path) -> dict[str, Xml.Element]:
    write_counts(folder, demand.counts)
    return {path.name: Xml.parse(path).getroot() for path in folder.glob("*.xml")}


def numbers(root: Xml.Element, element: str, name: str) -> list[int]:
    """The sum of an attribute over each interval."""
    return [
        sum(int(e.attrib[name]) for e in interval.iter(element))
        for interval in root.iter("interval")
    ]


def test_what_is_counted_in_each_lane_is_what_the_files_say(
    demand: MeasuredDemand, tmp_path: Path
) -> None:
    recorded = counted([seen()])
    (table,) = all_measures(recorded, SCHEMES["coco"], CLOCK)
    whole = table[(table["category"] == -1) & (table["observed"] > 0.995)]
    of_lane = {1: "east_0", 2: "east_1", 3: "east_2"}
    files = written(demand, tmp_path)
    found = {
        (lane.attrib["id"], float(interval.attrib["begin"])): int(lane.attrib["entered"])
        for interval in files["lanedata.xml"].iter("interval")
        for lane in interval.iter("lane")
    }
    checked = 0
    for row in whole[whole["lane_id"] > 0]:
        assert found[of_lane[int(row["lane_id"])], row["start_ns"] / 1e9] == row["volume"]
        checked += int(row["volume"])
    assert checked > 50


def test_movements_and_lanes_sum_to_the_edges_volume(
    demand: MeasuredDemand, tmp_path: Path
) -> None:
    files = written(demand, tmp_path)
    entered = numbers(files["edgedata.xml"], "edge", "entered")
    assert sum(entered) >= len(demand.counts.vehicles)
    assert numbers(files["lanedata.xml"], "lane", "entered") == entered
    assert numbers(files["od.xml"], "edgeRelation", "count") == entered
    assert len(list(files["routes.rou.xml"].iter("flow"))) == len(demand.counts.vehicles)


def test_time_that_was_not_watched_is_not_empty(
    network: RoadNetwork, demand: MeasuredDemand, tmp_path: Path
) -> None:
    gap = measure_demand(counted(without(seen(), 38.0, 82.0)), network, CLOCK)
    files, whole = written(gap, tmp_path), demand.counts.counts.count.sum(axis=1)
    edges = [e for e in files["edgedata.xml"].iter("edge") if e.attrib["id"] == "east"]
    dark = edges[2:4]
    for k, edge in enumerate(dark, 2):
        assert edge.attrib["seen"] == "0"
        assert float(edge.attrib["observed"]) == 0.0
        entered = int(edge.attrib["entered"])
        assert 0.5 * whole[k] < entered < 2.0 * whole[k]
        low, high = int(edge.attrib["entered_low"]), int(edge.attrib["entered_high"])
        assert low <= whole[k] <= high
        assert high - low > int(edges[0].attrib["entered_high"]) - int(
            edges[0].attrib["entered_low"]
        )
    assert edges[0].attrib["entered"] == str(whole[0])
    assert any("Not watched at all: 40 to 80" in text for text in gap.sentences())


def test_a_lane_that_the_network_lacks_is_told(network: RoadNetwork) -> None:
    lanes = [*LANES, lane(9, 12.0)]
    recorded = counted([seen({**LANE_Y, 9: 12.0})], lanes)
    assert match_edges(lanes, network).missing == (9,)
    demand = measure_demand(recorded, network, CLOCK)
    assert demand.counts.vehicles.beside_map > 50
    assert any("no lane for lane 9" in text for text in demand.sentences())


def test_ways_go_on_where_the_road_leads_nowhere_else(
    network: RoadNetwork, demand: MeasuredDemand
) -> None:
    ways = {way.edges for way in demand.counts.vehicles.ways}
    assert ways == {("east",)}  # the bend is out of view
    lanes = match_edges(LANES, network)
    assert lanes.network.edge_id[lanes.lane_at(1, 70.0)] == "east"
    assert lanes.first_seen_m[network.number["east_0"]] == pytest.approx(SEEN_M[0], abs=1.5)


def test_sumos_tools_take_the_files(
    network: RoadNetwork, demand: MeasuredDemand, tmp_path: Path
) -> None:
    files = written(demand, tmp_path)
    sampler = [sys.executable, str(TOOLS / "routeSampler.py"), "-r", "routes.rou.xml"]
    sampler += ["-d", "edgedata.xml", "-t", "turns.xml", "-O", "od.xml", "--keep-attributes"]
    done = subprocess.run(
        [*sampler, "-o", "out.rou.xml"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "underflow" not in done.stderr
    vehicles = list(Xml.parse(tmp_path / "out.rou.xml").iter("vehicle"))
    assert len(vehicles) == sum(numbers(files["edgedata.xml"], "edge", "entered"))
    router = [sys.executable, str(TOOLS / "detector" / "flowrouter.py"), "-n", str(network.path)]
    router += ["-d", "detectors.add.xml", "-f", "flows.csv", "-o", "r.xml", "-e", "e.xml"]
    subprocess.run(router, cwd=tmp_path, capture_output=True, check=True)
    flows = Xml.parse(tmp_path / "e.xml").iter("flow")
    assert sum(int(float(flow.attrib["number"])) for flow in flows) == len(vehicles)


def test_a_scenario_runs_and_every_vehicle_arrives(demand: MeasuredDemand, tmp_path: Path) -> None:
    config = write_scenario(tmp_path, demand.counts)
    program = Path(sys.executable).parent / "sumo"
    for name, schema in {"demand.add.xml": "additional", "demand.rou.xml": "routes"}.items():
        root = Xml.parse(tmp_path / name).getroot()
        root.set(f"{{{INSTANCE}}}noNamespaceSchemaLocation", str(SCHEMAS / f"{schema}_file.xsd"))
        Xml.ElementTree(root).write(tmp_path / name)
    command = [str(program), "-c", str(config), "--tripinfo-output", str(tmp_path / "trips.xml")]
    command += ["--xml-validation.routes", "always", "--no-step-log"]
    subprocess.run(command, check=True, capture_output=True, env={"SUMO_HOME": sumo.SUMO_HOME})
    trips = list(Xml.parse(tmp_path / "trips.xml").iter("tripinfo"))
    assert len(trips) == demand.counts.counts.count.sum()
    lanes = [trip.attrib["departLane"] for trip in trips]
    for way_lane in ("east_0", "east_1", "east_2"):
        k = demand.counts.network.number[way_lane]
        here = np.array([way.lane == k for way in demand.counts.vehicles.ways])
        assert lanes.count(way_lane) == demand.counts.counts.count[:, here].sum()
    speeds = [float(trip.attrib["departSpeed"]) for trip in trips]
    assert float(np.median(speeds)) == pytest.approx(25.0, abs=2.0)
