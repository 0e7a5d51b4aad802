"""The server's side of a masked sum: collects, hands on, unmasks the sum and nothing else."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.privacy.message import (
    SCHEMA,
    SecureMessage,
    Stage,
    read_rows,
    write_rows,
)
from geoorbit_ros.federated.privacy.participant import (
    BOX_BYTES,
    KEY_BYTES,
    PEERS_HEAD,
    mask_seed,
)
from geoorbit_ros.federated.privacy.random_stream import (
    Quantiser,
    Words,
    pairwise_mask,
    stream,
)
from geoorbit_ros.federated.privacy.shamir import SHARE_BYTES, restore

MIN_CLIENTS = 3
"""The sum of two is no secret to either of them."""


def threshold_of(clients: int) -> int:
    """Shares that restore a secret: more than two thirds of the clients.

    Bonawitz et al. ask for as many where a server might tell different clients different things.
    """
    return max(2 * clients // 3 + 1, 2)


class Coordinator:
    """One attempt at one masked sum.

    Args:
        expected: Clients that are waited for.
        round_number: The round.
        model: Digest of the model that updates start from.
        session: Number of this attempt.
        size: Length of the vectors.
        limit: Largest magnitude of a weight.

    Attributes:
        stage: What clients are to send next.
        survivors: Clients whose vectors are in the sum, once it is known.
    """

    def __init__(
        self,
        expected: Iterable[int],
        round_number: int,
        model: int,
        session: int,
        size: int,
        limit: float,
    ) -> None:
        self.stage = Stage.KEYS
        self.survivors: list[int] = []
        self._waiting = set(expected)
        self._round, self._model, self._session = round_number, model, session
        self._size, self._limit = size, limit
        self._came: dict[int, bytes] = {}
        self._keys: dict[int, bytes] = {}
        self._sharers: list[int] = []
        self._masked: Words = np.zeros(size, np.uint32)

    @property
    def came(self) -> int:
        """Clients heard at this stage."""
        return len(self._came)

    @property
    def least(self) -> int:
        """Clients without which this stage can't end."""
        if self.stage == Stage.KEYS:
            return MIN_CLIENTS
        return threshold_of(len(self._keys))

    @property
    def complete(self) -> bool:
        """Whether all clients were heard that still can be."""
        return self._waiting <= set(self._came)

    def take(self, message: SecureMessage) -> None:
        """Note a client's message.

        Raises:
            PayloadError: One out of order, twice, or of another form.
        """
        session = 0 if self.stage == Stage.KEYS else self._session
        wanted = (self.stage, self._round, self._model, session)
        found = (message.stage, message.round, message.model, message.session)
        if found != wanted:
            words = f"{message.stage.name}, round {message.round}, session {message.session}"
            expected = f"{self.stage.name}, round {self._round}, session {session}"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, words, expected)
        if message.sender in self._came:
            words = f"{message.stage.name} of {message.sender} again"
            raise PayloadError(Refusal.DUPLICATE, SCHEMA, words, "one each")
        if message.sender not in self._waiting and self.stage != Stage.KEYS:
            words = f"client {message.sender}"
            raise PayloadError(Refusal.NOT_SELECTED, SCHEMA, words, "one that began")
        self._check(message)
        self._came[message.sender] = message.data
        if self.stage == Stage.MASKED:  # only the sum is ever kept
            self._masked = self._masked + np.frombuffer(message.data, "<u4")
            self._came[message.sender] = b""

    def advance(self) -> SecureMessage | None:
        """End the stage; the server's next message, or None when the sum can be taken.

        Raises:
            FederationError: Too few clients were heard.
        """
        came = sorted(self._came)
        if len(came) < self.least:
            found = f"{len(came)} clients at stage {self.stage.name}"
            raise FederationError("secure aggregation", found, f"{self.least} or more")
        data, contents = b"", self._came
        if self.stage == Stage.KEYS:
            self._keys = contents
            rows = {(client,): key for client, key in contents.items()}
            data = PEERS_HEAD.pack(threshold_of(len(came)), self._limit) + write_rows(rows, 1)
        elif self.stage == Stage.SHARES:
            self._sharers = came
            boxes = {
                (sender, receiver[0]): box
                for sender in came
                for receiver, box in read_rows(contents[sender], 1, BOX_BYTES).items()
                if receiver[0] in contents
            }
            data = write_rows(boxes, 2)
        elif self.stage == Stage.MASKED:
            self.survivors = came
            data = write_rows({(client,): b"" for client in came}, 1)
        else:
            return None
        message = SecureMessage(
            Stage(self.stage + 1), self._round, self._model, self._session, 0, data
        )
        self.stage, self._came, self._waiting = Stage(self.stage + 2), {}, set(came)
        return message

    def total(self) -> NDArray[np.float64]:
        """The sum of the survivors' vectors, shape (size,), after the last stage.

        Raises:
            FederationError: Shares that fit no secret: a client sent wrong ones.
        """
        shares: dict[int, dict[int, bytes]] = {client: {} for client in self._sharers}
        for holder, data in self._came.items():
            for (owner,), share in read_rows(data, 1, SHARE_BYTES).items():
                if owner in shares:
                    shares[owner][holder] = share
        total, needed = self._masked, threshold_of(len(self._keys))
        for owner, held in shares.items():
            secret = restore(dict(sorted(held.items())[:needed]))
            if owner in self.survivors:
                total = total - stream(secret, self._size)
                continue
            key = X25519PrivateKey.from_private_bytes(secret)
            if key.public_key().public_bytes_raw() != self._keys[owner][KEY_BYTES:]:
                found = f"shares of {owner} that give another key"
                raise FederationError("secure aggregation", found, "its key")
            for other in self.survivors:
                seed = mask_seed(key, self._keys[other][KEY_BYTES:], self._session)
                total = total - pairwise_mask(other, owner, seed, self._size)
        return Quantiser(self._limit, len(self._keys)).backward(total)

    def _check(self, message: SecureMessage) -> None:
        """Form of the data, so that later stages can rely on it."""
        if self.stage == Stage.SHARES:
            expected = {(peer,) for peer in self._keys if peer != message.sender}
            good = set(read_rows(message.data, 1, BOX_BYTES)) == expected
        elif self.stage == Stage.REVEAL:
            good = set(read_rows(message.data, 1, SHARE_BYTES)) == {(c,) for c in self._sharers}
        else:
            size = 2 * KEY_BYTES if self.stage == Stage.KEYS else 4 * self._size
            good = len(message.data) == size
        if not good:
            found = f"{len(message.data)} bytes at stage {self.stage.name}"
            raise PayloadError(Refusal.SHAPE, SCHEMA, found, "a row per peer, or the model's size")
