"""Payload `SecureAggregation`: one step of a masked sum, and the tables inside its data."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import PayloadReader, begin_payload

SCHEMA, VERSION = "secure", 2
"""Those of msg_defs/SecureAggregation.msg."""
Key = TypeVar("Key", bound=tuple[int, ...])


class Stage(IntEnum):
    """Steps, in their order; clients send the even ones, the server the others."""

    KEYS = 0
    PEERS = 1
    SHARES = 2
    BUNDLES = 3
    MASKED = 4
    SURVIVORS = 5
    REVEAL = 6


@dataclass(frozen=True, slots=True)
class SecureMessage:
    """See msg_defs/SecureAggregation.msg, whose fields these are."""

    stage: Stage
    round: int
    model: int
    session: int
    sender: int
    data: bytes

    def unsigned(self) -> bytes:
        """The serialisation up to the signature, which is to be appended."""
        writer = begin_payload(SCHEMA, VERSION)
        writer.number("B", self.stage)
        writer.number("B", 0)
        for number in (self.round, self.model, self.session, self.sender):
            writer.number("I", number)
        writer.data(self.data)
        return writer.message()

    @classmethod
    def decode(cls, payload: bytes) -> SecureMessage:
        """Read a payload; its data and signature are not looked at yet.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION or MALFORMED.
        """
        reader = PayloadReader(payload, SCHEMA, VERSION)
        stage, flags = reader.whole("B"), reader.whole("B")
        if stage > max(Stage) or flags:
            found = f"stage {stage}, flags {flags}"
            raise PayloadError(Refusal.MALFORMED, SCHEMA, found, "stage 0 to 6, flags 0")
        number, model, session, sender = (reader.whole("I") for _ in range(4))
        data = bytes(reader.data())
        reader.finish()
        return cls(Stage(stage), number, model, session, sender, data)


def write_rows(rows: Mapping[Key, bytes], width: int) -> bytes:
    """A table: each row some 32-bit numbers as its key, then bytes, all of one length."""
    parts = [struct.pack(f"<{width}I", *key) + value for key, value in sorted(rows.items())]
    return b"".join(parts)


def read_rows(data: bytes, width: int, length: int) -> dict[tuple[int, ...], bytes]:
    """What `write_rows` wrote.

    Raises:
        PayloadError: MALFORMED, for another length or a key that comes twice.
    """
    step = 4 * width + length
    rows = {
        struct.unpack_from(f"<{width}I", data, at): data[at + 4 * width : at + step]
        for at in range(0, len(data) - step + 1, step)
    }
    if len(data) % step or len(rows) != len(data) // step:
        found = f"{len(data)} bytes with {len(rows)} keys"
        raise PayloadError(Refusal.MALFORMED, SCHEMA, found, f"rows of {step} bytes, keys once")
    return rows
