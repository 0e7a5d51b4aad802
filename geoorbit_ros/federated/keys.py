"""Who is who: Ed25519 keys, signatures, and the roster of cameras that may take part."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)

from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import SIGNATURE_BYTES, UNSIGNED

UNSIGNED_WORD = "unsigned"
"""In a roster, in the place of a key: the camera's updates are taken without signatures."""


class Signer:
    """Signs the payloads of one federation (RFC 8032, Ed25519).

    Args:
        private: 32 bytes of private key; None leaves payloads unsigned (64 zeros).
        federation: Name of the federation. It is signed, too, without being sent: a payload of one
            federation is worth nothing in another.
    """

    def __init__(self, private: bytes | None, federation: str) -> None:
        self._key = Ed25519PrivateKey.from_private_bytes(private) if private else None
        self._context = context_of(federation)

    @property
    def public(self) -> bytes | None:
        """32 bytes of public key; None without keys."""
        return self._key.public_key().public_bytes_raw() if self._key else None

    def seal(self, unsigned: bytes) -> bytes:
        """A payload with its signature."""
        signature = self._key.sign(self._context + unsigned) if self._key else UNSIGNED
        return unsigned + signature


class Verifier:
    """Checks the signatures of one sender.

    Args:
        public: 32 bytes of public key; None takes any payload, signed or not.
        federation: Name of the federation, see `Signer`.

    Raises:
        FederationError: Not a public key.
    """

    __slots__ = ("_context", "_key")

    def __init__(self, public: bytes | None, federation: str) -> None:
        if public is not None and len(public) != 32:
            raise FederationError("public key", f"{len(public)} bytes", "32 bytes, 64 hex digits")
        self._key = Ed25519PublicKey.from_public_bytes(public) if public else None
        self._context = context_of(federation)

    def check(self, payload: bytes, place: str) -> None:
        """Compare signature and content.

        Raises:
            PayloadError: SIGNATURE.
        """
        if self._key is None:
            return
        content, signature = payload[:-SIGNATURE_BYTES], payload[-SIGNATURE_BYTES:]
        try:
            self._key.verify(signature, self._context + content)
        except InvalidSignature:
            found = "no signature" if signature == UNSIGNED else "a signature that is not the key's"
            raise PayloadError(
                Refusal.SIGNATURE, place, found, "one by the key on the roster"
            ) from None


def context_of(federation: str) -> bytes:
    """What is signed before the payload: keeps federations and other uses of a key apart."""
    return b"geoorbit_ros federated\0" + federation.encode() + b"\0"


def client_id(camera_id: str, public: bytes | None) -> int:
    """The 32-bit number by which payloads name a client: the first bytes of a SHA-256.

    Of the public key, or without one of the camera's name.
    """
    return int.from_bytes(hashlib.sha256(public or camera_id.encode()).digest()[:4], "little")


def read_private_key(path: str | Path) -> bytes:
    """A private key file: 64 hex digits.

    Raises:
        FederationError: No such file, or not a key.
    """
    try:
        return _from_hex(Path(path).read_text(encoding="ascii").strip(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise FederationError(str(path), error, "a file with 64 hex digits") from None


def write_private_key(path: str | Path) -> bytes:
    """Make a key, keep it in a new file that only its owner can read, return the public key.

    Raises:
        FederationError: The file exists or can't be written: a key is never replaced.
    """
    key = Ed25519PrivateKey.generate()
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(key.private_bytes_raw().hex() + "\n")
    except OSError as error:
        raise FederationError(str(path), error.strerror, "a new file to write a key to") from None
    return key.public_key().public_bytes_raw()


@dataclass(frozen=True, slots=True)
class Member:
    """A camera that may take part.

    Attributes:
        camera_id: Its name.
        public: Its public key; None: its updates are taken unsigned.
    """

    camera_id: str
    public: bytes | None

    @property
    def id(self) -> int:
        """The number that payloads carry."""
        return client_id(self.camera_id, self.public)


def public_key(text: str) -> bytes | None:
    """A public key as parameters give it: 64 hex digits, or empty for none.

    Raises:
        FederationError: Neither.
    """
    return _from_hex(text.strip(), "public key") if text.strip() else None


class Roster:
    """The allow list: cameras that may take part, by their number.

    Args:
        members: In any order; it does not matter.
        server: Public key of the server, which no camera may have; None: it has none.

    Raises:
        FederationError: No members, two of one name, key or number, or a camera with the name or
            the key of the server.
    """

    def __init__(self, members: Iterable[Member], server: bytes | None = None) -> None:
        self._members: dict[int, Member] = {}
        names: set[str] = set()
        for member in members:
            if server is not None and member.public == server:
                found = f"'{member.camera_id}' with the server's key"
                raise FederationError("roster", found, "a key of its own for each camera")
            if member.id in self._members or member.camera_id in names:
                found = f"'{member.camera_id}' twice, or two keys of the number {member.id}"
                raise FederationError("roster", found, "one entry and one key per camera")
            names.add(member.camera_id)
            self._members[member.id] = member
        if not self._members:
            raise FederationError("roster", "no camera", "at least one")

    @classmethod
    def read(cls, path: str | Path, server: bytes | None = None) -> Roster:
        """A text file with one camera per line: its name and its public key in 64 hex digits.

        `NAME unsigned` admits a camera without signatures, in whose name anybody can send; a line
        with a name alone does not: it is a key that was forgotten. `#` begins a comment.

        Raises:
            FederationError: Naming file and line; and as the class.
        """
        members = []
        try:
            lines = Path(path).read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FederationError(str(path), error, "a roster file") from None
        for number, line in enumerate(lines, 1):
            words = line.partition("#")[0].split()
            place = f"{path}, line {number}"
            if words and len(words) != 2:
                found = "a name without a key" if len(words) == 1 else f"{len(words)} words"
                expected = f"a name and a public key, or '{words[0]} {UNSIGNED_WORD}'"
                raise FederationError(place, found, expected)
            if words:
                signed = words[1] != UNSIGNED_WORD
                members.append(Member(words[0], _from_hex(words[1], place) if signed else None))
        return cls(members, server)

    def __len__(self) -> int:
        return len(self._members)

    @property
    def unsigned(self) -> tuple[str, ...]:
        """Names of the cameras whose updates are taken unsigned."""
        return tuple(m.camera_id for m in self._members.values() if m.public is None)

    def __iter__(self) -> Iterator[int]:
        """Numbers of the members, ascending: an order that no file and no network decides."""
        return iter(sorted(self._members))

    def get(self, number: int) -> Member | None:
        """The member of this number."""
        return self._members.get(number)


def _from_hex(text: str, place: str) -> bytes:
    try:
        raw = bytes.fromhex(text)
    except ValueError:
        raw = b""
    if len(raw) != 32:
        raise FederationError(place, f"{len(text)} characters", "a key of 64 hex digits")
    return raw
