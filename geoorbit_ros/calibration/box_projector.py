"""Where on the road each boxed vehicle stands: the centre of its footprint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_geometry import (
    box_of_vehicle,
    corners,
    on_plane,
    vehicle_axes,
)
from geoorbit_ros.calibration.camera_pose import CameraPose, recover_pose
from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.calibration.motion import MotionFilter
from geoorbit_ros.calibration.plane import worst_sigma
from geoorbit_ros.calibration.track_slots import TrackSlots
from geoorbit_ros.calibration.vehicle_size import SizeFilter
from geoorbit_ros.core.errors import CalibrationError, TableError
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
)

Array = NDArray[np.float64]

CENTRE_SIGMA_PX = 0.8
CENTRE_SIGMA_RATIO = 0.01
"""1-sigma of a box's centre, from its frame-to-frame noise at two cameras on US-12: 0.7 to 0.9 px
for sides below 110 px, 1.3 to 2 px at 200 px."""
BORDER_RATIO = 0.01
"""Boxes that end within 1 % of the image from its border are truncated. At the US-12 cameras the
ends of boxes pile up within 4 px of the right border and 9 px of the bottom one (1920x1080):
detectors round to their stride and don't reach the last pixels."""
CENTRE_ITERATIONS = 2
"""Each one divides what is left of the correction by more than five."""
MAX_SIGMA_M = 10.0
"""Farther out a vehicle's position along the road is uncertain by two of its lengths."""


@dataclass(slots=True)
class ProjectionCounts:
    """What became of the rows so far: every row is in exactly one of the last five.

    Attributes:
        rows: Rows given.
        not_finite: NaN or infinite pixels.
        truncated: Cut by the image border.
        above_horizon: Not on the road.
        too_uncertain: Ground error above the limit.
        returned: Ground tracks returned.
    """

    rows: int = 0
    not_finite: int = 0
    truncated: int = 0
    above_horizon: int = 0
    too_uncertain: int = 0
    returned: int = 0


