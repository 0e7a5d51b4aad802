"""Closures and limits by parameters, forecasts by a service, and the live twin beside them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, made_network, rows
from numpy.typing import NDArray
from probe import LOSSLESS, Probe
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.conversions import datum_to_fix
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.sumo_bridge.node import SumoBridgeNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.twin.sumo_simulation import SumoSimulation

LANE_Y = (-8.75, -5.25, -1.75)
FRAMES = 150


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


def start(nodes: Composition, net: Path, **overrides: object) -> tuple[SumoBridgeNode, Probe, Any]:
    given = LOSSLESS | {"network": str(net), "cameras": "north"} | overrides
    node = nodes.make(SumoBridgeNode, "site", given)
    probe = Probe(nodes, "site/north")
    probe.publisher("datum", NavSatFix, LATCHED).publish(datum_to_fix(DATUM, "map"))
    send = probe.table_publisher("tracks")
    probe.until(lambda: len(node.known) == 1, "the datum")
    return node, probe, send


def frame(k: int) -> NDArray[np.void]:
    """A vehicle every 80 m in each of three lanes, from x = 20 to 280, 20 m/s; the road is full."""
    found = []
    for lane, y in enumerate(LANE_Y):
        for number in range(40):
            x = 260.0 + 2.0 * k - 80.0 * number + 25.0 * lane
            if 20.0 < x < 280.0:
                found.append((100 * lane + number + 1, x, y))
    return rows(found)


def set_parameters(probe: Probe, **values: str) -> Any:
    request = SetParameters.Request()
    for name, value in values.items():
        kind = ParameterType.PARAMETER_STRING
        request.parameters.append(
            Parameter(name=name, value=ParameterValue(type=kind, string_value=value))
        )
    return probe.call("/site/sumo_bridge/set_parameters", SetParameters, request).results


def drive(
    nodes: Composition, net: Path, *, forecast: bool
) -> tuple[list[Any], list[dict[str, Any]]]:
    """The twin's rows of all frames, and the forecasts that came meanwhile."""
    node, probe, send = start(nodes, net, forecast_minutes=2.0)
    ear = Probe(nodes, "site", "ear")
    tracks = ear.listen_tables("twin/tracks", TRACK_DTYPE)
    told = ear.listen("twin/forecast", String)
    probe.until(lambda: node.twin.tracks.get_subscription_count() == 1, "a listener")
    for k in range(FRAMES):
        send(START_NS + k * STEP_NS, frame(k))
        if k == FRAMES - 20:
            probe.until(lambda: len(tracks) == FRAMES - 19, "the twin")
            if forecast:
                assert all(r.successful for r in set_parameters(probe, closed_lanes="bend_0"))
                answer = probe.call("/site/sumo_bridge/forecast", Trigger, Trigger.Request())
                assert answer.success, answer.message
                assert json.loads(answer.message)["changes"] == "bend_0 closed"
                second = probe.call("/site/sumo_bridge/forecast", Trigger, Trigger.Request())
                assert not second.success
                assert "one at a time" in second.message
    probe.until(lambda: len(tracks) == FRAMES, "the twin")
    if forecast:
        probe.until(lambda: len(told) == 1, "the forecast")
        assert node.forecaster.done == 1
    return tracks, [json.loads(message.data) for message in told]


def test_a_forecast_leaves_the_live_twin_as_it_is(net: Path) -> None:
    with Composition(quiet=True) as nodes:
        alone, _ = drive(nodes, net, forecast=False)
    with Composition(quiet=True) as nodes:
        beside, told = drive(nodes, net, forecast=True)
    for (stamp, _, a), (other_stamp, _, b) in zip(alone, beside, strict=True):
        assert stamp == other_stamp
        assert np.array_equal(a, b)
    as_it_is, changed = told[0]["forecasts"]
    flows = [
        {lane["lane"]: lane["flow_per_h"] for lane in one["lanes"]} for one in (as_it_is, changed)
    ]
    seen = told[0]["observed_flow_per_h"]["east"]
    assert seen == pytest.approx(3 * 3600 * 20.0 / 80.0, rel=0.1)
    # No vehicle was seen beyond the fork: three lanes lead into the bend, one to the ramp.
    bend = sum(flows[0][f"bend_{k}"] for k in range(3))
    assert bend + flows[0]["ramp_0"] == pytest.approx(seen, rel=0.2)
    assert 2.0 < bend / flows[0]["ramp_0"] < 4.5
    assert flows[0]["bend_0"] > 0.0
    assert flows[1]["bend_0"] == 0.0


def test_closures_and_limits_reach_sumo_and_come_off_again(nodes: Composition, net: Path) -> None:
    node, probe, send = start(nodes, net)
    ear = Probe(nodes, "site", "ear")
    told = ear.listen("twin/scenario", String)
    simulation = node.runner.simulation
    assert isinstance(simulation, SumoSimulation)
    lane, pieces = simulation.sumo.lane, simulation.running.pieces("bend")
    limit = lane.getMaxSpeed(f"{pieces[0]}_1")
    assert all(
        result.successful
        for result in set_parameters(probe, closed_lanes="bend_0", speed_limits="bend=36")
    )
    for piece in pieces:
        assert lane.getMaxSpeed(f"{piece}_1") == pytest.approx(10.0)
        assert "passenger" in lane.getDisallowed(f"{piece}_0")
        assert "passenger" not in lane.getDisallowed(f"{piece}_1")
    # Who is tracked goes on, closed or not.
    for k in range(5):
        send(START_NS + k * STEP_NS, rows([(1, 50.0 + 2.0 * k, LANE_Y[0])]))
    probe.until(lambda: node.runner.twin.steps == 5, "the frames")
    assert node.runner.twin.placement.lost == 0
    refused = set_parameters(probe, closed_lanes="nowhere_3")[0]
    assert not refused.successful
    assert "'nowhere_3'" in refused.reason
    assert all(r.successful for r in set_parameters(probe, closed_lanes="", speed_limits=""))
    assert lane.getMaxSpeed(f"{pieces[0]}_1") == pytest.approx(limit)
    assert "passenger" not in lane.getDisallowed(f"{pieces[0]}_0")
    ear.until(lambda: len(told) >= 4, "the scenarios")
    assert json.loads(told[-1].data) == {"closed_lanes": [], "speed_limits_kmh": {}}


def test_a_forecast_without_traffic_says_so(nodes: Composition, net: Path) -> None:
    _, probe, _ = start(nodes, net)
    answer = probe.call("/site/sumo_bridge/forecast", Trigger, Trigger.Request())
    assert not answer.success
    assert "too little traffic" in answer.message


def test_a_lane_that_is_not_there_stops_the_start(nodes: Composition, net: Path) -> None:
    with pytest.raises(GeoOrbitError, match="nowhere"):
        start(nodes, net, closed_lanes="nowhere")
