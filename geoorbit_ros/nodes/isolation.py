"""A ROS domain of one's own on this machine."""

from __future__ import annotations

import os
import socket
from itertools import count

from geoorbit_ros.core.errors import GeoOrbitError

_FIRST, _LAST = 1, 100
"""Domain 0 is the default one; from 102 on Linux hands the ports out to others."""
_tries = count(os.getpid())
_BASE, _GAIN = 7400, 250
"""Discovery port of a domain: OMG DDS-RTPS 2.5, section 9.6.2.3."""


def free_domain_id() -> int:
    """A domain in which no participant runs on this machine; another one on every call.

    Raises:
        GeoOrbitError: All are taken.
    """
    number = _LAST - _FIRST + 1
    for _ in range(number):
        domain_id = _FIRST + next(_tries) % number
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:  # participants share this port among themselves, but not with a plain socket
                probe.bind(("", _BASE + _GAIN * domain_id))
            except OSError:
                continue
        return domain_id
    raise GeoOrbitError("ROS domains", f"{_FIRST} to {_LAST} in use", "a free one")
