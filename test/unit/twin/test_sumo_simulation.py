"""SUMO itself: vehicles are exactly where they are put, in lanes called as in the file."""

import os
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_twin import DATUM, made_network, made_roads
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError, RoadNetworkError
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.twin.running_network import (
    MAX_POINTS,
    MIN_PIECE_M,
    TOLERANCE_M,
    thin,
    write_running_network,
)
from geoorbit_ros.twin.simulation import Moves
from geoorbit_ros.twin.sumo_process import SimulationError
from geoorbit_ros.twin.sumo_simulation import Backend, SumoSimulation, backend_of


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


@pytest.fixture
def simulation(net: Path, request: pytest.FixtureRequest) -> Iterator[SumoSimulation]:
    running = SumoSimulation(net, 0.1, backend=getattr(request, "param", "libsumo"))
    yield running
    running.close()


def moves(network: RoadNetwork, lanes: list[str], arc_m: float, offset_m: float) -> Moves:
    """One vehicle in each lane, its front at `arc_m`."""
    xy, angle, share = [], [], []
    for name in lanes:
        lane = network.number[name]
        line, arc = network.line(lane), network.arc(lane)
        at = [arc_m, arc_m + 0.5]
        (x0, x1), (y0, y1) = (np.interp(at, arc, line[:, k]) for k in range(2))
        heading = np.arctan2(y1 - y0, x1 - x0)
        xy.append((x0 - offset_m * np.sin(heading), y0 + offset_m * np.cos(heading)))
        angle.append(np.degrees(np.pi / 2 - heading) % 360.0)
        share.append(arc_m / network.length_m[lane])
    number = [network.number[name] for name in lanes]
    return Moves(
        [f"v{name}" for name in lanes],
        [network.edge_id[k] for k in number],
        network.index[number],
        np.array(share),
        np.array(xy),
        np.array(angle),
        np.full(len(lanes), 3.0),
        np.full(len(lanes), True),
    )


@pytest.mark.parametrize("simulation", ["libsumo", "traci"], indirect=True)
def test_vehicles_are_where_they_are_put(simulation: SumoSimulation, net: Path) -> None:
    network = load_network(net, DATUM)
    lanes = ["east_0", "east_1", "east_2", "bend_0", "bend_2", "west_1", "ramp_0"]
    names = [f"v{name}" for name in lanes]
    for name in names:
        simulation.add(name, "car", 4.6, 1.8)
    for k in range(30):
        wanted = moves(network, lanes, 10.0 + 2.5 * k, 0.8 * np.sin(k / 5.0))
        simulation.move(wanted)
        simulation.step()
        states = simulation.states(names)
        assert np.abs(states.xy - wanted.xy).max() < 1e-9
        turn = (states.angle_deg - wanted.angle_deg + 180.0) % 360.0 - 180.0
        assert np.abs(turn).max() < 1e-9
        assert states.lane == lanes
    simulation.remove(names[0])
    simulation.move(
        Moves(
            names[1:],
            wanted.edge[1:],
            wanted.lane[1:],
            wanted.share[1:],
            wanted.xy[1:],
            wanted.angle_deg[1:],
            wanted.reach_m[1:],
            wanted.within[1:],
        )
    )
    simulation.step()
    states = simulation.states(names)
    assert np.isnan(states.xy[0]).all()
    assert states.lane == ["", *lanes[1:]]


def test_the_lane_that_is_named_counts_beyond_its_borders(net: Path, tmp_path: Path) -> None:
    """Also in a map whose lanes have names of their own, as netconvert gives them from OSM."""
    text = net.read_text(encoding="utf-8")
    lane = re.compile(r"(<lane [^>]*?)/>")
    named = tmp_path / "named.net.xml"
    given = r'\1><param key="origId" value="77"/></lane>'
    named.write_text(lane.sub(given, text), encoding="utf-8")
    assert named.read_text(encoding="utf-8") != text
    network, lanes = load_network(named, DATUM), ["east_0", "east_1", "west_0"]
    simulation = SumoSimulation(named, 0.1)
    try:
        for name in lanes:
            simulation.add(f"v{name}", "car", 4.6, 1.8)
        for k in range(20):
            wanted = moves(network, lanes, 20.0 + 2.5 * k, 2.6)
            simulation.move(replace(wanted, reach_m=np.full(len(lanes), 6.0)))
            simulation.step()
            states = simulation.states(wanted.name)
            assert states.lane == lanes
            assert np.abs(states.xy - wanted.xy).max() < 1e-9
    finally:
        simulation.close()


