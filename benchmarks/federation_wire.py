"""What a federation of four cameras and twenty rounds costs on the wire, headers included.

Server and cameras are real nodes, each in a network namespace of its own, on one Ethernet link.
Every frame at the server's network card is counted: the parameter topics' data, heartbeats and
acknowledgements with their RTPS, UDP and IP headers; discovery; the rest. The learning is made up
(updates are random, the worst case for top-k), messages, signatures and rounds are the real ones.

Fast DDS sends heartbeats every three seconds while something is not acknowledged: in faster rounds
one stands for several messages and the bill is smaller, in slower ones it is the same. So a round
takes six. The heartbeats of params/dds/thrifty.xml are as much closer together as rounds are than
once per minute, and the bill is that of a minute's rounds; `--round-s 60` takes the file as it is.

    python benchmarks/federation_wire.py [--ways unicast multicast thrifty] [--rounds 20]
        [--round-s 6] [--clients-per-round N]

Ways: `unicast`, models to each camera, as nodes come; `multicast`, params/dds/multicast.xml for the
cameras; `thrifty`, params/thrifty_federation.yaml and params/dds/thrifty.xml for all. They run at
the same time, each in a network of its own. In the first two all cameras take part in each round.

It needs `ip netns` and the right to use it (root), and is skipped elsewhere.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from geoorbit_ros.core.resources import share_path
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.payloads.model_layout import ModelLayout
from geoorbit_ros.federated.rounds.server_state import KIND, Answers, read_checkpoint
from geoorbit_ros.learning.meta_learner import MetaLearner

CAMERAS = ("north", "south", "west", "east")
LIMIT_BYTES = 28_000
HEARTBEAT_S = 3.0
"""The period of heartbeats where a profile says nothing."""
LIMIT_S = 120.0
"""For starting and ending; the rounds come on top."""
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
PREFIX = f"gw{os.getpid() % 10_000}"
ETHERNET_BYTES, UDP_BYTES, RTPS_BYTES = 14, 8, 20
DATA, DATA_FRAG, HEARTBEAT, ACKNACK, GAP, INFO_DST = 0x15, 0x16, 0x07, 0x06, 0x08, 0x0E
SCHEMAS = (b"update\0", b"model\0", b"delta\0")
Writer = tuple[bytes, bytes]
"""Participant and entity: the GUID of a DDS writer."""


# --- One camera -----------------------------------------------------------------------------------


def camera(name: str, folder: Path, server_key: str, settings: dict[str, object]) -> int:
    """A real meta_client with made-up lessons; ends when training is over.

    Args:
        name: Of the camera.
        folder: With its key.
        server_key: The server's public one.
        settings: Parameters of the node; and `round_s`, how long a lesson takes, `limit_s`,
            and `tail_s`, how long to stay after training.
    """
    import rclpy

    from geoorbit_ros.core.lanes import Lane
    from geoorbit_ros.core.tables import TRACK_DTYPE
    from geoorbit_ros.federated.rounds.local_work import LocalResult
    from geoorbit_ros.learning import camera_session
    from geoorbit_ros.learning.camera_session import LearningResult
    from geoorbit_ros.nodes.meta_client import MetaClientNode
    from geoorbit_ros.nodes.support.process import make_executor

    round_s, limit_s, tail_s = (
        float(str(settings.pop(name))) for name in ("round_s", "limit_s", "tail_s")
    )

    def lesson(task: Any, _: str, tensors: Any, order: Any, _best: Any = None) -> LearningResult:
        time.sleep(round_s)
        if not order.train:
            return LearningResult(LocalResult({}, 0, 1.0, -0.5), None)
        random = np.random.default_rng([order.round, *task.camera_id.encode()])
        delta = {
            key: random.normal(0, 0.02, value.shape).astype(np.float32)
            for key, value in tensors.items()
        }
        return LearningResult(LocalResult(delta, 1, 1.0, -0.5), np.zeros(3))

    setattr(camera_session, "learn_from_camera", lesson)  # noqa: B010
    rclpy.init()
    node = MetaClientNode(
        namespace=name,
        overrides={
            "key_file": str(folder / f"{name}.key"),
            "server_key": server_key,
            "observation_s": 1.0,
        }
        | settings,
    )
    node.session._executor = ThreadPoolExecutor(1)
    line, side = np.array([[0.0, 0.0], [50.0, 0.0]]), np.array([0.0, 1.75])
    lane = Lane(1, line, line + side, line - side, 3.5, 0.0, 1.0, "confirmed", 9.0)
    node.session.refer({1: lane}, -10.0)
    for k in range(12):
        rows = np.zeros(1, TRACK_DTYPE)
        rows["x"], rows["vx"], rows["track_id"], rows["sigma"] = 1.5 * k, 15.0, 1, 0.1
        node.session.add(k * 100_000_000, rows)
    executor = make_executor()
    executor.add_node(node)
    deadline = time.monotonic() + limit_s
    while not node.client.finished and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.2)
    end = time.monotonic() + tail_s  # the last heartbeats and acknowledgements
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.2)
    print(node.client.finished, flush=True)
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


# --- What is on the wire --------------------------------------------------------------------------


def sniff(device: str, path: Path) -> None:
    """Write every frame that a network card sends or receives to a file, until killed."""
    wire = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003))
    wire.bind((device, 0))
    with path.open("wb") as file:
        while True:
            frame = wire.recv(1 << 16)
            file.write(struct.pack("<I", len(frame)) + frame)
            file.flush()


def frames_in(path: Path) -> Iterator[bytes]:
    """The frames in such a file."""
    content, at = path.read_bytes(), 0
    while at + 4 <= len(content):
        (length,) = struct.unpack_from("<I", content, at)
        yield content[at + 4 : at + 4 + length]
        at += 4 + length


@dataclass
class Submessage:
    """A part of an RTPS message (OMG DDS-RTPS 2.5, section 9.4)."""

    kind: int
    writer: Writer
    size: int
    payload: bytes = b""


@dataclass
class Packet:
    """One IP packet with RTPS in it; `size` counts IP, UDP and RTPS headers."""

    size: int
    parts: list[Submessage] = field(default_factory=list)


def packet_of(frame: bytes) -> Packet | None:
    """The RTPS packet in an Ethernet frame; None when it holds something else."""
    ip = frame[ETHERNET_BYTES:]
    if frame[12:14] != b"\x08\x00" or ip[9] != socket.IPPROTO_UDP:
        return None
    start = 4 * (ip[0] & 15) + UDP_BYTES
    size = int.from_bytes(ip[2:4], "big")
    message = ip[start:size]
    if message[:4] != b"RTPS":
        return None
    source = target = message[8:RTPS_BYTES]
    found, at = Packet(size), RTPS_BYTES
    while at + 4 <= len(message):
        kind, flags = message[at], message[at + 1]
        length = int.from_bytes(message[at + 2 : at + 4], "little" if flags & 1 else "big")
        body = message[at + 4 : at + 4 + length] if length else message[at + 4 :]
        if kind == INFO_DST:
            target = body[:12]
        if kind in (DATA, DATA_FRAG):
            writer, payload = (source, body[8:12]), b""
            if kind == DATA and flags & 4 and not flags & 2:
                payload = body[20:]
            found.parts.append(Submessage(kind, writer, 4 + len(body), payload))
        elif kind in (HEARTBEAT, GAP):
            found.parts.append(Submessage(kind, (source, body[4:8]), 4 + len(body)))
        elif kind == ACKNACK:
            found.parts.append(Submessage(kind, (target, body[4:8]), 4 + len(body)))
        at += 4 + len(body)
    return found


def schema_in(payload: bytes) -> bytes:
    """The schema of a federation's payload in a serialised ByteMultiArray; empty for others."""
    inner = payload[16:]
    if inner[:4] != b"\0\1\0\0":
        return b""
    return next((s for s in SCHEMAS if inner[8:].startswith(s)), b"")


