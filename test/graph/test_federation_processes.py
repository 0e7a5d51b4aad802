"""A federation of real processes: killed with -9 it learns the same; models by multicast."""

import hashlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from camera_host import lesson

from geoorbit_ros.core.resources import share_path
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.encodings.encoding import make_encoding
from geoorbit_ros.federated.keys import Roster, Signer
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.in_process import run_in_process
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import KIND, Answers, ServerState, read_checkpoint
from geoorbit_ros.learning.camera_session import INTERFACE
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.nodes.support.composition import DomainClaim

REPOSITORY = Path(__file__).parents[2]
CAMERAS = ("north", "south")
ROUNDS = 3
LIMIT_S = 180.0
CONFIG = ServerConfig(rounds=ROUNDS, encoding="top_k", interface=INTERFACE, validation_divisor=1)


def signer_of(name: str) -> Signer:
    return Signer(hashlib.sha256(name.encode()).digest(), "geoorbit")


def until(met: Callable[[], Any], what: str) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not met():
        assert time.monotonic() < deadline, f"no {what} in {LIMIT_S:g} s"
        time.sleep(0.05)


class Processes:
    """Server and cameras, each of which can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._claim = DomainClaim()
        self._environment = os.environ | {
            "ROS_DOMAIN_ID": str(self._claim.domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONPATH": str(REPOSITORY),
            "OMP_NUM_THREADS": "1",
        }

    def start(self, name: str, **variables: str) -> None:
        words = [str(self.folder / f"{name}.key")]
        if name == "server":
            words = ["-m", "geoorbit_ros.nodes.federated_server", "--ros-args"]
            for key, value in {
                "roster": self.folder / "roster.txt",
                "key_file": self.folder / "server.key",
                "checkpoint": self.folder / "server.npz",
                "rounds": ROUNDS,
                "encoding": CONFIG.encoding,
            }.items():
                words += ["-p", f"{key}:={value}"]
        else:
            script = str(Path(__file__).with_name("camera_host.py"))
            public = (signer_of("server").public or b"").hex()
            words = [script, name, *words, public, str(self.folder), CONFIG.encoding]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, *words],
                env=self._environment | variables,
                stdout=log,
                stderr=log,
            )

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait(LIMIT_S)

    def close(self) -> None:
        for name in list(self.running):
            self.kill(name)
        self._claim.close()

    def learning(self, name: str, stage: int) -> bool:
        """Whether a camera is at work on a round, or on judging the last model."""
        assert self.running[name].poll() is None, (self.folder / f"{name}.log").read_text()
        path = self.folder / f"{name}.learning"
        return path.exists() and path.read_text() == str(stage)

    def all_learning(self, stage: int) -> None:
        until(lambda: all(self.learning(name, stage) for name in CAMERAS), f"work on round {stage}")

    def go(self, name: str, stage: int) -> None:
        """Let a camera end its work on this round."""
        (self.folder / f"{name}.go").write_text(str(stage))

    def again(self, *names: str) -> None:
        """Kill -9 all of these, then start them."""
        for name in names:
            self.kill(name)
            (self.folder / f"{name}.learning").unlink(missing_ok=True)
        for name in names:
            self.start(name)

    def state(self) -> ServerState | None:
        path = self.folder / "server.npz"
        layout = new_server(Roster.read(self.folder / "roster.txt")).layout
        return read_checkpoint(StateFile(path, KIND), layout, Answers(()))


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    lines = [f"{name} {(signer_of(name).public or b'').hex()}" for name in CAMERAS]
    (tmp_path / "roster.txt").write_text("\n".join(lines))
    for name in (*CAMERAS, "server"):
        (tmp_path / f"{name}.key").write_text(hashlib.sha256(name.encode()).hexdigest())
    processes = Processes(tmp_path)
    yield processes
    processes.close()


def new_server(roster: Roster) -> FederatedServer:
    tensors = MetaLearner.untrained(0).tensors()
    return FederatedServer(CONFIG, tensors, roster, signer=signer_of("server"))


def uninterrupted(roster: Roster) -> ServerState:
    """The same federation in this process, without anybody killed."""
    server = new_server(roster)
    clients = [
        FederatedClient(name, encoding=make_encoding(CONFIG.encoding), signer=signer_of(name))
        for name in CAMERAS
    ]
    run_in_process(
        server,
        clients,
        lambda asked: [lesson(c.camera_id, w.tensors, w.order) for c, w in asked],
    )
    return server._state


def test_kill_9_in_mid_round_changes_no_bit_of_the_final_model(processes: Processes) -> None:
    for name in CAMERAS:
        processes.go(name, 0)
    for name in ("server", *CAMERAS):
        processes.start(name)
    processes.all_learning(1)
    # North's update is made and kept; the server, which may have it or not, is killed, and south
    # while it trains.
    processes.go("north", 1)
    until((processes.folder / "north.npz").exists, "update of north")
    processes.again("server", "south")
    until(lambda: processes.learning("south", 1), "training of south again")
    processes.go("south", 1)
    # Both cameras while they train; the server, which waits, stays.
    processes.all_learning(2)
    processes.again(*CAMERAS)
    processes.all_learning(2)
    for name in CAMERAS:
        processes.go(name, 2)
    # The server while both train.
    processes.all_learning(3)
    processes.again("server")
    for name in CAMERAS:
        processes.go(name, 3)
    # Every client while the last model is validated.
    processes.all_learning(ROUNDS + 1)
    processes.again("server", *CAMERAS)
    processes.all_learning(ROUNDS + 1)
    for name in CAMERAS:
        processes.go(name, ROUNDS + 1)

    for name in CAMERAS:
        status = processes.running[name].wait(LIMIT_S)
        assert status == 0, (processes.folder / f"{name}.log").read_text()
    state = processes.state()
    assert state is not None
    assert state.finished
    # The last entry is the verdict on the final model, which no client trains on.
    assert [record.updates for record in state.history] == [*[len(CAMERAS)] * ROUNDS, 0]
    expected = uninterrupted(Roster.read(processes.folder / "roster.txt"))
    assert state.model.tobytes() == expected.model.tobytes()
    assert state.published.tobytes() == expected.published.tobytes()
    for found in (state, expected):
        assert found.approved == found.digests[ROUNDS + 1]
    told = [[replace(r, seconds=0.0) for r in s.history[:ROUNDS]] for s in (state, expected)]
    assert told[0] == told[1]
    for log in processes.folder.glob("*.log"):
        assert "Traceback" not in log.read_text(), log.name


@pytest.fixture
def group() -> Iterator[socket.socket]:
    """A bystander in the multicast group of params/dds/multicast.xml."""
    locator = "{http://www.eprosima.com}"
    root = ElementTree.parse(share_path("params/dds/multicast.xml"))
    address, port = (root.findtext(f".//{locator}{name}") for name in ("address", "port"))
    assert address
    assert port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bystander:
        bystander.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bystander.bind((address, int(port)))
        for interface in ("127.0.0.1", "0.0.0.0"):
            member = socket.inet_aton(address) + socket.inet_aton(interface)
            bystander.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        bystander.setblocking(False)
        yield bystander


def test_models_go_to_the_multicast_group_of_the_profile(
    processes: Processes, group: socket.socket
) -> None:
    profile = str(share_path("params/dds/multicast.xml"))
    processes.start("server")
    for name in CAMERAS:
        processes.start(name, FASTRTPS_DEFAULT_PROFILES_FILE=profile)
    for name in CAMERAS:
        status = processes.running[name].wait(LIMIT_S)
        assert status == 0, (processes.folder / f"{name}.log").read_text()
    state = processes.state()
    assert state is not None
    assert [record.updates for record in state.history] == [*[len(CAMERAS)] * ROUNDS, 0]
    for log in processes.folder.glob("*.log"):
        assert "XMLPARSER" not in log.read_text(), log.read_text()
    heard = set()
    with suppress(BlockingIOError):
        while True:
            heard.add(group.recv(1 << 16))
    # One change of the model per round and one after the last; the same packet for both cameras.
    assert len([packet for packet in heard if b"delta\0" in packet]) >= ROUNDS


_PARENT = """
import time
from os import getpid
from geoorbit_ros.learning.processes import BackgroundProcess
if __name__ == "__main__":
    training = BackgroundProcess()
    print(training.submit(getpid).result(), flush=True)
    time.sleep(100)
"""


def test_a_training_process_ends_with_the_node_that_started_it(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    parent = subprocess.Popen(
        [sys.executable, str(script)], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    assert Path(f"/proc/{worker}").exists()
    parent.kill()
    parent.wait(LIMIT_S)
    parent.stdout.close()

    def gone() -> bool:
        status = Path(f"/proc/{worker}/stat")
        return not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z"

    until(gone, "end of the worker")
