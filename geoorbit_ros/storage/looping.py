"""A recording at another time: again and again with stamps that go on, or as if it were live.

Time that jumps back makes every reader start anew: filters, transforms, lane maps. So each round
is moved behind the one before, in recording time and in the messages' own stamps.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.storage.bag_reader import BagMessage

_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""A header's stamp comes first, after the encapsulation header (OMG DDS-RTPS 2.5, section 10)."""
_LITTLE_ENDIAN = 1


def endless(read: Callable[[], Iterable[BagMessage]]) -> Iterator[BagMessage]:
    """All messages again and again; ends at once for a recording without messages.

    Args:
        read: Reads the recording from its beginning, in the order of recording time.
    """
    shift_ns = 0
    while True:
        first_ns = last_ns = None
        times: set[int] = set()
        for message in read():
            first_ns = message.time_ns if first_ns is None else first_ns
            last_ns = message.time_ns
            if shift_ns == 0:
                times.add(message.time_ns)
            yield _moved(message, shift_ns) if shift_ns else message
        if first_ns is None or last_ns is None:
            return
        if shift_ns == 0:
            # The pause between two rounds is that between two frames.
            length_ns = last_ns - first_ns
            period_ns = length_ns + max(length_ns // max(len(times) - 1, 1), 1)
        shift_ns += period_ns


def begun_at(messages: Iterable[BagMessage], first_ns: int) -> Iterator[BagMessage]:
    """The messages, moved in time so that the first was recorded at `first_ns`."""
    shift_ns: int | None = None
    for message in messages:
        shift_ns = first_ns - message.time_ns if shift_ns is None else shift_ns
        yield _moved(message, shift_ns)


def _moved(message: BagMessage, shift_ns: int) -> BagMessage:
    """A message recorded, and stamped, later by `shift_ns`."""
    cdr = message.cdr
    if _has_header(message.message_type) and cdr[1] == _LITTLE_ENDIAN:
        sec, nanosec = _STAMP.unpack_from(cdr, _STAMP_AT)
        if sec or nanosec:  # a zero stamp means "none"
            moved = divmod(sec * 1_000_000_000 + nanosec + shift_ns, 1_000_000_000)
            cdr = cdr[:_STAMP_AT] + _STAMP.pack(*moved) + cdr[_STAMP_AT + _STAMP.size :]
    return message._replace(time_ns=message.time_ns + shift_ns, cdr=cdr)


@lru_cache
def _has_header(message_type: str) -> bool:
    """Whether a message of this type begins with a stamp."""
    fields = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if message_type not in fields:
        return False
    _, members = fields[message_type]
    return bool(members) and members[0][1][1] == "std_msgs/msg/Header"
