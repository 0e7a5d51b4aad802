"""Turnarounds, which netconvert puts at every dead end: no unseen vehicle takes one."""

import csv
import json
import re
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_maps import BAVARIA, ENGLAND, MadeCamera, road
from made_twin import START_NS, STEP_NS, FakeSimulation, Steps, rows

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.cli.main import main
from geoorbit_ros.mapcheck.discrepancies import must_be_left
from geoorbit_ros.roadnet.netconvert import netconvert
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.reference_lanes import lane_chains
from geoorbit_ros.roadnet.routing import RouteFinder, position_ahead
from geoorbit_ros.twin.synchronizer import Synchronizer

FLAGS = {"left": ["--lefthand"], "right": [], "bare": ["--no-internal-links"]}


def made(folder: Path, kind: str, datum: Datum) -> RoadNetwork:
    """A road of two lanes each way, as netconvert makes it: with turnarounds at both ends."""
    area = road(datum, {"lanes": "4", "maxspeed": "60"}).write(folder / "area.osm")
    net = folder / "net.net.xml"
    options = ["--offset.disable-normalization", "--default.lanewidth=3.5", *FLAGS[kind]]
    names = [f"--osm-files={area}", f"--output-file={net}", f"--proj={datum.proj_string}"]
    netconvert([*names, *options], "test")
    assert re.search(r'dir="[tT]"', net.read_text())
    return load_network(net, datum)


@pytest.fixture(scope="module", params=FLAGS)
def network(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> RoadNetwork:
    return made(tmp_path_factory.mktemp("net"), request.param, BAVARIA)


def test_a_turnaround_is_no_way_on(network: RoadNetwork) -> None:
    for name in ("10_0", "10_1", "-10_0", "-10_1"):
        k = network.number[name]
        assert network.successors[k] == network.predecessors[k] == ()
        assert position_ahead(network, k, network.length_m[k] + 3.0, 0.0).ended
        assert not must_be_left(network, k)
    assert any(network.turnarounds)
    chains = lane_chains(network)
    assert sorted(len(chain) for chain in chains) == [1, 1, 1, 1]


def test_routes_turn_round_only_where_a_vehicle_was_seen_to(network: RoadNetwork) -> None:
    finder = RouteFinder(network)
    assert finder.branches("10") == {}
    assert finder.complete(["10", "-10"]) == ["10", "-10"]


def twin(network: RoadNetwork) -> tuple[Synchronizer, Steps]:
    steps = Steps()
    return Synchronizer(network, FakeSimulation(), ["c"], 0.1, 1.5, steps.append), steps


def test_a_vehicle_that_is_lost_at_the_end_leaves(network: RoadNetwork) -> None:
    bridge, steps = twin(network)
    x = float(network.line(network.number["10_1"])[0, 0])
    for k in range(60):
        there = [(1, x, 100.0 + 2.0 * k)] if k < 20 else []
        back = [(2, -x, 145.0 - 2.0 * (k - 25))] if k >= 25 else []
        north, south = rows(there, heading_rad=np.pi / 2), rows(back, heading_rad=-np.pi / 2)
        bridge.add("c", START_NS + k * STEP_NS, np.concatenate([north, south]))
    bridge.finish()
    assert steps.vehicles == {1, 2}
    assert np.diff(steps.of(1)[:, 1]).min() > 0.0
    assert np.diff(steps.of(2)[:, 1]).max() < 0.0


def test_a_vehicle_that_is_seen_to_turn_turns(network: RoadNetwork) -> None:
    bridge, steps = twin(network)
    x, top = float(network.line(network.number["10_1"])[0, 0]), 149.0
    angle = np.linspace(0.0, np.pi, 30)
    side = 1.0 if x > 0 else -1.0
    turn = np.column_stack((x * np.cos(angle), top + abs(x) * np.sin(angle)))
    up = np.column_stack((np.full(40, x), np.linspace(top - 20.0, top, 40)))
    path = np.concatenate([up, turn, np.column_stack((-up[:, 0], up[::-1, 1]))])
    for k, (here, there) in enumerate(pairwise(path)):
        heading = float(np.arctan2(*(there - here)[::-1]))
        speed = float(np.hypot(*(there - here))) / 0.1
        row = rows([(1, here[0], here[1])], speed_mps=speed, heading_rad=heading)
        bridge.add("c", START_NS + k * STEP_NS, row)
    bridge.finish()
    assert steps.vehicles == {1}
    wanted = [step.wanted_lane[0] for step in steps]
    names = [network.lane_id[k] for k in wanted if k >= 0]
    assert names[0] == "10_1"
    assert names[-1] == "-10_1"
    assert side * x > 0


def test_where_lanes_part_an_unseen_vehicle_goes_straight_on(network: RoadNetwork) -> None:
    """Not as the file's first connection leads, which is the turn towards the kerb."""
    k, turn, straight = (network.number[name] for name in ("10_0", "-10_1", "10_1"))
    nexts = list(network.successors)
    nexts[k] = (turn, straight)
    parted = replace(network, successors=tuple(nexts))
    assert position_ahead(parted, k, float(parted.length_m[k]) + 5.0, 0.0).lane == straight


def test_as_many_vehicles_as_tracks_and_none_in_both_directions(tmp_path: Path) -> None:
    network = made(tmp_path, "right", ENGLAND)
    camera = MadeCamera(ENGLAND)
    for x, way in ((1.75, 1), (5.25, 1), (-1.75, -1), (-5.25, -1)):
        line = np.array([(x, -145.0 * way), (x, 149.5 * way)])
        camera.drive(line, 8, begin_s=0.6 * abs(x), every_s=2.3)
    tracks, calibration = camera.write(tmp_path)
    seen, bag, out = ["--calibration", str(calibration)], str(tmp_path / "bag"), tmp_path / "twin"
    boxes = ["--tracks", str(tracks), "--camera-id", "c"]
    assert main(["bag", "from-csv", *boxes, *seen, "--out", bag]) == 0
    command = ["twin", "replay", bag, "--net", str(network.path), *seen, "--out", str(out)]
    assert main(command) == 0
    score = json.loads((out / "score.json").read_text())
    assert score["vehicles_total"] == score["tracks"] == camera.tracks
    assert score["handovers"] == 0
    with (out / "vehicles.csv").open() as file:
        states = list(csv.DictReader(file))
    headings = defaultdict(set)
    for row in states:
        headings[row["vehicle"]].add(abs(float(row["heading_deg"]) - 180.0) < 90.0)
    assert [v for v, ways in headings.items() if len(ways) > 1] == []
    assert {row["lane"] for row in states} <= {"", "10_0", "10_1", "-10_0", "-10_1"}
