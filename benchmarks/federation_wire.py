"""What a federation of four cameras and twenty rounds costs on the wire, headers included.

Server and cameras are real nodes, each in a network namespace of its own, on one Ethernet link.
Every frame at the server's network card is counted: the parameter topics' data, heartbeats and
acknowledgements with their RTPS, UDP and IP headers; discovery; the rest. Two runs: models to each
camera, and models by multicast (params/dds/multicast.xml). The learning is made up (updates are
random, the worst case for top-k), messages, signatures and rounds are the real ones.

    python benchmarks/federation_wire.py [--rounds 20] [--encoding top_k]

It needs `ip netns` and the right to use it (root), and is skipped elsewhere.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
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

from geoorbit_ros.core.resources import share_path
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.layout import ModelLayout
from geoorbit_ros.federated.ledger import Ledger
from geoorbit_ros.federated.server_state import read_checkpoint
from geoorbit_ros.learning.meta_learner import MetaLearner

CAMERAS = ("north", "south", "west", "east")
LIMIT_BYTES = 28_000
LIMIT_S = 120.0
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
PREFIX = f"gw{os.getpid() % 10_000}"
ETHERNET_BYTES, UDP_BYTES, RTPS_BYTES = 14, 8, 20
DATA, DATA_FRAG, HEARTBEAT, ACKNACK, GAP, INFO_DST = 0x15, 0x16, 0x07, 0x06, 0x08, 0x0E
SCHEMAS = (b"update\0", b"model\0", b"delta\0")
Writer = tuple[bytes, bytes]
"""Participant and entity: the GUID of a DDS writer."""


# --- One camera -----------------------------------------------------------------------------------


def camera(name: str, folder: Path, server_key: str, encoding: str) -> int:
    """A real meta_client with made-up lessons; ends when training is over."""
    import rclpy

    from geoorbit_ros.core.lanes import Lane
    from geoorbit_ros.core.tables import TRACK_DTYPE
    from geoorbit_ros.federated.local_work import LocalResult
    from geoorbit_ros.learning import camera_session
    from geoorbit_ros.learning.camera_learning import Lesson
    from geoorbit_ros.nodes.meta_client import MetaClientNode
    from geoorbit_ros.nodes.process import make_executor

    def lesson(task: Any, _: str, tensors: Any, order: Any, best: Any = None) -> Lesson:
        if not order.teach:
            return Lesson(LocalResult({}, 0, 1.0, -0.5), None)
        random = np.random.default_rng([order.round, *task.camera_id.encode()])
        delta = {
            key: random.normal(0, 0.02, value.shape).astype(np.float32)
            for key, value in tensors.items()
        }
        return Lesson(LocalResult(delta, 1, 1.0, -0.5), np.zeros(3))

    setattr(camera_session, "learn_from_camera", lesson)  # noqa: B010
    rclpy.init()
    node = MetaClientNode(
        namespace=name,
        overrides={
            "key_file": str(folder / f"{name}.key"),
            "server_key": server_key,
            "observation_s": 1.0,
            "encoding": encoding,
        },
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
    deadline = time.monotonic() + LIMIT_S
    while not node.client.finished and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.2)
    end = time.monotonic() + 1.0  # the last acknowledgements
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
def link() -> Iterator[dict[str, str]]:
    """Namespaces of server and cameras by name, all on one switch."""
    hosts = {name: f"{PREFIX}{k}" for k, name in enumerate(("server", *CAMERAS))}
    switch = f"{PREFIX}s"
    try:
        for name in (switch, *hosts.values()):
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip("-n", switch, "link", "add", "br0", "type", "bridge", "mcast_snooping", "0")
        ip("-n", switch, "link", "set", "br0", "up")
        for k, name in enumerate(hosts.values()):
            inner, outer = f"{PREFIX}i{k}", f"{PREFIX}o{k}"
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


def run(
    hosts: dict[str, str], folder: Path, rounds: int, encoding: str, dds: dict[str, str]
) -> tuple[Bill, float]:
    """Train once; the bill and the seconds that the rounds took.

    Args:
        hosts: Network namespaces.
        folder: For keys, logs and what the card saw; is made.
        rounds: How many.
        encoding: Of models and updates.
        dds: What Fast DDS finds in the cameras' environment.
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

    capture = folder / "frames"
    try:
        start("server", __file__, "--sniff", str(capture))
        words = ["-m", "geoorbit_ros.nodes.federated_server", "--ros-args"]
        for key, value in {
            "roster": roster,
            "key_file": folder / "server.key",
            "checkpoint": folder / "server.npz",
            "rounds": rounds,
            "encoding": encoding,
        }.items():
            words += ["-p", f"{key}:={value}"]
        start("server", *words)
        cameras = [
            start(name, __file__, "--camera", name, str(folder), public["server"], encoding, **dds)
            for name in CAMERAS
        ]
        for name, process in zip(CAMERAS, cameras, strict=True):
            if process.wait(LIMIT_S) != 0:
                raise SystemExit((folder / f"{name}.log").read_text())
    finally:
        for process in running:
            process.send_signal(signal.SIGKILL)
            process.wait(10.0)
    layout = ModelLayout.of(MetaLearner.untrained(0).tensors())
    state = read_checkpoint(folder / "server.npz", layout, Ledger(()))
    if state is None or not state.finished:
        raise SystemExit((folder / "server.log").read_text())
    updates = [record.updates for record in state.history]
    if updates != [*[len(CAMERAS)] * rounds, 0]:
        raise SystemExit(f"not everybody took part in every round: {updates}")
    return bill_of(capture), sum(record.seconds for record in state.history)


