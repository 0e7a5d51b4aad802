"""When each message of a recording is due, at any speed; the caller passes the time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.core.cdr import LITTLE_ENDIAN, stamp_of, with_stamp
from geoorbit_ros.storage.bag_reader import BagMessage


class Playback:
    """Hands out the messages of a recording as their time comes.

    Args:
        messages: In the order of their recording time.
        rate: Speed relative to the recording; 0 makes every message due at once.
        max_gap_s: Longer silences are cut to this, in seconds of the recording.
        start_offset_s: Leave out messages from before this time after the first.

    Attributes:
        played: Messages handed out so far.
        finished: Whether there are no more.
    """

    def __init__(
        self,
        messages: Iterable[BagMessage],
        rate: float = 1.0,
        max_gap_s: float = float("inf"),
        start_offset_s: float = 0.0,
    ) -> None:
        self.played = 0
        self._rate = rate
        self._max_gap_ns = max_gap_s * 1e9
        self._messages = _from_offset(messages, start_offset_s)
        self._position_ns = 0.0  # played time of the recording, gaps cut
        self._last_ns = 0  # recording time of the last message handed out
        self._wall_s: float | None = None
        self._next = next(self._messages, None)
        self._next_position_ns = 0.0

    @property
    def finished(self) -> bool:
        """Whether all messages have been handed out."""
        return self._next is None

    @property
    def time_ns(self) -> int:
        """The recording's time now; never past the next message, never before the last."""
        if self._next is None:
            return self._last_ns
        ahead = max(self._next_position_ns - self._position_ns, 0.0)
        return max(round(self._next.time_ns - ahead), self._last_ns)

    def hold(self) -> None:
        """Let no time pass until the next call of `due`."""
        self._wall_s = None

    def due(self, wall_s: float, limit: int) -> Iterator[BagMessage]:
        """The messages that are due at `wall_s`, at most `limit`.

        Where the limit holds messages back, the recording's time waits with them: playback slows
        down instead of catching up in a burst.

        Args:
            wall_s: Any steady clock.
            limit: Most messages to hand out now.
        """
        elapsed_s = 0.0 if self._wall_s is None else wall_s - self._wall_s
        self._wall_s = wall_s
        self._position_ns += elapsed_s * 1e9 * self._rate
        while self._next is not None and limit > 0:
            if self._rate == 0.0:
                self._position_ns = self._next_position_ns
            if self._next_position_ns > self._position_ns:
                return
            limit -= 1
            yield self._take(self._next)
        self._position_ns = min(self._position_ns, self._next_position_ns)

    def _take(self, message: BagMessage) -> BagMessage:
        self.played += 1
        self._last_ns = message.time_ns
        self._next = next(self._messages, None)
        if self._next is not None:
            gap_ns = max(self._next.time_ns - message.time_ns, 0)
            self._next_position_ns += min(gap_ns, self._max_gap_ns)
        return message


def rename_camera(topic: str, camera_id: str) -> str:
    """A recorded topic with its first name replaced, if there is more than one and a new one."""
    first, _, rest = topic.strip("/").partition("/")
    return f"/{camera_id or first}/{rest}" if rest else f"/{first}"


def _from_offset(messages: Iterable[BagMessage], start_offset_s: float) -> Iterator[BagMessage]:
    first_ns: int | None = None
    for message in messages:
        first_ns = message.time_ns if first_ns is None else first_ns
        if message.time_ns - first_ns >= start_offset_s * 1e9:
            yield message


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
    if _has_header(message.message_type) and cdr.startswith(LITTLE_ENDIAN):
        stamp_ns = stamp_of(cdr)
        if stamp_ns:  # a zero stamp means "none"
            cdr = with_stamp(cdr, stamp_ns + shift_ns)
    return message._replace(time_ns=message.time_ns + shift_ns, cdr=cdr)


@lru_cache
def _has_header(message_type: str) -> bool:
    """Whether a message of this type begins with a stamp."""
    fields = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if message_type not in fields:
        return False
    _, members = fields[message_type]
    return bool(members) and members[0][1][1] == "std_msgs/msg/Header"
