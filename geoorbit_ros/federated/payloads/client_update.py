"""Payload `ClientUpdate`: what one camera learned in one round.

Every field but the data has a fixed place, so one `struct` reads it: a server takes thousands.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import SIGNATURE_BYTES, check_header, header_bytes

SCHEMA, VERSION = "update", 3
"""Those of msg_defs/ClientUpdate.msg."""
_HEADER = header_bytes(SCHEMA, VERSION)
_FIELDS = struct.Struct("<BBIIIIffI")
_HEADER_BYTES = len(_HEADER) + _FIELDS.size


@dataclass(frozen=True, slots=True)
class ClientUpdate:
    """See msg_defs/ClientUpdate.msg, whose fields these are.

    Without examples (`sample_count` 0) and data it comes from a validation client and says only
    `gain`.
    """

    encoding: int
    round: int
    model: int
    client: int
    sample_count: int
    loss: float
    gain: float
    data: bytes

    def unsigned(self) -> bytes:
        """The serialisation up to the signature, which is to be appended."""
        fields = _FIELDS.pack(
            self.encoding,
            0,
            self.round,
            self.model,
            self.client,
            self.sample_count,
            self.loss,
            self.gain,
            len(self.data),
        )
        return _HEADER + fields + self.data

    @classmethod
    def decode(cls, payload: bytes) -> ClientUpdate:
        """Read a payload; its data and signature are not looked at yet.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION or MALFORMED.
        """
        check_header(payload, SCHEMA, VERSION)
        end = len(payload) - SIGNATURE_BYTES
        if end < _HEADER_BYTES:
            found = f"{len(payload)} bytes"
            expected = f"{_HEADER_BYTES + SIGNATURE_BYTES} or more"
            raise PayloadError(Refusal.TRUNCATED, SCHEMA, found, expected)
        encoding, flags, number, model, client, samples, loss, gain, length = _FIELDS.unpack_from(
            payload, len(_HEADER)
        )
        if flags:
            raise PayloadError(Refusal.MALFORMED, SCHEMA, f"flags {flags}", "0")
        if length != end - _HEADER_BYTES:
            reason = Refusal.TRUNCATED if length > end - _HEADER_BYTES else Refusal.TOO_LONG
            found = f"{end - _HEADER_BYTES} bytes of data"
            raise PayloadError(reason, SCHEMA, found, f"the {length} it names")
        data = payload[_HEADER_BYTES:end]
        return cls(encoding, number, model, client, samples, loss, gain, data)
