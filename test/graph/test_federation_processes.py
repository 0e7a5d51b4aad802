"""A federation of real processes: kill -9 of server and client in mid-round changes nothing."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from made_up_lanes import made_up_reference, made_up_tracks
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import encode_path, encode_table, path_headings
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.federated.camera_learning import learn_from_camera
from geoorbit_ros.federated.camera_session import INTERFACE
from geoorbit_ros.federated.client import FederatedClient, Work
from geoorbit_ros.federated.encodings.factory import make_encoding
from geoorbit_ros.federated.in_process import run_in_process
from geoorbit_ros.federated.keys import Roster, Signer
from geoorbit_ros.federated.ledger import Ledger
from geoorbit_ros.federated.server import FederatedServer
from geoorbit_ros.federated.server_config import ServerConfig
from geoorbit_ros.federated.server_state import ServerState, read_checkpoint
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.features import scene_features
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.nodes.composition import Composition
from geoorbit_ros.nodes.latched import LATCHED
from geoorbit_ros.nodes.table_stream import stream_qos

REPOSITORY = Path(__file__).parents[2]
CAMERAS = ("north", "south")
ROUNDS, OBSERVATION_S, ESTIMATOR = 3, 4.0, "geolane"
LIMIT_S = 90.0
CONFIG = ServerConfig(rounds=ROUNDS, encoding="top_k", interface=INTERFACE)


def private_key(name: str) -> bytes:
    return hashlib.sha256(name.encode()).digest()


def public_key(name: str) -> str:
    return (Signer(private_key(name), "geoorbit").public or b"").hex()


def frames_of(camera: str) -> list[tuple[int, Any]]:
    """What each camera sees; the second one has seen less."""
    frames = made_up_tracks(OBSERVATION_S)
    return frames if camera == "north" else [(stamp, rows[1:]) for stamp, rows in frames]


class Processes:
    """Node processes that can be killed, and a node of the test that feeds and watches them."""

    def __init__(self, nodes: Composition, folder: Path) -> None:
        self.nodes, self.folder = nodes, folder
        self.node = nodes.add(Node("feeder", context=nodes.context))
        self.status: dict[str, dict[str, str]] = {}
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, 100)
        self.tables = {
            name: self.node.create_publisher(
                PointCloud2, f"/{name}/tracks", stream_qos("reliable", 0)
            )
            for name in CAMERAS
        }
        self._paths = []
        for name in CAMERAS:
            for number, lane in made_up_reference().items():
                for role in ("centerline", "left", "right"):
                    topic = f"/{name}/reference/lane_{number}/{role}"
                    publisher = self.node.create_publisher(PathMessage, topic, LATCHED)
                    xy_m = getattr(lane, f"{role}_m")
                    publisher.publish(encode_path(1, "map", xy_m, path_headings(xy_m)))
                    self._paths.append(publisher)

    def _on_status(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.status[status.name] = {pair.key: pair.value for pair in status.values}

    def start(self, executable: str, namespace: str, **parameters: object) -> None:
        words = [sys.executable, "-m", f"geoorbit_ros.nodes.{executable}", "--ros-args"]
        words += ["-r", f"__ns:=/{namespace}"]
        for key, value in parameters.items():
            words += ["-p", f"{key}:={value}"]
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(self.nodes.domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONPATH": str(REPOSITORY),
            "OMP_NUM_THREADS": "1",
        }
        name = namespace or executable
        self.status.pop(f"/{namespace}/{executable}".replace("//", "/"), None)
        with (self.folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                words, env=environment, stdout=log, stderr=subprocess.STDOUT
            )

    def start_server(self) -> None:
        self.start(
            "federated_server",
            "",
            roster=self.folder / "roster.txt",
            key_file=self.folder / "server.key",
            checkpoint=self.folder / "server.npz",
            rounds=ROUNDS,
            encoding=CONFIG.encoding,
        )

    def start_client(self, name: str) -> None:
        self.start(
            "meta_client",
            name,
            key_file=self.folder / f"{name}.key",
            server_key=public_key("server"),
            state_file=self.folder / f"{name}.npz",
            estimator=ESTIMATOR,
            observation_s=OBSERVATION_S,
            encoding=CONFIG.encoding,
            reliability="reliable",
            queue_depth=0,
        )

    def feed(self, name: str) -> None:
        """Show a camera its observation, once it listens."""
        self.until(lambda: self.value(name, "round") not in ("", "0"), f"{name} with a model")
        for stamp_ns, rows in frames_of(name):
            self.tables[name].publish(encode_table(stamp_ns, "map", rows))

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        process.kill()
        process.wait(10.0)
        self.until(
            lambda: not any(Path(f"/proc/{child}").exists() for child in children),
            f"the end of what {name} had started",
        )

    def value(self, name: str, key: str) -> str:
        path = f"/{name}/meta_client" if name in CAMERAS else f"/{name}"
        return self.status.get(path, {}).get(key, "")

    def until(self, met: Callable[[], Any], what: str) -> None:
        def alive() -> bool:
            for name, process in self.running.items():
                log = self.folder / f"{name}.log"
                assert process.poll() is None, f"{name} died: {log.read_text()}"
            return bool(met())

        self.nodes.wait(alive, LIMIT_S, what)

    def checkpoint(self) -> ServerState | None:
        layout = FederatedServer(
            CONFIG, MetaLearner.untrained(0).tensors(), Roster.read(self.folder / "roster.txt")
        ).layout
        return read_checkpoint(self.folder / "server.npz", layout, Ledger(()))


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    lines = [f"{name} {public_key(name)}" for name in CAMERAS]
    (tmp_path / "roster.txt").write_text("\n".join(lines))
    for name in (*CAMERAS, "server"):
        (tmp_path / f"{name}.key").write_text(private_key(name).hex())
    with Composition(quiet=True) as nodes:
        processes = Processes(nodes, tmp_path)
        yield processes
        for name in list(processes.running):
            processes.kill(name)


def uninterrupted(roster: Roster) -> ServerState:
    """The same federation in this process, without anybody killed."""
    server = FederatedServer(
        CONFIG,
        MetaLearner.untrained(0).tensors(),
        roster,
        signer=Signer(private_key("server"), "geoorbit"),
    )
    clients = [
        FederatedClient(
            name,
            encoding=make_encoding(CONFIG.encoding),
            signer=Signer(private_key(name), "geoorbit"),
        )
        for name in CAMERAS
    ]
    best: dict[str, Any] = {}

    def train(asked: Any) -> Iterator[Any]:
        client: FederatedClient
        work: Work
        for client, work in asked:
            frames = frames_of(client.camera_id)
            offset = np.cumsum([0, *(len(rows) for _, rows in frames)])
            stamps = np.array([stamp for stamp, _ in frames])
            tracks = Frames(stamps, offset, np.concatenate([rows for _, rows in frames]))
            lanes = tuple(made_up_reference().values())
            task = CameraTask(
                client.camera_id, tracks, scene_features(tracks), lanes, lanes, surveyed=False
            )
            known = best.get(client.camera_id)
            lesson = learn_from_camera(task, ESTIMATOR, work.tensors, work.order, known)
            best[client.camera_id] = lesson.best_theta
            yield lesson.result

    run_in_process(server, clients, train)
    return server._state


@pytest.mark.slow
def test_kill_9_in_mid_round_changes_no_bit_of_the_final_model(processes: Processes) -> None:
    for name in CAMERAS:
        processes.start_client(name)
    processes.start_server()
    # One update is in, the other client has no observation yet: kill the server.
    processes.feed("north")
    processes.until(lambda: processes.value("federated_server", "collected") == "1", "one update")
    processes.kill("federated_server")
    processes.start_server()
    processes.until(lambda: processes.value("federated_server", "collected") == "1", "it again")
    # The other one is killed while it trains.
    processes.feed("south")
    processes.until(lambda: processes.value("south", "observations") == "1", "south at work")
    assert processes.value("south", "trained") == "0"
    processes.kill("south")
    processes.start_client("south")
    processes.feed("south")

    def finished() -> bool:
        state = processes.checkpoint()
        return state is not None and state.finished

    processes.until(finished, "the end of training")
    state = processes.checkpoint()
    assert state is not None
    assert [record.updates for record in state.history] == [len(CAMERAS)] * ROUNDS
    expected = uninterrupted(Roster.read(processes.folder / "roster.txt"))
    # The digest holds when the federation began; the weights must be the same to the bit.
    assert state.published.tobytes() == expected.published.tobytes()
    assert state.model.tobytes() == expected.model.tobytes()
    losses = [[record.loss for record in s.history] for s in (state, expected)]
    assert losses[0] == losses[1]
    for log in processes.folder.glob("*.log"):
        assert "Traceback" not in log.read_text(), log.name
