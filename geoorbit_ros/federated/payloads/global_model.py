"""Payloads of the server: `GlobalModel`, the whole model, and `ModelDelta`, its change."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import PayloadReader, begin_payload
from geoorbit_ros.federated.payloads.model_layout import ModelLayout

SCHEMA, VERSION = "model", 3
"""Those of msg_defs/GlobalModel.msg."""
FINAL, MASKED, ASYNCHRONOUS, VALIDATING = 1, 2, 4, 8
"""Bits of `flags`, see msg_defs/GlobalModel.msg."""


@dataclass(frozen=True, slots=True)
class GlobalModel:
    """See msg_defs/GlobalModel.msg, whose fields these are."""

    encoding: int
    flags: int
    run: int
    round: int
    model: int
    interface: int
    approved: int
    validation_divisor: int
    proximal_mu: float
    clients: tuple[int, ...]
    layout: ModelLayout
    data: bytes

    def unsigned(self) -> bytes:
        """The serialisation up to the signature, which is to be appended."""
        writer = begin_payload(SCHEMA, VERSION)
        writer.number("B", self.encoding)
        writer.number("B", self.flags)
        numbers = (
            self.run,
            self.round,
            self.model,
            self.interface,
            self.approved,
            self.validation_divisor,
        )
        for number in numbers:
            writer.number("I", number)
        writer.number("f", self.proximal_mu)
        writer.numbers("I", self.clients)
        writer.texts(self.layout.names)
        writer.numbers("I", [len(shape) for shape in self.layout.shapes])
        writer.numbers("I", [extent for shape in self.layout.shapes for extent in shape])
        writer.data(self.data)
        return writer.message()

    @classmethod
    def decode(cls, payload: bytes) -> GlobalModel:
        """Read a payload; its data and signature are not looked at yet.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION, MALFORMED, SHAPE or NOT_FINITE.
        """
        reader = PayloadReader(payload, SCHEMA, VERSION)
        encoding, flags = reader.whole("B"), reader.whole("B")
        run, number, model, interface, approved, validation_divisor = (
            reader.whole("I") for _ in range(6)
        )
        proximal_mu = reader.number("f")
        if not (math.isfinite(proximal_mu) and proximal_mu >= 0):
            found = f"proximal_mu {proximal_mu}"
            raise PayloadError(Refusal.NOT_FINITE, SCHEMA, found, "a number from 0")
        clients = tuple(reader.numbers("I").tolist())
        layout = _layout(reader)
        data = bytes(reader.data())
        reader.finish()
        return cls(
            encoding,
            flags,
            run,
            number,
            model,
            interface,
            approved,
            validation_divisor,
            proximal_mu,
            clients,
            layout,
            data,
        )


def _layout(reader: PayloadReader) -> ModelLayout:
    names = reader.texts()
    ranks = reader.numbers("I").tolist()
    extents = reader.numbers("I").tolist()
    if sum(ranks) != len(extents):
        found = f"{len(extents)} dimensions"
        raise PayloadError(Refusal.SHAPE, SCHEMA, found, f"{sum(ranks)}, the sum of the ranks")
    shapes, at = [], 0
    for rank in ranks:
        shapes.append(tuple(extents[at : at + rank]))
        at += rank
    return ModelLayout(tuple(names), tuple(shapes))


def interface_digest(inputs: Sequence[str], outputs: Sequence[str]) -> int:
    """A number for the names of a model's inputs and outputs, in order.

    Two sides with other features would multiply weights with what they were not made for.
    """
    return zlib.crc32("|".join([",".join(inputs), ",".join(outputs)]).encode())


DELTA_SCHEMA, DELTA_VERSION = "delta", 2
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
        writer = begin_payload(DELTA_SCHEMA, DELTA_VERSION)
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
        reader = PayloadReader(payload, DELTA_SCHEMA, DELTA_VERSION)
        encoding, flags = reader.whole("B"), reader.whole("B")
        number, base, model, approved = (reader.whole("I") for _ in range(4))
        clients = tuple(reader.numbers("I").tolist())
        data = bytes(reader.data())
        reader.finish()
        return cls(encoding, flags, number, base, model, approved, clients, data)