@dataclass
class Bill:
    """Bytes and packets by what they are for."""

    size: Counter[str] = field(default_factory=Counter)
    packets: Counter[str] = field(default_factory=Counter)

    def add(self, name: str, size: int) -> None:
        """One more packet."""
        self.size[name] += size
        self.packets[name] += 1

    def of(self, *names: str) -> int:
        """Bytes for all of these."""
        return sum(self.size[name] for name in names)


def bill_of(path: Path) -> Bill:
    """Sort all packets. One that carries several things belongs to the first that applies."""
    packets = [packet for frame in frames_in(path) if (packet := packet_of(frame))]
    ours = {part.writer for p in packets for part in p.parts if schema_in(part.payload)}
    bill = Bill()
    for packet in packets:
        kinds = {part.kind for part in packet.parts if part.writer in ours}
        data = [part for part in packet.parts if part.writer in ours and part.kind == DATA]
        if data:
            schema = schema_in(data[0].payload) or b"other\0"
            name = "updates" if schema == b"update\0" else "models"
            bill.add(name, packet.size)
            bill.size[f"{name}, payload"] += sum(len(part.payload) for part in data)
        elif kinds & {HEARTBEAT, GAP}:
            bill.add("heartbeats", packet.size)
        elif ACKNACK in kinds:
            bill.add("acknowledgements", packet.size)
        else:
            bill.add("discovery and other topics", packet.size)
    return bill


# --- The link -------------------------------------------------------------------------------------


def ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=10, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")


