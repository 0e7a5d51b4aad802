"""Theta into a running lane_geometry; a server and its clients over real topics."""

import hashlib
import json
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_lanes import LANE_Y_M, START_NS, made_up_reference, made_up_tracks
from nav_msgs.msg import Path as PathMessage
from probe import LIMIT_S, LOSSLESS, Probe
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ByteMultiArray, MultiArrayDimension, String

from geoorbit_ros.conversions import (
    decode_byte_array,
    decode_path,
    encode_byte_array,
    encode_path,
    path_headings,
)
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.federated.errors import Refusal
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.payloads.lane_parameters import ThetaPayload
from geoorbit_ros.federated.rounds.client import LocalResult
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.learning import camera_session
from geoorbit_ros.learning.camera_session import LearningResult
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.nodes.federated_server import FederatedServerNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.meta_client import MetaClientNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED

CAMERAS = ("north", "south", "west")


def signer_of(name: str) -> Signer:
    return Signer(hashlib.sha256(name.encode()).digest(), "geoorbit")


def theta(values: dict[str, float], number: int = 1, camera_id: str = "north") -> bytes:
    payload = ThetaPayload(camera_id, 1, number, 7, values)
    return signer_of("north").seal(payload.unsigned())


def test_a_byte_array_is_the_ros_message() -> None:
    data = bytes(range(200))
    cdr = encode_byte_array(data)
    message = deserialize_message(cdr, ByteMultiArray)
    assert b"".join(message.data) == data
    assert decode_byte_array(cdr, "t") == decode_byte_array(serialize_message(message), "t") == data
    message.layout.dim = [MultiArrayDimension(label="abc", size=3, stride=4)] * 2
    message.layout.data_offset = 5
    assert decode_byte_array(serialize_message(message), "t") == data
    for bad in (b"", cdr[:9], cdr[:-1], cdr + bytes(4), b"\1" + cdr[1:]):
        with pytest.raises(MessageError, match="ByteMultiArray"):
            decode_byte_array(bad, "t")


@pytest.mark.parametrize("points", [0, 1, 7])
@pytest.mark.parametrize("frame", ["map", "", "local_map_8"])
def test_a_path_comes_back(points: int, frame: str) -> None:
    xy_m = np.random.default_rng(points).normal(size=(points, 2))
    cdr = encode_path(5, frame, xy_m, np.zeros(points))
    again = serialize_message(deserialize_message(cdr, PathMessage))
    for bytes_ in (cdr, again):
        found = decode_path(bytes_, "t")
        assert found[0] == frame
        np.testing.assert_array_equal(found[1], xy_m)
    for bad in (cdr[:-1], cdr[:9], b""):
        with pytest.raises(MessageError, match="Path"):
            decode_path(bad, "t")


def test_theta_changes_a_running_node_and_what_is_refused_changes_nothing(
    nodes: Composition,
) -> None:
    public = signer_of("north").public
    assert public is not None
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS | {"lane_parameters_key": public.hex()})
    probe = Probe(nodes)
    publisher = probe.publisher("lane_parameters", ByteMultiArray, LATCHED)

    def send(payload: bytes) -> None:
        before = node.diagnostics.received
        publisher.publish(encode_byte_array(payload))
        probe.until(lambda: node.diagnostics.received > before, "the payload")

    frames = made_up_tracks()
    tables = probe.table_publisher("tracks")
    tables(*frames[0])
    probe.until(lambda: node.frames == 1, "a frame")
    send(theta({"smoothing": 5.0, "width_scale": 1.5}, number=3))
    wanted = LaneParameters(5.0, 0.5, 1.5)
    assert node.theta == wanted
    for payload, reason in (
        (theta({"smoothing": 99.0}, 4), Refusal.OUT_OF_RANGE),
        (theta({"smoothing": float("nan")}, 4), Refusal.NOT_FINITE),
        (theta({"colour": 1.0}, 4), Refusal.SHAPE),
        (theta({"smoothing": 9.0}, 2), Refusal.OLD_ROUND),
        (theta({"smoothing": 9.0}, 4, "south"), Refusal.UNKNOWN_SENDER),
        (theta({"smoothing": 9.0}, 4)[:-1] + b"\0", Refusal.SIGNATURE),
        (b"anything", Refusal.FOREIGN),
    ):
        refused = node.diagnostics.refused
        send(payload)
        assert node.diagnostics.refused == refused + 1
        assert getattr(node.diagnostics.last_refusal, "reason", None) == reason
        assert node.theta == wanted
    for frame in frames[1:]:
        tables(*frame)
    probe.until(lambda: node.frames == len(frames), "all frames")
    assert node._latest is not None

    mapper = LaneMapper(make_estimator("curvilinear"), wanted, 5.0)
    maps = [m for stamp_ns, rows in frames if (m := mapper.add(stamp_ns, rows))]
    widths = [[lane.width_m for lane in found.lanes] for found in (maps[-1], node._latest)]
    assert widths[0] == widths[1]
    assert len(widths[0]) == len(LANE_Y_M)
    status = probe.status_of("/north/lane_geometry")
    assert (status["predictions"], status["theta_smoothing"]) == ("1", "5.0")


