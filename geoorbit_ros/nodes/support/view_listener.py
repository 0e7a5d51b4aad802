"""Looks at the camera's view, for nodes that go by them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import decode_table
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import ViewNote
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LOOKS
from geoorbit_ros.view.looks import VIEW_DTYPE, ViewLook, look_of
from geoorbit_ros.view.timeline import ViewTimeline, utc_text


def listen_to_views(node: GeoOrbitNode[Any], on_look: Callable[[ViewLook], None]) -> None:
    """Subscribe `view`; what can't be used is told in the node's diagnostics."""
    topic = node.resolve_topic_name("view")

    def take(cdr: bytes) -> None:
        try:
            stamp_ns, _, rows = decode_table(cdr, VIEW_DTYPE, topic)
            on_look(look_of(stamp_ns, rows, topic))
        except GeoOrbitError as error:
            node.diagnostics.refuse(error)

    node.create_subscription(PointCloud2, "view", take, LOOKS, raw=True)


class ViewNotes:
    """What lanes should say of the view.

    Args:
        node: Subscribes.
        on_change: Called when lanes begin or end to be held, or the view has moved or is back.

    Attributes:
        note: The latest; None: nothing is to be said.
    """

    def __init__(self, node: GeoOrbitNode[Any], on_change: Callable[[], None]) -> None:
        self.note: ViewNote | None = None
        self._timeline, self._on_change = ViewTimeline(), on_change
        listen_to_views(node, self._on_look)

    def _on_look(self, look: ViewLook) -> None:
        began = self._timeline.add(look)
        note = self._timeline.note(utc_text)
        changed = (note is None) is not (self.note is None) or began
        if note is not None or changed:
            before, self.note = self.note, note
            if changed and before != note:
                self._on_change()
