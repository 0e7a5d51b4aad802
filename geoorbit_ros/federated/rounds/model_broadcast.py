"""Tells clients the model: whole, or as its change since the round before."""

from __future__ import annotations

import numpy as np

from geoorbit_ros.federated.encodings.encoding import Encoding
from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.encodings.int8 import Int8
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.payloads.global_model import GlobalModel, ModelDelta
from geoorbit_ros.federated.payloads.model_layout import ModelLayout, Vector
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import ServerState


class ModelBroadcast:
    """Makes the payload for each round and keeps what a late joiner needs.

    With `float32` and `float16` every round's payload is the whole model. With `int8` and `top_k`
    it is the encoded difference between the server's model and what the clients hold. What an
    encoding leaves out stays in that difference, and so is sent later: error feedback. The first
    model, which is arbitrary, goes out as int8; a whole one after that is exact.

    Args:
        config: Settings of the server.
        layout: Of the model.
        signer: Signs the payloads.
        proximal_mu: FedProx's, for the clients.

    Attributes:
        latched: Payloads that make a late joiner's model, oldest first: one whole model, then
            differences.
    """

    def __init__(
        self, config: ServerConfig, layout: ModelLayout, signer: Signer, proximal_mu: float
    ) -> None:
        self._config, self._layout, self._signer = config, layout, signer
        self._encoding = config.model_encoding()
        self._proximal_mu = proximal_mu
        self.latched: list[bytes] = []

    @property
    def differential(self) -> bool:
        """Whether differences are sent."""
        return self._config.encoding in ("int8", "top_k")

    def advance(self, state: ServerState) -> None:
        """Bring `state.published` nearer to `state.model`, and note its digest."""
        self._step = b""
        if not self.differential:
            state.published = self._decoded(self._encoding, state.model)
        elif state.round == 1:
            state.published = self._decoded(Int8(), state.model)
        else:
            self._step = self._encoding.encode(state.model - state.published)
            state.published = state.published + self._encoding.decode(self._step, self._layout.size)
        state.digests[state.round] = self._layout.digest(state.published, state.run)

    def announce(self, state: ServerState, clients: tuple[int, ...], flags: int) -> bytes:
        """The payload for the round that `advance` was called for."""
        if not self.differential:
            return self._whole(state, clients, flags, self._encoding, state.published)
        if state.round == 1:
            return self._whole(state, clients, flags, Int8(), state.model)
        if len(self.latched) >= self._config.keyframe_interval:
            return self.repeat(state, clients, flags)
        delta = ModelDelta(
            self._encoding.code,
            flags,
            state.round,
            state.digests[state.round - 1],
            state.digests[state.round],
            self._approved(state),
            clients,
            self._step,
        )
        return self._append(delta)

    def again(self, state: ServerState, flags: int) -> bytes:
        """The same model once more, to all who have it: what is said of it has changed."""
        if not self.differential:
            return self._whole(state, (), flags, self._encoding, state.published)
        if len(self.latched) >= self._config.keyframe_interval:
            return self.repeat(state, (), flags)
        digest = state.digests[state.round]
        delta = ModelDelta(
            self._encoding.code, flags, state.round, digest, digest, self._approved(state), (), b""
        )
        return self._append(delta)

    def repeat(self, state: ServerState, clients: tuple[int, ...], flags: int) -> bytes:
        """The whole model of the open round, exact: for clients with no model or another one."""
        return self._whole(state, clients, flags, Float32(), state.published)

    def seal(self, unsigned: bytes) -> bytes:
        """Any other payload of the server, with its signature."""
        return self._signer.seal(unsigned)

    def _whole(
        self,
        state: ServerState,
        clients: tuple[int, ...],
        flags: int,
        encoding: Encoding,
        vector: Vector,
    ) -> bytes:
        model = GlobalModel(
            encoding.code,
            flags,
            state.run,
            state.round,
            state.digests[state.round],
            self._config.interface,
            self._approved(state),
            self._config.validation_divisor,
            self._proximal_mu,
            clients,
            self._layout,
            encoding.encode(vector),
        )
        payload = self._signer.seal(model.unsigned())
        self.latched = [payload]
        return payload

    def _append(self, delta: ModelDelta) -> bytes:
        payload = self._signer.seal(delta.unsigned())
        self.latched.append(payload)
        return payload

    def _approved(self, state: ServerState) -> int:
        """Digest of the model to use; without validation, that of the newest one."""
        return state.approved if self._config.validation_divisor else state.digests[state.round]

    def _decoded(self, encoding: Encoding, vector: Vector) -> Vector:
        """What comes out at the other end."""
        return np.array(encoding.decode(encoding.encode(vector), self._layout.size))
