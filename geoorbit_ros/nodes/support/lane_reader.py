"""Lane maps from their text, with the camera's calibration in the same frame."""

from __future__ import annotations

from geoorbit_ros.calibration.camera_info import read_calibration
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.traffic.lane_maps import StampedLanes


class LaneReader:
    """Reads the texts of `lanes/geojson`.

    Args:
        calibration_file: Control points; empty: the calibration is not known.
        place: Where the texts are from, for errors.
        camera_info_file: The lens; empty: that of the control points' file.
    """

    def __init__(self, calibration_file: str, place: str, camera_info_file: str = "") -> None:
        self._file, self._place, self._lens = calibration_file, place, camera_info_file
        self._plane: tuple[Datum, RoadPlane] | None = None
        if calibration_file:  # a file that can't be used is told at once
            read_calibration(calibration_file, camera_info_file)

    def read(self, text: str) -> StampedLanes:
        """The lanes of a text.

        Raises:
            GeoOrbitError: Another text.
        """
        file = parse_lane_file(text, self._place)
        lane_map = file.lane_map
        return StampedLanes(lane_map.stamp_ns, lane_map.lanes, self._plane_at(file.datum))

    def _plane_at(self, datum: Datum) -> RoadPlane | None:
        if not self._file:
            return None
        if self._plane is None or self._plane[0] != datum:
            self._plane = datum, fit_homography(read_calibration(self._file, self._lens, datum))
        return self._plane[1]
