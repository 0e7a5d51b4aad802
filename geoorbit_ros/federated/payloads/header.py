"""What all payloads share: a header of schema and version, and the signature at the end."""

from __future__ import annotations

from functools import cache
from typing import NoReturn

from geoorbit_ros.core.cdr import CdrReader, CdrWriter
from geoorbit_ros.federated.errors import PayloadError, Refusal

SIGNATURE_BYTES = 64
"""Length of an Ed25519 signature (RFC 8032)."""
UNSIGNED = bytes(SIGNATURE_BYTES)
"""In the place of a signature, where a federation has no keys."""
MAX_PAYLOAD_BYTES = 1 << 26
"""64 MiB: a model of the largest allowed size as float32 just fits."""
FRAMING_BYTES = 16
"""What std_msgs/ByteMultiArray adds on the wire: encapsulation, empty layout, length."""


def begin_payload(schema: str, version: int) -> CdrWriter:
    """A writer behind the header of a payload."""
    writer = CdrWriter()
    writer.text(schema)
    writer.number("H", version)
    return writer


@cache
def header_bytes(schema: str, version: int) -> bytes:
    """The first bytes of a payload, up to its version, alignment included."""
    return begin_payload(schema, version).message()


def schema_of(payload: bytes) -> str:
    """The schema that a payload names; empty when it names none. Never raises."""
    length = int.from_bytes(payload[4:8], "little")
    if not 2 <= length <= 64 or len(payload) < 8 + length:
        return ""
    return payload[8 : 7 + length].decode("ascii", errors="replace")


def check_header(payload: bytes, schema: str, version: int) -> None:
    """Refuse what is too long, too short, or of another schema or version.

    Raises:
        PayloadError: TOO_LONG, TRUNCATED, FOREIGN or VERSION.
    """
    wanted = header_bytes(schema, version)
    if len(payload) > MAX_PAYLOAD_BYTES:
        found = f"{len(payload)} bytes"
        raise PayloadError(Refusal.TOO_LONG, schema, found, f"{MAX_PAYLOAD_BYTES} at most")
    if payload.startswith(wanted):
        return
    if wanted.startswith(payload):
        raise PayloadError(Refusal.TRUNCATED, schema, f"{len(payload)} bytes", "a whole payload")
    if not payload.startswith(wanted[:-2]):
        found = repr(schema_of(payload)) if schema_of(payload) else payload[:8].hex()
        raise PayloadError(Refusal.FOREIGN, schema, f"schema {found}", f"schema '{schema}'")
    number = int.from_bytes(payload[len(wanted) - 2 : len(wanted)], "little")
    raise PayloadError(Refusal.VERSION, schema, f"version {number}", f"version {version}")


class PayloadReader(CdrReader):
    """Reads the fields behind the header of a payload.

    Args:
        payload: With header and signature.
        schema: What it must be.
        version: Of that schema.

    Raises:
        PayloadError: TOO_LONG, TRUNCATED, FOREIGN or VERSION; all methods TRUNCATED where the
            payload ends too early, and MALFORMED where a length or a text can't be.
    """

    __slots__ = ()

    def __init__(self, payload: bytes, schema: str, version: int) -> None:
        check_header(payload, schema, version)
        super().__init__(payload, schema, "a whole payload")
        self._at = len(header_bytes(schema, version))

    def finish(self) -> None:
        """The signature comes next, and then nothing.

        Raises:
            PayloadError: TRUNCATED or TOO_LONG.
        """
        self.take(SIGNATURE_BYTES)
        self.end()

    def _truncated(self, found: str, expected: str) -> NoReturn:
        raise PayloadError(Refusal.TRUNCATED, self._place, found, expected)

    def _malformed(self, found: str, expected: str) -> NoReturn:
        raise PayloadError(Refusal.MALFORMED, self._place, found, expected)

    def _too_long(self, found: str, expected: str) -> NoReturn:
        raise PayloadError(Refusal.TOO_LONG, self._place, found, expected)
