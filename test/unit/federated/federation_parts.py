"""A small federation that learns something, for tests."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.encodings.encoding import Encoding
from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.keys import Member, Roster, Signer
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.payloads.model_layout import Tensors
from geoorbit_ros.federated.rounds.client import FederatedClient, LocalResult, TrainingOrder, Work
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.strategy import Strategy

INPUTS, HIDDEN, OUTPUTS = 6, 5, 3
FEDERATION = "test"
Array = NDArray[np.float64]


def key_of(name: str) -> bytes:
    """A private key that is the same in every run; only for tests."""
    return hashlib.sha256(name.encode()).digest()


def signer_of(name: str, federation: str = FEDERATION) -> Signer:
    return Signer(key_of(name), federation)


def roster_of(names: Sequence[str]) -> Roster:
    return Roster(Member(name, signer_of(name).public) for name in names)


def first_tensors(seed: int = 0) -> Tensors:
    generator = np.random.default_rng(seed)

    def drawn(*shape: int) -> NDArray[np.float32]:
        return generator.normal(0, 0.4, shape).astype(np.float32)

    return {
        "hidden.weight": drawn(HIDDEN, INPUTS),
        "hidden.bias": drawn(HIDDEN),
        "heads.weight": drawn(OUTPUTS, HIDDEN),
        "heads.bias": drawn(OUTPUTS),
    }


def predict(tensors: Mapping[str, Array | NDArray[np.float32]], x: Array) -> tuple[Array, Array]:
    hidden = np.tanh(x @ tensors["hidden.weight"].T + tensors["hidden.bias"])
    out = hidden @ tensors["heads.weight"].T + tensors["heads.bias"]
    return hidden, 0.5 * (1 + np.tanh(out / 2))


@dataclass(frozen=True)
class Camera:
    """A client's data: a task shared by all, seen from a place of its own."""

    x: Array
    y: Array

    @classmethod
    def drawn(cls, seed: int, examples: int = 30) -> "Camera":
        generator = np.random.default_rng(seed)
        x = generator.normal(0, 1, (examples, INPUTS)) + generator.normal(0, 0.5, INPUTS)
        truth = np.random.default_rng(7).normal(0, 0.7, (OUTPUTS, INPUTS))
        return cls(x, 1 / (1 + np.exp(-x @ truth.T)))

    def loss(self, tensors: Mapping[str, Any]) -> float:
        return float(np.mean((predict(tensors, self.x)[1] - self.y) ** 2))

    def gain(self, tensors: Mapping[str, Any]) -> float:
        """Against the first model, which stands for the defaults."""
        return float(np.log(self.loss(tensors) / self.loss(first_tensors())))

    def train(
        self, tensors: Tensors, order: TrainingOrder, steps: int = 10, rate: float = 1.0
    ) -> LocalResult:
        gain = self.gain(tensors) if order.validate else float("nan")
        if not order.train:
            return LocalResult({}, 0, self.loss(tensors), gain)
        weights = {name: t.astype(np.float64) for name, t in tensors.items()}
        for _ in range(steps):
            hidden, out = predict(weights, self.x)
            error = 2 * (out - self.y) * out * (1 - out) / len(self.x)
            inner = (error @ weights["heads.weight"]) * (1 - hidden**2)
            gradient = {
                "hidden.weight": inner.T @ self.x,
                "hidden.bias": inner.sum(0),
                "heads.weight": error.T @ hidden,
                "heads.bias": error.sum(0),
            }
            for name, t in tensors.items():
                pull = order.proximal_mu * (weights[name] - t)
                weights[name] = weights[name] - rate * (gradient[name] + pull)
        delta = {name: (weights[name] - t).astype(np.float32) for name, t in tensors.items()}
        return LocalResult(delta, len(self.x), self.loss(tensors), gain)


@dataclass
class Federation:
    """A server and its clients, each of which can be killed and started again."""

    names: Sequence[str]
    config: ServerConfig = field(default_factory=lambda: ServerConfig(federation=FEDERATION))
    strategy: Any = None
    encoding: Encoding = field(default_factory=Float32)
    folder: Path | None = None

    def __post_init__(self) -> None:
        self.cameras = {name: Camera.drawn(100 + k) for k, name in enumerate(self.names)}
        self.server = self.new_server()
        self.clients = [self.new_client(name) for name in self.names]

    def new_server(self) -> FederatedServer:
        strategy: Strategy | None = self.strategy() if self.strategy else None
        return FederatedServer(
            self.config,
            first_tensors(),
            roster_of(self.names),
            strategy,
            signer_of("server"),
            self.folder / "server.npz" if self.folder else None,
        )

    def new_client(self, name: str) -> FederatedClient:
        return FederatedClient(
            name,
            self.cameras[name].train,
            federation=FEDERATION,
            encoding=self.encoding,
            signer=signer_of(name),
            server_key=signer_of("server").public,
            state_path=self.folder / f"{name}.npz" if self.folder else None,
        )

    def train_many(self, asked: Sequence[tuple[FederatedClient, Work]]) -> list[LocalResult]:
        return [self.cameras[c.camera_id].train(w.tensors, w.order) for c, w in asked]

    def loss(self) -> float:
        tensors = self.server.published
        return float(np.mean([camera.loss(tensors) for camera in self.cameras.values()]))


def update_of(
    server: FederatedServer, name: str, vector: NDArray[np.float32], **changes: Any
) -> bytes:
    """A signed update to the open round, with fields changed on purpose."""
    state = server._state
    fields: dict[str, Any] = {
        "encoding": 0,
        "round": server.round,
        "model": state.digests[server.round],
        "client": signer_id(name),
        "sample_count": 1,
        "loss": 0.5,
        "gain": float("nan"),
        "data": np.asarray(vector, "<f4").tobytes(),
    }
    return signer_of(name).seal(ClientUpdate(**(fields | changes)).unsigned())


def signer_id(name: str) -> int:
    public = signer_of(name).public
    assert public is not None
    return Member(name, public).id