def show(way: str, bill: Bill, seconds: float) -> None:
    print(f"\nmodels by {way}", file=sys.stderr)
    for name, size in sorted(bill.size.items()):
        count = f"{bill.packets[name]:5d} packets" if name in bill.packets else ""
        print(f"{name:32s} {size / 1e3:8.2f} kB {count}", file=sys.stderr)
    print(f"rounds took {seconds:.1f} s", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--encoding", default="top_k")
    parser.add_argument("--sniff", metavar="FILE", help=argparse.SUPPRESS)
    parser.add_argument("--camera", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.sniff:
        sniff("eth0", Path(chosen.sniff))
    if chosen.camera:
        name, folder, key, encoding = chosen.camera
        sys.exit(camera(name, Path(folder), key, encoding))
    ways = {
        "unicast": {},
        "multicast": {PROFILES: str(share_path("params/dds/multicast.xml"))},
    }
    names = {
        "messages": "4 cameras x 20 rounds, models by {}: serialised messages / 28 kB",
        "data": "models by {}: messages with RTPS, UDP and IP headers / 28 kB",
        "all": "models by {}: the same with heartbeats and acknowledgements / 28 kB",
    }
    bills: dict[str, Bill] = {}
    reason = "" if shutil.which("ip") else "no `ip` command: install iproute2"
    try:
        with tempfile.TemporaryDirectory() as place, link() as hosts:
            for way, dds in ways.items():
                folder = Path(place) / way
                bills[way], seconds = run(hosts, folder, chosen.rounds, chosen.encoding, dds)
                show(way, bills[way], seconds)
    except OSError as error:
        reason = reason or f"network namespaces are not allowed here ({error})"
    for way in ways:
        for key, name in names.items():
            result: dict[str, object] = {"name": name.format(way)}
            if reason:
                print(json.dumps(result | {"skipped": reason}))
                continue
            size = size_of(bills[way], key)
            # The promise is about messages: for headers see docs/federation.md.
            limit = {"limit": 1.0} if key == "messages" else {}
            print(json.dumps(result | {"ratio": round(size / LIMIT_BYTES, 4)} | limit))


def size_of(bill: Bill, key: str) -> int:
    """Bytes of messages alone, with their headers (`data`), or with all that serves them."""
    if key == "messages":
        return bill.of("updates, payload", "models, payload")
    served = ("heartbeats", "acknowledgements") if key == "all" else ()
    return bill.of("updates", "models", *served)


if __name__ == "__main__":
    main()
