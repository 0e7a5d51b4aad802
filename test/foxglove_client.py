"""A viewer's side of the Foxglove WebSocket protocol, as little of it as tests need."""

import json
import queue
import struct
import threading
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1


class FoxgloveClient:
    """Connects, subscribes to every channel that the server offers, and collects what comes.

    Attributes:
        channels: By topic, as the server advertised them.
        messages: (topic, payload) in the order they came.
    """

    def __init__(self, port: int) -> None:
        self._open = ExitStack()
        self._socket = self._open.enter_context(
            connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol(PROTOCOL)])
        )
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: queue.Queue[tuple[str, bytes]] = queue.Queue()
        self._topic_of: dict[int, str] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        try:
            for message in self._socket:
                if isinstance(message, bytes):
                    self._take(message)
                else:
                    self._control(json.loads(message))
        except ConnectionClosed:
            return

    def _control(self, content: dict[str, Any]) -> None:
        if content["op"] == "status" and "Unknown channel ID" in content["message"]:
            # The SDK (0.30) advertises a channel a moment before it takes subscriptions to it.
            again = int(content["message"].rpartition(" ")[2])
            self._subscribe([{"id": again, "channelId": again}])
        if content["op"] != "advertise":
            return
        wanted = []
        for channel in content["channels"]:
            self.channels[channel["topic"]] = channel
            self._topic_of[channel["id"]] = channel["topic"]
            wanted.append({"id": channel["id"], "channelId": channel["id"]})
        self._subscribe(wanted)

    def _subscribe(self, wanted: list[dict[str, int]]) -> None:
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def _take(self, message: bytes) -> None:
        operation, subscription, _ = struct.unpack_from("<BIQ", message)
        if operation == MESSAGE_DATA:
            self.messages.put((self._topic_of[subscription], message[13:]))

    def received(self) -> dict[str, list[bytes]]:
        """Payloads so far, by topic."""
        found: dict[str, list[bytes]] = {}
        for topic, payload in list(self.messages.queue):
            found.setdefault(topic, []).append(payload)
        return found

    def __enter__(self) -> "FoxgloveClient":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()
        self._reader.join(5.0)
