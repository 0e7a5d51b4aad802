"""What all payloads share: schema, version, a limit on length, and the signature at the end."""

from __future__ import annotations

from geoorbit_ros.federated.errors import PayloadError, Refusal

SIGNATURE_BYTES = 64
UNSIGNED = bytes(SIGNATURE_BYTES)
MAX_PAYLOAD_BYTES = 1 << 26
"""64 MiB: a model of the largest allowed size as float32 just fits."""
FRAMING_BYTES = 16
"""What std_msgs/ByteMultiArray adds on the wire: encapsulation, empty layout, length."""


def prefix(schema: str, version: int) -> bytes:
    """The first bytes of a payload, up to its version, alignment included."""
    text = schema.encode() + b"\0"
    head = b"\x00\x01\x00\x00" + len(text).to_bytes(4, "little") + text
    return head + bytes(len(head) % 2) + version.to_bytes(2, "little")


def schema_of(payload: bytes) -> str:
    """The schema that a payload names; empty when it names none. Never raises."""
    length = int.from_bytes(payload[4:8], "little")
    if not 2 <= length <= 64 or len(payload) < 8 + length:
        return ""
    return payload[8 : 7 + length].decode("ascii", errors="replace")


def check_prefix(payload: bytes, schema: str, version: int) -> None:
    """Refuse what is too long, too short, or of another schema or version.

    Raises:
        PayloadError: TOO_LONG, TRUNCATED, FOREIGN or VERSION.
    """
    wanted = prefix(schema, version)
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
