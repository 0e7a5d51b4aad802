"""What one node of a process meets does not reach the others; rubbish leaves no memory behind."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

import pytest
from probe import LIMIT_S, LOSSLESS, Probe
from rclpy.node import Node
from std_msgs.msg import ByteMultiArray

from geoorbit_ros.conversions import decode_byte_array, encode_byte_array
from geoorbit_ros.core.errors import GeoOrbitError, InputFileError
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.nodes.federated_server import FederatedServerNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.meta_client import MetaClientNode
from geoorbit_ros.nodes.support import byte_topic
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.diagnostics import StatusListener
from geoorbit_ros.nodes.support.fleet_process import AbsentNode, made_or_absent
from geoorbit_ros.nodes.support.qos import updates_qos


def fails(error: Exception) -> Any:
    def callback(*_: object) -> None:
        raise error

    return callback


def roster_in(folder: Path) -> str:
    (folder / "roster.txt").write_text("north unsigned\nsouth unsigned\n")
    return str(folder / "roster.txt")


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), ValueError("x"), MemoryError()]
)
def test_whatever_fails_in_learning_its_camera_goes_on(
    nodes: Composition, error: Exception
) -> None:
    client = nodes.make(MetaClientNode, "north", LOSSLESS)
    client.create_timer(0.01, fails(error))
    nodes.wait(lambda: client.diagnostics.refused > 1, LIMIT_S, "two refusals")
    told = str(client.diagnostics.last_refusal)
    assert "\n" not in told
    assert "No space left" in told or type(error).__name__ in told


def test_a_full_disk_ends_no_node_and_a_mistake_ends_one_that_sees(nodes: Composition) -> None:
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS)
    timer = node.create_timer(0.01, fails(OSError(errno.ENOSPC, "No space left on device")))
    nodes.wait(lambda: node.diagnostics.refused > 0, LIMIT_S, "a refusal")
    node.destroy_timer(timer)
    node.create_timer(0.01, fails(ValueError("a mistake")))
    with pytest.raises(ValueError, match="a mistake"):
        nodes.wait(lambda: False, LIMIT_S, "the mistake")


def test_a_client_that_can_not_start_is_told_and_its_camera_starts(
    nodes: Composition, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Node, "__init__", _in_context(Node.__init__, nodes))
    given = {"key_file": str(tmp_path / "none.key")}
    node = made_or_absent(MetaClientNode, "north", given)
    assert isinstance(node, AbsentNode)
    nodes.add(node)
    listener = nodes.add(StatusListener(nodes.context))
    nodes.wait(lambda: bool(listener.reports()), LIMIT_S, "its report")
    (report,) = listener.reports()
    assert (report.name, report.ok) == ("/north/meta_client", False)
    assert "does not run" in report.message
    assert "none.key" in report.message
    with pytest.raises(GeoOrbitError):
        made_or_absent(LaneGeometryNode, "north", {"update_period_s": -1.0})


def _in_context(real: Any, nodes: Composition) -> Any:
    def made(self: Any, *given: Any, **named: Any) -> None:
        real(self, *given, **(named | {"context": nodes.context}))

    return made


def test_a_damaged_state_is_set_aside_and_the_client_starts(
    nodes: Composition, tmp_path: Path
) -> None:
    state = tmp_path / "north.npz"
    state.write_bytes(b"damage")
    client = nodes.make(MetaClientNode, "north", LOSSLESS | {"state_file": str(state)})
    assert "north.npz.damaged" in client.client.notes[0]
    assert not state.exists()


def test_a_server_on_a_full_disk_says_so_until_there_is_room(
    nodes: Composition, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = nodes.make(
        FederatedServerNode,
        "/",
        {"roster": roster_in(tmp_path), "checkpoint": str(tmp_path / "s.npz"), "deadline_s": 0.1},
    )
    monkeypatch.setattr("geoorbit_ros.federated.rounds.server.RETRY_S", 0.2)

    def full(self: StateFile, _: bytes, *, sync: bool = True) -> None:
        del sync
        raise InputFileError(str(self.path), "No space left on device", "room")

    outcome = server.server._round.outcome()
    with monkeypatch.context() as patched:
        patched.setattr(StateFile, "write", full)
        assert server.server._close(outcome, time.monotonic()) is None
        (told,) = [k for check in server.diagnostics._checks if (k := check())]
        assert "No space left" in told
    nodes.wait(lambda: server.server.round == 2, LIMIT_S, "the next round")
    assert not any(check() for check in server.diagnostics._checks)


def test_payloads_that_are_too_long_are_not_read_and_the_topic_comes_back(
    nodes: Composition, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []

    def seen(cdr: bytes, place: str) -> bytes:
        read.append(len(cdr))
        return decode_byte_array(cdr, place)

    monkeypatch.setattr(byte_topic, "decode_byte_array", seen)
    monkeypatch.setattr(byte_topic, "RUBBISH_BYTES", 400_000)
    server = nodes.make(FederatedServerNode, "/", {"roster": roster_in(tmp_path)})
    probe = Probe(nodes)
    topic = "/federated/client_update"
    publisher = probe.publisher(topic, ByteMultiArray, updates_qos())
    probe.until(lambda: publisher.get_subscription_count() == 1, "the server")
    for _ in range(4):
        publisher.publish(encode_byte_array(bytes(110_000)))
    probe.until(lambda: server.diagnostics.refused == 4, "four refusals")
    assert not read
    assert "110" in str(server.diagnostics.last_refusal)
    probe.until(lambda: publisher.get_subscription_count() == 0, "its leaving")
    probe.until(lambda: publisher.get_subscription_count() == 1, "its coming back")
    publisher.publish(encode_byte_array(b"short"))
    probe.until(lambda: server.diagnostics.refused == 5, "one more")
    assert len(read) == 1
