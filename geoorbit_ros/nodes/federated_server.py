"""Node `federated_server`: all cameras train one meta-learner, and none shows its data."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from rclpy.clock import Clock, ClockType
from std_msgs.msg import String

from geoorbit_ros.core.errors import PluginError
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.keys import Roster, Signer, read_private_key
from geoorbit_ros.federated.payloads.header import schema_of
from geoorbit_ros.federated.privacy.coordinator import MIN_CLIENTS
from geoorbit_ros.federated.privacy.message import SCHEMA as SECURE
from geoorbit_ros.federated.rounds.epoch import Epochs
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.status import progress, server_facts, status_text
from geoorbit_ros.federated.rounds.verdict import MIN_VALIDATION_CLIENTS, validation_divisor
from geoorbit_ros.federated.strategies.strategy import StrategySettings, make_strategy
from geoorbit_ros.learning.camera_session import INTERFACE, starting_learner
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.byte_topic import PayloadPublisher, PayloadSubscription
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, model_qos, updates_qos

PERIOD_S = 0.5
"""Between two looks at deadlines. Chosen: short beside `deadline_s`; larger, rounds end later."""


@dataclass(frozen=True, slots=True)
class FederatedServerParameters:
    """See params/federated_server.yaml."""

    federation: str
    roster: str
    key_file: str
    checkpoint: str
    model_file: str
    strategy: str
    server_learning_rate: float
    momentum: float
    proximal_mu: float
    byzantine_share: float
    buffer_size: int
    rounds: int
    target_loss: float
    clients_per_round: int
    selection: str
    validate_every: int
    quorum: float
    deadline_s: float
    max_staleness: int
    encoding: str
    top_k_share: float
    top_k_bits: int
    keyframe_interval: int
    max_abs_update: float
    max_sample_count: int
    clip_norm: float
    noise_multiplier: float
    reliability: str
    secure_aggregation: bool
    seed: int

    def config(self, run: int, roster: Roster) -> ServerConfig:
        """The part that the state machine takes."""
        least = MIN_CLIENTS if self.secure_aggregation else MIN_VALIDATION_CLIENTS
        divisor = validation_divisor(roster, self.validate_every, least)
        own = asdict(self)
        values = {f.name: own[f.name] for f in fields(ServerConfig) if f.name in own}
        return ServerConfig(run=run, interface=INTERFACE, validation_divisor=divisor, **values)

    def settings(self) -> StrategySettings:
        """The part that strategies take."""
        own = asdict(self)
        return StrategySettings(**{f.name: own[f.name] for f in fields(StrategySettings)})


class FederatedServerNode(GeoOrbitNode[FederatedServerParameters]):
    """Subscribes `/federated/client_update`; publishes `/federated/global_model`, latched.

    Deadlines are those of hosts and networks, and so go by a steady clock, whatever the traffic's
    time is. `/federated/status` is latched, too: one JSON object.
    """

    name = "federated_server"
    struct = FederatedServerParameters

    def setup(self) -> None:
        """Take up the checkpoint if there is one, and send the open round."""
        if self.p.secure_aggregation and self.p.reliability != "reliable":
            found = "secure_aggregation with reliability best_effort"
            raise FederationError("federated_server", found, "reliable: its steps are sent once")
        private = read_private_key(self.p.key_file) if self.p.key_file else None
        signer = Signer(private, self.p.federation)
        roster = Roster.read(self.p.roster, signer.public)
        self.server = FederatedServer(
            self.p.config(int(time.time()), roster),
            starting_learner(self.p.model_file, self.p.seed).tensors(),
            roster,
            make_strategy(self.p.strategy, self.p.settings()),
            signer,
            Path(self.p.checkpoint) if self.p.checkpoint else None,
            Epochs(Path(f"{self.p.key_file}.run") if self.p.key_file else None),
        )
        for note in self.server.notes:
            self.get_logger().warning(note)
        depth = self.p.keyframe_interval
        self._models = PayloadPublisher(self, "/federated/global_model", model_qos(depth))
        self._steps = PayloadPublisher(self, "/federated/secure_aggregation", updates_qos())
        self._status = self.create_publisher(String, "/federated/status", LATCHED)
        updates = updates_qos(self.p.reliability, len(roster))
        PayloadSubscription(
            self, "/federated/client_update", updates, self._on_update, self.server.longest
        )
        self.create_timer(PERIOD_S, self._on_time, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._fault = ""
        self.diagnostics.add_check(lambda: self._fault or self.server.fault or None)
        self._send(self.server.start(time.monotonic()))
        began = "resumed at" if self.server.resumed else "starts with"
        text = f"{began} {progress(self.server)}, strategy {self.p.strategy}"
        self.get_logger().info(text)

    def diagnostic_values(self) -> Mapping[str, object]:
        """Where training is."""
        return self._facts()

    def _facts(self) -> dict[str, object]:
        return server_facts(self.server) | {"sent_bytes": self._models.sent_bytes}

    def _on_update(self, payload: bytes) -> None:
        self._go_on(lambda now_s: self.server.receive(payload, now_s))

    def _on_time(self) -> None:
        self._go_on(self.server.tick)

    def _go_on(self, step: Callable[[float], bytes | None]) -> None:
        """Send what a step gives; after a mistake of the strategy, training stands still."""
        if self._fault:
            return
        try:
            self._send(step(time.monotonic()))
        except PluginError as error:
            self._fault = f"training stopped: {error}"
            self.get_logger().error(self._fault)

    def _send(self, payload: bytes | None) -> None:
        if payload is None:
            return
        (self._steps if schema_of(payload) == SECURE else self._models).publish(payload)
        self._status.publish(String(data=status_text(self.server, self._facts())))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(FederatedServerNode, args)


if __name__ == "__main__":
    sys.exit(main())
