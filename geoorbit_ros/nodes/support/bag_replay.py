"""Plays a bag through the real nodes, composed in this process, and returns the lane map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.nodes.bag_player import BagPlayerNode
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED_ALL

START_TIMEOUT_S = 20.0
STALL_TIMEOUT_S = 120.0
"""Longer than any single lane update takes."""
WINDOW = 500
"""Frames under way at most: a tenth of what the middleware keeps for a reader."""
LOSSLESS: dict[str, object] = {"reliability": "reliable", "queue_depth": 0}


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
        domain_id: ROS domain to be seen on; None takes a free one on this machine alone.
        quiet: Whether the nodes log warnings only.
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
    domain_id: int | None = None
    quiet: bool = True


def replay(request: ReplayRequest, on_frames: Callable[[int], None] = lambda _: None) -> str:
    """Replay without losing a frame; the lane map as the text of `lanes.geojson`.

    Args:
        request: What to replay.
        on_frames: Told now and then how many frames have gone through.

    Raises:
        GeoOrbitError: Input that can't be used, or nodes that don't get on within the time limits.
    """
    topic, (width, height) = f"/{request.camera_id}/tracks_px", request.image_size
    method = {"estimator": request.estimator, "update_period_s": request.update_period_s}
    camera = {
        "calibration_file": str(request.calibration),
        "image_width": width,
        "image_height": height,
        "datum_latitude_deg": request.datum[0],
        "datum_longitude_deg": request.datum[1],
    }
    recording = {"bag": str(request.bag), "topics": topic, "rate": request.rate}
    with Composition(request.domain_id, quiet=request.quiet) as nodes:
        camera_id = request.camera_id
        lanes = nodes.make(LaneGeometryNode, camera_id, LOSSLESS | method)
        readers: list[LaneGeometryNode | RecorderNode] = [lanes]
        if request.database:
            database = {"database": str(request.database)}
            readers.append(nodes.make(RecorderNode, camera_id, LOSSLESS | database))
        homography = nodes.make(HomographyNode, camera_id, LOSSLESS | camera)
        held = LOSSLESS | recording | {"start_paused": True}
        player = nodes.make(BagPlayerNode, camera_id, held)
        asker = nodes.add(Node("replay", context=nodes.context, namespace=camera_id))
        update = asker.create_client(Trigger, "lane_geometry/update")
        maps: list[String] = []
        asker.create_subscription(String, "lanes/geojson", maps.append, LATCHED_ALL)

        def matched() -> bool:
            return (
                homography.tracks.get_subscription_count() == len(readers)
                and player.topics[topic].get_subscription_count() == 1
                and lanes.datum is not None
                and bool(update.service_is_ready())
            )

        def under_way() -> int:
            taken = min(reader.diagnostics.received for reader in readers)
            behind = homography.diagnostics.published - taken
            return player.diagnostics.published - homography.diagnostics.received + behind

        def through() -> bool:
            on_frames(lanes.frames)
            return player.finished and under_way() == 0

        nodes.wait(matched, START_TIMEOUT_S, "nodes that find each other")
        player.may_send = lambda: WINDOW - under_way()
        player.paused = False
        nodes.wait(through, STALL_TIMEOUT_S, "frames that get through", lambda: lanes.frames)
        for node in (homography, *readers):
            if node.diagnostics.last_refusal is not None:
                raise node.diagnostics.last_refusal
        answer = update.call_async(Trigger.Request())
        nodes.wait(answer.done, STALL_TIMEOUT_S, "an answer of lane_geometry/update")
        if not answer.result().success:
            raise NoTrafficError(str(request.bag), answer.result().message, "frames")
        count = lanes.diagnostics.published
        nodes.wait(
            lambda: len(maps) == count == min(reader.lane_maps for reader in readers),
            START_TIMEOUT_S,
            f"{count} maps on lanes/geojson",
        )
        return str(maps[-1].data)