@contextmanager
def link(number: int) -> Iterator[dict[str, str]]:
    """Namespaces of server and cameras by name, all on one switch, one of several such links."""
    prefix = f"{PREFIX}{number}"
    hosts = {name: f"{prefix}{k}" for k, name in enumerate(("server", *CAMERAS))}
    switch = f"{prefix}s"
    try:
        for name in (switch, *hosts.values()):
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("-n", switch, "link", "add", "br0", "type", "bridge", "mcast_snooping", "0")
        ip("-n", switch, "link", "set", "br0", "up")
        for k, name in enumerate(hosts.values()):
            inner, outer = f"{prefix}i{k}", f"{prefix}o{k}"
            ip("link", "add", inner, "type", "veth", "peer", "name", outer)
            ip("link", "set", inner, "netns", name)
            ip("link", "set", outer, "netns", switch)
            ip("-n", name, "link", "set", inner, "name", "eth0")
            ip("-n", name, "addr", "add", f"10.214.0.{k + 1}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
            ip("-n", name, "route", "add", "default", "dev", "eth0")
            ip("-n", switch, "link", "set", outer, "master", "br0")
            ip("-n", switch, "link", "set", outer, "up")
        yield hosts
    finally:
        for name in (switch, *hosts.values()):
            subprocess.run(
                ["ip", "netns", "del", name], capture_output=True, timeout=10, check=False
            )


@dataclass(frozen=True)
class Way:
    """How a federation is set up.

    Attributes:
        title: In words.
        parameters: File of parameters for both nodes; empty: all cameras in each round, top-k.
        server_profile: What Fast DDS finds in the server's environment; empty: nothing.
        camera_profile: The same for the cameras.
        limit: Whether everything, not the messages alone, is to fit in 28 kB.
    """

    title: str
    parameters: str = ""
    server_profile: str = ""
    camera_profile: str = ""
    limit: bool = False


WAYS = {
    "unicast": Way("models to each camera"),
    "multicast": Way("models by multicast", camera_profile="multicast.xml"),
    "thrifty": Way(
        "thrifty: two cameras per round, models by multicast, few acknowledgements",
        "thrifty_federation.yaml",
        "thrifty.xml",
        "thrifty.xml",
        limit=True,
    ),
}


def settings_of(way: Way, node: str) -> dict[str, object]:
    """Parameters of a node."""
    if not way.parameters:
        return {"encoding": "top_k"}
    content = yaml.safe_load(share_path(f"params/{way.parameters}").read_text())
    return dict(content[f"/**/{node}"]["ros__parameters"])


def profile(name: str, folder: Path, round_s: float) -> tuple[dict[str, str], float]:
    """The environment that makes Fast DDS read a profile; the period of its heartbeats, in seconds.

    A period that is in the file follows the rounds' pace.
    """
    if not name:
        return {}, HEARTBEAT_S
    text, scaled = share_path(f"params/dds/{name}").read_text(), HEARTBEAT_S
    period = re.search(r"<heartbeatPeriod>\s*<sec>(\d+)</sec>", text)
    if period:
        scaled = max(1, round(int(period[1]) * round_s / 60.0))
        text = text.replace(period[0], f"<heartbeatPeriod><sec>{scaled}</sec>")
    (folder / name).write_text(text)
    return {PROFILES: str(folder / name)}, float(scaled)


def run(
    hosts: dict[str, str], folder: Path, way: Way, rounds: int, round_s: float, per_round: int
) -> tuple[Bill, float]:
    """Train once; the bill and the seconds that the rounds took.

    Args:
        hosts: Network namespaces.
        folder: For keys, logs and what the card saw; is made.
        way: How.
        rounds: How many.
        round_s: How long a camera works on one.
        per_round: Cameras in a round; 0: what the way says.
    """
    folder.mkdir()
    public = {}
    for name in ("server", *CAMERAS):
        private = hashlib.sha256(name.encode()).digest()
        (folder / f"{name}.key").write_text(private.hex())
        public[name] = (Signer(private, "geoorbit").public or b"").hex()
    roster = folder / "roster.txt"
    roster.write_text("\n".join(f"{name} {public[name]}" for name in CAMERAS))
    running: list[subprocess.Popen[bytes]] = []

    def start(host: str, *words: str, **variables: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            # Shared memory would connect what no network does: all hosts are one machine here.
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            **variables,
        }
        with (folder / f"{host}.log").open("ab") as log:
            process = subprocess.Popen(
                ["ip", "netns", "exec", hosts[host], sys.executable, *words],
                env=environment,
                stdout=log,
                stderr=log,
            )
        running.append(process)
        return process

    for_server, heartbeat_s = profile(way.server_profile, folder, round_s)
    with_profile, _ = profile(way.camera_profile, folder, round_s)
    tail_s = heartbeat_s + 1.0
    capture, limit_s = folder / "frames", LIMIT_S + (rounds + 1) * round_s
    settings = settings_of(way, "federated_server")
    if per_round:
        settings["clients_per_round"] = per_round % len(CAMERAS)
    lessons = {"round_s": round_s, "limit_s": limit_s, "tail_s": tail_s}
    for_cameras = json.dumps(settings_of(way, "meta_client") | lessons)
    try:
        start("server", __file__, "--sniff", str(capture))
        words = ["-m", "geoorbit_ros.nodes.federated_server", "--ros-args"]
        for key, value in {
            "roster": roster,
            "key_file": folder / "server.key",
            "checkpoint": folder / "server.npz",
            "rounds": rounds,
            **settings,
        }.items():
            words += ["-p", f"{key}:={value}"]
        start("server", *words, **for_server)
        cameras = [
            start(
                n,
                __file__,
                "--camera",
                n,
                str(folder),
                public["server"],
                for_cameras,
                **with_profile,
            )
            for n in CAMERAS
        ]
        for name, process in zip(CAMERAS, cameras, strict=True):
            if process.wait(limit_s + tail_s) != 0:
                raise SystemExit((folder / f"{name}.log").read_text())
    finally:
        for process in running:
            process.send_signal(signal.SIGKILL)
            process.wait(10.0)
    layout = ModelLayout.of(MetaLearner.untrained(0).tensors())
    state = read_checkpoint(StateFile(folder / "server.npz", KIND), layout, Answers(()))
    if state is None or not state.finished:
        raise SystemExit((folder / "server.log").read_text())
    updates = [record.updates for record in state.history]
    if updates != [*[settings.get("clients_per_round") or len(CAMERAS)] * rounds, 0]:
        raise SystemExit(f"not everybody took part in every round: {updates}")
    return bill_of(capture), sum(record.seconds for record in state.history)


def show(way: Way, bill: Bill, seconds: float) -> None:
    print(f"\n{way.title}", file=sys.stderr)
    for name, size in sorted(bill.size.items()):
        count = f"{bill.packets[name]:5d} packets" if name in bill.packets else ""
        print(f"{name:32s} {size / 1e3:8.2f} kB {count}", file=sys.stderr)
    for key, name in LEVELS.items():
        print(f"{name:60s} {size_of(bill, key) / 1e3:8.2f} kB", file=sys.stderr)
    print(f"rounds took {seconds:.1f} s", file=sys.stderr)


LEVELS = {
    "messages": "serialised messages",
    "data": "messages with RTPS, UDP and IP headers",
    "all": "the same with heartbeats and acknowledgements",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--round-s", type=float, default=6.0)
    parser.add_argument("--clients-per-round", type=int, default=0)
    parser.add_argument("--sniff", metavar="FILE", help=argparse.SUPPRESS)
    parser.add_argument("--camera", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.sniff:
        sniff("eth0", Path(chosen.sniff))
    if chosen.camera:
        name, folder, key, settings = chosen.camera
        sys.exit(camera(name, Path(folder), key, json.loads(settings)))
    bills: dict[str, Bill] = {}
    reason = "" if shutil.which("ip") else "no `ip` command: install iproute2"

    def measure(number: int, way: str, place: Path) -> tuple[Bill, float]:
        with link(number) as hosts:
            numbers = (chosen.rounds, chosen.round_s, chosen.clients_per_round)
            return run(hosts, place / way, WAYS[way], *numbers)

    try:
        with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor() as pool:
            tasks = [pool.submit(measure, k, way, Path(place)) for k, way in enumerate(chosen.ways)]
            for way, task in zip(chosen.ways, tasks, strict=True):
                bills[way], seconds = task.result()
                show(WAYS[way], bills[way], seconds)
    except OSError as error:
        reason = reason or f"network namespaces are not allowed here ({error})"
    for way in chosen.ways:
        for key, level in LEVELS.items():
            name = f"4 cameras x 20 rounds, {WAYS[way].title}: {level} / 28 kB"
            result: dict[str, object] = {"name": name}
            if reason:
                print(json.dumps(result | {"skipped": reason}))
                continue
            size = size_of(bills[way], key)
            # The promise is about messages; of the thrifty way, about all that its topics cause.
            limit = {"limit": 1.0} if key == "messages" or WAYS[way].limit else {}
            print(json.dumps(result | {"ratio": round(size / LIMIT_BYTES, 4)} | limit))


def size_of(bill: Bill, key: str) -> int:
    """Bytes of messages alone, with their headers (`data`), or with all that serves them."""
    if key == "messages":
        return bill.of("updates, payload", "models, payload")
    served = ("heartbeats", "acknowledgements") if key == "all" else ()
    return bill.of("updates", "models", *served)


if __name__ == "__main__":
    main()
