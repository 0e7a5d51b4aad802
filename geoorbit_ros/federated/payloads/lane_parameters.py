"""Payload `LaneParameters`: what the meta-learner predicts for one camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Verifier
from geoorbit_ros.federated.payloads.header import PayloadReader, begin_payload
from geoorbit_ros.lanes.parameters import BOUNDS, LaneParameters

SCHEMA, VERSION = "theta", 3
"""Those of msg_defs/LaneParameters.msg."""


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
        writer = begin_payload(SCHEMA, VERSION)
        writer.text(self.camera_id)
        for number in (self.run, self.round, self.model):
            writer.number("I", number)
        writer.texts(list(self.values))
        writer.numbers("d", list(self.values.values()))
        return writer.message()

    @classmethod
    def decode(cls, payload: bytes) -> ThetaPayload:
        """Read a payload; its signature is not looked at.

        Raises:
            PayloadError: TOO_LONG, TRUNCATED, FOREIGN, VERSION, MALFORMED, SHAPE or NOT_FINITE.
        """
        reader = PayloadReader(payload, SCHEMA, VERSION)
        camera_id = reader.text()
        run, number, model = (reader.whole("I") for _ in range(3))
        names = reader.texts()
        values = [float(value) for value in reader.numbers("d").tolist()]
        reader.finish()
        if len(names) != len(values) or len(set(names)) != len(names):
            found = f"{len(values)} values for the names {', '.join(names)[:80]}"
            raise PayloadError(Refusal.SHAPE, SCHEMA, found, "one value per name")
        if not all(math.isfinite(value) for value in values):
            raise PayloadError(Refusal.NOT_FINITE, SCHEMA, values[:9], "finite numbers")
        return cls(camera_id, run, number, model, dict(zip(names, values, strict=True)))


MAX_BYTES = 1 << 16
"""Longest payload that is read. Chosen: some hundred times what three parameters need."""


class ThetaInbox:
    """Checks `LaneParameters` payloads for one camera.

    Args:
        camera_id: The camera they must be for.
        verifier: Checks their signatures.

    Attributes:
        taken: How many have been taken.
        version: Where theta is from, in words for people. Set it, too, when theta is set otherwise.
    """

    def __init__(self, camera_id: str, verifier: Verifier) -> None:
        self._camera_id, self._verifier = camera_id, verifier
        self._newest = (0, 0)
        self.taken, self.version = 0, "own"

    def take(self, payload: bytes, current: LaneParameters) -> LaneParameters:
        """Theta from now on: `current` with the values that the payload names.

        A payload of the same round as the last is taken, too: parameters set by hand have none.

        Raises:
            PayloadError: With any reason; nothing has changed then.
        """
        if len(payload) > MAX_BYTES:
            found = f"{len(payload)} bytes"
            raise PayloadError(Refusal.TOO_LONG, SCHEMA, found, f"{MAX_BYTES} at most")
        theta = ThetaPayload.decode(payload)
        if theta.camera_id != self._camera_id:
            found = f"parameters for '{theta.camera_id}'"
            raise PayloadError(Refusal.UNKNOWN_SENDER, SCHEMA, found, f"for '{self._camera_id}'")
        of = (theta.run, theta.round)
        if of < self._newest:
            found, expected = f"run, round {of}", f"{self._newest} or later"
            raise PayloadError(Refusal.OLD_ROUND, SCHEMA, found, expected)
        self._verifier.check(payload, SCHEMA)
        if unknown := set(theta.values) - set(BOUNDS):
            found, expected = ", ".join(sorted(unknown))[:80], ", ".join(BOUNDS)
            raise PayloadError(Refusal.SHAPE, SCHEMA, f"parameters {found}", expected)
        try:
            changed = replace(current, **theta.values)
        except ParameterError as error:
            raise PayloadError(
                Refusal.OUT_OF_RANGE, error.place, error.found, error.expected
            ) from None
        self._newest = of
        self.taken += 1
        self.version = _origin(theta)
        return changed


def _origin(theta: ThetaPayload) -> str:
    if theta.model == 0:
        return "defaults" if theta.run else "by hand"
    return f"round {theta.round}" if theta.run else "a model"
