"""Takes detection parameters from the meta-learner, or says with one reason why not."""

from __future__ import annotations

from dataclasses import replace

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Verifier
from geoorbit_ros.federated.theta import SCHEMA, ThetaPayload
from geoorbit_ros.lanes.parameters import BOUNDS, LaneParameters

MAX_BYTES = 1 << 16


class ThetaInbox:
    """Checks `LaneParameters` payloads for one camera.

    Args:
        camera_id: The camera they must be for.
        verifier: Checks their signatures.

    Attributes:
        taken: How many have been taken.
        version: Where theta is from, in words for people; whoever sets it otherwise says so here.
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