class AtOnce(Executor):
    """Runs where it is told to, so that a test needs no process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def learned(task: Any, _: str, tensors: Any, order: Any, _best: Any = None) -> LearningResult:
    """Local training that moves every head's bias, without any search for theta*."""
    gain = -0.5 if order.round > 1 else 0.0
    assert len(task.supervision) == len(LANE_Y_M)
    assert task.tracks.stamp_ns[0] == START_NS
    if not order.train:
        return LearningResult(LocalResult({}, 0, 2.0 / order.round, gain), None)
    delta = {name: np.zeros_like(value) for name, value in tensors.items()}
    delta["heads.bias"] += np.float32(0.1)
    return LearningResult(LocalResult(delta, 1, 2.0 / order.round, gain), np.zeros(3))


@pytest.mark.parametrize("masks", [False, True], ids=["plain", "masked"])
def test_cameras_learn_together_over_topics(
    nodes: Composition, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, masks: bool
) -> None:
    monkeypatch.setattr(camera_session, "learn_from_camera", learned)
    roster, server_key = tmp_path / "roster.txt", tmp_path / "server.key"
    lines = [f"{name} {(signer_of(name).public or b'').hex()}" for name in CAMERAS]
    roster.write_text("\n".join(lines))
    server_key.write_text(hashlib.sha256(b"server").hexdigest())
    server = nodes.make(
        FederatedServerNode,
        "/",
        {
            "roster": str(roster),
            "key_file": str(server_key),
            "checkpoint": str(tmp_path / "server.npz"),
            "rounds": 3,
            "encoding": "float32" if masks else "int8",
            "secure_aggregation": masks,
        },
    )
    clients = []
    for name in CAMERAS:
        key = tmp_path / f"{name}.key"
        key.write_text(hashlib.sha256(name.encode()).hexdigest())
        client = nodes.make(
            MetaClientNode,
            name,
            LOSSLESS
            | {
                "key_file": str(key),
                "server_key": (signer_of("server").public or b"").hex(),
                "observation_s": 4.0,
                "state_file": str(tmp_path / f"{name}.npz"),
            },
        )
        client.session._executor = AtOnce()
        clients.append(client)
    probes = [Probe(nodes, name, f"probe_{name}") for name in CAMERAS]
    heard = probes[0].listen("lane_parameters", ByteMultiArray)
    statuses = probes[0].listen("/federated/status", String)
    keep = []
    for probe in probes:
        for number, lane in made_up_reference().items():
            for role in ("centerline", "left", "right"):
                xy_m = getattr(lane, f"{role}_m")
                publisher = probe.node.create_publisher(
                    PathMessage, f"reference/lane_{number}/{role}", LATCHED
                )
                publisher.publish(encode_path(1, "map", xy_m, path_headings(xy_m)))
                keep.append(publisher)
        send = probe.table_publisher("tracks")
        for stamp_ns, rows in made_up_tracks(4.0):
            send(stamp_ns, rows)
    nodes.wait(lambda: all(c.client.finished for c in clients), LIMIT_S, "the end of training")

    assert [record.updates for record in server.server.history] == [3, 3, 3, 0]
    assert [record.approved for record in server.server.history] == [False, True, True, True]
    assert server.server.history[0].loss == pytest.approx(2.0, rel=1e-3)
    final = server.server.tensors
    start = MetaLearner.untrained(0).tensors()
    np.testing.assert_allclose(final["heads.bias"], start["heads.bias"] + 0.3, atol=1e-3)
    for client in clients:
        assert client.client.tensors is not None
        for name, value in server.server.published.items():
            np.testing.assert_array_equal(client.client.tensors[name], value)
        assert client.session.trained == 4  # the last time it only validated
        assert client.diagnostics.refused == 0, client.diagnostics.last_refusal
    assert server.diagnostics.refused == 0, server.diagnostics.last_refusal

    def newest() -> ThetaPayload:
        return ThetaPayload.decode(b"".join(heard[-1].data))

    final_model = clients[0].client.model_of[2]
    probes[0].until(lambda: bool(heard) and newest().model == final_model, "theta of the last one")
    probes[0].until(lambda: bool(statuses) and '"round": 4' in statuses[-1].data, "the status")
    last = newest()
    learner = MetaLearner.from_tensors(clients[0].client.tensors or {})
    features = clients[0].session._features
    assert features is not None
    predicted = learner.predict(features)
    assert last.values == pytest.approx(
        {name: getattr(predicted, name) for name in learner.parameter_names}
    )
    assert (last.camera_id, last.round, last.model) == ("north", 4, clients[0].client.used)
    first = ThetaPayload.decode(b"".join(heard[0].data))
    assert (first.model, first.values) == (
        0,
        asdict(LaneParameters()),
    )  # none validated yet
    assert json.loads(statuses[-1].data)["finished"] is True


