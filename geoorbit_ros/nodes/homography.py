"""Node `homography`: tracked boxes in the image become vehicles on the road."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from sensor_msgs.msg import NavSatFix, PointCloud2
from std_msgs.msg import Float64MultiArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.camera_info import read_calibration
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum, given_datum
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.conversions import (
    datum_to_fix,
    encode_pose_array,
    encode_table,
    plane_message,
    vehicle_poses,
)
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.lens_listener import LensListener
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import LATCHED, stream_qos
from geoorbit_ros.nodes.support.road_paint import PLANE_TOPIC
from geoorbit_ros.nodes.support.table_stream import TableStream
from geoorbit_ros.nodes.support.view_listener import listen_to_views
from geoorbit_ros.view.looks import ViewLook
from geoorbit_ros.view.memory import named_files
from geoorbit_ros.view.projection import ViewProjector


@dataclass(frozen=True, slots=True)
class HomographyParameters:
    """See params/homography.yaml."""

    calibration_file: str
    camera_info_file: str
    image_width: int
    image_height: int
    datum_latitude_deg: float
    datum_longitude_deg: float
    pixel_sigma: float
    ground_sigma_m: float
    max_sigma_m: float
    reject_truncated: bool
    frame_id: str
    reliability: str
    queue_depth: int
    restart_jump_s: float
    view_calibrations: str


class HomographyNode(GeoOrbitNode[HomographyParameters]):
    """From `tracks_px`, `view`, `camera_info`: `tracks`, `vehicles`; `datum` and plane are latched.

    Every frame of `tracks_px` that can be used becomes one frame of `tracks` with its stamp, also
    when no vehicle is left in it. Frames that show no calibrated view become none.

    Raises:
        GeoOrbitError: A parameter or the calibration file can't be used.
    """

    name = "homography"
    struct = HomographyParameters

    def setup(self) -> None:
        """Fit the road plane, then start."""
        p = self.p
        place = f"node '{self.get_fully_qualified_name()}'"
        datum = given_datum(p.datum_latitude_deg, p.datum_longitude_deg, place)
        size = (p.image_width, p.image_height)
        points = read_calibration(p.calibration_file, p.camera_info_file, datum, image_size=size)
        expected = "parameters datum_latitude_deg and datum_longitude_deg: where (0, 0) is"
        origin = points.need_datum(expected)
        self._plane = self.create_publisher(Float64MultiArray, PLANE_TOPIC, LATCHED)
        self._others = self._other_views(origin, place)
        self._calibrate(points)
        self.diagnostics.add_check(self._doubt)
        self.diagnostics.add_check(self._view_fault)

        qos = stream_qos(p.reliability, p.queue_depth)
        self.tracks = self.create_publisher(PointCloud2, "tracks", qos)
        self._vehicles = self.create_publisher(PoseArray, "vehicles", qos)
        self._fix = self.create_publisher(NavSatFix, "datum", LATCHED)
        self._fix.publish(datum_to_fix(origin, p.frame_id))
        self._on_road = 0
        self._lens = LensListener(self, lambda: self._homography.points, self._calibrate)
        TableStream(
            self, "tracks_px", PIXEL_TRACK_DTYPE, p, self._on_frame, lambda: self._views.reset()
        )
        listen_to_views(self, self._on_view)

    def _calibrate(self, points: ControlPoints) -> None:
        """Fit the road plane, tell what is to be said about it, and publish it."""
        p = self.p
        self._homography = fit_homography(points, p.pixel_sigma, p.ground_sigma_m)
        self._projector = self._projector_of(self._homography)
        self._views = ViewProjector(self._projector, self._others)
        for sentence in self._homography.describe_residuals():
            self.get_logger().info(sentence)
        for sentence in self._projector.calibration_report.sentences():
            self.get_logger().warning(f"{points.place}: {sentence}")
        if self._projector.pose_error is not None:
            self.get_logger().warning(str(self._projector.pose_error))
        self._plane.publish(plane_message(self._homography, (p.image_width, p.image_height)))

    def diagnostic_values(self) -> Mapping[str, object]:
        """Reprojection error of every control point, and what became of the boxes."""
        counts = {f"boxes_{key}": n for key, n in asdict(self._projector.counts).items()}
        readers = self.tracks.get_subscription_count()
        remarks = " ".join([*self._sentences(), *self._lens.remarks])
        return {
            "vehicles": self._on_road,
            "tracks_subscribers": readers,
            "frames_left_out_by_view": self._views.left_out,
            **counts,
            "remarks": remarks,
            **self._homography.residual_texts(),
        }

    @property
    def views_until_ns(self) -> int:
        """Stamp of the latest look at the view; 0 before the first."""
        look = self._views.motions.latest
        return look.stamp_ns if look else 0

    def _sentences(self, *, doubts: bool = False) -> Iterator[str]:
        """What was done with the control points, and what speaks against the inputs."""
        for report in self._projector.reports("tracks_px"):
            yield from (f"{report.place}: {text}" for text in report.sentences(doubts=doubts))

    def _doubt(self) -> str | None:
        """Lanes are not confirmed while this says something."""
        return "; ".join(self._sentences(doubts=True)) or None

    def _projector_of(self, plane: Homography) -> BoxProjector:
        p = self.p
        return BoxProjector(
            plane,
            (p.image_width, p.image_height),
            reject_truncated=p.reject_truncated,
            max_sigma_m=p.max_sigma_m,
        )

    def _other_views(self, origin: Datum, place: str) -> dict[int, BoxProjector]:
        """Projectors of a PTZ camera's other presets, by the number of the view."""
        p = self.p
        size = (p.image_width, p.image_height)
        named = named_files(p.view_calibrations, f"{place}, parameter 'view_calibrations'")
        return {
            number: self._projector_of(
                fit_homography(
                    read_calibration(str(file), p.camera_info_file, origin, image_size=size),
                    p.pixel_sigma,
                    p.ground_sigma_m,
                )
            )
            for number, file in enumerate(named.values(), 1)
        }

    def _view_fault(self) -> str | None:
        """Why there are no tracks, while the image shows no calibrated view."""
        return self._views.fault

    def _on_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self._publish(self._views.take(stamp_ns, rows))

    def _on_view(self, look: ViewLook) -> None:
        self._publish(self._views.look(look))

    def _publish(self, frames: Iterable[tuple[int, NDArray[np.void]]]) -> None:
        for stamp_ns, ground in frames:
            self._on_road = len(ground)
            self.publish_stream(self.tracks, encode_table(stamp_ns, self.p.frame_id, ground))
            if self._vehicles.get_subscription_count():
                poses = vehicle_poses(ground)
                self._vehicles.publish(encode_pose_array(stamp_ns, self.p.frame_id, *poses))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(HomographyNode, args)


if __name__ == "__main__":
    sys.exit(main())
