"""Payload `LaneParameters`: what the meta-learner predicts for one camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from geoorbit_ros.federated.cdr import CdrReader, CdrWriter
from geoorbit_ros.federated.envelope import SIGNATURE_BYTES, check_prefix
from geoorbit_ros.federated.errors import PayloadError, Refusal

SCHEMA, VERSION = "theta", 3


@dataclass(frozen=True, slots=True)
class ThetaPayload:
    """See msg_defs/LaneParameters.msg, whose fields these are; `values` by name."""

    camera_id: str
    run: int
    round: int
    model: int
    values: Mapping[str, float]

    def unsigned(self) -> bytes:
        """The serialisation up to the signature, which is to be appended."""
        writer = CdrWriter()
        writer.text(SCHEMA)
        writer.number("H", VERSION)
        writer.text(self.camera_id)
        for number in (self.run, self.round, self.model):
            writer.number("I", number)
        writer.texts(list(self.values))
        writer.numbers("d", list(self.values.values()))
        return writer.payload()

    @classmethod
    def decode(cls, payload: bytes) -> ThetaPayload:
        """Read a payload; its signature is not looked at.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION, MALFORMED, SHAPE or NOT_FINITE.
        """
        check_prefix(payload, SCHEMA, VERSION)
        reader = CdrReader(payload, SCHEMA)
        reader.text()
        reader.number("H")
        camera_id = reader.text()
        run, number, model = (reader.whole("I") for _ in range(3))
        names = reader.texts()
        values = [float(value) for value in reader.numbers("d").tolist()]
        reader.fixed(SIGNATURE_BYTES)
        reader.end()
        if len(names) != len(values) or len(set(names)) != len(names):
            found = f"{len(values)} values for the names {', '.join(names)[:80]}"
            raise PayloadError(Refusal.SHAPE, SCHEMA, found, "one value per name")
        if not all(math.isfinite(value) for value in values):
            raise PayloadError(Refusal.NOT_FINITE, SCHEMA, values[:9], "finite numbers")
        return cls(camera_id, run, number, model, dict(zip(names, values, strict=True)))
