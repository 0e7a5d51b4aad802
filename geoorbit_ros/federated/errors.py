"""Why a payload is refused: one reason each, to be counted."""

from __future__ import annotations

from enum import StrEnum

from geoorbit_ros.core.errors import GeoOrbitError


class Refusal(StrEnum):
    """Reasons to refuse a payload, in the order in which they are looked for."""

    TOO_LONG = "too long"
    TRUNCATED = "truncated"
    FOREIGN = "foreign schema"
    VERSION = "other version"
    MALFORMED = "malformed"
    UNKNOWN_SENDER = "unknown sender"
    OLD_ROUND = "old round"
    FUTURE_ROUND = "future round"
    DUPLICATE = "duplicate"
    OTHER_MODEL = "other model"
    NOT_SELECTED = "not selected"
    SIGNATURE = "bad signature"
    ENCODING = "other encoding"
    SHAPE = "other shape"
    NOT_FINITE = "not finite"
    OUT_OF_RANGE = "out of range"


class PayloadError(GeoOrbitError):
    """A payload that can't be used.

    Args:
        reason: The one reason, also the name of its counter.
        place: What was being read, such as `ClientUpdate`.
        found: What was found there.
        expected: What would have been accepted.
    """

    def __init__(self, reason: Refusal, place: str, found: object, expected: str) -> None:
        self.reason = reason
        super().__init__(place, found, expected)


class FederationError(GeoOrbitError):
    """A roster, key, checkpoint or setting with which no federation can run."""