def test_vehicles_beside_the_road_and_over_each_other_stay(
    simulation: SumoSimulation, net: Path
) -> None:
    """For two minutes nothing is teleported, collides away or arrives."""
    network = load_network(net, DATUM)
    on_top = moves(network, ["east_1"], 100.0, 0.0)
    names = ["a", "b", "beside", "beyond"]
    places = np.array([on_top.xy[0], on_top.xy[0] + (1.0, 0.0), (100.0, -60.0), (-300.0, 5.75)])
    for name in names:
        simulation.add(name, "truck", 9.0, 2.5)
    for _ in range(1200):
        simulation.move(
            Moves(
                names,
                ["east", "east", "", ""],
                np.array([1, 1, 0, 0]),
                np.full(4, 0.3),
                places,
                np.full(4, 90.0),
                np.full(4, 3.0),
                np.array([True, True, False, False]),
            )
        )
        simulation.step()
    states = simulation.states(names)
    assert np.abs(states.xy - places).max() < 1e-9
    assert states.lane == ["east_1", "east_1", "", ""]


def step_on(simulation: SumoSimulation) -> None:
    for _ in range(3):
        simulation.step()


@pytest.mark.parametrize("simulation", ["traci"], indirect=True)
def test_a_sumo_that_is_killed_is_one_sentence(simulation: SumoSimulation) -> None:
    simulation.add("a", "car", 4.6, 1.8)
    assert simulation.pid is not None
    os.kill(simulation.pid, signal.SIGKILL)
    with pytest.raises(SimulationError, match="signal 9") as error:
        step_on(simulation)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("simulation")
def test_one_simulation_per_process(net: Path) -> None:
    with pytest.raises(SimulationError, match="a second simulation in one process"):
        SumoSimulation(net, 0.1)


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_a_network_that_sumo_refuses_is_one_sentence(
    net: Path, tmp_path: Path, backend: Backend
) -> None:
    bad = tmp_path / "bad.net.xml"
    bad.write_text(net.read_text().replace('toLane="0"', 'toLane="7"'))
    with pytest.raises(SimulationError) as error:
        SumoSimulation(bad, 0.1, backend=backend)
    assert "\n" not in str(error.value)
    with pytest.raises(RoadNetworkError, match="no such file"):
        SumoSimulation(tmp_path / "no.net.xml", 0.1, backend=backend)
    SumoSimulation(net, 0.1, backend=backend).close()  # the failure left nothing behind


def test_a_window_needs_a_program_of_its_own() -> None:
    assert backend_of("traci", gui=True) == "traci"
    with pytest.raises(ParameterError, match="with a window"):
        backend_of("libsumo", gui=True)


def test_the_running_network_is_the_same_road(net: Path, tmp_path: Path) -> None:
    """Cut and thinned, its lanes lie within the tolerance of the file's, end to end."""
    out = tmp_path / "running.net.xml"
    running = write_running_network(net, out)
    whole, cut = load_network(net), load_network(out)
    assert set(running.cuts) == {"bend", "ramp"}  # straight roads have two points
    for lane in range(len(whole)):
        if whole.internal[lane]:
            continue
        edge, index = whole.edge_id[lane], whole.index[lane]
        pieces = [cut.number[f"{piece}_{index}"] for piece in running.pieces(edge)]
        for before, after in pairwise(pieces):
            assert after in cut.successors[before]
        assert {running.of_lane[cut.lane_id[k]][0] for k in pieces} == {whole.lane_id[lane]}
        assert min(cut.length_m[k] for k in pieces) >= 0.95 * MIN_PIECE_M
        assert np.mean([len(cut.line(k)) for k in pieces]) <= MAX_POINTS + 1
        line = np.concatenate([cut.line(k) for k in pieces])
        assert np.abs(line[[0, -1]] - whole.line(lane)[[0, -1]]).max() < 0.01
        for point in whole.line(lane):
            assert _distance(point, line) < TOLERANCE_M + 0.005
    assert running.piece("east", 0.7) == "east"
    assert running.piece("bend", 0.0) == "bend~1"
    assert running.piece("bend", 1.2) == running.pieces("bend")[-1]


def _distance(point: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    step = np.diff(line, axis=0)
    length = np.maximum((step**2).sum(axis=1), 1e-12)
    along = np.clip(((point - line[:-1]) * step).sum(axis=1) / length, 0.0, 1.0)
    return float(np.hypot(*(line[:-1] + along[:, None] * step - point).T).min())


@pytest.mark.parametrize("tolerance_m", [0.01, 0.2])
def test_a_thinned_line_is_within_its_tolerance(tolerance_m: float) -> None:
    line = made_roads()["bend"].centerline(0)
    kept = thin(line, tolerance_m)
    assert kept[0] == 0
    assert kept[-1] == len(line) - 1
    assert len(kept) < len(line) / 1.5
    assert max(_distance(point, line[kept]) for point in line) <= tolerance_m
