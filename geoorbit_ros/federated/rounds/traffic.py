"""Counts the bytes that cross the wire."""

from __future__ import annotations

from dataclasses import dataclass

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.federated.payloads.header import FRAMING_BYTES


@dataclass(slots=True)
class Traffic:
    """Bytes and messages in both directions.

    A message to n clients counts n times. Counted is the serialised `std_msgs/ByteMultiArray`:
    payload with names, numbers, encoded weights and signature, and 16 bytes of framing. Headers of
    DDS, UDP and IP and DDS discovery are not.

    Attributes:
        down_bytes: From the server to clients.
        down_messages: Their number.
        up_bytes: From clients to the server.
        up_messages: Their number.
    """

    down_bytes: int = 0
    down_messages: int = 0
    up_bytes: int = 0
    up_messages: int = 0

    def down(self, payload: bytes, receivers: int) -> None:
        """Count a payload sent to so many clients."""
        self.down_bytes += receivers * (len(payload) + FRAMING_BYTES)
        self.down_messages += receivers

    def up(self, payload: bytes) -> None:
        """Count a payload sent to the server."""
        self.up_bytes += len(payload) + FRAMING_BYTES
        self.up_messages += 1

    @property
    def total_bytes(self) -> int:
        """Everything."""
        return self.down_bytes + self.up_bytes

    def bits_per_second(self, seconds: float) -> float:
        """The paper's BPS (section IV-D): bits transmitted by time of communication."""
        return 8 * self.total_bytes / seconds


def bits_per_second(total_bytes: int, duration_s: float) -> float:
    """BPS = total bits transmitted / total communication time in seconds.

    Args:
        total_bytes: What crossed the wire in both directions, headers and signatures included.
        duration_s: Time that the exchange took.

    Raises:
        ParameterError: A negative number of bytes, or a duration that is not positive.
    """
    if total_bytes < 0:
        raise ParameterError("bytes transmitted", total_bytes, "0 or more")
    if not duration_s > 0.0:
        raise ParameterError("communication time", f"{duration_s} s", "more than 0 s")
    return 8.0 * total_bytes / duration_s
