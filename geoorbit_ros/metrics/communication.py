"""The paper's communication cost (section IV-D)."""

from __future__ import annotations

from geoorbit_ros.core.errors import ParameterError


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
