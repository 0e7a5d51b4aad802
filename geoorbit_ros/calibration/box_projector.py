"""Where on the road each boxed vehicle stands: the centre of its footprint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import CameraPose, recover_pose
from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.calibration.plane import worst_sigma
from geoorbit_ros.calibration.plausibility import TrafficCheck, calibration_report
from geoorbit_ros.calibration.track_velocity import TrackSlots, VelocityFilter
from geoorbit_ros.calibration.vehicle_fit import fit_vehicles
from geoorbit_ros.calibration.vehicle_size import SizeFilter
from geoorbit_ros.core.errors import CalibrationError, TableError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.tables import (
    FLAG_DOUBTFUL,
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
)

Array = NDArray[np.float64]

BORDER_RATIO = 0.01
"""Boxes that end within 1 % of the image from its border are truncated. At the US-12 cameras the
ends of boxes pile up within 4 px of the right border and 9 px of the bottom one (1920x1080):
detectors round to their stride and don't reach the last pixels."""
MAX_SIGMA_M = 10.0
"""Farther out a vehicle's position along the road is uncertain by two of its lengths. Chosen:
larger passes on rows that say little, smaller ends tracks nearer to the camera."""
SIZE_PERIOD_S = 0.1
"""Sizes are learnt from one frame in every such period of data time: boxes of the frames between
have the same errors. Chosen: longer learns sizes later, shorter costs time."""
PATH_HEIGHT_M = 0.8
"""Height of a box's centre where nothing is known of the vehicle: half the height of a car."""


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
    """Projects boxes to the road; satisfies `lanes.pipeline.GroundProjector`.

    The vehicle is a box on the road, turned the way it moves. The ground point is where its image
    explains the four edges of the observed box best (`vehicle_fit`). Length, width and height are
    learnt per track from the sides of its boxes (`vehicle_size`), the heading from its velocity
    (`track_velocity`). Both use the past only, so the result of a frame never changes.

    Without a recoverable camera pose (`pose_error` says why) the ground point is the middle of the
    box's lower edge, which lies up to half a vehicle's length nearer to the camera.

    Args:
        homography: The road plane.
        image_size: (width, height) of the image in pixels.
        reject_truncated: Leave out boxes cut by the image border. Otherwise they come flagged.
        max_sigma_m: Leave out rows whose 1-sigma ground error is larger.
        border_ratio: Share of the image's width and height that counts as its border.

    Attributes:
        calibration_report: What is to be said about the control points and their image.
        traffic: Looks whether the vehicles are what these inputs together can show.
        doubted: Set by who knows of something else that speaks against the boxes.
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
        self.calibration_report = calibration_report(homography, image_size)
        self.doubted = False
        try:
            self.pose = recover_pose(homography, image_size)
            self._projection = self.pose.projection
        except CalibrationError as error:
            self.pose_error = error
            self._projection = np.insert(homography.inverse, 2, 0.0, axis=1)
        self.traffic = TrafficCheck(homography, image_size, self.pose, self.pose_error)
        self.reset()

    @property
    def doubtful(self) -> bool:
        """Whether something speaks against trusting what is made of these tracks."""
        return self.doubted or self.calibration_report.doubtful or self.traffic.doubtful

    def reports(self, place: str) -> tuple[InputReport, InputReport]:
        """What is to be said about the calibration, and about the traffic of `place`."""
        traffic = InputReport(place, "vehicles", remarks=list(self.traffic.findings))
        return self.calibration_report, traffic

    def reset(self) -> None:
        """Forget all tracks, for a source that starts again at an earlier time."""
        self._slots = TrackSlots()
        self._motion = VelocityFilter(self._slots.capacity)
        self._sizes = SizeFilter(self._slots.capacity)
        self.traffic.reset()
        self._stamp_ns: int | None = None
        self._epoch_ns: int | None = None
        self._period = 0

    @property
    def tracks(self) -> int:
        """How many tracks are remembered: those seen in the last ten seconds."""
        return len(self._slots)

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame; see `lanes.pipeline.GroundProjector`.

        Raises:
            TableError: Rows of another dtype, or a stamp not later than the one before.
        """
        self._check_frame(stamp_ns, rows)
        if self._epoch_ns is None:
            self._epoch_ns = stamp_ns
        time_s = (stamp_ns - self._epoch_ns) * 1e-9
        period, self._period = self._period, int(time_s / SIZE_PERIOD_S)
        self._stamp_ns = stamp_ns
        self.traffic.add(stamp_ns, rows)
        rows, centre, side, truncated = self._usable_rows(rows)
        if not len(rows):
            return np.empty(0, dtype=TRACK_DTYPE)
        observed = (rows["flags"] & FLAG_PREDICTED) == 0
        solid = (rows["flags"] & FLAG_GROUND_POINT) == 0
        if self.pose is None:
            centre, solid = _foot(centre, side), np.zeros_like(solid)
            side = np.zeros_like(side)

        slot, fresh = self._slots.enter(stamp_ns, rows["track_id"])
        self._motion.reserve(self._slots.capacity)
        self._sizes.reserve(self._slots.capacity)
        size, size_cov = self._sizes.enter(slot, fresh, time_s, rows["class_id"])
        heading = self._motion.enter(slot, fresh)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            fit = fit_vehicles(self._projection, centre, side, heading, size, size_cov, solid)
        if self._period != period:
            usable = solid & observed & ~truncated & fit.good & ~np.isnan(heading)
            self._sizes.update(slot, time_s, rows, side, fit.side_px, fit.side_slope, usable)
        total = fit.covariance + self.homography.fit_covariance(centre)
        if self.pose is None:
            total[:, (0, 1), (0, 1)] += (size[:, 1:2] / 2) ** 2
        sigma, noise = worst_sigma(total), worst_sigma(fit.noise)
        # A vehicle of unknown size moves all the same, and its size is learnt with its heading:
        # only the noise of the box decides whether a position is any use for the motion.
        observed &= noise <= self._max_sigma_m
        path, scale = self._path(fit.first_xy, size, solid)
        velocity, heading = self._motion.update(slot, time_s, path, noise, observed)
        velocity = velocity * scale

        out = np.empty(len(rows), dtype=TRACK_DTYPE)
        out["x"], out["y"] = fit.xy.T
        out["vx"], out["vy"] = velocity.T
        out["heading"], out["sigma"] = heading, sigma
        out["length"], out["width"] = size[:, 0], size[:, 1]
        out["flags"] = (rows["flags"] & FLAG_PREDICTED) | np.where(truncated, FLAG_TRUNCATED, 0)
        out["flags"] |= FLAG_DOUBTFUL if self.doubtful else 0
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

    def _path(self, first_xy: Array, size: Array, solid: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Positions (M, 2) for the motion filter and the scale (M, 1) of their velocities.

        While a vehicle's size is being learnt its ground point shifts, which isn't motion. The
        image of its body's centre on a plane of fixed height doesn't shift, and another height
        only scales that plane's path about the point below the camera.
        """
        if self.pose is None:
            return first_xy, np.ones((len(first_xy), 1))
        below = self.pose.position_m[:2]
        depth = self.pose.position_m[2] - np.where(solid, size[:, 2] / 2, PATH_HEIGHT_M)
        scale = (depth / (self.pose.position_m[2] - PATH_HEIGHT_M))[:, None]
        return below + (first_xy - below) / scale, scale

    def _check_frame(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        if rows.dtype != PIXEL_TRACK_DTYPE:
            raise TableError("tracked boxes", rows.dtype, str(PIXEL_TRACK_DTYPE))
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            raise TableError(
                "tracked boxes", f"stamp {stamp_ns} ns after {self._stamp_ns} ns", "a later stamp"
            )


def _foot(centre: Array, side: Array) -> Array:
    """Middle of the lower edge of boxes."""
    foot = centre.copy()
    foot[:, 1] += side[:, 1] / 2
    return foot
