"""A WebSocket server for Foxglove-compatible viewers, fed with serialised ROS 2 messages.

No ROS in here: topics, types and CDR bytes come in. Foxglove's own SDK speaks the protocol; the
schema of each type is its `.msg` text from rosbags.
"""

from __future__ import annotations

import threading
from functools import lru_cache

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.store import Typestore

from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.viewer.derived import Derived, derive


class Demand(ServerListener):
    """Counts the viewers of each channel; the server calls it from threads of its own."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._viewers: dict[str, set[int]] = {}
        self._new: set[str] = set()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """A viewer begins to look at a channel."""
        with self._lock:
            self._viewers.setdefault(channel.topic, set()).add(client.id)
            self._new.add(channel.topic)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """A viewer looks at a channel no longer, or is gone."""
        with self._lock:
            self._viewers.get(channel.topic, set()).discard(client.id)

    def topics(self) -> frozenset[str]:
        """Channels with at least one viewer."""
        with self._lock:
            return frozenset(topic for topic, viewers in self._viewers.items() if viewers)

    def take_new(self) -> frozenset[str]:
        """Channels that a viewer began to look at since the last call."""
        with self._lock:
            new, self._new = frozenset(self._new), set()
            return new


BACKLOG = 256
"""Messages kept for one viewer that is behind; the oldest are dropped first."""


class ViewerError(GeoOrbitError):
    """A server for viewers that can't be started."""


class ViewerServer:
    """One channel per topic, and a further one where a topic can be shown better in another form.

    Args:
        name: Shown by viewers.
        host: Address to listen on.
        port: TCP port; 0 takes a free one.

    Attributes:
        port: Where it listens.

    Raises:
        ViewerError: The address or the port can't be had.
    """

    def __init__(self, name: str, host: str, port: int) -> None:
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._derived: dict[str, Derived] = {}
        self._kept: dict[str, bytes] = {}
        self._demand = Demand()
        self._new: frozenset[str] = frozenset()
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                context=self._context,
                server_listener=self._demand,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError) as error:
            place, expected = f"viewer on {host}:{port}", "a free port and an address of this host"
            raise ViewerError(place, str(error), expected) from error
        self.port: int = self._server.port

    @property
    def topics(self) -> frozenset[str]:
        """Offered topics, without the further channels."""
        return frozenset(self._channels)

    def wanted(self) -> frozenset[str]:
        """Offered topics that a viewer looks at, in whatever form."""
        seen = self._demand.topics()
        return frozenset(topic for topic in self._channels if seen & self._forms(topic))

    def offer(self, topic: str, type_name: str) -> None:
        """Offer a topic to viewers; once more changes nothing.

        Args:
            topic: Full name.
            type_name: `nav_msgs/msg/Path`.

        Raises:
            MessageError: A type whose definition is not known here.
        """
        if topic in self._channels:
            return
        definition = message_definition(type_name).encode()
        self._channels[topic] = foxglove.Channel(
            topic,
            schema=foxglove.Schema(name=type_name, encoding="ros2msg", data=definition),
            message_encoding="cdr",
            context=self._context,
        )
        if (derived := derive(topic, self._context)) is not None:
            self._derived[topic] = derived

    def withdraw(self, topic: str) -> None:
        """No longer offer a topic."""
        self.forget(topic)
        self._channels.pop(topic).close()
        if topic in self._derived:
            self._derived.pop(topic).close()

    def send(self, topic: str, cdr: bytes, time_ns: int, *, keep: bool = False) -> None:
        """Send a serialised message to all who look at an offered topic.

        Args:
            topic: The topic.
            cdr: The message.
            time_ns: When it came: viewers align their panels by it.
            keep: Whether whoever looks later gets it, too (a latched topic).

        Raises:
            MessageError: It can't be shown in the topic's other form.
        """
        if keep:
            self._kept[topic] = cdr
        self._channels[topic].log(cdr, log_time=time_ns)
        if topic in self._derived:
            self._derived[topic].send(cdr, time_ns)

    def send_kept(self, time_ns: int) -> None:
        """Send the kept messages of topics that a viewer has just begun to look at.

        To be called now and then. Each goes out at two calls: the server tells of a viewer a moment
        before that viewer is sent anything.

        Raises:
            MessageError: As `send`.
        """
        before, self._new = self._new, self._demand.take_new()
        for topic, cdr in list(self._kept.items()):
            if (self._new | before) & self._forms(topic):
                self.send(topic, cdr, time_ns)

    def forget(self, topic: str) -> None:
        """Drop the kept message of a topic."""
        self._kept.pop(topic, None)

    def close(self) -> None:
        """End all connections."""
        self._server.stop()

    def _forms(self, topic: str) -> set[str]:
        derived = self._derived.get(topic)
        return {topic, derived.topic} if derived else {topic}


@lru_cache
def message_definition(type_name: str) -> str:
    """The `.msg` text of a type and of all types in it, as bags and viewers want it.

    Raises:
        MessageError: Not a message of ROS 2 Jazzy's common interfaces.
    """
    try:
        text, _ = _typestore().generate_msgdef(type_name, ros_version=2)
    except TypesysError as error:
        raise MessageError("viewer", type_name, "a type of ROS 2 Jazzy") from error
    return str(text)


@lru_cache
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)
