"""Node `federated_server`: all cameras train one meta-learner, and none shows its data."""

from __future__ import annotations

import json
import math
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
        resumed = "resumed at" if self.server.resumed else "starts with"
        if self.server.round > self.p.rounds:
            began = f"resumed after all {self.p.rounds} rounds"
        else:
            began = f"{resumed} round {self.server.round} of {self.p.rounds}"
        self.get_logger().info(f"{began}, strategy {self.p.strategy}")

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


def server_facts(server: FederatedServer) -> dict[str, object]:
    """Round, clients heard, refusals by reason, last loss and verdict: one word or number each."""
    last = next((record for record in reversed(server.history) if record.updates), None)
    rounds = server.config.rounds
    over = server.round > rounds
    return {
        "run": server.run,
        "progress": f"all {rounds} rounds done" if over else f"round {server.round} of {rounds}",
        "round": server.round,
        "rounds": rounds,
        "finished": server.finished,
        "selected": len(server.selected),
        "collected": server.collected,
        "answers": f"{server.collected} of {server.wanted}",
        "validated": server.validated,
        "judged": server.validated,  # its old name, until 0.2.0
        "accepted": server.accepted,
        **{f"refused_{r.replace(' ', '_')}": n for r, n in server.refused.items()},
        "loss": round(last.loss, 6) if last else "",
        "model_approved": server.verdict.accepted,
    }


def status_text(server: FederatedServer, facts: dict[str, object]) -> str:
    """These facts and what came of the last round as JSON; what is not a number is null."""
    rows = [
        {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(record).items()
        }
        | {"judges": record.validation_clients}  # its old name, until 0.2.0
        for record in server.history[-1:]
    ]
    return json.dumps(facts | {"last_round": rows})


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(FederatedServerNode, args)


if __name__ == "__main__":
    sys.exit(main())
