"""The twin as a real camera would see it: the scenes' renderer at the camera's calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.rendering.renderer import SceneRenderer
from geoorbit_ros.roadnet.camera_view import view_polygon
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.roadnet.reference_lanes import reference_lanes
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.twin.vehicle_types import TYPES

WIDTH_PX = 640
"""Of the pictures: three beside each other are as wide as a screen."""
FAR_SIGMA_M = 20.0
"""Lanes are drawn farther than they can be measured."""


class TwinCamera:
    """Renders the twin's vehicles and the network's lanes; made in a second or two.

    Args:
        homography: The camera's calibration.
        image_size: Width and height of its images.
        network: The network's file.
        datum: Origin of the camera's map frame.

    Attributes:
        scale: Of the rendered pictures against the camera's.

    Raises:
        GeoOrbitError: The calibration leaves the camera's height open, or it sees no lane.
    """

    def __init__(
        self,
        homography: Homography,
        image_size: tuple[int, int],
        network: str | Path,
        datum: Datum,
    ) -> None:
        pose = recover_pose(homography, image_size)
        self.scale = min(WIDTH_PX / image_size[0], 1.0)
        # Third row of unit length: depths in metres.
        matrix = pose.projection / np.linalg.norm(pose.projection[2, :3])
        matrix = np.diag([self.scale, self.scale, 1.0]) @ matrix
        size = (round(self.scale * image_size[0]), round(self.scale * image_size[1]))
        camera = PinholeCamera(matrix, pose.position_m, self.scale * pose.focal_px, size)
        polygon = view_polygon(homography, image_size, FAR_SIGMA_M)
        self._renderer = SceneRenderer(
            camera, reference_lanes(load_network(network, datum), polygon)
        )
        self._datum = datum

    def render(
        self, rows: NDArray[np.void], datum: Datum, alignment: Alignment | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The picture (H, W, 3), and the boxes (N, 4) of its vehicles; NaN where none shows.

        Args:
            rows: `TRACK_DTYPE` of the twin's vehicles (`rows.track_rows`).
            datum: Origin of their frame.
            alignment: What the camera's tracks were moved by, which is undone: what is rendered
                lies where the camera saw it.
        """
        xy = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
        heading = rows["heading"].astype(np.float64)
        if alignment is not None:
            xy = alignment.inverse_points(xy)
            heading = heading - alignment.turn_rad
        if datum != self._datum and len(xy):
            xy = self._datum.to_local(*datum.to_geodetic(xy).T)
        height = {kind.coco_class: kind.height_m for kind in TYPES}
        heights = np.array([height.get(k, TYPES[0].height_m) for k in rows["class_id"].tolist()])
        size = np.column_stack((rows["length"], rows["width"], heights)).astype(np.float64)
        view = View(
            rows["track_id"].astype(np.int64),
            xy,
            heading,
            size,
            rows["class_id"].astype(np.int64),
        )
        image, truth = self._renderer.render_with_boxes(view, 0.0)
        return image, np.where(truth.visible[:, None] > 0.0, truth.boxes, np.nan)
