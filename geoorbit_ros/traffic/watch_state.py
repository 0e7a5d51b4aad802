"""The state of who watches for events, as bytes: a watch that is stopped goes on from it.

What is told of a lane rests on hours of traffic, so a watch that began anew would tell other
things. The state is a pickle of the watch's own objects. It is read with a closed list of types
("Restricting Globals" in the documentation of `pickle`), so that a foreign file can run nothing.
Only the code that wrote a state reads it: after an update the watch begins anew.
"""

from __future__ import annotations

import io
import pickle
import zlib
from collections import deque
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneEvidence
from geoorbit_ros.traffic import (
    event_records,
    events,
    lane_flow,
    moments,
    queues,
    road_coordinates,
    standing,
    watched_tracks,
    wrong_way,
)
from geoorbit_ros.traffic.events import EventWatch

MODULES = (
    event_records,
    events,
    lane_flow,
    moments,
    queues,
    road_coordinates,
    standing,
    watched_tracks,
    wrong_way,
)
"""Whose classes a state is made of."""
PROTOCOL = 4
"""Of pickle: with it arrays are made of the types below alone."""
_CRC_BYTES = 4


def pack_watch(watch: EventWatch) -> bytes:
    """The state of a watch."""
    return code_checksum() + zlib.compress(pickle.dumps(watch, PROTOCOL))


def unpack_watch(data: bytes) -> EventWatch | None:
    """The watch; None where another version wrote it, or it is damaged."""
    if data[:_CRC_BYTES] != code_checksum():
        return None
    try:
        found = _OwnTypes(io.BytesIO(zlib.decompress(data[_CRC_BYTES:]))).load()
    except (
        zlib.error, pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError,
        LookupError, ImportError, OverflowError, MemoryError,
    ):  # fmt: skip
        return None
    return found if isinstance(found, EventWatch) else None


@lru_cache(maxsize=1)
def code_checksum() -> bytes:
    """Of the code that a state belongs to, and of numpy's version."""
    sum_of = zlib.crc32(np.__version__.encode())
    for module in MODULES:
        assert module.__file__ is not None
        sum_of = zlib.crc32(Path(module.__file__).read_bytes(), sum_of)
    return sum_of.to_bytes(_CRC_BYTES, "little")


@lru_cache(maxsize=1)
def _types() -> dict[tuple[str, str], Any]:
    """All types and makers of arrays that a state may name."""
    found: list[Any] = [deque, Lane, LaneEdge, LaneEvidence, np.dtype, np.ndarray]
    for module in MODULES:
        members = vars(module).values()
        found += [m for m in members if isinstance(m, type) and m.__module__ == module.__name__]
    made: dict[tuple[str, str], Any] = {(m.__module__, m.__qualname__): m for m in found}
    makers: tuple[Any, Any] = np.empty(0).__reduce__()[0], np.float64(0.0).__reduce__()[0]
    made |= {(maker.__module__, maker.__name__): maker for maker in makers}
    return made


class _OwnTypes(pickle.Unpickler):
    """Makes objects of the types of a state, and no others."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """The type of a name.

        Raises:
            UnpicklingError: It is none of a state's.
        """
        try:
            return _types()[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(f"{module_name}.{global_name} is no state's") from None
