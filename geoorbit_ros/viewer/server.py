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

BACKLOG = 256
"""Messages kept for a viewer that is behind; the oldest are dropped. Chosen: larger needs more
memory and shows older messages, smaller drops some of a slow viewer's."""


class Subscriptions(ServerListener):
    """Keeps the viewers of each channel; the server calls it from its own threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._viewers: dict[str, set[int]] = {}
        self._new: set[str] = set()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """A viewer subscribes to a channel."""
        with self._lock:
            self._viewers.setdefault(channel.topic, set()).add(client.id)
            self._new.add(channel.topic)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """A viewer unsubscribes from a channel, or is gone."""
        with self._lock:
            self._viewers.get(channel.topic, set()).discard(client.id)

    def topics(self) -> frozenset[str]:
        """Channels with at least one viewer."""
        with self._lock:
            return frozenset(topic for topic, viewers in self._viewers.items() if viewers)

    def take_new(self) -> frozenset[str]:
        """Channels with a new viewer since the last call."""
        with self._lock:
            new, self._new = frozenset(self._new), set()
            return new


class ViewerError(GeoOrbitError):
    """A server for viewers that can't be started."""


class ViewerServer:
    """One channel per topic, and a derived one where viewers can't draw the topic itself.

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
        self._subscriptions = Subscriptions()
        self._new: frozenset[str] = frozenset()
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                context=self._context,
                server_listener=self._subscriptions,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError) as error:
            place, expected = f"viewer on {host}:{port}", "a free port and an address of this host"
            raise ViewerError(place, str(error), expected) from error
        self.port: int = self._server.port

    @property
    def topics(self) -> frozenset[str]:
        """Offered topics, without the derived channels."""
        return frozenset(self._channels)

    def wanted(self) -> frozenset[str]:
        """Offered topics with a viewer, of the topic itself or its derived channel."""
        seen = self._subscriptions.topics()
        return frozenset(topic for topic in self._channels if seen & self._forms(topic))

    def offer(self, topic: str, type_name: str) -> None:
        """Offer a topic to viewers; offering it again changes nothing.

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
        """Send a serialised message to all viewers of an offered topic.

        Args:
            topic: The topic.
            cdr: The message.
            time_ns: When it came: viewers align their panels by it.
            keep: Whether later viewers get it, too (a latched topic).

        Raises:
            MessageError: The derived channel can't show it.
        """
        if keep:
            self._kept[topic] = cdr
        self._channels[topic].log(cdr, log_time=time_ns)
        if topic in self._derived:
            self._derived[topic].send(cdr, time_ns)

    def send_kept(self, time_ns: int) -> None:
        """Send the kept messages of topics with a new viewer; to be called regularly.

        Each message is sent in two successive calls, because the server reports a viewer a moment
        before it can receive.

        Raises:
            MessageError: As `send`.
        """
        before, self._new = self._new, self._subscriptions.take_new()
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
    """The `.msg` text of a type and of all types in it, as bags and viewers need it.

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
