"""Follows a camera's reference lanes and how its own lanes lie on them: topics `reference/…`."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray

from geoorbit_ros.conversions import decode_path, movement_of
from geoorbit_ros.core.errors import GeoOrbitError, MessageError
from geoorbit_ros.core.lanes import Lane, LaneMap, lane_of_map
from geoorbit_ros.lanes.mapping.map_prior import MapPrior
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED

PERIOD_S = 1.0
"""Between two looks for new topics. Chosen: smaller costs a look at all topics of the graph more
often, larger finds reference lanes later."""
_TYPE = "nav_msgs/msg/Path"
_ROLES = ("centerline", "left", "right")
_TOPIC = re.compile(r"/lane_(\d+)/(centerline|left|right)")


class ReferenceListener:
    """Subscribes lanes as they appear; an empty path takes one away.

    Args:
        node: Subscribes, and is told about paths that can't be used.
        on_change: Called with all complete lanes by number whenever one has changed.
    """

    def __init__(
        self, node: GeoOrbitNode[Any], on_change: Callable[[dict[int, Lane]], None]
    ) -> None:
        self._node, self._on_change = node, on_change
        self._prefix = node.resolve_topic_name("reference")
        self._known: set[str] = set()
        self._lines: dict[int, dict[str, NDArray[np.float64]]] = {}
        self._look()
        node.create_timer(PERIOD_S, self._look)

    def _look(self) -> None:
        for topic, types in self._node.get_topic_names_and_types():
            match = _TOPIC.fullmatch(topic.removeprefix(self._prefix))
            if match is None or topic in self._known or types != [_TYPE]:
                continue
            self._known.add(topic)
            self._subscribe(topic, int(match[1]), match[2])

    def _subscribe(self, topic: str, number: int, role: str) -> None:
        def receive(cdr: bytes) -> None:
            try:
                self._lines.setdefault(number, {})[role] = decode_path(cdr, topic)[1]
            except GeoOrbitError as error:
                self._node.diagnostics.refuse(error)
                return
            lanes = {k: lane for k, lines in self._lines.items() if (lane := _lane(k, lines))}
            self._on_change(lanes)

        self._node.create_subscription(Path, topic, receive, LATCHED, raw=True)


class PriorListener:
    """Topics `reference/lane_<k>/…` and `reference/alignment` become a prior on lanes.

    There is no prior before both have come: without the alignment it isn't known how the camera's
    lanes lie on the map.

    Args:
        node: Subscribes, and is told about messages that can't be used.
    """

    def __init__(self, node: GeoOrbitNode[Any]) -> None:
        self._node = node
        self._place = node.resolve_topic_name("reference/alignment")
        self._lanes: dict[int, Lane] = {}
        self._movement: tuple[NDArray[np.float64], float] | None = None
        self.prior: MapPrior | None = None
        self._references = ReferenceListener(node, self._on_lanes)
        node.create_subscription(
            PoseWithCovarianceStamped, self._place, self._on_alignment, LATCHED
        )

    def refine(self, lane_map: LaneMap) -> LaneMap:
        """The map with its prior, as it is where there is none."""
        return lane_map if self.prior is None else self.prior.refine(lane_map)

    def _on_lanes(self, lanes: dict[int, Lane]) -> None:
        self._lanes = lanes
        self._renew()

    def _on_alignment(self, message: PoseWithCovarianceStamped) -> None:
        try:
            shift, turn_rad, _ = movement_of(message, self._place)
        except MessageError as error:
            self._node.diagnostics.refuse(error)
            return
        self._movement = (shift, turn_rad)
        self._renew()

    def _renew(self) -> None:
        if self._movement is None or not self._lanes:
            return
        self.prior = MapPrior.as_seen(self._lanes.values(), *self._movement)


def _lane(number: int, lines: dict[str, NDArray[np.float64]]) -> Lane | None:
    """The lane, once all three lines are there and fit each other."""
    shapes = {lines[role].shape for role in _ROLES if role in lines}
    if set(lines) != set(_ROLES) or len(shapes) != 1 or len(lines["left"]) < 2:
        return None
    return lane_of_map(number, *(lines[role] for role in _ROLES))
