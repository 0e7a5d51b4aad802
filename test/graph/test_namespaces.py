"""Cameras and server on three hosts, which network namespaces stand in for.

Each camera has a link to the server's host alone, and no link carries multicast: what finds whom
is the Fast DDS discovery server of docs/guide-several-hosts.md.
"""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.keys import Roster, Signer
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import KIND, Answers, read_checkpoint
from geoorbit_ros.learning.camera_session import INTERFACE
from geoorbit_ros.learning.meta_learner import MetaLearner

REPOSITORY = Path(__file__).parents[2]
CAMERAS = ("north", "south")
ROUNDS, PORT, LIMIT_S = 2, 11811, 240.0
PREFIX = f"go{os.getpid() % 10_000}"
HUB = f"{PREFIX}h"


def ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")


def address(camera: str, end: int) -> str:
    """End 1 is the server's host, end 2 the camera's."""
    return f"10.213.{CAMERAS.index(camera) + 1}.{end}"


@pytest.fixture
def hosts() -> Iterator[dict[str, str]]:
    """Namespaces by host: the server's and one per camera."""
    if shutil.which("ip") is None:
        pytest.skip("no `ip` command: install iproute2")
    names = {"server": HUB, **{c: f"{PREFIX}{k}" for k, c in enumerate(CAMERAS)}}
    try:
        try:
            for name in names.values():
                ip("netns", "add", name)
                ip("-n", name, "link", "set", "lo", "up")
        except OSError as error:
            pytest.skip(f"network namespaces are not allowed here ({error})")
        for k, camera in enumerate(CAMERAS):
            ends = [(f"{PREFIX}v{k}", HUB, 1), (f"{PREFIX}w{k}", names[camera], 2)]
            ip("link", "add", ends[0][0], "type", "veth", "peer", "name", ends[1][0])
            for device, name, end in ends:
                ip("link", "set", device, "netns", name)
                ip("-n", name, "link", "set", "dev", device, "multicast", "off")
                ip("-n", name, "addr", "add", f"{address(camera, end)}/24", "dev", device)
                ip("-n", name, "link", "set", device, "up")
        yield names
    finally:
        for name in names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True, timeout=60)


class Running:
    """Processes on hosts."""

    def __init__(self, hosts: dict[str, str], folder: Path) -> None:
        self._hosts, self._folder = hosts, folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, host: str, name: str, *words: str, **environment: str) -> None:
        values = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"} | environment
        # Shared memory would connect what no network does: all hosts are one machine here.
        values |= {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
        with (self._folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                ["ip", "netns", "exec", self._hosts[host], *words],
                env=values,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()

    def stop(self) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGKILL)
            process.wait(LIMIT_S)


@pytest.fixture
def running(hosts: dict[str, str], tmp_path: Path) -> Iterator[Running]:
    running = Running(hosts, tmp_path)
    yield running
    running.stop()


def signer_of(name: str) -> Signer:
    return Signer(hashlib.sha256(name.encode()).digest(), "geoorbit")


def test_cameras_on_hosts_of_their_own_train_with_a_server_on_a_third(
    running: Running, tmp_path: Path
) -> None:
    program = Path(sys.prefix) / "bin" / "fast-discovery-server"
    if not program.exists():
        pytest.skip("no fast-discovery-server beside this Python")
    for name in (*CAMERAS, "server"):
        (tmp_path / f"{name}.key").write_text(hashlib.sha256(name.encode()).hexdigest())
    lines = [f"{name} {(signer_of(name).public or b'').hex()}" for name in CAMERAS]
    (tmp_path / "roster.txt").write_text("\n".join(lines))

    listen = [word for c in CAMERAS for word in ("-l", address(c, 1), "-p", str(PORT))]
    running.start("server", "discovery", str(program), "-i", "0", *listen)
    words = [sys.executable, "-m", "geoorbit_ros.nodes.federated_server", "--ros-args"]
    for key, value in {
        "roster": tmp_path / "roster.txt",
        "key_file": tmp_path / "server.key",
        "checkpoint": tmp_path / "server.npz",
        "rounds": ROUNDS,
        "encoding": "top_k",
    }.items():
        words += ["-p", f"{key}:={value}"]
    at_home = f"{address(CAMERAS[0], 1)}:{PORT}"
    running.start("server", "server", *words, ROS_DISCOVERY_SERVER=at_home)
    script = str(Path(__file__).with_name("camera_host.py"))
    public = (signer_of("server").public or b"").hex()
    for camera in CAMERAS:
        key = str(tmp_path / f"{camera}.key")
        meeting = f"{address(camera, 1)}:{PORT}"
        running.start(
            camera,
            camera,
            sys.executable,
            script,
            camera,
            key,
            public,
            str(tmp_path),
            ROS_DISCOVERY_SERVER=meeting,
        )

    deadline = time.monotonic() + LIMIT_S
    for camera in CAMERAS:
        status = running.processes[camera].wait(max(1.0, deadline - time.monotonic()))
        assert status == 0, running.log(camera) + running.log("server") + running.log("discovery")
    config = ServerConfig(rounds=ROUNDS, encoding="top_k", interface=INTERFACE)
    tensors = MetaLearner.untrained(0).tensors()
    server = FederatedServer(config, tensors, Roster.read(tmp_path / "roster.txt"))
    state = read_checkpoint(StateFile(tmp_path / "server.npz", KIND), server.layout, Answers(()))
    assert state is not None
    assert state.finished
    assert [record.updates for record in state.history] == [*[len(CAMERAS)] * ROUNDS, 0]
    assert state.approved == state.digests[ROUNDS + 1]
