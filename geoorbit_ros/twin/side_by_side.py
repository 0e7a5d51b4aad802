"""The camera's image, the twin rendered as the camera would see it, and both their boxes.

`TwinCamera` renders the twin's vehicles and the network's lanes at the camera's calibration;
`side_by_side` puts the images together and measures how the boxes differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.rendering.renderer import SceneRenderer
from geoorbit_ros.report.image_overlay import write_text
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.roadnet.reference_lanes import reference_lanes, view_polygon
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.twin.vehicles import TYPES

SEEN, TWIN = (0, 165, 255), (80, 220, 80)
"""Colours of the boxes, orange and green, as blue, green, red."""
WIDTH_PX = 640
"""Of the images. Chosen: three beside each other are as wide as a screen; larger takes longer to
render."""
FAR_SIGMA_M = 20.0
"""Lanes are drawn up to this 1-sigma error of a pixel on the ground: farther than they can be
measured, as the camera shows them. Chosen: larger draws to the horizon."""
MIN_OVERLAP = 0.1
"""Boxes with a smaller intersection over union are not the same vehicle. Chosen: larger leaves
vehicles unmatched whose rendered height differs, smaller matches neighbours."""


@dataclass(frozen=True, slots=True)
class Difference:
    """How the twin's boxes lie on those that were seen.

    Attributes:
        matched: Vehicles in both.
        seen_only, twin_only: In one of them.
        overlap: Mean intersection over union of those in both; NaN without any.
        apart_px: Mean distance of their boxes' lower middles, in pixels of the camera's image.
    """

    matched: int
    seen_only: int
    twin_only: int
    overlap: float
    apart_px: float

    @property
    def sentence(self) -> str:
        """The difference in one line, without the full stop."""
        both = f"{self.matched} in both"
        if self.matched:
            both += f" (overlap {self.overlap:.2f}, {self.apart_px:.0f} px apart)"
        return f"{both}, {self.seen_only} only seen, {self.twin_only} only in the twin"


def compare_boxes(seen: NDArray[np.float64], twin: NDArray[np.float64], scale: float) -> Difference:
    """Match boxes (N, 4) and (M, 4) of left, top, right, bottom; NaN rows are left out."""
    seen, twin = (boxes[np.isfinite(boxes).all(axis=1)] for boxes in (seen, twin))
    if not len(seen) or not len(twin):
        return Difference(0, len(seen), len(twin), float("nan"), float("nan"))
    low = np.maximum(seen[:, None, :2], twin[None, :, :2])
    high = np.minimum(seen[:, None, 2:], twin[None, :, 2:])
    inner = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = [np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (seen, twin)]
    overlap = inner / (area[0][:, None] + area[1][None] - inner)
    a, b = scipy.optimize.linear_sum_assignment(-overlap)
    good = overlap[a, b] >= MIN_OVERLAP
    a, b = a[good], b[good]
    if not len(a):
        return Difference(0, len(seen), len(twin), float("nan"), float("nan"))
    feet = [
        np.column_stack((0.5 * (boxes[k, 0] + boxes[k, 2]), boxes[k, 3]))
        for boxes, k in ((seen, a), (twin, b))
    ]
    return Difference(
        matched=len(a),
        seen_only=len(seen) - len(a),
        twin_only=len(twin) - len(a),
        overlap=float(overlap[a, b].mean()),
        apart_px=float(np.hypot(*(feet[0] - feet[1]).T).mean()) / scale,
    )


def side_by_side(
    image: NDArray[np.uint8] | None,
    seen: NDArray[np.float64],
    rendered: NDArray[np.uint8],
    twin: NDArray[np.float64],
    scale: float,
) -> tuple[NDArray[np.uint8], Difference]:
    """The camera's image, the twin's, and both their boxes over one another.

    Args:
        image: The camera's, in any size; None: its boxes are shown alone.
        seen: (N, 4) boxes in the rendered image's pixels.
        rendered: (H, W, 3) of the twin.
        twin: (M, 4) boxes in it.
        scale: Size of the rendered image over that of the camera's.

    Returns:
        (H, 3 W, 3) and the difference in figures.
    """
    height, width = rendered.shape[:2]
    if image is None:
        left = np.full_like(rendered, 40)
    else:
        left = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    below = left if image is not None else np.rint(0.5 * rendered).astype(np.uint8)
    right = np.rint(0.6 * below).astype(np.uint8)
    _draw(left, seen, SEEN)
    _draw(right, seen, SEEN)
    _draw(right, twin, TWIN)
    difference = compare_boxes(seen, twin, scale)
    panels = [left, rendered.copy(), right]
    for panel, text in zip(panels, ("seen", "twin", difference.sentence), strict=True):
        write_text(panel, text, (8, 20), 0.45, (255, 255, 255))
    return np.hstack(panels), difference


def boxes_of(rows: NDArray[np.void], scale: float) -> NDArray[np.float64]:
    """(N, 4) left, top, right, bottom of `PIXEL_TRACK_DTYPE` rows, in the rendered pixels."""
    middle = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    half = 0.5 * np.column_stack((rows["width"], rows["height"])).astype(np.float64)
    return scale * np.hstack((middle - half, middle + half))


def _draw(
    image: NDArray[np.uint8], boxes: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    for box in boxes[np.isfinite(boxes).all(axis=1)]:
        left, top, right, bottom = np.rint(box).astype(int).tolist()
        cv2.rectangle(image, (left, top), (right, bottom), colour, 1, cv2.LINE_AA)


class TwinCamera:
    """Renders the twin's vehicles and the network's lanes; made in a second or two.

    Args:
        homography: The camera's calibration.
        image_size: Width and height of its images.
        network: The network's file.
        datum: Origin of the camera's map frame.

    Attributes:
        scale: Size of the rendered images over that of the camera's.

    Raises:
        GeoOrbitError: The calibration does not determine the camera's height, or it sees no lane.
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
        lens = None if pose.lens is None or pose.lens.straight else pose.lens.scaled(size)
        camera = PinholeCamera(matrix, pose.position_m, self.scale * pose.focal_px, size, lens)
        polygon = view_polygon(homography, image_size, FAR_SIGMA_M)
        self._renderer = SceneRenderer(
            camera, reference_lanes(load_network(network, datum), polygon)
        )
        self._datum = datum

    def render(
        self, rows: NDArray[np.void], datum: Datum, alignment: Alignment | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The image (H, W, 3), and the boxes (N, 4) of its vehicles; NaN where none is visible.

        Args:
            rows: `TRACK_DTYPE` of the twin's vehicles (`placement.track_rows`).
            datum: Origin of their frame.
            alignment: Movement of the camera's tracks, which is undone, so that vehicles are
                rendered where the camera saw them.
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

    def beside(
        self,
        image: NDArray[np.uint8] | None,
        boxes: NDArray[np.void] | None,
        rows: NDArray[np.void],
        datum: Datum,
        alignment: Alignment | None = None,
    ) -> tuple[NDArray[np.uint8], Difference]:
        """`side_by_side` of what the camera saw and what the twin shows.

        Args:
            image: The camera's; None: its boxes stand for it.
            boxes: `PIXEL_TRACK_DTYPE` of what it saw; None: nothing.
            rows: As in `render`, with `datum` and `alignment`.
            datum: Origin of their frame.
            alignment: What the camera's tracks were moved by.
        """
        rendered, twin = self.render(rows, datum, alignment)
        seen = np.empty((0, 4)) if boxes is None else boxes_of(boxes, self.scale)
        return side_by_side(image, seen, rendered, twin, self.scale)
