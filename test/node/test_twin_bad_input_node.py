"""Whatever the bridge is given: one sentence, the other nodes run on, and it catches up."""

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, made_network, rows
from probe import LOSSLESS, Probe
from sensor_msgs.msg import NavSatFix

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.sumo_bridge.node import SumoBridgeNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.twin import sumo_process
from geoorbit_ros.twin.sumo_simulation import SumoSimulation

LANE_Y = -5.25


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


def start(nodes: Composition, net: Path, **overrides: object) -> SumoBridgeNode:
    given = LOSSLESS | {"network": str(net), "cameras": "north"} | overrides
    return nodes.make(SumoBridgeNode, "site", given)


def speak(nodes: Composition, camera: str, datum: Datum = DATUM) -> tuple[Probe, Any]:
    probe = Probe(nodes, f"site/{camera}", f"probe_{camera}")
    probe.publisher("datum", NavSatFix, LATCHED).publish(datum_to_fix(datum, "map"))
    return probe, probe.table_publisher("tracks")


BROKEN: dict[str, tuple[Callable[[str], str], str]] = {
    "half a file": (lambda text: text[: len(text) // 2], "broken XML"),
    "nothing": (lambda _: "", "broken XML"),
    "another file": (lambda _: "<osm/>", "a file of <osm>"),
    "no roads": (
        lambda text: f"<net>{re.search('<location[^>]*>', text)[0]}</net>",  # type: ignore[index]
        "no lane",
    ),
    "no place": (
        lambda text: re.sub(r'projParameter="[^"]*"', 'projParameter="!"', text),
        "a network without projection",
    ),
    "no projection of PROJ's": (
        lambda text: re.sub(r'projParameter="[^"]*"', 'projParameter="+proj=none"', text),
        r"projection '\+proj=none'",
    ),
    "no numbers": (lambda text: text.replace('shape="', 'shape="nan,nan ', 1), "not finite"),
    "a lane that is not there": (
        lambda text: re.sub(r'fromLane="\d"', 'fromLane="9"', text, count=1),
        "SUMO: found a network it refuses",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_network_that_can_not_be_used(
    nodes: Composition, net: Path, tmp_path: Path, name: str
) -> None:
    spoil, said = BROKEN[name]
    bad = tmp_path / "bad.net.xml"
    bad.write_text(spoil(net.read_text()))
    other = nodes.make(RecorderNode, "north", {"database": str(tmp_path / "db")})
    with pytest.raises(GeoOrbitError, match=said) as error:
        start(nodes, bad)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400
    probe = Probe(nodes, "north")
    probe.table_publisher("tracks")(START_NS, rows([(1, 50.0, LANE_Y)]))
    probe.until(lambda: other.diagnostics.received == 1, "the node beside it")


@pytest.mark.parametrize(
    ("datum", "said"),
    [
        (Datum(44.6, -89.35), "a datum 17[0-9] km from the network"),
        (Datum(-30.0, 100.0), "a datum .* from the network"),
    ],
)
def test_a_camera_outside_the_network(
    nodes: Composition, net: Path, datum: Datum, said: str
) -> None:
    """It says so, for its tracks, too, and the other camera's twin goes on."""
    node = start(nodes, net, cameras="north south")
    (probe, north), (_, south) = speak(nodes, "north"), speak(nodes, "south", datum)
    probe.until(lambda: node.diagnostics.refused == 1 and len(node.known) == 1, "the datums")
    for k in range(5):
        north(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
        south(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
    probe.until(lambda: node.runner.twin.steps == 5, "the twin")
    probe.until(lambda: node.diagnostics.refused == 6, "the refusals")
    refusal = str(node.diagnostics.last_refusal)
    assert re.search(f"camera 'south': found {said}", refusal)
    assert len(node.runner.twin.vehicles.slots) == 1


def test_a_camera_beside_the_roads_is_heard_and_has_no_vehicles(
    nodes: Composition, net: Path
) -> None:
    node = start(nodes, net)
    probe, send = speak(nodes, "north")
    probe.until(lambda: len(node.known) == 1, "the datum")
    for k in range(5):
        send(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, 900.0)]))
    probe.until(lambda: node.runner.twin.steps == 5, "the twin")
    assert node.runner.twin.fusion.counts.off_road == 5
    assert not len(node.runner.twin.vehicles.slots)


def test_tracks_that_jump_or_are_no_numbers(nodes: Composition, net: Path) -> None:
    """Beside a good one: out of the world, to another lane and back, not a number, infinite."""
    node = start(nodes, net)
    probe, send = speak(nodes, "north")
    probe.until(lambda: len(node.known) == 1, "the datum")
    wild = [100.0, 1e30, 40.0, np.nan, np.inf, 250.0, -1e9, 100.0, 110.0, 120.0]
    for k, x in enumerate(wild):
        table = rows([(1, 50.0 + 2.0 * k, LANE_Y), (2, x, -1.75)])
        if k == 4:
            table["vx"], table["heading"][1], table["sigma"][1] = np.inf, np.nan, np.nan
        send(START_NS + k * STEP_NS, table)
    probe.until(lambda: node.runner.twin.steps == len(wild), "the twin")
    assert node.diagnostics.refused == 0
    counts = node.runner.twin.fusion.counts
    assert counts.jumps >= 1
    assert counts.jumps + counts.unsettled >= 3  # who jumps again before it settled was nowhere
    simulation = node.runner.simulation
    assert simulation is not None
    front = 50.0 + 2.0 * 9 + 2.3
    assert np.allclose(simulation.states(["v1"]).xy[0], (front, LANE_Y), atol=0.05)
    assert node.runner.twin.placement.lost == 0


def test_a_sumo_that_hangs_is_replaced(
    nodes: Composition, net: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sumo_process, "ANSWER_TIMEOUT_S", 0.5)
    node = start(nodes, net, backend="traci")
    probe, send = speak(nodes, "north")
    probe.until(lambda: len(node.known) == 1, "the datum")
    simulation = node.runner.simulation
    assert isinstance(simulation, SumoSimulation)
    assert simulation.pid is not None
    send(START_NS, rows([(1, 50.0, LANE_Y)]))
    probe.until(lambda: node.diagnostics.received == 1, "the first frame")
    os.kill(simulation.pid, signal.SIGSTOP)
    for k in range(1, 6):
        send(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y)]))
    probe.until(lambda: node.diagnostics.received == 6, "the frames after it")
    assert node.runner.restarts == 1
    assert node.diagnostics.refused == 1
    assert "it hung" in str(node.diagnostics.last_refusal)
    replaced = node.runner.simulation
    assert isinstance(replaced, SumoSimulation)
    assert np.allclose(replaced.states(["v1"]).xy[0], (60.0 + 2.3, LANE_Y), atol=1e-3)
