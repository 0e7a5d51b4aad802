"""The bridge compares lanes with its network; what it finds reaches people and the lane mapper."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from made_detections import detected, lane
from made_twin import DATUM, START_NS, STEP_NS, made_network, rows
from probe import LOSSLESS, Probe
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import String

from geoorbit_ros.conversions import datum_to_fix, movement_message, movement_of
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.sumo_bridge.node import SumoBridgeNode
from geoorbit_ros.nodes.sumo_bridge.reference_publisher import publish_lanes
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.support.reference_listener import PriorListener
from geoorbit_ros.roadnet.network import load_network

SHIFT = np.array([0.5, -1.2])
"""What the camera's map frame is off by."""


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


@pytest.fixture(scope="module")
def lanes(net: Path) -> list[Lane]:
    found = detected(load_network(net, DATUM))
    return [replace(each, centerline_m=each.centerline_m + SHIFT) for each in found]


def geojson(lanes: list[Lane], stamp_s: float) -> String:
    return String(data=dumps_lanes(LaneMap(round(stamp_s * 1e9), tuple(lanes)), DATUM))


def test_findings_and_alignment_are_published_and_move_the_tracks(
    nodes: Composition, net: Path, lanes: list[Lane]
) -> None:
    given = LOSSLESS | {"network": str(net), "cameras": "north"}
    node = nodes.make(SumoBridgeNode, "site", given)
    ear = Probe(nodes, "site", "ear")
    found = ear.listen("twin/map", DiagnosticArray)
    moves = ear.listen("north/reference/alignment", PoseWithCovarianceStamped)
    table = ear.listen_tables("twin/tracks", TRACK_DTYPE)
    ear.publisher("north/datum", NavSatFix, LATCHED).publish(datum_to_fix(DATUM, "map"))
    ear.until(lambda: len(node.known) == 1, "the datum")
    speak = ear.publisher("north/lanes/geojson", String, LATCHED)
    missing = [each for each in lanes if each.lane_id != 4]  # no finding: nothing drives there
    extra = lane(9, lanes[2].centerline_m + np.array([0.0, 3.5]))  # which the map lacks
    speak.publish(String(data="{"))
    ear.until(lambda: node.diagnostics.refused == 1, "a refusal")
    speak.publish(geojson([*missing, extra], 10.0))
    ear.until(lambda: bool(found and moves), "findings and alignment")
    status = found[-1].status[0]
    assert (status.name, status.level) == ("map as seen by north", DiagnosticStatus.WARN)
    text = " ".join(pair.value for pair in status.values)
    assert "lane 9 (20 vehicles) is not in the map, beside east_2" in text
    shift, turn_rad, covariance = movement_of(moves[-1], "test")
    assert shift == pytest.approx(-SHIFT, abs=0.3)
    assert abs(turn_rad) < 0.01
    assert covariance[1, 1] < 0.05
    size_m = float(str(node.map.diagnostic_values()["aligned_north_m"]))
    assert size_m == pytest.approx(np.hypot(*SHIFT), abs=0.2)
    # The tracks follow: one beside its lane by the camera's error is in its middle.
    ear.until(lambda: node.twin.tracks.get_subscription_count() == 1, "a listener")
    send = ear.table_publisher("north/tracks")
    for k in range(3):
        send(START_NS + k * STEP_NS, rows([(1, 250.0 + 2.0 * k, -5.25 + SHIFT[1])]))
    ear.until(lambda: len(table) >= 2, "the twin")
    assert table[-1][2]["y"][0] == pytest.approx(-5.25, abs=0.2)
    # A right map, but too early after the last look; then late enough.
    speak.publish(geojson(lanes, 20.0))
    speak.publish(geojson(lanes, 45.0))
    ear.until(lambda: "lane 9" not in str(found[-1].status[0].values), "the next look")


def test_sparse_lanes_take_the_word_of_a_map_that_is_right(
    nodes: Composition, net: Path, lanes: list[Lane]
) -> None:
    probe = Probe(nodes, "north")
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS | {"map_prior": False})
    listener = PriorListener(node)
    sparse = replace(lanes[1], status="tentative", sigma_m=0.6)
    sparse = replace(sparse, centerline_m=sparse.centerline_m + np.array([0.0, 0.7]))
    seen = LaneMap(0, (lanes[0], sparse, lanes[2]))
    assert listener.refine(seen) is seen  # nothing has been heard
    network = load_network(net, DATUM)
    references = detected(network, noise_m=0.0)
    kept = publish_lanes(node, "", "map", references[:3])
    speak = probe.publisher("reference/alignment", PoseWithCovarianceStamped, LATCHED)
    speak.publish(movement_message("map", -SHIFT[0], -SHIFT[1], 0.0, np.eye(3)))
    probe.until(lambda: listener.prior is not None and len(listener.prior.lanes) == 3, "a prior")
    refined = listener.refine(seen)
    assert refined.lanes[0] is lanes[0]
    error = refined.lanes[1].centerline_m - lanes[1].centerline_m
    assert np.abs(error[5:-5, 1]).max() < 0.25
    assert refined.lanes[1].status == "tentative"
    assert kept
