"""Hears the network's lanes and how the camera lies on them, for the lanes that are sparse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray

from geoorbit_ros.conversions import movement_of
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.lanes.mapping.map_prior import MapPrior
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.support.reference_listener import ReferenceListener


class PriorListener:
    """Topics `reference/lane_<k>/…` and `reference/alignment` become a prior on lanes.

    There is none before both are there: without an alignment nobody has compared map and camera.

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
        shift, turn_rad = self._movement
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        back = np.array([[cos, -sin], [sin, cos]])  # row vectors: the transpose turns back

        def seen(line: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((line - shift) @ back)

        self.prior = MapPrior(
            [
                replace(
                    lane,
                    centerline_m=seen(lane.centerline_m),
                    left_m=seen(lane.left_m),
                    right_m=seen(lane.right_m),
                )
                for lane in self._lanes.values()
            ]
        )
