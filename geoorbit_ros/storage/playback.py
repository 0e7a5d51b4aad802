"""When each message of a recording is due, at any speed; the caller passes the time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import chain, islice

from rosbags.typesys import Stores, get_typestore

from geoorbit_ros.core.cdr import LITTLE_ENDIAN, stamp_of, with_stamp
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.frame_order import NO_STAMP_NS
from geoorbit_ros.storage.bag_reader import BagMessage

OTHER_CLOCK_NS = 3_600_000_000_000
"""Stamps that differ by more from the time of receipt are of another clock. Chosen: no message
takes an hour; a clock in another time zone is off by at least that."""
_HEAD = 20
"""Messages at the beginning that show which clock stamps are of. Chosen: a second of a camera."""
_STAMPED_BYTES = 12
"""Of a message with a stamp: encapsulation, seconds, nanoseconds."""
_TRACKS = "/tracks_px"


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


def played_topics(topics: Sequence[str], camera_id: str, place: str) -> dict[str, str]:
    """Names under which the topics of a recording are played.

    Args:
        topics: Full names in the recording.
        camera_id: The camera to play as; empty keeps all names.
        place: The recording, for errors.

    Returns:
        By recorded name. Of several recorded cameras only the one called `camera_id`.

    Raises:
        ParameterError: Several cameras, none of that name.
    """
    if not camera_id:
        return {name: name for name in topics}
    cameras = [name.removesuffix(_TRACKS) for name in topics if name.endswith(_TRACKS)]
    if len(cameras) > 1:
        if f"/{camera_id}" not in cameras:
            names = ", ".join(camera.strip("/") for camera in cameras)
            expected = "the name of one of them, or its topics in parameter 'topics'"
            raise ParameterError(f"{place}, which has the cameras {names}", camera_id, expected)
        return {name: name for name in topics if name.startswith(f"/{camera_id}/")}
    if not cameras:
        return {name: _renamed(name, camera_id) for name in topics}
    old = cameras[0]
    moved = {name: f"/{camera_id}{name.removeprefix(old)}" for name in topics}
    return {
        n: moved[n] if n.endswith(_TRACKS) or (old and n.startswith(f"{old}/")) else n
        for n in topics
    }


def _renamed(topic: str, camera_id: str) -> str:
    """A recorded topic with its first name replaced, if there is more than one."""
    first, _, rest = topic.strip("/").partition("/")
    return f"/{camera_id}/{rest}" if rest else f"/{first}"


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
    shift_ns, zero_is_time = 0, False
    while True:
        first_ns = last_ns = None
        times: set[int] = set()
        for message in read():
            first_ns = message.time_ns if first_ns is None else first_ns
            last_ns = message.time_ns
            if shift_ns == 0:
                times.add(message.time_ns)
                zero_is_time = zero_is_time or 0 < (_stamp(message) or 0) < NO_STAMP_NS
            yield _moved(message, shift_ns, shift_ns, zero_is_time) if shift_ns else message
        if first_ns is None or last_ns is None:
            return
        if shift_ns == 0:
            # The pause between two rounds is that between two frames.
            length_ns = last_ns - first_ns
            period_ns = length_ns + max(length_ns // max(len(times) - 1, 1), 1)
        shift_ns += period_ns


def begun_at(messages: Iterable[BagMessage], first_ns: int) -> Iterator[BagMessage]:
    """The messages, moved in time so that the first was recorded at `first_ns`.

    Stamps are moved with them. Those of another clock than the recorder's, such as a simulation's,
    are moved so that the first is as late as its message.
    """
    stream = iter(messages)
    head = list(islice(stream, _HEAD))
    if not head:
        return
    shift_ns = stamp_shift_ns = first_ns - head[0].time_ns
    zero_is_time = any(0 < (_stamp(message) or 0) < NO_STAMP_NS for message in head)
    stamped = ((m.time_ns, s) for m in head if (s := _stamp(m)) or (s == 0 and zero_is_time))
    for time_ns, stamp_ns in islice(stamped, 1):
        if abs(time_ns - stamp_ns) > OTHER_CLOCK_NS:
            stamp_shift_ns += time_ns - stamp_ns
    for message in chain(head, stream):
        yield _moved(message, shift_ns, stamp_shift_ns, zero_is_time)


def _stamp(message: BagMessage) -> int | None:
    """The stamp that a message begins with, None if it begins with none."""
    if _has_header(message.message_type) and message.cdr.startswith(LITTLE_ENDIAN):
        return stamp_of(message.cdr) if len(message.cdr) >= _STAMPED_BYTES else None
    return None


def _moved(
    message: BagMessage, shift_ns: int, stamp_shift_ns: int, zero_is_time: bool
) -> BagMessage:
    """A message recorded later by `shift_ns`; a stamp of 0 stays unless it is a time."""
    stamp_ns, cdr = _stamp(message), message.cdr
    if stamp_ns or (stamp_ns == 0 and zero_is_time):
        cdr = with_stamp(cdr, stamp_ns + stamp_shift_ns)
    return message._replace(time_ns=message.time_ns + shift_ns, cdr=cdr)


@lru_cache
def _has_header(message_type: str) -> bool:
    """Whether a message of this type begins with a stamp."""
    fields = get_typestore(Stores.ROS2_JAZZY).fielddefs
    if message_type not in fields:
        return False
    _, members = fields[message_type]
    return bool(members) and members[0][1][1] == "std_msgs/msg/Header"
