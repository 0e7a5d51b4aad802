"""Plays a bag through the real nodes, composed in this process, and returns the lane map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.conversions import encode_png
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.nodes.bag_player import BagPlayerNode
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED, LATCHED_ALL
from geoorbit_ros.nodes.support.road_paint import TOPIC

START_TIMEOUT_S = 20.0
"""For nodes to find each other. Chosen: larger, a graph that can't work is reported later; smaller,
a busy machine fails."""
STALL_TIMEOUT_S = 120.0
"""Longer than any single lane update takes."""
WINDOW = 500
"""Frames under way at most: a tenth of what the middleware keeps for a reader."""
LOSSLESS: dict[str, object] = {"reliability": "reliable", "queue_depth": 0}
"""Parameters of nodes that keep every message."""


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """What to replay, and how.

    Attributes:
        bag: A bag with the topic `/<camera_id>/tracks_px`.
        calibration: Control points.
        camera_id: Which camera.
        datum: Latitude and longitude of the map's origin, degrees.
        image_size: (width, height) in pixels.
        rate: Speed relative to the recording; 0 is as fast as the nodes can.
        estimator: Name of the lane estimator.
        update_period_s: Data time between two updates of the map.
        database: Also record into this trajectory database.
        road_image: (H, W, 3) BGR of the road, for its painted lines; None: there is none.
        domain_id: ROS domain to be seen on; None takes a free one on this machine alone.
        quiet: Whether the nodes log warnings only.
        camera_info: The camera's lens, in YAML; None: as the control points' file says.
    """

    bag: Path
    calibration: Path
    camera_id: str
    datum: tuple[float, float]
    image_size: tuple[int, int]
    rate: float
    estimator: str
    update_period_s: float
    database: Path | None = None
    road_image: NDArray[np.uint8] | None = None
    domain_id: int | None = None
    quiet: bool = True
    camera_info: Path | None = None


def replay_bag(request: ReplayRequest, on_frames: Callable[[int], None] = lambda _: None) -> str:
    """Replay without losing a frame; the lane map as the text of `lanes.geojson`.

    Args:
        request: What to replay.
        on_frames: Told now and then how many frames have gone through.

    Raises:
        GeoOrbitError: Input that can't be used, or nodes that don't get on within the time limits.
    """
    with Composition(request.domain_id, quiet=request.quiet) as composition:
        nodes = _Nodes(composition, request)
        composition.wait(nodes.matched, START_TIMEOUT_S, "nodes that find each other")
        nodes.player.may_send = lambda: WINDOW - nodes.under_way()
        nodes.player.paused = False

        def through() -> bool:
            on_frames(nodes.lanes.frames)
            return nodes.player.finished and nodes.under_way() == 0

        what = "frames that get through"
        composition.wait(through, STALL_TIMEOUT_S, what, lambda: nodes.lanes.frames)
        for node in (nodes.homography, *nodes.readers):
            if node.diagnostics.last_refusal is not None:
                raise node.diagnostics.last_refusal
        answer = nodes.update.call_async(Trigger.Request())
        composition.wait(answer.done, STALL_TIMEOUT_S, "an answer of lane_geometry/update")
        if not answer.result().success:
            raise NoTrafficError(str(request.bag), answer.result().message, "frames")
        count, maps = nodes.lanes.diagnostics.published, nodes.maps
        composition.wait(
            lambda: len(maps) == count == min(reader.lane_maps for reader in nodes.readers),
            START_TIMEOUT_S,
            f"{count} maps on lanes/geojson",
        )
        return str(maps[-1].data)


class _Nodes:
    """The nodes of a replay, and how far its frames are.

    Attributes:
        player, homography, lanes: In the order in which frames go through them.
        readers: The nodes that read tracks: `lanes` and, where one is asked for, a recorder.
        update: Client of the service that derives the last map.
        maps: What came on `lanes/geojson`.
    """

    def __init__(self, composition: Composition, request: ReplayRequest) -> None:
        width, height = request.image_size
        method = {"estimator": request.estimator, "update_period_s": request.update_period_s}
        camera = {
            "calibration_file": str(request.calibration),
            "camera_info_file": str(request.camera_info or ""),
            "image_width": width,
            "image_height": height,
            "datum_latitude_deg": request.datum[0],
            "datum_longitude_deg": request.datum[1],
        }
        self._topic = f"/{request.camera_id}/tracks_px"
        recording = {"bag": str(request.bag), "topics": self._topic, "rate": request.rate}
        make, camera_id = composition.make, request.camera_id
        self.lanes = make(LaneGeometryNode, camera_id, LOSSLESS | method)
        self.readers: list[LaneGeometryNode | RecorderNode] = [self.lanes]
        if request.database:
            database = {"database": str(request.database)}
            self.readers.append(make(RecorderNode, camera_id, LOSSLESS | database))
        self.homography = make(HomographyNode, camera_id, LOSSLESS | camera)
        held = LOSSLESS | recording | {"start_paused": True}
        self.player = make(BagPlayerNode, camera_id, held)
        asker = composition.add(Node("replay", context=composition.context, namespace=camera_id))
        self.update = asker.create_client(Trigger, "lane_geometry/update")
        self._road = asker.create_publisher(CompressedImage, TOPIC, LATCHED)
        self._images = 0
        if request.road_image is not None:
            self._road.publish(encode_png(0, request.camera_id, request.road_image))
            self._images = 1
        self.maps: list[String] = []
        asker.create_subscription(String, "lanes/geojson", self.maps.append, LATCHED_ALL)

    def matched(self) -> bool:
        """Whether every node has found those that it works with."""
        return (
            self.homography.tracks.get_subscription_count() == len(self.readers)
            and self.player.topics[self._topic].get_subscription_count() == 1
            and self.lanes.datum is not None
            and self.lanes.paint.images == self._images
            and bool(self.update.service_is_ready())
        )

    def under_way(self) -> int:
        """Frames that were played and have not been taken by every reader."""
        taken = min(reader.diagnostics.received for reader in self.readers)
        behind = self.homography.diagnostics.published - taken
        return self.player.diagnostics.published - self.homography.diagnostics.received + behind
