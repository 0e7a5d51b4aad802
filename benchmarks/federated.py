"""Cost of a round on the server beside Flower's FedAvg on the same arrays, and memory by clients.

Ours is everything a server does between the bytes that arrive and the bytes it sends: read, look
up, verify an Ed25519 signature, validate, add, make the model, checkpoint, sign. Flower's is
`aggregate_train` alone, on messages that are already in memory, without signatures.

Flower lives in an environment of its own (benchmarks/peers/flower.txt), whose Python
GEOORBIT_FLOWER_PYTHON names. Times are CPU times, each the median of alternating runs.
"""

from __future__ import annotations

import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.keys import Member, Roster, Signer
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.learning.meta_learner import MetaLearner

PEER = Path(__file__).parent / "peers" / "flower_fedavg.py"
PYTHON = "GEOORBIT_FLOWER_PYTHON"
CLIENTS = (400, 10_000)
REPEATS = 5
FEDERATION = "benchmark"
Updates = NDArray[np.float32]


def signer(number: int) -> Signer:
    return Signer(hashlib.sha256(str(number).encode()).digest(), FEDERATION)


def peer_round(arrays: Path) -> tuple[list[float], list[float]]:
    """CPU seconds of Flower's aggregation, and the mean that it found."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("LD_", "_ROS", "PYTH"))}
    done = subprocess.run(
        [os.environ[PYTHON], str(PEER), str(arrays), "3"],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=600,
        env=environment,
    )
    result = json.loads(done.stdout.splitlines()[-1])
    return result["seconds"], result["mean"]


class Fleet:
    """A server and the payloads of so many clients for its open round."""

    def __init__(self, clients: int, folder: Path) -> None:
        tensors = MetaLearner.untrained(0).tensors()
        size = sum(tensor.size for tensor in tensors.values())
        self.shapes = [tensor.shape for tensor in tensors.values()]
        generator = np.random.default_rng(1)
        self.updates = generator.normal(0, 0.02, (clients, size)).astype(np.float32)
        self.counts = generator.integers(1, 50, clients)
        self.signers = [signer(k) for k in range(clients)]
        roster = Roster(Member(f"camera_{k}", s.public) for k, s in enumerate(self.signers))
        numbers = list(roster)
        by_key = {s.public: s for s in self.signers}
        members = [roster.get(number) for number in numbers]
        self.order = [(n, by_key[m.public]) for n, m in zip(numbers, members, strict=True) if m]
        config = ServerConfig(federation=FEDERATION, rounds=1000)
        self.server = FederatedServer(
            config, tensors, roster, None, signer(-1), folder / f"{clients}.npz"
        )
        self.server.start(0.0)

    def payloads(self) -> list[bytes]:
        """Signed updates to the open round."""
        model = self.server.layout.digest(
            self.server.layout.flatten(self.server.published), self.server.run
        )
        sent = []
        for (number, key), row, count in zip(self.order, self.updates, self.counts, strict=True):
            data = row.tobytes()
            update = ClientUpdate(0, self.server.round, model, number, int(count), 0.5, 0.1, data)
            sent.append(key.seal(update.unsigned()))
        return sent

    def round_s(self) -> float:
        """CPU seconds of one round on the server."""
        payloads, number = self.payloads(), self.server.round
        start = time.process_time()
        for payload in payloads:
            self.server.receive(payload, 0.0)
        elapsed = time.process_time() - start
        assert self.server.round == number + 1
        return elapsed

    def round_memory_bytes(self) -> tuple[int, int]:
        """Most memory that a round takes beyond what was there before it.

        Returns:
            While updates come in, and until the next round is announced, checkpoint included.
        """
        payloads = self.payloads()
        last = payloads.pop()
        self.server.receive(payloads.pop(), 0.0)
        tracemalloc.start()
        for payload in payloads:
            self.server.receive(payload, 0.0)
        collecting = tracemalloc.get_traced_memory()[1]
        self.server.receive(last, 0.0)
        closing = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return collecting, closing


def report(name: str, ratio: float, limit: float | None, note: str) -> None:
    line = {"name": name, "ratio": round(ratio, 4)} | ({"limit": limit} if limit else {})
    print(json.dumps(line), flush=True)
    print(f"{name}: {note}", file=sys.stderr)


def compare_speed(fleet: Fleet, folder: Path) -> None:
    number = len(fleet.updates)
    name = f"round of {number} clients, signatures checked / Flower's aggregate_train without"
    if not os.environ.get(PYTHON):
        print(json.dumps({"name": name, "skipped": f"{PYTHON} names no Python with flwr"}))
        return
    arrays = folder / "arrays.npz"
    shapes = json.dumps(fleet.shapes)
    np.savez(arrays, shapes=np.array(shapes), updates=fleet.updates, counts=fleet.counts)
    before = fleet.server.layout.flatten(fleet.server.tensors)
    own = [fleet.round_s()]
    peer: list[float] = []
    mean: list[float] = []
    found = fleet.server.layout.flatten(fleet.server.tensors) - before
    for _ in range(REPEATS):
        seconds, mean = peer_round(arrays)
        peer += seconds
        own.append(fleet.round_s())
    np.testing.assert_allclose(found, mean, atol=1e-5, err_msg="not the same mean")
    own_s, peer_s = statistics.median(own), statistics.median(peer)
    note = f"{own_s:.3f} s, {1e6 * own_s / number:.0f} µs per update; Flower {peer_s:.3f} s"
    report(name, own_s / peer_s, 1.0, note)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        memory = {}
        for clients in CLIENTS:
            fleet = Fleet(clients, folder)
            compare_speed(fleet, folder)
            memory[clients] = fleet.round_memory_bytes()
        few, many = CLIENTS
        update_bytes = 4 * fleet.updates.shape[1]
        for k, part in enumerate(("while updates come in", "until the next one, checkpoint too")):
            per_client = (memory[many][k] - memory[few][k]) / (many - few)
            sizes = " and ".join(f"{memory[clients][k] / 1e3:.0f}" for clients in CLIENTS)
            note = f"{sizes} kB, {per_client:.1f} B per client"
            title = f"memory of a round {part}, per further client / size of its update"
            report(title, per_client / update_bytes, 0.05, note)


if __name__ == "__main__":
    main()