class BoxProjector:
    """Projects boxes to the road; implements `ground.GroundProjector`.

    A box's centre is, to first order, the image of the centre of the vehicle's body, which is half
    its height above the road. So the ray through it is met with that plane. Then the vehicle's
    eight corners are projected, and the difference between the centre of their box and that of
    the observed box moves the ray: perspective pulls the box of a long vehicle towards its near
    end. Length, width and height are learnt per track from the sides of its boxes, the heading
    from its motion.

    Without a recoverable camera pose (`pose_error` says why) the ground point is the middle of the
    box's lower edge, which lies up to half a vehicle's length nearer to the camera.

    Args:
        homography: The road plane.
        image_size: (width, height) of the image in pixels.
        reject_truncated: Leave out boxes cut by the image border. Otherwise they come flagged.
        max_sigma_m: Leave out rows whose 1-sigma ground error is larger.
        border_ratio: Share of the image's width and height that counts as its border.

    Raises:
        CalibrationError: Control points outside the image: it isn't the image they belong to.
    """

    def __init__(
        self,
        homography: Homography,
        image_size: tuple[int, int],
        *,
        reject_truncated: bool = True,
        max_sigma_m: float = MAX_SIGMA_M,
        border_ratio: float = BORDER_RATIO,
    ) -> None:
        self.homography = homography
        self.image_size = image_size
        self.counts = ProjectionCounts()
        self.pose: CameraPose | None = None
        self.pose_error: CalibrationError | None = None
        self._reject_truncated = reject_truncated
        self._max_sigma_m = max_sigma_m
        self._size_px = np.array(image_size, dtype=np.float64)
        self._border = border_ratio * self._size_px
        self._horizon = homography.matrix[2]
        self._check_image_size()
        try:
            self.pose = recover_pose(homography, image_size)
            self._projection = self.pose.projection
        except CalibrationError as error:
            self.pose_error = error
            self._projection = np.insert(homography.inverse, 2, 0.0, axis=1)
        self.reset()

    def reset(self) -> None:
        """Forget all tracks, for a source that starts again at an earlier time."""
        self._slots = TrackSlots()
        self._motion = MotionFilter(self._slots.capacity)
        self._sizes = SizeFilter(self._slots.capacity)
        self._stamp_ns: int | None = None
        self._epoch_ns: int | None = None

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame; see `ground.GroundProjector`.

        Raises:
            TableError: Rows of another dtype, or a stamp not later than the one before.
        """
        self._check_frame(stamp_ns, rows)
        if self._epoch_ns is None:
            self._epoch_ns = stamp_ns
        self._stamp_ns = stamp_ns
        rows, centre, side, truncated = self._usable_rows(rows)
        if not len(rows):
            return np.empty(0, dtype=TRACK_DTYPE)
        observed = (rows["flags"] & FLAG_PREDICTED) == 0
        solid = (rows["flags"] & FLAG_GROUND_POINT) == 0

        slot, dt, fresh = self._slots.enter(stamp_ns, rows["track_id"])
        self._motion.reserve(self._slots.capacity)
        self._sizes.reserve(self._slots.capacity)
        size, height_sigma = self._sizes.enter(slot, fresh, rows["class_id"])
        heading = self._motion.enter(slot, fresh)

        if self.pose is None:
            xy, _ = on_plane(self._projection, _foot(centre, side), np.zeros(len(rows)))
            sigma, noise = self._sigma(xy, np.zeros(len(rows)), side, size[:, 1] / 2)
        else:
            shaped = solid & np.isfinite(heading)
            z = np.where(solid, size[:, 2] / 2, 0.0)
            xy, predicted, slope = self._match(centre, z, heading, size, shaped)
            usable = shaped & observed & ~truncated
            self._sizes.update(slot, rows, dt, side, predicted, slope, usable)
            sigma, noise = self._sigma(xy, z, side, np.where(solid, height_sigma / 2, 0.0))

        # A vehicle whose height is still unknown moves all the same: its motion is what its size
        # is learnt with. Only the noise of the box decides whether a position is any use for that.
        far = noise > self._max_sigma_m
        time_s = (stamp_ns - self._epoch_ns) * 1e-9
        velocity, heading = self._motion.update(slot, time_s, xy, noise, observed & ~far)
        out = np.empty(len(rows), dtype=TRACK_DTYPE)
        out["x"], out["y"] = xy.T
        out["vx"], out["vy"] = velocity.T
        out["heading"], out["sigma"] = heading, sigma
        out["length"], out["width"] = size[:, 0], size[:, 1]
        out["flags"] = (rows["flags"] & FLAG_PREDICTED) | np.where(truncated, FLAG_TRUNCATED, 0)
        for name in ("score", "class_id", "track_id"):
            out[name] = rows[name]
        kept = sigma <= self._max_sigma_m
        self.counts.too_uncertain += int(np.count_nonzero(~kept))
        self.counts.returned += int(np.count_nonzero(kept))
        return out if kept.all() else out[kept]

    def _usable_rows(
        self, rows: NDArray[np.void]
    ) -> tuple[NDArray[np.void], Array, Array, NDArray[np.bool_]]:
        """Rows that show the road: the rows, box centres (M, 2), sides (M, 2), truncated (M,)."""
        box = np.empty((len(rows), 4))
        for k, name in enumerate(("x", "y", "width", "height")):
            box[:, k] = rows[name]
        finite = np.isfinite(box.sum(axis=1))
        centre, half = box[:, :2], box[:, 2:] / 2
        cut = (centre - half < self._border) | (centre + half > self._size_px - self._border)
        truncated = cut.any(axis=1) & ((rows["flags"] & FLAG_GROUND_POINT) == 0)
        truncated |= (rows["flags"] & FLAG_TRUNCATED) != 0
        inside = finite & ~truncated if self._reject_truncated else finite
        foot = centre if self.pose is not None else _foot(centre, box[:, 2:])
        kept = inside & (foot @ self._horizon[:2] + self._horizon[2] > 0)
        self.counts.rows += len(rows)
        self.counts.not_finite += int(np.count_nonzero(~finite))
        self.counts.truncated += int(np.count_nonzero(finite & ~inside))
        self.counts.above_horizon += int(np.count_nonzero(inside & ~kept))
        if kept.all():
            return rows, centre, box[:, 2:], truncated
        return rows[kept], centre[kept], box[kept, 2:], truncated[kept]

    def _match(
        self, centre: Array, z: Array, heading: Array, size: Array, shaped: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array]:
        """Ground points whose vehicles' boxes have the observed centres.

        Returns:
            Metres (M, 2), the sides of the predicted boxes (M, 2) and their slopes (M, 2, 3).
        """
        xy, _ = on_plane(self._projection, centre, z)
        axes = vehicle_axes(self._projection, np.where(shaped, heading, 0.0), size)
        target = centre
        for _ in range(CENTRE_ITERATIONS):
            uv, depth = corners(self._projection, xy, axes)
            middle = (uv.max(axis=1) + uv.min(axis=1)) / 2
            target = target + (centre - middle)
            moved, scale = on_plane(self._projection, target, z)
            good = shaped & (scale > 0) & (depth > 0).all(axis=1)
            xy = np.where(good[:, None], moved, xy)
        sides, slope = box_of_vehicle(uv, depth, axes, size)
        return xy, sides, slope

    def _sigma(self, xy: Array, z: Array, side: Array, offset_m: Array) -> tuple[Array, Array]:
        """1-sigma ground error (M,) along its worst direction: in all, and of the box alone.

        Args:
            xy: (M, 2) ground points.
            z: (M,) height of the point that was projected to the ground.
            side: (M, 2) box sides, pixels.
            offset_m: (M,) 1-sigma of z, or without a pose of the offset on the ground.
        """
        p = self._projection
        uvw = xy @ p[:, :2].T + p[:, 3] + z[:, None] * p[:, 2]
        uv = uvw[:, :2] / uvw[:, 2:]
        j = (p[:2] - uv[:, :, None] * p[2]) / uvw[:, 2, None, None]
        inverse = np.empty((len(xy), 2, 2))
        inverse[:, 0, 0], inverse[:, 1, 1] = j[:, 1, 1], j[:, 0, 0]
        inverse[:, 0, 1], inverse[:, 1, 0] = -j[:, 0, 1], -j[:, 1, 0]
        inverse /= (j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0])[:, None, None]
        pixel = CENTRE_SIGMA_PX**2 + (CENTRE_SIGMA_RATIO * side) ** 2
        noise = (inverse * pixel[:, None, :]) @ np.swapaxes(inverse, 1, 2)
        fit = self.homography.fit_covariance(uv)
        if self.pose is None:
            shift = np.eye(2)[None] * offset_m[:, None, None]
        else:
            shift = (inverse @ j[:, :, 2:3]) * offset_m[:, None, None]
        return worst_sigma(noise + fit + shift @ np.swapaxes(shift, 1, 2)), worst_sigma(noise)

    def _check_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        if rows.dtype != PIXEL_TRACK_DTYPE:
            raise TableError("tracked boxes", rows.dtype, str(PIXEL_TRACK_DTYPE))
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            raise TableError(
                "tracked boxes", f"stamp {stamp_ns} ns after {self._stamp_ns} ns", "a later stamp"
            )

    def _check_image_size(self) -> None:
        points = self.homography.points
        outside = (points.pixel < -self._border) | (points.pixel > self._size_px + self._border)
        if outside.any():
            k = int(np.argmax(outside.any(axis=1)))
            raise CalibrationError(
                f"{points.place}, line {points.line_number[k]}",
                f"pixel ({points.pixel[k, 0]:g}, {points.pixel[k, 1]:g})",
                f"a pixel of the {self.image_size[0]}x{self.image_size[1]} image",
            )


def _foot(centre: Array, side: Array) -> Array:
    """Middle of the lower edge of boxes."""
    foot = centre.copy()
    foot[:, 1] += side[:, 1] / 2
    return foot
