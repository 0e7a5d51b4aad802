"""The federated client as a plain state machine over bytes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.encodings.encoding import Encoding, ErrorFeedback, decode_vector
from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Signer, Verifier, client_id
from geoorbit_ros.federated.payloads.client_update import SCHEMA as UPDATE_SCHEMA
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.payloads.global_model import (
    ASYNCHRONOUS,
    DELTA_SCHEMA,
    FINAL,
    MASKED,
    VALIDATING,
    GlobalModel,
    ModelDelta,
)
from geoorbit_ros.federated.payloads.header import UNSIGNED, schema_of
from geoorbit_ros.federated.payloads.model_layout import Tensors, Vector
from geoorbit_ros.federated.privacy.masked_rounds import MaskedClient
from geoorbit_ros.federated.rounds.client_state import (
    KIND,
    ClientState,
    read_client_state,
    write_client_state,
)
from geoorbit_ros.federated.rounds.local_work import LocalResult, Train, TrainingOrder, Work
from geoorbit_ros.federated.rounds.verdict import is_training_client, is_validation_client

__all__ = ["FederatedClient", "LocalResult", "Train", "TrainingOrder", "Work"]


class FederatedClient:
    """Follows the global model and answers the rounds it is selected for.

    Usage::

        client = FederatedClient("north", train)
        update = client.answer(payload)        # train if asked to; bytes to send, or None

        client.used_tensors                    # the model to predict with, None: the defaults

    or, where training must not block::

        work = client.receive(payload)         # None: nothing to do
        result = train(work.tensors, work.order)  # elsewhere, unless work.ready
        update = client.finish(work, result)   # bytes to send

    Args:
        camera_id: Its name on the roster.
        train: Local training, for `answer`; None when it is done outside.
        federation: Name of the federation.
        encoding: How updates are encoded, with error feedback; default: float32.
        signer: Signs updates; default: unsigned.
        server_key: Public key of the server; None takes unsigned models.
        interface: `global_model.interface_digest` of this camera's model; 0: not checked.
        state_path: File to resume from and to write before each update is sent; default: none.

    Attributes:
        id: Its number in payloads.
        refused: Payloads refused since the start, by reason.
        fault: Why its state is not saved at present, such as a full disk; empty: it is.
        notes: What was found wrong with the state file, in sentences.

    Raises:
        NewerStateError: A state file of a newer version.
    """

    def __init__(
        self,
        camera_id: str,
        train: Train | None = None,
        *,
        federation: str = "geoorbit",
        encoding: Encoding | None = None,
        signer: Signer | None = None,
        server_key: bytes | None = None,
        interface: int = 0,
        state_path: Path | None = None,
    ) -> None:
        self.camera_id, self._train = camera_id, train
        self._signer = signer or Signer(None, federation)
        self.id = client_id(camera_id, self._signer.public)
        self._verifier = Verifier(server_key, federation)
        self._encoding = encoding or Float32()
        self._interface, self._server = interface, server_key.hex() if server_key else ""
        self._file = StateFile(state_path, KIND) if state_path else None
        self._state = read_client_state(self._file, self._server) if self._file else None
        self.notes, self.fault = self._file.told if self._file else [], ""
        self.finished = self._asynchronous = self._masks = False
        self._masked = MaskedClient(self.id, self._signer, self._verifier)
        self.refused: Counter[Refusal] = Counter()

    @property
    def tensors(self) -> Tensors | None:
        """The global model as last received; None before the first."""
        return self._state.layout.unflatten(self._state.model) if self._state else None

    @property
    def used_tensors(self) -> Tensors | None:
        """The newest model that was approved; None when the defaults are to be used."""
        state = self._state
        return state.layout.unflatten(state.used_model) if state and state.used else None

    @property
    def used(self) -> int:
        """Digest of that model; 0: none."""
        return self._state.used if self._state else 0

    @property
    def model_of(self) -> tuple[int, int, int]:
        """Run, round and digest of the global model; zeros before the first."""
        state = self._state
        return (state.run, state.round, state.digest) if state else (0, 0, 0)

    @property
    def answered(self) -> int:
        """Round of the last update made; 0: none."""
        return self._state.answered if self._state else 0

    def receive(self, payload: bytes) -> Work | None:
        """Take a `GlobalModel` or `ModelDelta`.

        Returns:
            What to do: train, validate, or send an update again. None when not selected, or when
            training is over.

        Raises:
            PayloadError: It was refused; the client goes on as if it had never come.
        """
        try:
            take = self._take_delta if schema_of(payload) == DELTA_SCHEMA else self._take_whole
            clients, flags = take(payload)
        except PayloadError as error:
            self.refused[error.reason] += 1
            raise
        state = self._state
        assert state is not None
        self.finished, self._asynchronous = bool(flags & FINAL), bool(flags & ASYNCHRONOUS)
        selected = not clients or self.id in clients
        order = TrainingOrder(
            state.round,
            state.proximal_mu,
            train=selected
            and is_training_client(self.id, state.validation_divisor)
            and not flags & VALIDATING,
            validate=is_validation_client(self.id, state.validation_divisor)
            and (selected or state.validation_divisor > 1),
        )
        if self.finished or not (order.train or order.validate):
            return None
        self._masks, ready = bool(flags & MASKED), b""
        if state.answered == state.round and state.answered_model == state.digest:
            ready = state.update
            if self._masks:
                ready = self._masked.begin(state.update, state.layout.size)
        tensors = state.layout.unflatten(state.model)
        return Work(state.round, state.digest, tensors, order, ready)

    def finish(self, work: Work, result: LocalResult) -> bytes | None:
        """Turn what was learned into an update; it is kept on disk before it is returned.

        Returns:
            The update to send; None when it would be refused: nothing was learned, or the round is
            over by now and the server is not asynchronous.

        Raises:
            FederationError: Tensors of another layout.
        """
        if work.ready:
            return work.ready
        state = self._state
        in_time_only = not (self._asynchronous and work.order.train)
        late = state is not None and state.round != work.round and in_time_only
        if state is None or late or state.answered >= work.round or not _usable(result, work.order):
            return None
        if self._masks:
            return self._hide(state, work, result)
        data = b""
        if work.order.train:
            feedback = ErrorFeedback(self._encoding, state.layout.size)
            feedback.residual = state.residual
            data = feedback.encode(state.layout.flatten(result.delta))
            state.residual = feedback.residual
        update = self._update(self._encoding.code, work, result, data)
        state.update = self._signer.seal(update.unsigned())
        state.answered, state.answered_model = work.round, work.model
        self._save(state)
        return state.update

    def answer(self, payload: bytes) -> bytes | None:
        """`receive`, train, `finish` in one go: an update to send, or None.

        Raises:
            PayloadError: As `receive`.
        """
        work = self.receive(payload)
        if work is None:
            return None
        if work.ready or self._train is None:
            return work.ready or None
        return self.finish(work, self._train(work.tensors, work.order))

    def assist(self, payload: bytes) -> bytes | None:
        """Take a step of a masked sum from the server.

        Returns:
            This client's next step; None when it has no part in that sum.

        Raises:
            PayloadError: It was refused.
        """
        try:
            return self._masked.assist(payload)
        except PayloadError as error:
            self.refused[error.reason] += 1
            raise

    def _hide(self, state: ClientState, work: Work, result: LocalResult) -> bytes:
        """Keep the update, unsent, and begin to take part in a masked sum with it."""
        train = work.order.train
        data = Float32().encode(state.layout.flatten(result.delta)) if train else b""
        update = self._update(Float32().code, work, result, data)
        state.update = update.unsigned() + UNSIGNED
        state.answered, state.answered_model = work.round, work.model
        self._save(state)
        return self._masked.begin(state.update, state.layout.size)

    def _update(self, encoding: int, work: Work, result: LocalResult, data: bytes) -> ClientUpdate:
        return ClientUpdate(
            encoding,
            work.round,
            work.model,
            self.id,
            result.sample_count if work.order.train else 0,
            result.loss,
            result.gain,
            data,
        )

    def _take_whole(self, payload: bytes) -> tuple[tuple[int, ...], int]:
        model = GlobalModel.decode(payload)
        state = self._state
        known = (state.run, state.round) if state else (0, 0)
        if (model.run, model.round) < known:
            found = f"run {model.run}, round {model.round}"
            expected = f"run, round {known} or later"
            if model.run < known[0]:
                expected += "; has the server lost its checkpoint and its time? Give it a new key"
            raise PayloadError(Refusal.OLD_ROUND, "model", found, expected)
        self._verifier.check(payload, "model")
        if self._interface and model.interface != self._interface:
            found, expected = f"interface {model.interface:08x}", f"{self._interface:08x}"
            raise PayloadError(Refusal.SHAPE, "model", found, expected)
        vector = decode_vector(model.encoding, model.data, model.layout.size)
        self._check_digest(model.layout.digest(vector, model.run), model.model)
        self._check_not_over(model.run, model.round, model.flags)
        if state is None or state.run != model.run or state.layout != model.layout:
            nothing = np.zeros(model.layout.size, np.float32)
            state = ClientState(model.layout, model.run, 0, vector, 0, 0.0, nothing)
            state.server = self._server
        before = state.digest, state.model
        state.round, state.model, state.digest = model.round, np.array(vector), model.model
        state.proximal_mu, state.validation_divisor = model.proximal_mu, model.validation_divisor
        self._state = state
        self._use(state, model.approved, before)
        return model.clients, model.flags

    def _take_delta(self, payload: bytes) -> tuple[tuple[int, ...], int]:
        delta = ModelDelta.decode(payload)
        state = self._state
        if state is None:
            expected = "a whole model first"
            raise PayloadError(Refusal.OTHER_MODEL, DELTA_SCHEMA, f"round {delta.round}", expected)
        if (delta.round, delta.model) == (state.round, state.digest):
            self._verifier.check(payload, DELTA_SCHEMA)  # sent again: the update may have been lost
            self._check_not_over(state.run, delta.round, delta.flags)
            self._use(state, delta.approved, (0, state.model))
            return delta.clients, delta.flags
        if delta.round <= state.round:
            found = f"round {delta.round}"
            raise PayloadError(Refusal.OLD_ROUND, DELTA_SCHEMA, found, f"round {state.round + 1}")
        if delta.base != state.digest:
            found, expected = f"a change of model {delta.base:08x}", f"of {state.digest:08x}"
            raise PayloadError(Refusal.OTHER_MODEL, DELTA_SCHEMA, found, expected)
        self._verifier.check(payload, DELTA_SCHEMA)
        step = decode_vector(delta.encoding, delta.data, state.layout.size)
        vector: Vector = state.model + step
        self._check_digest(state.layout.digest(vector, state.run), delta.model)
        before = state.digest, state.model
        state.round, state.model, state.digest = delta.round, vector, delta.model
        self._use(state, delta.approved, before)
        return delta.clients, delta.flags

    def _use(self, state: ClientState, approved: int, before: tuple[int, Vector]) -> None:
        """Take the approved model in use: the one just taken, the one before, or the one in use.

        Who has it not, having joined later, uses the defaults until the next verdict.
        """
        if approved == state.used:
            return
        known = {0: state.model, before[0]: before[1], state.digest: state.model}
        state.used = approved if approved in known else 0
        state.used_model = known[state.used]
        if self.fault or state.used not in (0, state.digest):  # which is not sent again
            self._save(state)

    def _save(self, state: ClientState) -> None:
        """Keep the state, or say why not: a full disk costs what a restart would forget, only."""
        if self._file is None:
            return
        try:
            write_client_state(self._file, state)
            self.fault = ""
        except InputFileError as error:
            self.fault = f"learning is not saved: {error}"

    def _check_not_over(self, run: int, number: int, flags: int) -> None:
        """Refuse a broadcast from before the last one, which was for the same model."""
        if self.finished and (run, number) == self.model_of[:2] and not flags & FINAL:
            found = f"round {number}, open"
            raise PayloadError(Refusal.OLD_ROUND, "model", found, "its end, which was heard")

    @staticmethod
    def _check_digest(found: int, expected: int) -> None:
        if found != expected:
            text = f"a model of digest {found:08x}"
            raise PayloadError(Refusal.OTHER_MODEL, "model", text, f"{expected:08x} as it says")


def _usable(result: LocalResult, order: TrainingOrder) -> bool:
    """Nothing learned, or nothing finite, is nothing to send; neither is a verdict on nothing."""
    arrays = result.delta.values()
    finite = all(bool(np.isfinite(a).all()) for a in arrays) and np.isfinite(result.loss)
    return bool(finite) and (result.sample_count > 0 if order.train else order.validate)


class ResendQueue:
    """Keeps the last update until a newer model, or the end of training, shows that it was heard.

    No acknowledgement is needed: a synchronous server goes on once it has heard all clients. One
    that still waits refuses a second copy, so sending twice changes nothing. Steps of masked sums
    are not sent again: they belong to one attempt.

    Args:
        resend_s: Time to the first repetition; each further one takes twice as long. 0: never.
    """

    def __init__(self, resend_s: float) -> None:
        self._first_s = resend_s
        self._payload, self._model = b"", (0, 0, 0)
        self._due_s = self._wait_s = 0.0

    def pass_on(self, payload: bytes | None, client: FederatedClient, now_s: float) -> bytes | None:
        """A new payload, or the last once more where that is due.

        Args:
            payload: To be sent; None where there is nothing new.
            client: Whose it is.
            now_s: Time of a clock that does not go back.
        """
        if payload is not None:
            keep = self._first_s > 0 and schema_of(payload) == UPDATE_SCHEMA
            self._payload, self._model = payload if keep else b"", client.model_of
            self._wait_s = self._first_s
            self._due_s = now_s + self._wait_s
            return payload
        if client.finished or client.model_of != self._model:
            self._payload = b""
        if not self._payload or now_s < self._due_s:
            return None
        self._wait_s *= 2
        self._due_s = now_s + self._wait_s
        return self._payload
