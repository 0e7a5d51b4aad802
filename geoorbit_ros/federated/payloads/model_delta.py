"""Payload `ModelDelta`: the change of the global model since the round before."""

from __future__ import annotations

from dataclasses import dataclass

from geoorbit_ros.federated.payloads.header import PayloadReader, begin_payload

SCHEMA, VERSION = "delta", 2
"""Those of msg_defs/ModelDelta.msg."""


@dataclass(frozen=True, slots=True)
class ModelDelta:
    """See msg_defs/ModelDelta.msg, whose fields these are."""

    encoding: int
    flags: int
    round: int
    base: int
    model: int
    approved: int
    clients: tuple[int, ...]
    data: bytes

    def unsigned(self) -> bytes:
        """The serialisation up to the signature, which is to be appended."""
        writer = begin_payload(SCHEMA, VERSION)
        writer.number("B", self.encoding)
        writer.number("B", self.flags)
        for number in (self.round, self.base, self.model, self.approved):
            writer.number("I", number)
        writer.numbers("I", self.clients)
        writer.data(self.data)
        return writer.message()

    @classmethod
    def decode(cls, payload: bytes) -> ModelDelta:
        """Read a payload; its data and signature are not looked at yet.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION or MALFORMED.
        """
        reader = PayloadReader(payload, SCHEMA, VERSION)
        encoding, flags = reader.whole("B"), reader.whole("B")
        number, base, model, approved = (reader.whole("I") for _ in range(4))
        clients = tuple(reader.numbers("I").tolist())
        data = bytes(reader.data())
        reader.finish()
        return cls(encoding, flags, number, base, model, approved, clients, data)
