"""A client's side of a masked sum: hides one update, helps to unmask the sum, once."""

from __future__ import annotations

import secrets
import struct

import numpy as np
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.privacy.message import (
    SCHEMA,
    SecureMessage,
    Stage,
    read_rows,
    write_rows,
)
from geoorbit_ros.federated.privacy.random_stream import (
    Quantiser,
    pairwise_mask,
    shared_key,
    stream,
)
from geoorbit_ros.federated.privacy.shamir import SHARE_BYTES, split

KEY_BYTES = 32
"""Of an X25519 public key (RFC 7748)."""
BOX_BYTES = 2 * SHARE_BYTES + 16
"""Two shares and the 16-byte tag of the encryption."""
PEERS_HEAD = struct.Struct("<If")


class Participant:
    """Takes part in one masked sum with one vector; makes fresh secrets, kept in memory alone.

    Args:
        own_id: Number of the client.
        round_number: The round.
        model: Digest of the model that the update starts from.
        values: What is summed, shape (size,).
    """

    def __init__(
        self, own_id: int, round_number: int, model: int, values: NDArray[np.float32]
    ) -> None:
        self._id, self._round, self._model, self._values = own_id, round_number, model, values
        self._box_key, self._mask_key = X25519PrivateKey.generate(), X25519PrivateKey.generate()
        self._self_seed = secrets.token_bytes(KEY_BYTES)
        self._next = Stage.PEERS
        self._session = 0
        self._peers: dict[int, bytes] = {}
        self._sharers: list[int] = []
        self._held: dict[int, bytes] = {}

    def keys(self) -> SecureMessage:
        """The first message: both public keys."""
        data = self._box_key.public_key().public_bytes_raw()
        return self._message(Stage.KEYS, data + self._mask_key.public_key().public_bytes_raw())

    def answer(self, message: SecureMessage) -> SecureMessage:
        """The next message.

        Raises:
            PayloadError: A step out of its order, or one that would give an update away.
        """
        if message.stage != self._next or (message.round, message.model) != (
            self._round,
            self._model,
        ):
            found = f"stage {message.stage.name} of round {message.round}"
            expected = f"{self._next.name} of round {self._round}"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, found, expected)
        if message.stage != Stage.PEERS and message.session != self._session:
            found, expected = f"session {message.session}", f"{self._session}"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, found, expected)
        if message.stage == Stage.PEERS:
            reply = self._share(message)
        elif message.stage == Stage.BUNDLES:
            reply = self._mask(message)
        else:
            reply = self._reveal(message)
        self._next = Stage(min(message.stage + 2, Stage.SURVIVORS + 1))
        return reply

    def _share(self, message: SecureMessage) -> SecureMessage:
        if len(message.data) < PEERS_HEAD.size:
            raise PayloadError(Refusal.MALFORMED, SCHEMA, "no threshold", "a threshold")
        threshold, limit = PEERS_HEAD.unpack_from(message.data)
        rows = read_rows(message.data[PEERS_HEAD.size :], 1, 2 * KEY_BYTES)
        self._peers = {key[0]: value for key, value in rows.items()}
        own = self._peers.get(self._id, b"")
        number = len(self._peers)
        # Half or fewer could be a server's own inventions, or be asked twice.
        if own != self.keys().data or not number / 2 < threshold <= number or not limit > 0:
            found = f"{number} peers, threshold {threshold}, range {limit}"
            raise PayloadError(Refusal.OUT_OF_RANGE, SCHEMA, found, "this client among the peers")
        self._session, self._threshold = message.session, threshold
        self._quantiser = Quantiser(limit, number)
        points = sorted(self._peers)
        mask_shares = split(self._mask_key.private_bytes_raw(), points, threshold)
        seed_shares = split(self._self_seed, points, threshold)
        self._held[self._id] = mask_shares[self._id] + seed_shares[self._id]
        boxes = {
            (peer,): self._box(peer).encrypt(
                _nonce(self._id), mask_shares[peer] + seed_shares[peer], self._purpose()
            )
            for peer in points
            if peer != self._id
        }
        return self._message(Stage.SHARES, write_rows(boxes, 1))

    def _mask(self, message: SecureMessage) -> SecureMessage:
        rows = read_rows(message.data, 2, BOX_BYTES)
        self._sharers = sorted({sender for sender, _ in rows} | {self._id})
        if len(self._sharers) < self._threshold or not set(self._sharers) <= set(self._peers):
            found = f"shares of {len(self._sharers)} peers"
            raise PayloadError(Refusal.OUT_OF_RANGE, SCHEMA, found, f"{self._threshold} or more")
        for (sender, receiver), box in rows.items():
            if receiver != self._id:
                continue
            try:
                shares = self._box(sender).decrypt(_nonce(sender), box, self._purpose())
            except InvalidTag:
                found = f"shares of {sender} that can't be decrypted"
                raise PayloadError(Refusal.SIGNATURE, SCHEMA, found, "shares for me") from None
            self._held[sender] = shares
        total = self._quantiser.forward(self._values) + stream(self._self_seed, len(self._values))
        for peer in self._sharers:
            if peer != self._id:
                seed = mask_seed(self._mask_key, self._peers[peer][KEY_BYTES:], self._session)
                total = total + pairwise_mask(self._id, peer, seed, len(total))
        return self._message(Stage.MASKED, total.astype("<u4").tobytes())

    def _reveal(self, message: SecureMessage) -> SecureMessage:
        survivors = {key[0] for key in read_rows(message.data, 1, 0)}
        if len(survivors) < self._threshold or not survivors <= set(self._sharers):
            found = f"{len(survivors)} survivors"
            raise PayloadError(Refusal.OUT_OF_RANGE, SCHEMA, found, f"{self._threshold} or more")
        # One share per peer, never both: both together would lay an update bare.
        shares = {
            (peer,): share[SHARE_BYTES:] if peer in survivors else share[:SHARE_BYTES]
            for peer, share in self._held.items()
        }
        return self._message(Stage.REVEAL, write_rows(shares, 1))

    def _box(self, peer: int) -> ChaCha20Poly1305:
        try:
            key = shared_key(self._box_key, self._peers[peer][:KEY_BYTES], b"box" + self._purpose())
        except (KeyError, ValueError):
            found = f"no usable key of {peer}"
            raise PayloadError(Refusal.SIGNATURE, SCHEMA, found, "an X25519 key") from None
        return ChaCha20Poly1305(key)

    def _purpose(self) -> bytes:
        return struct.pack("<III", self._round, self._model, self._session)

    def _message(self, stage: Stage, data: bytes) -> SecureMessage:
        return SecureMessage(stage, self._round, self._model, self._session, self._id, data)


def mask_seed(own: X25519PrivateKey, other: bytes, session: int) -> bytes:
    """Seed of the mask between two clients, from either's private key.

    Raises:
        PayloadError: SIGNATURE, for a public key with which nothing can be agreed.
    """
    try:
        return shared_key(own, other, b"mask" + struct.pack("<I", session))
    except ValueError:
        raise PayloadError(Refusal.SIGNATURE, SCHEMA, "an unusable key", "an X25519 key") from None


def _nonce(sender: int) -> bytes:
    """Both directions between two clients have the same key, so the sender makes the nonce."""
    return sender.to_bytes(12, "little")
