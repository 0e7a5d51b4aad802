"""Who looks at what."""

from __future__ import annotations

import threading

from foxglove.websocket import ChannelView, Client, ServerListener


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
