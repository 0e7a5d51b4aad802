"""Node `meta_client`: predicts the camera's parameters θ, and trains with other cameras."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rclpy.clock import Clock, ClockType

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.federated.encodings.encoding import EncodingSettings, make_encoding
from geoorbit_ros.federated.keys import Signer, public_key, read_private_key
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.learning.camera_session import INTERFACE, CameraSession
from geoorbit_ros.learning.meta_learner import load_model
from geoorbit_ros.learning.processes import BackgroundProcess
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.byte_topic import PayloadPublisher, PayloadSubscription
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, model_qos, updates_qos
from geoorbit_ros.nodes.support.reference_listener import ReferenceListener
from geoorbit_ros.nodes.support.table_stream import TableStream

PERIOD_S = 0.1
"""Between two looks at the training process. Chosen: larger, updates leave later."""


@dataclass(frozen=True, slots=True)
class MetaClientParameters:
    """See params/meta_client.yaml."""

    federation: str
    camera_id: str
    key_file: str
    server_key: str
    state_file: str
    model_file: str
    estimator: str
    observation_s: float
    encoding: str
    top_k_share: float
    top_k_bits: int
    resend_s: float
    model_history: int
    reliability: str
    queue_depth: int
    restart_jump_s: float


class MetaClientNode(GeoOrbitNode[MetaClientParameters]):
    """Subscribes `tracks`, `reference/…` and `/federated/global_model`.

    Publishes `lane_parameters`, latched, for every new model and observation, and
    `/federated/client_update` for every round that it is selected for. Training runs in a process
    of its own at low priority, so that nothing here waits for it. Whatever fails here, the nodes
    beside it go on.
    """

    name = "meta_client"
    struct = MetaClientParameters
    optional = True

    def setup(self) -> None:
        """Take up the state file if there is one, and wait for a model."""
        p = self.p
        signer = Signer(read_private_key(p.key_file) if p.key_file else None, p.federation)
        self.client = FederatedClient(
            p.camera_id or self.camera_id,
            federation=p.federation,
            encoding=make_encoding(p.encoding, EncodingSettings(p.top_k_share, p.top_k_bits)),
            signer=signer,
            server_key=public_key(p.server_key),
            interface=INTERFACE,
            state_path=Path(p.state_file) if p.state_file else None,
        )
        for note in self.client.notes:
            self.get_logger().warning(note)
        self.diagnostics.add_check(lambda: self.client.fault or None)
        self._training = BackgroundProcess()
        self.session = CameraSession(
            self.client, signer, p.estimator, p.observation_s, self._training, p.resend_s
        )
        if p.model_file:
            self.session.learner = load_model(Path(p.model_file))
        self._resend = b""
        self._theta = PayloadPublisher(self, "lane_parameters", LATCHED)
        self._updates = PayloadPublisher(self, "/federated/client_update", updates_qos())
        TableStream(self, "tracks", TRACK_DTYPE, p, self.session.add, self.session.restart)
        ReferenceListener(self, self._on_reference)
        models = model_qos(p.model_history)
        PayloadSubscription(self, "/federated/global_model", models, self.session.receive)
        PayloadSubscription(self, "/federated/secure_aggregation", updates_qos(), self._on_step)
        self.create_timer(PERIOD_S, self._on_time, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def diagnostic_values(self) -> Mapping[str, object]:
        """What it has and what it waits for."""
        return {**self.session.facts(), "sent_bytes": self._updates.sent_bytes}

    def close(self) -> None:
        """Leave training where it is: the server sends the round again when the client is back."""
        self._training.kill()

    def _on_step(self, payload: bytes) -> None:
        if step := self.client.assist(payload):
            self._updates.publish(step)

    def _on_reference(self, lanes: dict[int, Lane]) -> None:
        self.session.refer(lanes, time.monotonic())

    def _on_time(self) -> None:
        try:
            self._resend = self.session.poll(time.monotonic()) or self._resend
            theta = self.session.theta()
        except GeoOrbitError as error:
            self.diagnostics.refuse(error)
            return
        if self._resend and self._updates.subscribers:  # else nothing would receive it
            self._updates.publish(self._resend)
            self._resend = b""
        if theta is not None:
            self._theta.publish(theta)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(MetaClientNode, args)


if __name__ == "__main__":
    sys.exit(main())