def test_a_worker_that_fails_is_named_and_the_node_goes_on(
    nodes: Composition, tmp_path: Path
) -> None:
    class Broken(Executor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            future: Future[Any] = Future()
            future.set_exception(MemoryError("no room"))
            return future

    roster = tmp_path / "roster.txt"
    roster.write_text("north unsigned\n")
    nodes.make(FederatedServerNode, "/", {"roster": str(roster)})
    client = nodes.make(MetaClientNode, "north", LOSSLESS | {"observation_s": 1.0})
    client.session._executor = Broken()
    client.session.refer(made_up_reference(), -10.0)
    for stamp_ns, rows in made_up_tracks(1.0):
        client.session.add(stamp_ns, rows.astype(TRACK_DTYPE))
    nodes.wait(lambda: client.diagnostics.refused == 1, LIMIT_S, "the failure")
    assert "no room" in str(client.diagnostics.last_refusal)
    assert client.session.poll(0.0) is None


def test_work_that_a_killed_process_takes_with_it_is_done_once_more(
    nodes: Composition, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Killed(AtOnce):
        killed = 0

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            if self.killed:
                return super().submit(fn, *args, **kwargs)
            self.killed += 1
            future: Future[Any] = Future()
            future.set_exception(BrokenExecutor("ended by SIGKILL"))
            return future

    monkeypatch.setattr(camera_session, "learn_from_camera", learned)
    roster = tmp_path / "roster.txt"
    roster.write_text("north unsigned\n")
    server = nodes.make(FederatedServerNode, "/", {"roster": str(roster), "rounds": 2})
    client = nodes.make(MetaClientNode, "north", LOSSLESS | {"observation_s": 1.0})
    client.session._executor = Killed()
    client.session.refer(made_up_reference(), -10.0)
    for stamp_ns, rows in made_up_tracks(1.0):
        client.session.add(stamp_ns, rows.astype(TRACK_DTYPE))
    nodes.wait(lambda: server.server.round > 1, LIMIT_S, "a round")
    assert client.diagnostics.refused == 1
    assert "a process that was killed" in str(client.diagnostics.last_refusal)


def test_a_mistake_of_the_strategy_stops_training_and_is_reported_with_its_line(
    nodes: Composition, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(camera_session, "learn_from_camera", learned)
    own, roster = tmp_path / "own.py", tmp_path / "roster.txt"
    own.write_text(
        "from geoorbit_ros.federated.strategies.strategy import Strategy\n"
        "class Own(Strategy):\n    def step(self, aggregate):\n        return aggregate[1:]\n"
    )
    roster.write_text("north unsigned\n")
    given = {"roster": str(roster), "rounds": 2, "strategy": f"{own}:Own"}
    server = nodes.make(FederatedServerNode, "/", given)
    client = nodes.make(MetaClientNode, "north", LOSSLESS | {"observation_s": 1.0})
    client.session._executor = AtOnce()
    client.session.refer(made_up_reference(), -10.0)
    for stamp_ns, rows in made_up_tracks(1.0):
        client.session.add(stamp_ns, rows.astype(TRACK_DTYPE))
    nodes.wait(lambda: bool(server._fault), LIMIT_S, "the fault")
    assert f"training stopped: {own}, line 3, Own.step: found an array of shape" in server._fault
    assert [check() for check in server.diagnostics._checks] == [server._fault]
    assert (server.server.round, len(server.server.history)) == (1, 0)  # nothing is half done
