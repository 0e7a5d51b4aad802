"""Node `tracker`: detections frame by frame become tracks with lasting ids."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import encode_table
from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.tracking.parameters import TrackerParameters, first_id_at
from geoorbit_ros.tracking.tracker import VehicleTracker, make_tracker, outside_image


@dataclass(frozen=True, slots=True)
class TrackerNodeParameters:
    """See params/tracker.yaml."""

    tracker: str
    high_score: float
    low_score: float
    birth_score: float
    confirm_hits: int
    confirm_score: float
    max_gap_s: float
    predict_s: float
    image_width: int
    image_height: int
    first_id: int
    reliability: str
    queue_depth: int
    restart_jump_s: float

    def of_tracker(self, stamp_ns: int) -> TrackerParameters:
        """The part that the tracker takes, for a first frame at `stamp_ns`."""
        return TrackerParameters(
            self.high_score,
            self.low_score,
            self.birth_score,
            self.confirm_hits,
            self.confirm_score,
            self.max_gap_s,
            self.predict_s,
            self.image_width,
            self.image_height,
            self.first_id or first_id_at(stamp_ns),
        )


class TrackerNode(GeoOrbitNode[TrackerNodeParameters]):
    """Subscribes `detections`; publishes `tracks_px` in the same frame, one per frame.

    A gap in the stream or a restart of the detector does not end tracks; a vehicle unseen for
    `max_gap_s` of stamps does. A source that starts again at an earlier time ends all of them.

    Raises:
        GeoOrbitError: A parameter can't be used.
    """

    name = "tracker"
    struct = TrackerNodeParameters

    def setup(self) -> None:
        """Check the parameters, then start."""
        make_tracker(self.p.tracker, self.p.of_tracker(0))
        self._tracker: VehicleTracker | None = None
        qos = stream_qos(self.p.reliability, self.p.queue_depth)
        self.tracks = self.create_publisher(PointCloud2, "tracks_px", qos)
        self._stream = TableStream(
            self, "detections", DETECTION_DTYPE, self.p, self._on_frame, self._on_restart
        )
        self._outside = ""
        self.diagnostics.add_check(self._image_size_fault)

    def diagnostic_values(self) -> Mapping[str, object]:
        """Tracks at present, and what has happened since the start."""
        tracker = self._tracker
        if tracker is None:
            return {"tracks_alive": 0, "tracks_lost": 0}
        counts = {f"total_{key}": n for key, n in asdict(tracker.counts).items()}
        return {"tracks_alive": tracker.alive, "tracks_lost": tracker.lost, **counts}

    def _on_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        if self._tracker is None:
            self._tracker = make_tracker(self.p.tracker, self.p.of_tracker(stamp_ns))
        tracks = self._tracker.update(stamp_ns, rows)
        self._look_outside(rows)
        self.publish_stream(self.tracks, encode_table(stamp_ns, self._stream.frame_id, tracks))

    def _on_restart(self) -> None:
        if self._tracker is not None:
            self._tracker.reset()

    def _look_outside(self, rows: NDArray[np.void]) -> None:
        width, height = self.p.image_width, self.p.image_height
        if width and (place := outside_image(rows, width, height)):
            self._outside = f"a box at ({place[0]:.0f}, {place[1]:.0f})"

    def _image_size_fault(self) -> str | None:
        """Parameters of another camera, or of the image before it was scaled."""
        found, self._outside = self._outside, ""
        expected = f"an image of {self.p.image_width} x {self.p.image_height} pixels"
        place = self.resolve_topic_name("detections")
        return str(MessageError(place, found, expected)) if found else None


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(TrackerNode, args)


if __name__ == "__main__":
    sys.exit(main())
