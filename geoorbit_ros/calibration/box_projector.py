"""Where on the road each boxed vehicle stands: the centre of its footprint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import CameraPose, recover_pose
from geoorbit_ros.calibration.elementwise import worst_sigma
from geoorbit_ros.calibration.ground_filter import STATE_ROWS, Boxes, GroundFilter, GroundRows
from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.calibration.plausibility import TrafficCheck, calibration_report
from geoorbit_ros.calibration.track_waves import TrackMemory
from geoorbit_ros.calibration.vehicle_size import GROUP
from geoorbit_ros.core.errors import CalibrationError, TableError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.tables import (
    FLAG_DOUBTFUL,
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
    Frames,
    one_frame,
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
        self._size_px = np.array(image_size, dtype=np.float64)[:, None]
        self._border = border_ratio * self._size_px
        self._horizon = homography.matrix[2]
        lens = homography.lens
        self._lens = None if lens is None or lens.straight else lens
        self.calibration_report = calibration_report(homography, image_size)
        self.doubted = False
        try:
            self.pose = recover_pose(homography, image_size)
            projection, camera_m = self.pose.projection, self.pose.position_m
            self._filter = GroundFilter(projection, camera_m, max_sigma_m, self._lens)
        except CalibrationError as error:
            self.pose_error = error
            projection = np.insert(homography.inverse, 2, 0.0, axis=1)
            self._filter = GroundFilter(projection, None, max_sigma_m, self._lens)
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
        self._memory = TrackMemory(STATE_ROWS)
        self.traffic.reset()
        self._stamp_ns: int | None = None
        self._epoch_ns: int | None = None
        self._period = 0

    @property
    def tracks(self) -> int:
        """How many tracks are remembered: those seen in the last ten seconds."""
        return len(self._memory)

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame; see `lanes.pipeline.GroundProjector`.

        Raises:
            TableError: Rows of another dtype, or a stamp not later than the one before.
        """
        return self.project_block(one_frame(stamp_ns, rows)).rows

    def project_block(self, frames: Frames) -> Frames:
        """Project many frames together, in a fraction of the time; see `lanes.pipeline`.

        The bytes are those of one frame after the other, and so is what is remembered.

        Raises:
            TableError: Rows of another dtype, or a stamp not later than the one before.
        """
        self._check_frames(frames)
        if not len(frames):
            return Frames(frames.stamp_ns, frames.offset, np.empty(0, dtype=TRACK_DTYPE))
        doubtful = self.traffic.add(frames)
        return self.with_bends(with_doubts(self.place_block(frames), doubtful))

    @property
    def bent(self) -> bool:
        """Whether the road was known not to be the plane in some frame of the latest block."""
        return any(stretches for _, stretches in self.traffic.bends)

    def with_bends(self, frames: Frames) -> Frames:
        """Ground tracks of the latest block with the error that a bent road adds to them.

        A stretch that lies higher or lower than the plane puts vehicles too far or too near by the
        same share of their distance from the camera.
        """
        if self.pose is None or not self.bent:
            return frames
        rows, camera = frames.rows, self.pose.position_m
        distance_m = np.hypot(rows["x"] - camera[0], rows["y"] - camera[1])
        ends = [*(frame for frame, _ in self.traffic.bends[1:]), len(frames)]
        for (first, stretches), last in zip(self.traffic.bends, ends, strict=True):
            part = slice(int(frames.offset[first]), int(frames.offset[last]))
            for stretch in stretches:
                here = distance_m[part]
                inside = (here >= stretch.near_m) & (here < stretch.far_m)
                added = np.where(inside, abs(stretch.bend) * here, 0.0)
                rows["sigma"][part] = np.hypot(rows["sigma"][part], added)
        return frames

    def place_block(self, frames: Frames) -> Frames:
        """As `project_block`, without a look at whether the traffic is what the inputs can show.

        That needs all boxes, and nothing of what is computed here: a second process can do it.

        Args:
            frames: At least one frame.
        """
        stamps = frames.stamp_ns
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps[0])
        time_s = (stamps - self._epoch_ns).astype(np.float64) * 1e-9
        period = (time_s / SIZE_PERIOD_S).astype(np.int64)
        sampled = period != np.concatenate(([self._period], period[:-1]))
        self._stamp_ns, self._period = int(stamps[-1]), int(period[-1])
        doubtful = self.doubted or self.calibration_report.doubtful
        frame = np.arange(len(stamps)).repeat(frames.offset[1:] - frames.offset[:-1])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            kept, truncated = self._usable_rows(frames.rows)
            frame, found = frame[kept], np.empty(0, dtype=TRACK_DTYPE)
            if len(kept):
                waves = self._memory.enter(stamps[frame], frames.rows["track_id"][kept])
                at, row = frame[waves.order], kept[waves.order]
                rows, cut = frames.rows.take(row), truncated[row]
                boxes = self._boxes(rows, cut, time_s[at], sampled[at])
                ground = self._filter.run(waves, boxes)
                self._memory.leave(waves, self._stamp_ns)
                sigma = self._sigma(boxes, ground)
                place = np.empty(len(kept), dtype=np.intp)
                place[waves.order] = np.arange(len(kept))
                place = place[sigma[place] <= self._max_sigma_m]
                found = _table(rows, cut, doubtful, sigma, ground).take(place)
                frame = at[place]
        self.counts.too_uncertain += len(kept) - len(found)
        self.counts.returned += len(found)
        offset = np.zeros_like(frames.offset)
        np.bincount(frame, minlength=len(stamps)).cumsum(out=offset[1:])
        return Frames(stamps, offset, found)

    def _usable_rows(self, rows: NDArray[np.void]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Which rows (M,) show the road, and which of all rows (N,) are truncated."""
        box = _columns(rows, ("x", "y", "width", "height"))
        finite = np.isfinite(box).all(axis=0)
        centre, half = box[:2], box[2:] / 2
        cut = (centre - half < self._border) | (centre + half > self._size_px - self._border)
        truncated = cut.any(axis=0) & ((rows["flags"] & FLAG_GROUND_POINT) == 0)
        truncated |= (rows["flags"] & FLAG_TRUNCATED) != 0
        inside = finite & ~truncated if self._reject_truncated else finite
        point = centre if self.pose is not None else _foot(centre, box[2:])
        x, y = point if self._lens is None else self._lens.undistort_columns(point)
        kept = inside & (self._horizon[0] * x + self._horizon[1] * y + self._horizon[2] > 0)
        self.counts.rows += len(rows)
        self.counts.not_finite += int((~finite).sum())
        self.counts.truncated += int((finite & ~inside).sum())
        self.counts.above_horizon += int((inside & ~kept).sum())
        return kept.nonzero()[0], truncated

    def _boxes(
        self,
        rows: NDArray[np.void],
        truncated: NDArray[np.bool_],
        time_s: Array,
        sampled: NDArray[np.bool_],
    ) -> Boxes:
        """Usable rows (M,) for the filter; without a pose, all are ground points."""
        centre, side = _columns(rows, ("x", "y")), _columns(rows, ("width", "height"))
        observed = (rows["flags"] & FLAG_PREDICTED) == 0
        solid = (rows["flags"] & FLAG_GROUND_POINT) == 0
        if self.pose is None:
            centre, solid = _foot(centre, side), np.zeros_like(solid)
            side = np.zeros_like(side)
        group, score = GROUP[rows["class_id"] & 255], rows["score"].astype(np.float64)
        whole = solid & observed & ~truncated
        return Boxes(time_s, centre, side, group, score, solid, observed, whole, sampled)

    def _sigma(self, boxes: Boxes, ground: GroundRows) -> Array:
        """(M,) 1-sigma ground error with that of the road plane, metres."""
        plane = self.homography.fit_covariance(boxes.centre.T)
        covariance = ground.covariance + plane.transpose(1, 2, 0)
        if self.pose is None:
            covariance[(0, 1), (0, 1)] += (ground.size[1] / 2) ** 2
        return worst_sigma(covariance)

    def _check_frames(self, frames: Frames) -> None:
        if frames.rows.dtype != PIXEL_TRACK_DTYPE:
            raise TableError("tracked boxes", frames.rows.dtype, str(PIXEL_TRACK_DTYPE))
        before_ns = self._stamp_ns
        if before_ns is not None and len(frames) and frames.stamp_ns[0] <= before_ns:
            found = f"stamp {frames.stamp_ns[0]} ns after {before_ns} ns"
            raise TableError("tracked boxes", found, "a later stamp")


def with_doubts(frames: Frames, doubtful: NDArray[np.bool_]) -> Frames:
    """Frames of `TRACK_DTYPE`, their rows flagged where a frame (F,) is doubtful."""
    if doubtful.any():
        frames.rows["flags"][np.repeat(doubtful, np.diff(frames.offset))] |= FLAG_DOUBTFUL
    return frames


def _columns(rows: NDArray[np.void], names: tuple[str, ...]) -> Array:
    """Columns of a table as (len(names), N) float64."""
    return np.array([rows[name] for name in names], dtype=np.float64)


def _foot(centre: Array, side: Array) -> Array:
    """Middle of the lower edge (2, N) of boxes."""
    return np.stack((centre[0], centre[1] + side[1] / 2))


def _table(
    rows: NDArray[np.void],
    truncated: NDArray[np.bool_],
    doubtful: bool,
    sigma: Array,
    ground: GroundRows,
) -> NDArray[np.void]:
    """(M,) `TRACK_DTYPE` of `PIXEL_TRACK_DTYPE` rows and what came out for them."""
    out = np.empty(len(rows), dtype=TRACK_DTYPE)
    out["x"], out["y"] = ground.xy
    out["vx"], out["vy"] = ground.velocity
    out["heading"], out["sigma"] = ground.heading, sigma
    out["length"], out["width"] = ground.size[:2]
    out["flags"] = rows["flags"] & np.uint32(FLAG_PREDICTED | FLAG_GROUND_POINT)
    out["flags"] |= np.where(truncated, np.uint32(FLAG_TRUNCATED), np.uint32(0))
    out["flags"] |= np.uint32(FLAG_DOUBTFUL if doubtful else 0)
    for name in ("score", "class_id", "track_id"):
        out[name] = rows[name]
    return out
